"""Runs ``deploy``, ``update``, ``rollback``, ``reboot``, ``logs`` and ``shell``; prints the result robot by robot."""

from __future__ import annotations

import asyncio
import json
import os
import shlex
import shutil
import tempfile
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Table

from fullswarm import output
from fullswarm.deploy.fleet.facts import Facts, facts_of
from fullswarm.deploy.fleet.login import Address, Login, confirm_host_keys, login_for, pick_robots
from fullswarm.deploy.fleet.releases import Archives, Desired, extras_needed
from fullswarm.deploy.fleet.remote import LinkBroke, Remote, clean_log_line, need_asyncssh
from fullswarm.deploy.fleet.robot_update import Refused, RobotUpdater, SupportPackage, read_health, roll_back
from fullswarm.deploy.fleet.rollout import AT_A_TIME, GOOD, Outcome, Plan, Rollout, Stage, UpdateState, perform_rollout
from fullswarm.deploy.release.keys import Keys, public
from fullswarm.deploy.release.store import Store
from fullswarm.drivers.fleet_file import load_fleet
from fullswarm.errors import ConfigError, FullswarmError, Unreachable

if TYPE_CHECKING:
    from fullswarm.config import RobotConfig, SwarmConfig

FILE_COLUMNS = 110
"""Columns into a file: a reason that is broken in five is hard to find again."""


@dataclass(frozen=True, slots=True)
class Row:
    """One robot's line; `exit_code` 0 when all is well with it."""

    robot: str
    result: str
    what: str = ""
    mend: str = ""
    release: str = ""
    shipped_bytes: int = 0
    exit_code: int = 0

    @classmethod
    def of(cls, robot: str, outcome: Outcome) -> Row:
        """From what a rollout says."""
        code = 0 if outcome.stage in GOOD else outcome.exit_code
        changed = f" ({', '.join(outcome.changed)})" if outcome.changed and code == 0 else ""
        return cls(
            robot,
            str(outcome.stage),
            outcome.what if outcome.stage is Stage.CURRENT else outcome.what + changed,
            outcome.mend,
            outcome.release,
            outcome.shipped_bytes,
            code,
        )


def print_rows(rows: Sequence[Row], *, as_json: bool) -> int:
    """Print the rows and return the exit code: 0, 1 when some failed, else what all of them failed with."""
    codes = {each.exit_code for each in rows}
    code = codes.pop() if len(codes) == 1 else 1
    if as_json:
        robots = [{**asdict(each), "ok": not each.exit_code} for each in rows]
        for robot in robots:
            del robot["exit_code"]
        output.data_json({"ok": code == 0, "robots": robots})
        return code
    columns = ("robot", "result", "runs", "shipped", "what", "what to do")
    cells = [
        (each.robot, each.result, each.release or "-", size(each.shipped_bytes), each.what, each.mend) for each in rows
    ]
    output.data_table(table(columns, cells), into_file=FILE_COLUMNS)
    return code


def table(columns: Iterable[str], rows: Iterable[Sequence[str]]) -> Table:
    """A plain table, whose words are only words: no markup that a robot could have put there."""
    shown = Table(box=None, pad_edge=False)
    for name in columns:
        shown.add_column(name, overflow="fold", no_wrap=name in ("robot", "result"))
    for row in rows:
        shown.add_row(*(escape(each) for each in row))
    return shown


def size(count: int) -> str:
    """``0.3 MB``."""
    if count < 1000:
        return f"{count} B" if count else "-"
    return f"{count / 1000:.0f} kB" if count < 1_000_000 else f"{count / 1e6:.1f} MB"


# ---------------------------------------------------------------- deploy and update
@dataclass(frozen=True, slots=True)
class FleetRequest:
    """What a command line asked for; times in seconds."""

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
        """In the order in which they are tried."""
        return tuple(each.id for each in self.robots)

    @property
    def addresses(self) -> dict[str, Address]:
        """By robot."""
        return {each.id: Address.of(each) for each in self.robots}


def deploy(order: FleetRequest) -> int:
    """Install what is missing and bring robots to a release, all at a time; return the exit code."""
    from fullswarm.deploy.robot.support_package import check_hub, package_id, support_package

    fleet = Fleet.of(order, own_keys=True)
    for each in fleet.robots:
        check_hub(each, fleet.config)
    signers = fleet.keys.allowed_signers()
    archives = {each.id: support_package(each, fleet.config, signers) for each in fleet.robots}
    kits = {robot: SupportPackage(archive, package_id(archive)) for robot, archive in archives.items()}
    everybody = Plan(canary=0, wave=1.0, stop_at=len(fleet.robots) + 1)
    return _run(order, fleet, everybody, kits)


def update(order: FleetRequest) -> int:
    """Bring robots to a release in waves; return the exit code."""
    return _run(order, Fleet.of(order), order.plan, {})


def _run(order: FleetRequest, fleet: Fleet, plan: Plan, kits: dict[str, SupportPackage]) -> int:
    board = UpdateState(Rollout.of(fleet.ids, plan))
    with tempfile.TemporaryDirectory(prefix="fullswarm-") as scratch:
        work = RobotUpdater(
            fleet.login,
            fleet.addresses,
            Store.default(),
            Archives(Path(scratch)),
            output.progress,
            fleet.keys.allowed_signers(),
            named=order.release,
            target=order.target,
            kits=kits,
            needs={each.id: extras_needed(each, fleet.config) for each in fleet.robots},
            public_key=public(fleet.keys.fleet_key()),
            guard_s=order.guard_s,
            force=order.force,
        )
        if order.release is not None:
            work.store.get(order.release)  # a wrong name is no robot's fault
        try:
            asyncio.run(_perform(order, fleet, board, work, first_contact=bool(kits)))
        except KeyboardInterrupt:
            print_rows(_rows(fleet, board), as_json=order.as_json)
            raise
    if board.rollout.stopped:
        output.progress(f"stopped after {plan.stop_at} failures: the others keep what they run")
    return print_rows(_rows(fleet, board), as_json=order.as_json)


async def _perform(
    order: FleetRequest, fleet: Fleet, board: UpdateState, work: RobotUpdater, *, first_contact: bool
) -> None:
    strangers: dict[str, FullswarmError] = {}
    if first_contact and not order.dry_run:
        known = tuple(fleet.addresses.values())
        strangers = await confirm_host_keys(fleet.login, known, accept=order.accept_host_keys)
    if order.dry_run:
        looks = await asyncio.gather(*(work.look(each) for each in fleet.ids))
        board.outcomes.update(zip(fleet.ids, looks, strict=True))
        return

    async def hands(robot: str, stage: Stage) -> Outcome:
        problem = strangers.pop(robot, None)
        if problem is not None:
            lost = Stage.UNREACHABLE if isinstance(problem, Unreachable) else Stage.FAILED
            return Outcome(lost, problem.what, problem.hint, exit_code=problem.exit_code)
        return await work(robot, stage)

    try:
        await perform_rollout(board, hands, order.at_a_time, order.keep_trying_s)
    except asyncio.CancelledError:
        board.interrupted(order.guard_s)
        raise
    finally:
        Desired.of(fleet.config.swarm).want(_wanted(board, work))
        board.held()


def _wanted(board: UpdateState, work: RobotUpdater) -> dict[str, str]:
    """What robots should run from now on: what they were given; those that were away, what the others were given."""
    given = {robot: folder.name for robot, folder in work.releases.items()}
    away = [robot for robot, stage in board.rollout.stages.items() if stage is Stage.UNREACHABLE]
    if work.named is not None or len(set(given.values())) == 1:
        common = next(iter(given.values())) if given else work.store.get(work.named or "").name
        given.update(dict.fromkeys(away, common))
    unfit = [robot for robot, stage in board.rollout.stages.items() if stage is Stage.FAILED]
    return {robot: release for robot, release in given.items() if robot not in unfit}


def _rows(fleet: Fleet, board: UpdateState) -> list[Row]:
    nothing = Outcome(Stage.WAITING, "not begun: nothing was changed", "update again")
    return [Row.of(each, board.outcomes.get(each, nothing)) for each in fleet.ids]


# ---------------------------------------------------------------- rollback and reboot
AGENT_S = 40.0
BOOT_POLL_S = 1.0

Visit = Callable[[Address], Awaitable[Row]]


def rollback(order: FleetRequest) -> int:
    """Go back to the release before on each robot; return the exit code."""
    fleet = Fleet.of(order)

    async def visit(address: Address) -> Row:
        async with fleet.login.connect(address) as remote:
            facts = await _idle(remote, order)
            goal = "what it ran before" if facts.pending else facts.previous
            if goal is None:
                hint = "`fullswarm update --release` takes any release of the store"
                raise Refused("there is no release to go back to", where=address.robot, hint=hint)
            if order.dry_run:
                return Row(address.robot, "would go back", f"to {goal}", release=facts.current or "")
            now = await roll_back(remote, "asked for by the operator")
            why = await _why_not_healthy(remote)
        if why:
            return Row(
                address.robot, "rolled back", f"and not healthy: {why}", _see_logs(address), now or "", exit_code=1
            )
        return Row(address.robot, "rolled back", f"from {facts.current}", release=now or "")

    rows = asyncio.run(for_each_robot(fleet.addresses, visit, order.at_a_time))
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
                pass  # it is on its way down
        if wait_s is None:
            return Row(address.robot, "reboots", release=facts.current or "")
        output.progress(f"{address.robot}: reboots")
        return await _wait_for_boot(fleet.login, address, facts.boot_id, wait_s)

    return print_rows(asyncio.run(for_each_robot(fleet.addresses, visit, order.at_a_time)), as_json=order.as_json)


async def for_each_robot(addresses: Mapping[str, Address], visit: Visit, at_a_time: int) -> list[Row]:
    """Visit all, `at_a_time`; an error is the robot's own row."""
    room = asyncio.Semaphore(at_a_time)

    async def one(address: Address) -> Row:
        async with room:
            try:
                return await visit(address)
            except Unreachable as error:
                return Row(address.robot, "unreachable", error.what, error.hint, exit_code=error.exit_code)
            except FullswarmError as error:
                result = "refused" if isinstance(error, Refused) else "failed"
                return Row(address.robot, result, error.what, error.hint, exit_code=error.exit_code)

    return list(await asyncio.gather(*(one(each) for each in addresses.values())))


async def _idle(remote: Remote, order: FleetRequest) -> Facts:
    facts = await facts_of(remote)
    if not facts.installed:
        hint = f"`fullswarm deploy {remote.robot}` puts it there"
        raise FullswarmError("nothing of ours is installed there", where=remote.robot, hint=hint)
    if facts.busy_with and not order.force:
        hint = "stop it (`fullswarm stop`) first, or --force"
        raise Refused(f"it is {facts.busy_with}", where=remote.robot, hint=hint)
    return facts


async def _why_not_healthy(remote: Remote) -> str:
    """Wait for the agent to be healthy; empty when it is."""
    now = asyncio.get_running_loop().time
    until_s = now() + AGENT_S
    while True:
        said, why = await read_health(remote)
        if said is not None and said.healthy:
            return ""
        if now() >= until_s:
            return why
        await asyncio.sleep(BOOT_POLL_S)


async def _wait_for_boot(login: Login, address: Address, boot_id: str, wait_s: float) -> Row:
    """Wait until a computer has booted anew."""
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
            pass  # not up yet
        await asyncio.sleep(BOOT_POLL_S)
    mend = "look at its screen, or put its card into a computer"
    return Row(address.robot, "not back", f"nothing heard for {wait_s:.0f} s", mend, exit_code=3)


def _see_logs(address: Address) -> str:
    return f"fullswarm logs {address.robot}"


# ---------------------------------------------------------------- logs and shell
def logs(order: FleetRequest, lines: int, *, follow: bool) -> int:
    """Print what a robot's agent has said, as it stands or as JSON lines; return the exit code."""
    fleet = Fleet.of(order)
    address = fleet.addresses[fleet.ids[0]]

    async def read() -> int:
        words = ("logs", *(("--json",) if order.as_json else ()), *(("-f",) if follow else ()), "-n", str(lines))
        tell = json_line if order.as_json else clean_log_line
        async with fleet.login.connect(address) as remote:
            answer = await remote.program(
                *words, within_s=None if follow else 60.0, line=lambda said: output.data(tell(said))
            )
        if answer.code:
            raise FullswarmError(f"no logs: {answer.words}", where=address.robot, hint="fullswarm deploy")
        return 0

    return asyncio.run(read())


def json_line(said: bytes) -> str:
    """Return one line of the journal's own JSON as ours: when (s since 1970), how bad (syslog's 0 to 7), what."""
    try:
        entry = json.loads(said)
        text = entry["MESSAGE"]
        when_s, priority = int(entry["__REALTIME_TIMESTAMP"]) / 1e6, int(entry.get("PRIORITY", 6))
    except (ValueError, TypeError, KeyError):
        return json.dumps({"text": clean_log_line(said)})
    text = clean_log_line(text.encode()) if isinstance(text, str) else "bytes that are no text"
    return json.dumps({"time_s": when_s, "priority": priority, "text": text})


def shell(order: FleetRequest, command: list[str]) -> int:
    """Hand the terminal over to ``ssh``, which takes the place of this process."""
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
    """``ssh``'s arguments: our pinned keys and no others, the fleet's key, then the user's own."""
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
