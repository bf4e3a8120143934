"""`fullswarm doctor --robot`: whether a robot is fit to drive today, and what mends it if not.

Two ways lead to a robot, and each is told apart from the other: the bus, on which its agent talks
(``preflight_bus.py``), and SSH, behind which its computer answers (``preflight_ssh.py``, judged by
``preflight_board.py``). Nothing moves; at the end its e-stop is pressed and released once if the operator agrees
(``preflight_estop.py``).
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from fullswarm import __version__, output
from fullswarm.bringup import preflight_board, preflight_bus, preflight_estop
from fullswarm.bringup.checks import Check, show
from fullswarm.bringup.preflight_bus import BusState
from fullswarm.bringup.preflight_estop import Agree
from fullswarm.bringup.preflight_ssh import Board, look
from fullswarm.bus.endpoint import host_of, is_loopback
from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.deploy.fleet import people
from fullswarm.deploy.fleet.hostkeys import HostKeyProblem
from fullswarm.deploy.fleet.login import Address, LoginRefused
from fullswarm.deploy.fleet.remote import need_asyncssh
from fullswarm.deploy.release.keys import Keys
from fullswarm.errors import ConfigError, FullswarmError, Unreachable, did_you_mean
from fullswarm.operator import session
from fullswarm.operator.session import Session, Target
from fullswarm.operator.view import FleetView

NOT_REACHED = 3


def run(config: SwarmConfig, robot_id: str, agree: Agree | None, *, as_json: bool) -> int:
    """Print the checks; return 0 without a failure, else 1, and 3 when nothing of the robot answers.

    Parameters
    ----------
    agree
        Asks whether its e-stop may be pressed for a moment; None: it is not.

    Raises
    ------
    ConfigError
        The fleet has no such robot.
    """
    robot = _named(config, robot_id)
    reached = {"bus": False, "ssh": False}
    about: dict[str, Any] = {"robot": robot.id, "reached": reached}
    failed = show(_checks(config, robot, agree, reached), as_json=as_json, about=about)
    if not any(reached.values()):
        return NOT_REACHED
    return 1 if failed else 0


def _named(config: SwarmConfig, robot_id: str) -> RobotConfig:
    for robot in config.robot:
        if robot.id == robot_id:
            return robot
    hint = did_you_mean(robot_id, config.robots)
    raise ConfigError(f"no robot '{robot_id}' in the fleet", where="--robot", hint=hint)


@dataclass(frozen=True, slots=True)
class Ways:
    """What came of the two ways to a robot.

    Parameters
    ----------
    bus
        A BusState, or why there is none: no hub answers.
    ssh
        A Board, or why there is none; None: a simulated robot has no computer of its own.
    """

    bus: BusState | FullswarmError
    ssh: Board | FullswarmError | None

    @property
    def heard(self) -> bool:
        """Return whether it is reachable on the bus."""
        return isinstance(self.bus, BusState) and self.bus.there

    @property
    def answers(self) -> bool:
        """Return whether its computer answers, even if it refuses the login."""
        return isinstance(self.ssh, Board | HostKeyProblem | LoginRefused)


def _checks(config: SwarmConfig, robot: RobotConfig, agree: Agree | None, reached: dict[str, bool]) -> Iterator[Check]:
    with ExitStack() as stack:
        line, view, bus = _listen(config, robot, stack)
        ways = Ways(bus, _look(config, robot))
        reached["bus"], reached["ssh"] = ways.heard, isinstance(ways.ssh, Board)
        yield _by_ssh(ways)
        if isinstance(ways.ssh, Board):
            port, net = port_of(robot)
            yield from preflight_board.checks(ways.ssh, robot.id, __version__, port=port, net=net)
        yield _by_bus(config, robot, ways)
        if isinstance(bus, BusState) and bus.there and line is not None and view is not None:
            yield from preflight_bus.checks(bus, config.agent.battery_low)
            if agree is None:
                yield Check(preflight_estop.NAME, "ok", "not pressed: not wanted")
            else:
                yield preflight_estop.check(line, view, robot.id, agree)


def _listen(
    config: SwarmConfig, robot: RobotConfig, stack: ExitStack
) -> tuple[Session | None, FleetView | None, BusState | FullswarmError]:
    output.progress(f"listening for {robot.id} on {config.hub.endpoint}")
    try:
        line = stack.enter_context(session.connect(Target(config.hub.endpoint, config.swarm)))
    except Unreachable as error:
        return None, None, error
    view = FleetView(line.bus, line.keys, line.runtime, (robot.id,))
    stack.callback(view.close)
    return line, view, preflight_bus.listen(line, view, robot.id)


def _look(config: SwarmConfig, robot: RobotConfig) -> Board | FullswarmError | None:
    if robot.simulated and not robot.host:
        return None
    address = Address.of(robot)
    output.progress(f"logging in to {address.where} as {address.user}")
    try:
        need_asyncssh()
        return asyncio.run(look(people.login(config, Keys.default()), address, *port_of(robot)))
    except FullswarmError as error:
        return error


def port_of(robot: RobotConfig) -> tuple[str, str]:
    """Return the path of its driver's serial port and the name of its CAN interface; empty: it has none."""
    parts = urlsplit(robot.url)
    path = unquote(parts.path)
    if robot.simulated:
        return "", ""
    if path.strip("/"):
        return path, ""
    interface = parse_qs(parts.query).get("interface", ["socketcan"])
    if not parts.scheme.startswith("can+") or interface != ["socketcan"]:
        return "", ""
    return "", unquote(parts.netloc)


# ---------------------------------------------------------------- one way, the other, both or none
def _by_ssh(ways: Ways) -> Check:
    if ways.ssh is None:
        return Check("ssh", "ok", "a simulated robot has no computer of its own")
    if isinstance(ways.ssh, Board):
        return Check("ssh", "ok", "its computer lets us in")
    what, where = ways.ssh.what, f"{ways.ssh.where}: " if ways.ssh.where else ""
    if ways.heard:
        what += "; but its agent is received on the bus, so it is switched on and in the network"
    return Check("ssh", "failure", f"{where}{what}", ways.ssh.hint)


def _by_bus(config: SwarmConfig, robot: RobotConfig, ways: Ways) -> Check:
    hub, bus = config.hub.endpoint, ways.bus
    if not isinstance(bus, BusState):
        also = "; but its computer answers: only the hub is missing" if ways.answers else ""
        mend = f"start it there: `fullswarm hub --listen {hub} --insecure-network`; check network and firewall"
        return Check("bus", "failure", f"{hub}: {bus.what}{also}", mend)
    if ways.heard:
        row = bus.row
        return Check("bus", "ok", f"{hub}: received, fullswarm {row.version if row else ''} aboard")
    was = "no longer received" if bus.row is not None else "not heard"
    what = f"{hub}: the hub answers, but {robot.id} is {was} in swarm '{config.swarm}'"
    if not ways.answers:
        return Check("bus", "failure", what, "is it switched on and in this network?")
    what += ", although its computer answers"
    if is_loopback(host_of(hub)) and not is_loopback(robot.host or robot.id):
        mend = "hub.endpoint in the fleet file is this machine's own loopback: name an address that robots reach"
    elif isinstance(ways.ssh, Board) and ways.ssh.facts.agent.active:
        mend = f"its agent runs but does not reach {hub}: firewall, other swarm or an old fleet file there; "
        mend += f"fullswarm deploy {robot.id} brings the new one"
    else:
        mend = f"its agent does not run: fullswarm logs {robot.id}"
    return Check("bus", "failure", what, mend)
