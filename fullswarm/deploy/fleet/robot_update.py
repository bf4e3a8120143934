"""Updates one robot: install, stage, switch under guard, then commit it healthy or roll it back.

Each step may be repeated: a robot that has it already says so. What a robot refuses raises `Refused`. After the switch
the link may be gone for a while; the robot's own guard rolls back what is not committed in time.
"""

from __future__ import annotations

import asyncio
import gzip
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import gettempdir
from typing import Literal

from fullswarm.deploy.fleet.facts import Facts, Health, facts_of
from fullswarm.deploy.fleet.login import Address, Login
from fullswarm.deploy.fleet.releases import Archives, choose_release, missing_of, size_of
from fullswarm.deploy.fleet.remote import Answer, LinkBroke, Remote, clean, strict_json
from fullswarm.deploy.fleet.rollout import Outcome, Stage
from fullswarm.deploy.release.keys import verify_release
from fullswarm.deploy.release.manifest import Manifest
from fullswarm.deploy.release.store import Store, head_archive, roots_archive
from fullswarm.errors import FullswarmError, MessageError, Unreachable

UNPACK = 'd=$(mktemp -d) && trap "rm -rf $d" EXIT && tar -xf - -C "$d" && sh "$d/install.sh"'
ADMIT = """umask 077; mkdir -p "$HOME/.ssh" && cd "$HOME/.ssh" && IFS= read -r k || exit 1
grep -qxF "$k" authorized_keys 2>/dev/null && exit 0
[ -s authorized_keys ] && [ -n "$(tail -c 1 authorized_keys)" ] && echo >> authorized_keys
printf '%s\\n' "$k" >> authorized_keys"""
INSTALL_S, WANT_S, RECEIVE_S, SWITCH_S = 180.0, 180.0, 240.0, 150.0
"""Time limits of the steps after all was sent, on the slowest supported card."""
LACKS, REFUSED, WENT_BACK = 1, 3, 4
POLL_S = 0.5
STEADY_S = 2.0
"""Must be healthy for so long without interruption: an agent may start and crash."""
FAULT_S = 5.0
"""A fault that lasts so long will not clear on its own."""
AFTER_GUARD_S = 20.0
"""Time within which a robot has rolled back after its guard expired, restart of the old agent included."""
SHIP_ATTEMPTS = 4
AGAIN_S = 1.0
POLL_S = 0.5
SILENT_S = 30.0
"""Time within which a restarted agent reports its health, on the slowest card too."""
SICK_S = 5.0
"""A cause that keeps an agent unhealthy for so long, for example a core that is not started, may persist."""


class Refused(FullswarmError):
    """The robot refused, and nothing has changed on it."""

    exit_code = 3


class RolledBack(FullswarmError):
    """The robot tried the release, its agent did not start, and it runs the previous one again."""


def check_installed(facts: Facts, robot: str) -> None:
    """Raise when fullswarm is not installed on a robot."""
    if not facts.installed:
        hint = f"`fullswarm deploy {robot}` installs it"
        raise FullswarmError("fullswarm is not installed on it", where=robot, hint=hint)


def check_idle(facts: Facts, robot: str, *, force: bool) -> None:
    """Raise `Refused` when a robot does what a restart of its agent would end."""
    if facts.busy_with and not force:
        raise Refused(f"it is {facts.busy_with}", where=robot, hint="stop it (`fullswarm stop`) first, or --force")


async def authorize_fleet_key(remote: Remote, public_key: str) -> None:
    """Add the fleet's key to the authorized keys of the user."""
    answer = await remote.run(ADMIT, feed=f"{public_key}\n".encode())
    _check_answer(answer, remote, "cannot write ~/.ssh/authorized_keys")


async def install_package(remote: Remote, archive: bytes, *, installed: bool) -> None:
    """Install a support package: our program, units, rules, the fleet file; restart only what changed."""
    if installed:  # sudo allows this program only
        answer = await remote.program("install", feed=archive, within_s=INSTALL_S)
    else:
        answer = await remote.as_root(f"sh -c {shlex.quote(UNPACK)}", feed=archive, within_s=INSTALL_S)
    _check_answer(answer, remote, "the installer failed")


async def send_roots(remote: Remote, roots: Sequence[str], facts: Facts) -> None:
    """Send the versions of the root metadata that a robot lacks; each must be signed by keys that it trusts."""
    have = facts.root_version
    if have is None or have >= len(roots):
        return
    answer = await remote.program("trust", feed=roots_archive(roots[have:], have + 1))
    _check_answer(answer, remote, "does not accept the new root metadata")


async def ship_release(remote: Remote, release: Path, parcels: Archives, facts: Facts) -> None:
    """Copy a release to a robot, beside the one that it runs; after a broken link only what is still missing."""
    name = Manifest.read(release).id
    nearest = ("--from", facts.current) if facts.current else ()
    # Compressed, because hashes are sent in hexadecimal.
    head, size = gzip.compress(head_archive(release), mtime=0), size_of(release)
    answer = await remote.program("want", name, *nearest, "--bytes", str(size), feed=head, within_s=WANT_S)
    _check_answer(answer, remote, "does not accept the release")
    # A file that it shares with the release it runs may be damaged: then it requests that one, too.
    for _ in range(2):
        missing = missing_of(release, answer.out, remote.robot)
        if not missing and name in facts.releases:
            return  # it has it, and its statement is the new one
        archive = await parcels.of(release, missing, zstd=facts.zstd)
        answer = await remote.program("receive", name, feed=archive, within_s=RECEIVE_S)
        if answer.code != LACKS or not answer.out.strip():
            break
    _check_answer(answer, remote, "received the release incompletely")


async def switch_release(remote: Remote, release: str, guard_s: float, *, force: bool) -> None:
    """Make a release the current one; the robot rolls back on its own unless it is committed in `guard_s`."""
    forced = ("--force",) if force else ()
    answer = await remote.program("switch", release, "--guard", f"{guard_s:.0f}", *forced, within_s=SWITCH_S)
    _check_answer(answer, remote, "did not switch")


async def read_health(remote: Remote) -> tuple[Health | None, str]:
    """Read the agent's health; without a fresh report: None and why."""
    answer = await remote.program("health", within_s=10.0)
    if answer.code == 0:
        health = strict_json(answer.out, Health, remote.robot)
        return health, "; ".join(health.why) or ("" if health.healthy else "not healthy, without a reason")
    return None, answer.words


async def commit_release(remote: Remote, release: str) -> None:
    """Keep what it runs: remove its guard and its pending mark."""
    _check_answer(await remote.program("commit", release), remote, "cannot commit the release")


async def roll_back(remote: Remote, because: str) -> str | None:
    """Roll back to the previous release; return what it runs now."""
    answer = await remote.program("rollback", "--because", because[:200], within_s=SWITCH_S)
    if answer.code != WENT_BACK:
        _check_answer(answer, remote, "cannot roll back")
    return (await facts_of(remote)).current


def _check_answer(answer: Answer, remote: Remote, what: str) -> None:
    if answer.code == 0:
        return
    if answer.code == REFUSED:
        raise Refused(answer.words, where=remote.robot)
    if answer.code == WENT_BACK:
        raise RolledBack(answer.words, where=remote.robot)
    if b": busy: " in answer.err[-4096:]:
        # After a broken link the robot may still serve the old connection.
        raise LinkBroke(answer.words, where=remote.robot, hint="try again")
    if answer.code < 0:  # killed: it may have done its work, or a part of it
        raise LinkBroke(f"{what}: it was killed", where=remote.robot, hint="try again")
    if answer.code == 127:
        raise MessageError(
            "fullswarm-robot is not installed", where=remote.robot, hint=f"`fullswarm deploy {remote.robot}`"
        )
    raise FullswarmError(f"{what}: {answer.words}", where=remote.robot)


# ---------------------------------------------------------------- after the switch
@dataclass(frozen=True, slots=True)
class Verdict:
    """healthy: committed; back: on the previous release; never: it has not switched; lost: still unknown."""

    state: Literal["healthy", "back", "never", "lost"]
    why: str = ""


@dataclass(slots=True)
class SwitchWatch:
    """Polls one robot from its switch on.

    Parameters
    ----------
    guard_s
        When the robot rolls back on its own. The base decides after two thirds of it, because it knows the reason.
    switched
        It has confirmed the switch; else the link broke, and this must be found out.
    rollback_before
        The robot's last rollback before the switch.
    """

    login: Login
    address: Address
    release: str
    guard_s: float
    switched: bool = False
    rollback_before: str | None = None
    _why: str = field(default="no report yet", init=False)
    _good_since_s: float | None = field(default=None, init=False)
    _fault_since_s: float | None = field(default=None, init=False)

    async def until_settled(self) -> Verdict:
        """Wait until it is healthy, and commit; else roll it back; or see that it has rolled back on its own."""
        now = asyncio.get_running_loop().time
        began_s = now()
        while now() < began_s + self.guard_s + AFTER_GUARD_S:
            try:
                async with self.login.connect(self.address) as remote:
                    verdict = await self._over(remote, began_s + self.guard_s * 2 / 3)
                    if verdict is not None:
                        return verdict
            except FullswarmError as error:  # retried until the guard has expired
                self._why, self._good_since_s = error.what, None
            await asyncio.sleep(POLL_S)
        return Verdict("lost", self._why)

    async def _over(self, remote: Remote, judge_s: float) -> Verdict | None:
        """Watch over one connection; None: it answered, but its state is not final."""
        now = asyncio.get_running_loop().time
        gone = await self._if_not_running(remote)
        while gone is None:
            health, why = await read_health(remote)
            self._note(health, why, now())
            if self._good_since_s is not None and now() - self._good_since_s >= STEADY_S:
                await commit_release(remote, self.release)
                return Verdict("healthy")
            if health is None or health.release != self.release:
                gone = await self._if_not_running(remote)
            elif self._fault_since_s is not None and now() - self._fault_since_s >= FAULT_S:
                return await self._roll_back(remote)
            if gone is None and now() >= judge_s:
                return await self._roll_back(remote)
            await asyncio.sleep(POLL_S)
        return gone

    def _note(self, health: Health | None, why: str, now_s: float) -> None:
        mine = health is not None and health.release == self.release
        good = mine and health is not None and health.healthy
        self._good_since_s = (self._good_since_s or now_s) if good else None
        faulty = mine and health is not None and health.lifecycle == "FAULT"
        self._fault_since_s = (self._fault_since_s or now_s) if faulty else None
        if not good:
            self._why = why

    async def _if_not_running(self, remote: Remote) -> Verdict | None:
        """Return the verdict when the release does not run: rolled back on its own, or never switched to."""
        facts = await facts_of(remote)
        if facts.current == self.release:
            self.switched = True
            # Nothing pending: the commit was received, and only its answer was lost.
            return None if facts.pending else Verdict("healthy")
        if not self.switched and facts.last_rollback == self.rollback_before:
            return Verdict("never")
        return Verdict("back", f"rolled back on its own: {facts.rollback_reason or self._why}")

    async def _roll_back(self, remote: Remote) -> Verdict:
        try:
            await roll_back(remote, self._why)
        except Unreachable:
            raise
        except FullswarmError as error:
            return Verdict("lost", f"{self._why}; {error.what}")
        return Verdict("back", self._why)


# ---------------------------------------------------------------- one robot of a rollout
@dataclass(frozen=True, slots=True)
class SupportPackage:
    """The support package of one robot; `name` is what the robot reports when it is installed."""

    archive: bytes
    name: str


@dataclass(slots=True)
class RobotUpdater:
    """Performs the steps of an update or a first install on robots.

    Parameters
    ----------
    named
        The release to install; None: the newest one that fits each robot.
    packages
        By robot; empty: change nothing outside the releases.
    needs
        By robot: the extras that its release must have.
    signers
        Text of ``allowed_signers``: the keys whose releases may leave this machine.
    roots
        All versions of the root metadata: robots get those that they lack.
    public_key
        Of the fleet: added where the user's own key was needed to log in.
    guard_s
        A robot rolls back on its own so long after its switch, unless the release is committed.
    """

    login: Login
    addresses: Mapping[str, Address]
    store: Store
    parcels: Archives
    progress: Callable[[str], None]
    signers: str
    roots: Sequence[str] = ()
    named: str | None = None
    target: str | None = None
    packages: Mapping[str, SupportPackage] = field(default_factory=dict)
    needs: Mapping[str, frozenset[str]] = field(default_factory=dict)
    public_key: str = ""
    guard_s: float = 60.0
    force: bool = False
    releases: dict[str, Path] = field(default_factory=dict)
    before: dict[str, str | None] = field(default_factory=dict)
    shipped: dict[str, int] = field(default_factory=dict)
    changed: dict[str, tuple[str, ...]] = field(default_factory=dict)
    _verified: dict[Path, asyncio.Task[None]] = field(default_factory=dict)

    async def __call__(self, robot: str, stage: Stage) -> Outcome:
        """Perform a step; an error becomes an outcome, so that it does not end the work on other robots."""
        staging = stage is Stage.STAGING
        try:
            outcome = await (self._stage(robot) if staging else self._switch(robot))
        except Refused as error:
            # Before the switch it refuses the release; at the switch, the moment.
            mend = error.hint or ("" if staging else "stop it (`fullswarm stop`) and update again, or --force")
            outcome = Outcome(Stage.FAILED if staging else Stage.REFUSED, error.what, mend, exit_code=error.exit_code)
        except Unreachable as error:
            outcome = Outcome(Stage.UNREACHABLE, error.what, error.hint, exit_code=error.exit_code)
        except FullswarmError as error:
            outcome = Outcome(Stage.FAILED, error.what, error.hint, exit_code=error.exit_code)
        except OSError as error:  # of our own disk: errors of links are above
            what = f"this computer could not read or pack the release: {error.strerror or error}"
            outcome = Outcome(Stage.FAILED, what, f"is its disk full? `df -h {gettempdir()}`; then update again")
        return replace(
            outcome,
            release=outcome.release or self.before.get(robot) or "",
            shipped_bytes=self.shipped.get(robot, 0),
            changed=self.changed.get(robot, ()),
        )

    async def preview(self, robot: str) -> Outcome:
        """Return what would be done, without doing it."""
        try:
            async with self.login.connect(self.addresses[robot]) as remote:
                facts = await facts_of(remote)
            name = Manifest.read(self._choose(robot, facts)).id
        except FullswarmError as error:
            return Outcome(Stage.WAITING, error.what, error.hint, exit_code=error.exit_code)
        package = self.packages.get(robot)
        todo = (
            ["install" if not facts.installed else "set up again"]
            if package is not None and facts.kit != package.name
            else []
        )
        if facts.current != name or not facts.settled:
            todo += [f"switch to {name}"] if name in facts.releases else [f"ship {name}", "switch to it"]
        if facts.busy_with and todo:
            return Outcome(Stage.WAITING, f"would be refused: it is {facts.busy_with}", release=facts.current or "")
        what = "would " + ", ".join(todo) if todo else "nothing to do"
        return Outcome(Stage.WAITING, what, release=facts.current or "", exit_code=0)

    def _choose(self, robot: str, facts: Facts) -> Path:
        return choose_release(self.store, self.named, facts, robot, self.target, self.needs.get(robot, frozenset()))

    # ------------------------------------------------------------ staging: no effect on what runs
    async def _stage(self, robot: str) -> Outcome:
        for attempt in range(1, SHIP_ATTEMPTS + 1):
            try:
                return await self._stage_once(robot)
            except LinkBroke as error:
                if attempt == SHIP_ATTEMPTS:
                    raise
                self.progress(f"{robot}: {error.what}; continuing with what is missing")
                await asyncio.sleep(AGAIN_S * attempt)
        raise AssertionError("the last attempt has raised or returned")

    async def _stage_once(self, robot: str) -> Outcome:
        async with self.login.connect(self.addresses[robot]) as remote:
            facts = await facts_of(remote)
            self.before.setdefault(robot, facts.current)
            folder = self._choose(robot, facts)
            self.releases[robot], name = folder, Manifest.read(folder).id
            try:
                await send_roots(remote, self.roots, facts)
                facts = await self._install(remote, facts)
                if facts.current == name and facts.settled:
                    return await self._current(remote, facts, name)
                await self._verify(folder)
                if name not in facts.releases:
                    self.progress(f"{robot}: shipping {name}")
                await ship_release(remote, folder, self.parcels, facts)
            finally:
                self.shipped[robot] = self.shipped.get(robot, 0) + remote.sent_bytes
        self.progress(f"{robot}: has {name}")
        return Outcome(Stage.STAGED, f"has {name}, runs {facts.current or 'nothing'}")

    async def _verify(self, folder: Path) -> None:
        """Verify a release once, all its files; robots verify only the files that they lack."""
        if folder not in self._verified:
            self._verified[folder] = asyncio.create_task(asyncio.to_thread(verify_release, folder, self.signers))
        await asyncio.shield(self._verified[folder])

    async def _install(self, remote: Remote, facts: Facts) -> Facts:
        package = self.packages.get(remote.robot)
        if package is None:
            check_installed(facts, remote.robot)
            return facts
        if remote.own_key:
            await authorize_fleet_key(remote, self.public_key)
        if facts.installed and facts.kit == package.name:
            return facts
        check_idle(facts, remote.robot, force=self.force)  # new settings restart its agent
        self.progress(f"{remote.robot}: installing")
        await install_package(remote, package.archive, installed=facts.installed)
        now = await facts_of(remote)
        if now.kit != package.name:
            hint = "read-only root file system, or another program that writes there? deploy again"
            raise FullswarmError("its installer reported success, but its files differ", hint=hint)
        self.changed[remote.robot] = ("installed" if not facts.installed else "set up again",)
        return now

    async def _current(self, remote: Remote, facts: Facts, release: str) -> Outcome:
        """Check that the release, which it has already, runs; an agent that was restarted gets time."""
        now = asyncio.get_running_loop().time
        began_s, restarts = now(), facts.agent.restarts
        while why := _why_unhealthy(facts, release):
            runs = _runs(facts, release) and facts.agent.restarts == restarts
            if now() - began_s >= (SICK_S if runs else SILENT_S):
                break
            await asyncio.sleep(POLL_S)
            facts = await facts_of(remote)
        if why and not runs:
            raise FullswarmError(f"its agent does not run: {why}", hint=f"`fullswarm logs {remote.robot}`")
        changed = ", ".join(self.changed.get(remote.robot, ())) or "nothing was changed"
        what = f"runs it already; {changed}{f'; not healthy: {why}' if why else ''}"
        return Outcome(Stage.CURRENT, what, release=release)

    # ------------------------------------------------------------ the switch
    async def _switch(self, robot: str) -> Outcome:
        release, before = Manifest.read(self.releases[robot]).id, self.before.get(robot)
        self.progress(f"{robot}: switching to {release}")
        watch = SwitchWatch(self.login, self.addresses[robot], release, self.guard_s)
        async with self.login.connect(self.addresses[robot]) as remote:
            watch.rollback_before = (await facts_of(remote)).last_rollback
            try:
                await switch_release(remote, release, self.guard_s, force=self.force)
                watch.switched = True
            except RolledBack as error:
                return _rolled_back(error.what, before)
            except Unreachable:
                pass  # it may have switched: watching its health shows it
        verdict = await watch.until_settled()
        self.progress(f"{robot}: {verdict.state}{f': {verdict.why}' if verdict.why else ''}")
        return _judged(verdict, release, before)


def _runs(facts: Facts, release: str) -> bool:
    """Return whether its agent runs and reports this release."""
    return facts.agent.active and facts.health is not None and facts.health.release == release


def _why_unhealthy(facts: Facts, release: str) -> str:
    health = facts.health
    if not facts.agent.active:
        return f"{clean(facts.agent.state, 60) or 'not started'}, restarted {facts.agent.restarts} times"
    if health is None:
        return "it reports no health"
    if health.release != release:
        return f"it still runs {clean(health.release or 'another release', 60)}"
    return "" if health.healthy else clean("; ".join(health.why)) or "without a reason"


def _judged(verdict: Verdict, release: str, before: str | None) -> Outcome:
    if verdict.state == "healthy":
        return Outcome(Stage.HEALTHY, f"runs {release}", release=release)
    if verdict.state == "back":
        return _rolled_back(verdict.why, before)
    if verdict.state == "never":
        return Outcome(Stage.UNREACHABLE, "the link broke before it switched", "update again", before or "")
    what = f"silent since the switch ({verdict.why})" if verdict.why else "silent since the switch"
    return Outcome(Stage.LOST, what, f"its guard rolls it back to {before or 'nothing'}; `fullswarm fleet` later")


def _rolled_back(why: str, before: str | None) -> Outcome:
    what = clean(why) or "it was not healthy in time"
    return Outcome(Stage.ROLLED_BACK, what, "see `fullswarm logs`; fix it, bundle, update again", before or "none")
