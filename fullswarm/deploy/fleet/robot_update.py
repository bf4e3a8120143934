"""Updates one robot: install, stage, switch under guard, then commit it healthy or roll it back.

Each step may be repeated: a robot that has it already says so. What a robot refuses raises `Refused`. After the switch
the link may be gone for a while; the robot's own guard rolls back what is not committed in time.
"""

from __future__ import annotations

import asyncio
import gzip
import shlex
from collections.abc import Callable, Mapping
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
from fullswarm.deploy.release.store import Store, head_archive
from fullswarm.errors import FullswarmError, MessageError, Unreachable

UNPACK = 'd=$(mktemp -d) && trap "rm -rf $d" EXIT && tar -xf - -C "$d" && sh "$d/install.sh"'
ADMIT = """umask 077; mkdir -p "$HOME/.ssh" && cd "$HOME/.ssh" && IFS= read -r k || exit 1
grep -qxF "$k" authorized_keys 2>/dev/null && exit 0
[ -s authorized_keys ] && [ -n "$(tail -c 1 authorized_keys)" ] && echo >> authorized_keys
printf '%s\\n' "$k" >> authorized_keys"""
INSTALL_S, WANT_S, RECEIVE_S, SWITCH_S = 180.0, 180.0, 240.0, 150.0
"""The longest a step may take after all was sent, on the slowest card that we would wait for."""
LACKS, REFUSED, WENT_BACK = 1, 3, 4
POLL_S = 0.5
STEADY_S = 2.0
"""Healthy for so long in one piece: an agent that comes up and dies again is not."""
FAULT_S = 5.0
"""A fault that stays so long will not go by itself."""
AFTER_GUARD_S = 20.0
"""A robot has gone back by itself so long after its guard fired, restart of the old agent included."""
SHIP_ATTEMPTS = 4
AGAIN_S = 1.0
POLL_S = 0.5
SILENT_S = 30.0
"""An agent that was restarted says how it is within this time, on the slowest card too."""
SICK_S = 5.0
"""What keeps an agent from being healthy for so long, a core that is not started, for example, may stay."""


class Refused(FullswarmError):
    """The robot said no, and nothing has changed there."""

    exit_code = 3


class RolledBack(FullswarmError):
    """The robot tried the release, its agent did not start, and it runs the one before again."""


async def authorize_fleet_key(remote: Remote, public_key: str) -> None:
    """Let the fleet's key in from now on."""
    answer = await remote.run(ADMIT, feed=f"{public_key}\n".encode())
    _check_answer(answer, remote, "cannot write ~/.ssh/authorized_keys")


async def install_package(remote: Remote, archive: bytes, *, installed: bool) -> None:
    """Spread a kit: our program, units, rules, the fleet file. Restarts nothing that it need not."""
    if installed:  # the one program that a plain user may run as root
        answer = await remote.program("install", feed=archive, within_s=INSTALL_S)
    else:
        answer = await remote.as_root(f"sh -c {shlex.quote(UNPACK)}", feed=archive, within_s=INSTALL_S)
    _check_answer(answer, remote, "the installer failed")


async def ship_release(remote: Remote, release: Path, parcels: Archives, facts: Facts) -> None:
    """Bring a release to a robot, beside the one that it runs. After a cut: only what is still missing."""
    name = Manifest.read(release).id
    nearest = ("--from", facts.current) if facts.current else ()
    # Hashes in hex: half of them is air.
    head, size = gzip.compress(head_archive(release), mtime=0), size_of(release)
    answer = await remote.program("want", name, *nearest, "--bytes", str(size), feed=head, within_s=WANT_S)
    _check_answer(answer, remote, "does not take the release")
    # A file that it has of the release that it runs may turn out to be damaged there: then it asks for that one, too.
    for _ in range(2):
        missing = missing_of(release, answer.out, remote.robot)
        archive = await parcels.of(release, missing, zstd=facts.zstd)
        answer = await remote.program("receive", name, feed=archive, within_s=RECEIVE_S)
        if answer.code != LACKS or not answer.out.strip():
            break
    _check_answer(answer, remote, "did not get the release whole")


async def switch_release(remote: Remote, release: str, guard_s: float, *, force: bool) -> None:
    """Make a release the current one; the robot goes back by itself unless it is committed in `guard_s`."""
    forced = ("--force",) if force else ()
    answer = await remote.program("switch", release, "--guard", f"{guard_s:.0f}", *forced, within_s=SWITCH_S)
    _check_answer(answer, remote, "did not switch")


async def read_health(remote: Remote) -> tuple[Health | None, str]:
    """Ask how the agent is; without a fresh word of the right release: None and why."""
    answer = await remote.program("health", within_s=10.0)
    if answer.code == 0:
        said = strict_json(answer.out, Health, remote.robot)
        return said, "; ".join(said.why) or ("" if said.healthy else "it says it is not healthy, and not why")
    return None, answer.words


async def commit_release(remote: Remote, release: str) -> None:
    """Keep what it runs: guard and pending mark are taken away."""
    _check_answer(await remote.program("commit", release), remote, "cannot be told to keep the release")


async def roll_back(remote: Remote, because: str) -> str | None:
    """Go back to the release before; return what it runs now."""
    answer = await remote.program("rollback", "--because", because[:200], within_s=SWITCH_S)
    if answer.code != WENT_BACK:
        _check_answer(answer, remote, "cannot go back")
    return (await facts_of(remote)).current


def _check_answer(answer: Answer, remote: Remote, what: str) -> None:
    if answer.code == 0:
        return
    if answer.code == REFUSED:
        raise Refused(answer.words, where=remote.robot)
    if answer.code == WENT_BACK:
        raise RolledBack(answer.words, where=remote.robot)
    if b": busy: " in answer.err[-4096:]:
        # After a cut the other end of the old link may not have noticed yet.
        raise LinkBroke(answer.words, where=remote.robot, hint="try again")
    if answer.code < 0:  # killed there, by whomever: it may have done its work, or a part of it
        raise LinkBroke(f"{what}: it was killed", where=remote.robot, hint="try again")
    if answer.code == 127:
        raise MessageError("our program is not there", where=remote.robot, hint=f"`fullswarm deploy {remote.robot}`")
    raise FullswarmError(f"{what}: {answer.words}", where=remote.robot)


# ---------------------------------------------------------------- after the switch
@dataclass(frozen=True, slots=True)
class Verdict:
    """healthy: committed; back: on the release before; never: it has not switched; lost: unknown yet."""

    state: Literal["healthy", "back", "never", "lost"]
    why: str = ""


@dataclass(slots=True)
class SwitchWatch:
    """Polls one robot from its switch on.

    Parameters
    ----------
    guard_s
        When the robot goes back by itself. The base judges a third of that before: it knows why.
    switched
        It has said that it switched; else the link broke, and that must be found out.
    rollback_before
        What the robot said of its last rollback before the switch.
    """

    login: Login
    address: Address
    release: str
    guard_s: float
    switched: bool = False
    rollback_before: str | None = None
    _why: str = field(default="nothing heard yet", init=False)
    _good_since_s: float | None = field(default=None, init=False)
    _fault_since_s: float | None = field(default=None, init=False)

    async def until_settled(self) -> Verdict:
        """Wait until it is healthy, and commit; else take it back; else see whether it has gone back by itself."""
        now = asyncio.get_running_loop().time
        began_s = now()
        while now() < began_s + self.guard_s + AFTER_GUARD_S:
            try:
                async with self.login.connect(self.address) as remote:
                    verdict = await self._over(remote, began_s + self.guard_s * 2 / 3)
                    if verdict is not None:
                        return verdict
            except FullswarmError as error:  # whatever it is: until the guard has fired, there is hope
                self._why, self._good_since_s = error.what, None
            await asyncio.sleep(POLL_S)
        return Verdict("lost", self._why)

    async def _over(self, remote: Remote, judge_s: float) -> Verdict | None:
        """Watch over one connection; None: it was there, and does not say yet."""
        now = asyncio.get_running_loop().time
        gone = await self._elsewhere(remote)
        while gone is None:
            said, why = await read_health(remote)
            self._note(said, why, now())
            if self._good_since_s is not None and now() - self._good_since_s >= STEADY_S:
                await commit_release(remote, self.release)
                return Verdict("healthy")
            if said is None or said.release != self.release:
                gone = await self._elsewhere(remote)
            elif self._fault_since_s is not None and now() - self._fault_since_s >= FAULT_S:
                return await self._take_back(remote)
            if gone is None and now() >= judge_s:
                return await self._take_back(remote)
            await asyncio.sleep(POLL_S)
        return gone

    def _note(self, said: Health | None, why: str, now_s: float) -> None:
        mine = said is not None and said.release == self.release
        good = mine and said is not None and said.healthy
        self._good_since_s = (self._good_since_s or now_s) if good else None
        faulty = mine and said is not None and said.lifecycle == "FAULT"
        self._fault_since_s = (self._fault_since_s or now_s) if faulty else None
        if not good:
            self._why = why

    async def _elsewhere(self, remote: Remote) -> Verdict | None:
        """It does not run the release: it went back by itself, or never got there."""
        facts = await facts_of(remote)
        if facts.current == self.release:
            self.switched = True
            # Nothing pending: our commit was heard, and only the answer was lost.
            return None if facts.pending else Verdict("healthy")
        if not self.switched and facts.last_rollback == self.rollback_before:
            return Verdict("never")
        return Verdict("back", f"went back by itself: {facts.back_because or self._why}")

    async def _take_back(self, remote: Remote) -> Verdict:
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
    """What stands on a robot outside every release, for one robot; `name` is what it says when it has it."""

    archive: bytes
    name: str


@dataclass(slots=True)
class RobotUpdater:
    """The hands of an update or a first install.

    Parameters
    ----------
    named
        The release that was asked for; None: the newest one that fits each robot.
    kits
        By robot; empty: leave what stands outside the releases alone.
    needs
        By robot: the extras that its release must have.
    signers
        Text of ``allowed_signers``: whose releases leave this machine.
    public_key
        Of the fleet: put where the user's own key got us in.
    guard_s
        A robot goes back by itself so long after its switch, unless it is told to stay.
    """

    login: Login
    addresses: Mapping[str, Address]
    store: Store
    parcels: Archives
    tell: Callable[[str], None]
    signers: str
    named: str | None = None
    target: str | None = None
    kits: Mapping[str, SupportPackage] = field(default_factory=dict)
    needs: Mapping[str, frozenset[str]] = field(default_factory=dict)
    public_key: str = ""
    guard_s: float = 60.0
    force: bool = False
    releases: dict[str, Path] = field(default_factory=dict)
    before: dict[str, str | None] = field(default_factory=dict)
    shipped: dict[str, int] = field(default_factory=dict)
    changed: dict[str, tuple[str, ...]] = field(default_factory=dict)
    _sound: dict[Path, asyncio.Task[None]] = field(default_factory=dict)

    async def __call__(self, robot: str, stage: Stage) -> Outcome:
        """Do what is due; every error of ours becomes an outcome, none ends the others' work."""
        staging = stage is Stage.STAGING
        try:
            outcome = await (self._stage(robot) if staging else self._switch(robot))
        except Refused as error:
            # Before the switch it minds the release, afterwards the moment.
            mend = error.hint or ("" if staging else "stop it (`fullswarm stop`) and update again, or --force")
            outcome = Outcome(Stage.FAILED if staging else Stage.REFUSED, error.what, mend, exit_code=error.exit_code)
        except Unreachable as error:
            outcome = Outcome(Stage.UNREACHABLE, error.what, error.hint, exit_code=error.exit_code)
        except FullswarmError as error:
            outcome = Outcome(Stage.FAILED, error.what, error.hint, exit_code=error.exit_code)
        except OSError as error:  # of our own disk: what a link says is one of the above
            what = f"this computer could not read or pack the release: {error.strerror or error}"
            outcome = Outcome(Stage.FAILED, what, f"is its disk full? `df -h {gettempdir()}`; then again")
        return replace(
            outcome,
            release=outcome.release or self.before.get(robot) or "",
            shipped_bytes=self.shipped.get(robot, 0),
            changed=self.changed.get(robot, ()),
        )

    async def look(self, robot: str) -> Outcome:
        """Tell what would be done, and do nothing."""
        try:
            async with self.login.connect(self.addresses[robot]) as remote:
                facts = await facts_of(remote)
            name = Manifest.read(self._choose(robot, facts)).id
        except FullswarmError as error:
            return Outcome(Stage.WAITING, error.what, error.hint, exit_code=error.exit_code)
        kit = self.kits.get(robot)
        todo = (
            ["install" if not facts.installed else "set up anew"] if kit is not None and facts.kit != kit.name else []
        )
        if facts.current != name or not facts.settled:
            todo += [f"switch to {name}"] if name in facts.releases else [f"ship {name}", "switch to it"]
        if facts.busy_with and todo:
            return Outcome(Stage.WAITING, f"would be refused: it is {facts.busy_with}", release=facts.current or "")
        what = "would " + ", ".join(todo) if todo else "nothing to do"
        return Outcome(Stage.WAITING, what, release=facts.current or "", exit_code=0)

    def _choose(self, robot: str, facts: Facts) -> Path:
        return choose_release(self.store, self.named, facts, robot, self.target, self.needs.get(robot, frozenset()))

    # ------------------------------------------------------------ no effect on what runs
    async def _stage(self, robot: str) -> Outcome:
        for attempt in range(1, SHIP_ATTEMPTS + 1):
            try:
                return await self._stage_once(robot)
            except LinkBroke as error:
                if attempt == SHIP_ATTEMPTS:
                    raise
                self.tell(f"{robot}: {error.what}; going on with what is missing")
                await asyncio.sleep(AGAIN_S * attempt)
        raise AssertionError("the last attempt has raised or returned")

    async def _stage_once(self, robot: str) -> Outcome:
        async with self.login.connect(self.addresses[robot]) as remote:
            facts = await facts_of(remote)
            self.before.setdefault(robot, facts.current)
            folder = self._choose(robot, facts)
            self.releases[robot], name = folder, Manifest.read(folder).id
            try:
                facts = await self._install(remote, facts)
                if facts.current == name and facts.settled:
                    return await self._current(remote, facts, name)
                await self._verify(folder)
                if name not in facts.releases:
                    self.tell(f"{robot}: shipping {name}")
                    await ship_release(remote, folder, self.parcels, facts)
            finally:
                self.shipped[robot] = self.shipped.get(robot, 0) + remote.sent_bytes
        self.tell(f"{robot}: has {name}")
        return Outcome(Stage.STAGED, f"has {name}, runs {facts.current or 'nothing'}")

    async def _verify(self, folder: Path) -> None:
        """Look once whether a release is whole and signed: robots look themselves, but at what they lack only."""
        if folder not in self._sound:
            self._sound[folder] = asyncio.create_task(asyncio.to_thread(verify_release, folder, self.signers))
        await asyncio.shield(self._sound[folder])

    async def _install(self, remote: Remote, facts: Facts) -> Facts:
        kit = self.kits.get(remote.robot)
        if kit is None:
            if not facts.installed:
                hint = f"`fullswarm deploy {remote.robot}` puts it there"
                raise FullswarmError("nothing of ours is installed there", where=remote.robot, hint=hint)
            return facts
        if remote.own_key:
            await authorize_fleet_key(remote, self.public_key)
        if facts.installed and facts.kit == kit.name:
            return facts
        if facts.busy_with and not self.force:
            # New settings restart its agent.
            raise Refused(f"it is {facts.busy_with}", where=remote.robot, hint="stop it first, or --force")
        self.tell(f"{remote.robot}: installing")
        await install_package(remote, kit.archive, installed=facts.installed)
        now = await facts_of(remote)
        if now.kit != kit.name:
            hint = "is its root file system read-only, or does another program write there? deploy again"
            raise FullswarmError("it says that it was set up, and its files are other ones", hint=hint)
        self.changed[remote.robot] = ("installed" if not facts.installed else "set up anew",)
        return now

    async def _current(self, remote: Remote, facts: Facts, release: str) -> Outcome:
        """It has what it should have: does it run? One that is well is not asked again, a restarted one gets time."""
        now = asyncio.get_running_loop().time
        began_s, restarts = now(), facts.agent.restarts
        while why := _why_not_well(facts, release):
            runs = _says(facts, release) and facts.agent.restarts == restarts
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
        self.tell(f"{robot}: switching to {release}")
        watch = SwitchWatch(self.login, self.addresses[robot], release, self.guard_s)
        async with self.login.connect(self.addresses[robot]) as remote:
            watch.rollback_before = (await facts_of(remote)).last_rollback
            try:
                await switch_release(remote, release, self.guard_s, force=self.force)
                watch.switched = True
            except RolledBack as error:
                return _rolled_back(error.what, before)
            except Unreachable:
                pass  # it may have switched: the watch over its health finds out
        verdict = await watch.until_settled()
        self.tell(f"{robot}: {verdict.state}{f': {verdict.why}' if verdict.why else ''}")
        return _judged(verdict, release, before)


def _says(facts: Facts, release: str) -> bool:
    """Whether its agent runs, and says so itself, of this release."""
    return facts.agent.active and facts.health is not None and facts.health.release == release


def _why_not_well(facts: Facts, release: str) -> str:
    said = facts.health
    if not facts.agent.active:
        return f"{clean(facts.agent.state, 60) or 'not started'}, restarted {facts.agent.restarts} times"
    if said is None:
        return "it says nothing of its health"
    if said.release != release:
        return f"it still runs {clean(said.release or 'another release', 60)}"
    return "" if said.healthy else clean("; ".join(said.why)) or "it gives no reason"


def _judged(verdict: Verdict, release: str, before: str | None) -> Outcome:
    if verdict.state == "healthy":
        return Outcome(Stage.HEALTHY, f"runs {release}", release=release)
    if verdict.state == "back":
        return _rolled_back(verdict.why, before)
    if verdict.state == "never":
        return Outcome(Stage.UNREACHABLE, "the link broke before it switched", "update again", before or "")
    what = f"silent since the switch ({verdict.why})" if verdict.why else "silent since the switch"
    return Outcome(Stage.LOST, what, f"its guard takes it back to {before or 'nothing'}; `fullswarm fleet` later")


def _rolled_back(why: str, before: str | None) -> Outcome:
    what = clean(why) or "it was not healthy in time"
    return Outcome(Stage.ROLLED_BACK, what, "`fullswarm logs` says more; mend, bundle, update again", before or "none")
