"""``deploy``, ``update`` and ``rollback``: from the words of a command line to robots that run a release."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from fullswarm import output
from fullswarm.deploy.fleet import people
from fullswarm.deploy.fleet.choose import needs
from fullswarm.deploy.fleet.desired import Desired
from fullswarm.deploy.fleet.login import Address, Login
from fullswarm.deploy.fleet.remote import need_asyncssh
from fullswarm.deploy.fleet.report import Row, tell
from fullswarm.deploy.fleet.rollout import Plan, Rollout, Stage
from fullswarm.deploy.fleet.ship import Parcels
from fullswarm.deploy.fleet.update import AT_A_TIME, Board, perform
from fullswarm.deploy.fleet.work import Kit, Outcome, Work
from fullswarm.deploy.release.keys import Keys, public
from fullswarm.deploy.release.store import Store
from fullswarm.drivers.fleet_file import load_fleet
from fullswarm.errors import FullswarmError, Unreachable

if TYPE_CHECKING:
    from fullswarm.config import RobotConfig, SwarmConfig


@dataclass(frozen=True, slots=True)
class Order:
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
    def of(cls, order: Order, *, own_keys: bool = False) -> Fleet:
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
        robots = people.pick(config, order.robots, order.fleet)
        keys = Keys.default()
        login = people.login(config, keys, ask_password=order.ask_password, own_keys=own_keys)
        return cls(config, robots, login, keys)

    @property
    def ids(self) -> tuple[str, ...]:
        """In the order in which they are tried."""
        return tuple(each.id for each in self.robots)

    @property
    def addresses(self) -> dict[str, Address]:
        """By robot."""
        return {each.id: Address.of(each) for each in self.robots}


def deploy(order: Order) -> int:
    """Install what is missing and bring robots to a release, all at a time; return the exit code."""
    from fullswarm.deploy.robot.support_package import check_hub, package_id, support_package

    fleet = Fleet.of(order, own_keys=True)
    for each in fleet.robots:
        check_hub(each, fleet.config)
    signers = fleet.keys.allowed_signers()
    archives = {each.id: support_package(each, fleet.config, signers) for each in fleet.robots}
    kits = {robot: Kit(archive, package_id(archive)) for robot, archive in archives.items()}
    everybody = Plan(canary=0, wave=1.0, stop_at=len(fleet.robots) + 1)
    return _run(order, fleet, everybody, kits)


def update(order: Order) -> int:
    """Bring robots to a release in waves; return the exit code."""
    return _run(order, Fleet.of(order), order.plan, {})


def _run(order: Order, fleet: Fleet, plan: Plan, kits: dict[str, Kit]) -> int:
    board = Board(Rollout.of(fleet.ids, plan))
    with tempfile.TemporaryDirectory(prefix="fullswarm-") as scratch:
        work = Work(
            fleet.login,
            fleet.addresses,
            Store.default(),
            Parcels(Path(scratch)),
            output.progress,
            fleet.keys.allowed_signers(),
            named=order.release,
            target=order.target,
            kits=kits,
            needs={each.id: needs(each, fleet.config) for each in fleet.robots},
            public_key=public(fleet.keys.fleet_key()),
            guard_s=order.guard_s,
            force=order.force,
        )
        if order.release is not None:
            work.store.get(order.release)  # a wrong name is no robot's fault
        try:
            asyncio.run(_perform(order, fleet, board, work, first_contact=bool(kits)))
        except KeyboardInterrupt:
            tell(_rows(fleet, board), as_json=order.as_json)
            raise
    if board.rollout.stopped:
        output.progress(f"stopped after {plan.stop_at} failures: the others keep what they run")
    return tell(_rows(fleet, board), as_json=order.as_json)


async def _perform(order: Order, fleet: Fleet, board: Board, work: Work, *, first_contact: bool) -> None:
    strangers: dict[str, FullswarmError] = {}
    if first_contact and not order.dry_run:
        known = tuple(fleet.addresses.values())
        strangers = await people.get_to_know(fleet.login, known, accept=order.accept_host_keys)
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
        await perform(board, hands, order.at_a_time, order.keep_trying_s)
    except asyncio.CancelledError:
        board.interrupted(order.guard_s)
        raise
    finally:
        Desired.of(fleet.config.swarm).want(_wanted(board, work))
        board.held()


def _wanted(board: Board, work: Work) -> dict[str, str]:
    """What robots should run from now on: what they were given; those that were away, what the others were given."""
    given = {robot: folder.name for robot, folder in work.releases.items()}
    away = [robot for robot, stage in board.rollout.stages.items() if stage is Stage.UNREACHABLE]
    if work.named is not None or len(set(given.values())) == 1:
        common = next(iter(given.values())) if given else work.store.get(work.named or "").name
        given.update(dict.fromkeys(away, common))
    unfit = [robot for robot, stage in board.rollout.stages.items() if stage is Stage.FAILED]
    return {robot: release for robot, release in given.items() if robot not in unfit}


def _rows(fleet: Fleet, board: Board) -> list[Row]:
    nothing = Outcome(Stage.WAITING, "not begun: nothing was changed", "update again")
    return [Row.of(each, board.outcomes.get(each, nothing)) for each in fleet.ids]
