"""Runs ``deploy``, ``update``, ``rollback``, ``reboot``, ``fleet``, ``logs``, ``shell``; prints a line per robot."""

from __future__ import annotations

import asyncio
import json
import math
import os
import shlex
import shutil
import tempfile
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from rich.markup import escape

from fullswarm import output
from fullswarm.clock import wall_time_s
from fullswarm.deploy.fleet.facts import Facts, clock_error_s, facts_of
from fullswarm.deploy.fleet.login import Address, Login, confirm_host_keys, login_for, pick_robots
from fullswarm.deploy.fleet.releases import Archives, Desired, extras_needed
from fullswarm.deploy.fleet.remote import LinkBroke, Remote, clean, clean_log_line, need_asyncssh
from fullswarm.deploy.fleet.robot_update import (
    Refused,
    RobotUpdater,
    SupportPackage,
    check_idle,
    check_installed,
    read_health,
    roll_back,
)
from fullswarm.deploy.fleet.rollout import AT_A_TIME, GOOD, Outcome, Plan, Rollout, Stage, UpdateState, perform_rollout
from fullswarm.deploy.release.keys import Keys, public, sign_release, verify_sums
from fullswarm.deploy.release.store import Store
from fullswarm.drivers.fleet_file import load_fleet
from fullswarm.errors import ConfigError, FullswarmError, Unreachable

if TYPE_CHECKING:
    from fullswarm.config import RobotConfig, SwarmConfig

FILE_COLUMNS = 110
"""Width of a table in a file."""
CLOCK_S = 60.0
LOW_DISK_BYTES = 500_000_000
HOT_C = 80.0

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Row:
    """One robot's line of a result; `exit_code` 0 when all is well with it."""

    robot: str
    result: str
    what: str = ""
    mend: str = ""
    release: str = ""
    shipped_bytes: int = 0
    exit_code: int = 0

    @classmethod
    def of(cls, robot: str, outcome: Outcome) -> Row:
        """Return the line for the outcome of a rollout."""
        code = 0 if outcome.stage in GOOD else outcome.exit_code
        changed = f" ({', '.join(outcome.changed)})" if outcome.changed and code == 0 else ""
        what = outcome.what if outcome.stage is Stage.CURRENT else outcome.what + changed
        return cls(robot, str(outcome.stage), what, outcome.mend, outcome.release, outcome.shipped_bytes, code)

    @classmethod
    def failed(cls, address: Address, error: FullswarmError) -> Row:
        """Return the line for an error."""
        result = (
            "unreachable" if isinstance(error, Unreachable) else "refused" if isinstance(error, Refused) else "failed"
        )
        return cls(address.robot, result, error.what, error.hint, exit_code=error.exit_code)


@dataclass(frozen=True, slots=True)
class Status:
    """What one robot runs; `skew` is empty when it is what it should run."""

    robot: str
    host: str
    release: str
    desired: str
    skew: str
    health: str
    why: str = ""
    mend: str = ""
    temperature_c: float | None = None
    disk_free_bytes: int | None = None
    exit_code: int = 0


COLUMNS = {
    Row: ("robot", "result", "runs", "shipped", "what", "what to do"),
    Status: ("robot", "host", "release", "skew", "health", "why", "what to do"),
}


def print_rows(rows: Sequence[Row] | Sequence[Status], *, as_json: bool) -> int:
    """Print the rows and return the exit code: 0, 1 when some failed, else what all of them failed with."""
    codes = {each.exit_code for each in rows}
    code = codes.pop() if len(codes) == 1 else 1
    if as_json:
        robots = [{**asdict(each), "ok": not each.exit_code} for each in rows]
        for robot in robots:
            del robot["exit_code"]
        output.data_json({"ok": code == 0, "robots": robots})
        return code
    shown = output.plain_table()
    for name in COLUMNS[type(rows[0])] if rows else ():
        shown.add_column(name, overflow="fold", no_wrap=name in ("robot", "result"))
    for each in rows:  # escaped, because some of the text comes from robots
        shown.add_row(*map(escape, _cells(each)))
    output.data_table(shown, into_file=FILE_COLUMNS)
    return code


def _cells(row: Row | Status) -> tuple[str, ...]:
    if isinstance(row, Row):
        return row.robot, row.result, row.release or "-", _size(row.shipped_bytes), row.what, row.mend
    return row.robot, row.host, row.release or "-", row.skew or "-", row.health, row.why, row.mend


def _size(count: int) -> str:
    """Return ``0.3 MB``."""
    if count < 1000:
        return f"{count} B" if count else "-"
    return f"{count / 1000:.0f} kB" if count < 1_000_000 else f"{count / 1e6:.1f} MB"


async def for_each_robot(
    fleet: Fleet,
    visit: Callable[[Address], Awaitable[T]],
    failed: Callable[[Address, FullswarmError], T],
    at_a_time: int,
) -> list[T]:
    """Visit all robots, `at_a_time`; `failed` makes a row of an error."""
    room = asyncio.Semaphore(at_a_time)

    async def one(address: Address) -> T:
        async with room:
            try:
                return await visit(address)
            except FullswarmError as error:
                return failed(address, error)

    return list(await asyncio.gather(*(one(each) for each in fleet.addresses.values())))


# ---------------------------------------------------------------- deploy and update
@dataclass(frozen=True, slots=True)
class FleetRequest:
    """The options of a command line; times in seconds."""

    fleet: Path
    robots: Sequence[str] = ()
    release: str | None = None
    target: str | None = None
    plan: Plan = field(default_factory=Plan)
    guard_s: float = 60.0
    force: bool = False
    keep_trying_s: float = 0.0
    at_a_time: int = AT_A_TIME
    ask_password: bool = False
    accept_host_keys: bool = False
    dry_run: bool = False
    as_json: bool = False
    allow_older: bool = False
    rename: bool = False


@dataclass(frozen=True, slots=True)
class Fleet:
    """The robots that a command is about, and how to get to them."""

    config: SwarmConfig
    robots: tuple[RobotConfig, ...]
    login: Login
    keys: Keys

    @classmethod
    def of(cls, order: FleetRequest, *, own_keys: bool = False) -> Fleet:
        """Read the fleet file and the keys.

        Raises
        ------
        ConfigError
            The file is wrong, or a name is not in it.
        MissingExtra
            asyncssh is not installed.
        """
        need_asyncssh()
        config = load_fleet(order.fleet)
        robots = pick_robots(config, order.robots, order.fleet)
        keys = Keys.default()
        login = login_for(config, keys, ask_password=order.ask_password, own_keys=own_keys)
        return cls(config, robots, login, keys)

    @property
    def ids(self) -> tuple[str, ...]:
        """The robots in the order in which they are tried."""
        return tuple(each.id for each in self.robots)

    @property
    def addresses(self) -> dict[str, Address]:
        """SSH addresses by robot."""
        return {each.id: Address.of(each) for each in self.robots}


def deploy(order: FleetRequest) -> int:
    """Install what is missing and bring robots to a release, all at a time; return the exit code."""
    from fullswarm.deploy.robot.support_package import check_hub, package_id, robot_credentials, signed, support_package

    fleet = Fleet.of(order, own_keys=True)
    for each in fleet.robots:
        check_hub(each, fleet.config)
    root, now_s = fleet.keys.roots()[-1], wall_time_s()
    archives = {
        each.id: support_package(each, fleet.config, root, credentials=robot_credentials(each, fleet.config, now_s))
        for each in fleet.robots
    }
    if not order.dry_run:
        archives = signed(archives, fleet.keys, rename=order.rename)
    packages = {robot: SupportPackage(archive, package_id(archive)) for robot, archive in archives.items()}
    at_once = Plan(canary=0, wave=1.0, stop_at=len(fleet.robots) + 1)
    return _run(order, fleet, at_once, packages)


def update(order: FleetRequest) -> int:
    """Bring robots to a release in waves; return the exit code."""
    return _run(order, Fleet.of(order), order.plan, {})


def _run(order: FleetRequest, fleet: Fleet, plan: Plan, packages: dict[str, SupportPackage]) -> int:
    if order.allow_older and not order.dry_run:
        _sign_older(order, fleet.keys)
    state = UpdateState(Rollout.of(fleet.ids, plan))
    with tempfile.TemporaryDirectory(prefix="fullswarm-") as scratch:
        updater = RobotUpdater(
            fleet.login,
            fleet.addresses,
            Store.default(),
            Archives(Path(scratch)),
            output.progress,
            fleet.keys.allowed_signers(),
            fleet.keys.roots(),
            named=order.release,
            target=order.target,
            packages=packages,
            needs={each.id: extras_needed(each, fleet.config) for each in fleet.robots},
            public_key=public(fleet.keys.fleet_key()),
            guard_s=order.guard_s,
            force=order.force,
        )
        if order.release is not None:
            updater.store.get(order.release)  # a wrong name is reported once, not for each robot
        try:
            asyncio.run(_perform(order, fleet, state, updater, first_install=bool(packages)))
        except KeyboardInterrupt:
            print_rows(_rows(fleet, state), as_json=order.as_json)
            raise
    if state.rollout.stopped:
        output.progress(f"stopped after {plan.stop_at} failures: the others keep what they run")
    return print_rows(_rows(fleet, state), as_json=order.as_json)


def _sign_older(order: FleetRequest, keys: Keys) -> None:
    """Sign the named release anew, so that robots accept it although they have verified a newer one."""
    if order.release is None:
        hint = "name the release: --release ID --allow-older"
        raise ConfigError("which release may be older?", where="--allow-older", hint=hint)
    folder = Store.default().get(order.release)
    verify_sums(folder, keys.allowed_signers())
    sign_release(folder, keys, older=True)
    output.progress(f"{folder.name}: signed anew, so that robots may go back to it")


async def _perform(
    order: FleetRequest, fleet: Fleet, state: UpdateState, updater: RobotUpdater, *, first_install: bool
) -> None:
    unconfirmed: dict[str, FullswarmError] = {}
    if first_install and not order.dry_run:
        known = tuple(fleet.addresses.values())
        unconfirmed = await confirm_host_keys(fleet.login, known, accept=order.accept_host_keys)
    if order.dry_run:
        previews = await asyncio.gather(*(updater.preview(each) for each in fleet.ids))
        state.outcomes.update(zip(fleet.ids, previews, strict=True))
        return

    async def step(robot: str, stage: Stage) -> Outcome:
        problem = unconfirmed.pop(robot, None)
        if problem is not None:
            stage = Stage.UNREACHABLE if isinstance(problem, Unreachable) else Stage.FAILED
            return Outcome(stage, problem.what, problem.hint, exit_code=problem.exit_code)
        return await updater(robot, stage)

    try:
        await perform_rollout(state, step, order.at_a_time, order.keep_trying_s)
    except asyncio.CancelledError:
        state.interrupted(order.guard_s)
        raise
    finally:
        Desired.of(fleet.config.swarm).want(_wanted(state, updater))
        state.held()


def _wanted(state: UpdateState, updater: RobotUpdater) -> dict[str, str]:
    """Return what robots should run: what they were given; those that were unreachable, what the others were given."""
    given = {robot: folder.name for robot, folder in updater.releases.items()}
    away = [robot for robot, stage in state.rollout.stages.items() if stage is Stage.UNREACHABLE]
    if updater.named is not None or len(set(given.values())) == 1:
        common = next(iter(given.values())) if given else updater.store.get(updater.named or "").name
        given.update(dict.fromkeys(away, common))
    unfit = [robot for robot, stage in state.rollout.stages.items() if stage is Stage.FAILED]
    return {robot: release for robot, release in given.items() if robot not in unfit}


def _rows(fleet: Fleet, state: UpdateState) -> list[Row]:
    nothing = Outcome(Stage.WAITING, "not started: nothing was changed", "update again")
    return [Row.of(each, state.outcomes.get(each, nothing)) for each in fleet.ids]


# ---------------------------------------------------------------- rollback and reboot
AGENT_S = 40.0
BOOT_POLL_S = 1.0


def rollback(order: FleetRequest) -> int:
    """Roll back each robot to its previous release; return the exit code."""
    fleet = Fleet.of(order)

    async def visit(address: Address) -> Row:
        async with fleet.login.connect(address) as remote:
            facts = await _idle(remote, order)
            goal = "what it ran before" if facts.pending else facts.previous
            if goal is None:
                hint = "`fullswarm update --release` installs any release of the store"
                raise Refused("there is no release to roll back to", where=address.robot, hint=hint)
            if order.dry_run:
                return Row(address.robot, "would roll back", f"to {goal}", release=facts.current or "")
            now = await roll_back(remote, "requested by the operator")
            why = await _why_not_healthy(remote)
        if why:
            return Row(
                address.robot, "rolled back", f"and not healthy: {why}", _see_logs(address), now or "", exit_code=1
            )
        return Row(address.robot, "rolled back", f"from {facts.current}", release=now or "")

    rows = asyncio.run(for_each_robot(fleet, visit, Row.failed, order.at_a_time))
    if not order.dry_run:
        back = {each.robot: each.release for each in rows if each.result == "rolled back" and each.release}
        Desired.of(fleet.config.swarm).want(back)
    return print_rows(rows, as_json=order.as_json)


def reboot(order: FleetRequest, wait_s: float | None) -> int:
    """Restart the computers of robots, which must stand idle; return the exit code."""
    fleet = Fleet.of(order)

    async def visit(address: Address) -> Row:
        async with fleet.login.connect(address) as remote:
            facts = await _idle(remote, order)
            if order.dry_run:
                return Row(address.robot, "would reboot", release=facts.current or "")
            try:
                forced = ("--force",) if order.force else ()
                answer = await remote.program("reboot", *forced)
                if answer.code:
                    raise Refused(answer.words, where=address.robot)
            except LinkBroke:
                pass  # it is shutting down
        if wait_s is None:
            return Row(address.robot, "reboots", release=facts.current or "")
        output.progress(f"{address.robot}: reboots")
        return await _wait_for_boot(fleet.login, address, facts.boot_id, wait_s)

    return print_rows(asyncio.run(for_each_robot(fleet, visit, Row.failed, order.at_a_time)), as_json=order.as_json)


async def _idle(remote: Remote, order: FleetRequest) -> Facts:
    facts = await facts_of(remote)
    check_installed(facts, remote.robot)
    check_idle(facts, remote.robot, force=order.force)
    return facts


async def _why_not_healthy(remote: Remote) -> str:
    """Wait for the agent to be healthy; empty when it is."""
    now = asyncio.get_running_loop().time
    until_s = now() + AGENT_S
    while True:
        health, why = await read_health(remote)
        if health is not None and health.healthy:
            return ""
        if now() >= until_s:
            return why
        await asyncio.sleep(BOOT_POLL_S)


async def _wait_for_boot(login: Login, address: Address, boot_id: str, wait_s: float) -> Row:
    """Wait until a computer has rebooted."""
    now = asyncio.get_running_loop().time
    began_s = now()
    while now() < began_s + wait_s:
        try:
            async with login.connect(address) as remote:
                facts = await facts_of(remote)
                if facts.boot_id != boot_id:
                    release = facts.current or ""
                    return Row(address.robot, "rebooted", f"back after {now() - began_s:.0f} s", release=release)
        except FullswarmError:
            pass  # still booting
        await asyncio.sleep(BOOT_POLL_S)
    mend = "check its screen, or put its card into a computer"
    return Row(address.robot, "not back", f"no answer for {wait_s:.0f} s", mend, exit_code=3)


def _see_logs(address: Address) -> str:
    return f"fullswarm logs {address.robot}"


# ---------------------------------------------------------------- fleet
def fleet(order: FleetRequest) -> int:
    """Print the fleet; return 0 when all is well and as it should be, 3 when no robot was reached, else 1."""
    whole = Fleet.of(order)
    desired = Desired.of(whole.config.swarm).read()

    async def visit(address: Address) -> Status:
        async with whole.login.connect(address) as remote:
            return status_of(address, await facts_of(remote), desired.get(address.robot, ""))

    def failed(address: Address, error: FullswarmError) -> Status:
        wanted = desired.get(address.robot, "")
        state = "unreachable" if isinstance(error, Unreachable) else "unknown"
        skew = f"wants {wanted}" if wanted else ""
        return Status(address.robot, address.host, "", wanted, skew, state, error.what, error.hint, exit_code=3)

    return print_rows(asyncio.run(for_each_robot(whole, visit, failed, order.at_a_time)), as_json=order.as_json)


def status_of(address: Address, facts: Facts, wanted: str) -> Status:
    """Return the state of one robot by its facts."""
    release = clean(facts.current or "", 80)
    skew = f"wants {wanted}" if wanted and wanted != release else ""
    health, why, mend = _health(address.robot, facts)
    if not mend and skew:
        mend = f"fullswarm update {address.robot}"
        why = why or (f"rolled back: {facts.rollback_reason}" if facts.rollback_reason else "")
    warnings = _warnings(facts)
    return Status(
        address.robot,
        address.host,
        release,
        wanted,
        skew,
        health,
        "; ".join(filter(None, (why, *warnings))),
        mend,
        facts.temperature_c,
        facts.disk_free_bytes,
        exit_code=0 if health == "healthy" and not skew else 1,
    )


def _health(robot: str, facts: Facts) -> tuple[str, str, str]:
    """Return state, reason, and what to do."""
    deploy, logs = f"fullswarm deploy {robot}", f"fullswarm logs {robot}"
    if not facts.installed:
        return "not installed", "", deploy
    if facts.robot != robot:
        name = clean(facts.robot, 64) or "none"
        return "another robot", f"its own name is {name}", "`host` in the fleet file, or `fullswarm deploy --rename`"
    if not facts.current:
        return "no release", facts.rollback_reason, deploy
    if facts.pending:
        return (
            "pending",
            f"{clean(facts.pending, 80)} is not committed yet",
            "wait: without a commit it rolls back",
        )
    if facts.health is None:
        restarts = f", {facts.agent.restarts} restarts" if facts.agent.restarts else ""
        return "silent", f"no report of its agent ({clean(facts.agent.state, 40) or 'no unit'}{restarts})", logs
    if not facts.health.healthy:
        return "not healthy", clean("; ".join(facts.health.why)), logs
    return "healthy", "", ""


def _warnings(facts: Facts) -> list[str]:
    warnings = []
    off_s = clock_error_s(facts)
    if not math.isnan(off_s) and abs(off_s) > CLOCK_S:
        warnings.append(f"clock off by {off_s:+.0f} s")
    if facts.disk_free_bytes is not None and facts.disk_free_bytes < LOW_DISK_BYTES:
        warnings.append(f"{facts.disk_free_bytes / 1e6:.0f} MB of disk free")
    if not facts.disk_writable:
        warnings.append("disk not writable")
    if facts.temperature_c is not None and facts.temperature_c > HOT_C:
        warnings.append(f"{facts.temperature_c:.0f} °C")
    return warnings


# ---------------------------------------------------------------- logs and shell
def logs(order: FleetRequest, lines: int, *, follow: bool) -> int:
    """Print the log of a robot's agent, as text or JSON lines; return the exit code."""
    fleet = Fleet.of(order)
    address = fleet.addresses[fleet.ids[0]]

    async def read() -> int:
        words = ("logs", *(("--json",) if order.as_json else ()), *(("-f",) if follow else ()), "-n", str(lines))
        convert = json_line if order.as_json else clean_log_line
        async with fleet.login.connect(address) as remote:
            answer = await remote.program(
                *words, within_s=None if follow else 60.0, line=lambda raw: output.data(convert(raw))
            )
        if answer.code:
            raise FullswarmError(f"no logs: {answer.words}", where=address.robot, hint="fullswarm deploy")
        return 0

    return asyncio.run(read())


def json_line(raw: bytes) -> str:
    """Return one line of the journal's JSON as ours: time (s since 1970), priority (syslog's 0 to 7), text."""
    try:
        entry = json.loads(raw)
        text = entry["MESSAGE"]
        when_s, priority = int(entry["__REALTIME_TIMESTAMP"]) / 1e6, int(entry.get("PRIORITY", 6))
    except (ValueError, TypeError, KeyError):
        return json.dumps({"text": clean_log_line(raw)})
    text = clean_log_line(text.encode()) if isinstance(text, str) else "binary data"
    return json.dumps({"time_s": when_s, "priority": priority, "text": text})


def shell(order: FleetRequest, command: list[str]) -> int:
    """Replace this process by ``ssh``."""
    fleet = Fleet.of(order)
    address = fleet.addresses[fleet.ids[0]]
    pins = fleet.login.pins
    pins.pin_flashed(address.robot, address.host, address.port)
    if not pins.keys(address.robot, address.host, address.port):
        raise pins.unknown(address.robot, address.host, asyncio.run(fleet.login.host_key(address)))
    program = shutil.which("ssh")
    if program is None:
        raise ConfigError("ssh is not installed here", hint="sudo apt install openssh-client")
    words = ssh_words(fleet, address)
    if not order.dry_run:
        os.execv(program, [program, *words, *command])  # noqa: S606 - the user's own terminal, no shell between
    output.data(shlex.join([program, *words, *command]))
    return 0


def ssh_words(fleet: Fleet, address: Address) -> list[str]:
    """Return ``ssh``'s arguments: only our pinned host keys; the fleet's key, then the user's own."""
    return [
        *("-o", f"UserKnownHostsFile={fleet.login.pins.known_hosts}"),
        *("-o", "GlobalKnownHostsFile=/dev/null"),
        *("-o", "StrictHostKeyChecking=yes"),
        *("-o", "UpdateHostKeys=no"),
        *("-i", str(fleet.login.fleet_key)),
        *("-p", str(address.port)),
        *("-l", address.user),
        *("--", address.host),
    ]
