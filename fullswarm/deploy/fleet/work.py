"""What a rollout asks of one robot: take the release in, then switch to it and be found healthy, or go back."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import gettempdir

from fullswarm.deploy.fleet import steps
from fullswarm.deploy.fleet.choose import choose
from fullswarm.deploy.fleet.facts import Facts, facts_of
from fullswarm.deploy.fleet.login import Address, Login
from fullswarm.deploy.fleet.remote import LinkBroke, Remote
from fullswarm.deploy.fleet.rollout import Stage
from fullswarm.deploy.fleet.ship import Parcels
from fullswarm.deploy.fleet.untrusted import clean
from fullswarm.deploy.fleet.verdict import Verdict, Watch
from fullswarm.deploy.release.keys import verify_release
from fullswarm.deploy.release.manifest import Manifest
from fullswarm.deploy.release.store import Store
from fullswarm.errors import FullswarmError, Unreachable

SHIP_ATTEMPTS = 4
AGAIN_S = 1.0
POLL_S = 0.5
SILENT_S = 30.0
"""An agent that was restarted says how it is within this time, on the slowest card too."""
SICK_S = 5.0
"""What keeps an agent from being healthy for so long, a core that is not started, for example, may stay."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one robot, and what to do."""

    stage: Stage
    what: str
    mend: str = ""
    release: str = ""
    shipped_bytes: int = 0
    changed: tuple[str, ...] = ()
    exit_code: int = 1


@dataclass(frozen=True, slots=True)
class Kit:
    """What stands on a robot outside every release, for one robot; `name` is what it says when it has it."""

    archive: bytes
    name: str


@dataclass(slots=True)
class Work:
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
    parcels: Parcels
    tell: Callable[[str], None]
    signers: str
    named: str | None = None
    target: str | None = None
    kits: Mapping[str, Kit] = field(default_factory=dict)
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
        except steps.Refused as error:
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
        return choose(self.store, self.named, facts, robot, self.target, self.needs.get(robot, frozenset()))

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
                    await steps.stage(remote, folder, self.parcels, facts)
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
            await steps.admit(remote, self.public_key)
        if facts.installed and facts.kit == kit.name:
            return facts
        if facts.busy_with and not self.force:
            # New settings restart its agent.
            raise steps.Refused(f"it is {facts.busy_with}", where=remote.robot, hint="stop it first, or --force")
        self.tell(f"{remote.robot}: installing")
        await steps.install(remote, kit.archive, installed=facts.installed)
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
        watch = Watch(self.login, self.addresses[robot], release, self.guard_s)
        async with self.login.connect(self.addresses[robot]) as remote:
            watch.rollback_before = (await facts_of(remote)).last_rollback
            try:
                await steps.switch(remote, release, self.guard_s, force=self.force)
                watch.switched = True
            except steps.WentBack as error:
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
