"""Checks one robot before it drives, `fullswarm doctor --robot`, and reports what fixes what is wrong.

Two ways lead to a robot, and each is checked apart from the other: the bus, on which its agent publishes, and SSH, by
which its computer answers (``preflight_ssh.py``). Nothing moves; at the end its e-stop is pressed and released once if
the operator agrees: this proves that an e-stop reaches it, and how soon. No other operator's e-stop is cleared: a
latched robot is left alone, and one that another operator latches meanwhile stays latched.
"""

from __future__ import annotations

import asyncio
import statistics
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

import typer

from fullswarm import __version__, output
from fullswarm.bringup import checks
from fullswarm.bringup.certificates import check_certificates, names_of
from fullswarm.bringup.checks import Check, Status, show, took
from fullswarm.bringup.preflight_ssh import RobotComputer, computer, inspect
from fullswarm.bus.endpoint import host_of, is_loopback
from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.deploy.fleet.login import Address, HostKeyProblem, LoginRefused, login_for
from fullswarm.deploy.fleet.remote import need_asyncssh
from fullswarm.deploy.release.keys import Keys
from fullswarm.drivers.fleet_file import load_fleet
from fullswarm.errors import ConfigError, FullswarmError, Unreachable, did_you_mean
from fullswarm.messages import EStop, Ping
from fullswarm.operator import session
from fullswarm.operator.estop import EStopOrder
from fullswarm.operator.robot_state import LOW_BATTERY, advise
from fullswarm.operator.session import Session, Target
from fullswarm.operator.view import FleetView, RobotRow

NOT_REACHED = 3
LISTEN_S = 1.2
"""Two health reports, and the core's heartbeat of each second."""
PATIENCE_S = 3.0
PINGS = 20
PING_S = 0.5
FAR_S = 0.05
"""Half of the messages take longer there and back: driving by hand feels late."""
READY = ("READY", "ACTIVE")
ESTOP = "e-stop"
PRESS_S = RELEASE_S = 3.0
LATE_S, TOO_LATE_S = 0.2, 1.0
FRESH_S = 1.0
"""Health reports come at 2 Hz and on change: an older one may not know of a latch or a behaviour."""
ROLLED_M = 0.02
CROSSING_S = 0.3
"""Time within which another operator's order may cross ours."""

Agree = Callable[[str], bool | None]
"""Asks the operator; None: no terminal."""


def check_robot(fleet: Path | None, robot: str, *, press: bool, yes: bool, as_json: bool) -> int:
    """Print the checks of one robot and its computer.

    Parameters
    ----------
    press, yes
        Its e-stop may be pressed for a moment; without a question.

    Raises
    ------
    ConfigError
        No fleet file, a wrong one, or one without this robot.
    """
    if fleet is None:
        hint = "fullswarm doctor --robot r1 --fleet lab.toml, or FULLSWARM_FLEET"
        raise ConfigError("the fleet file says where a robot is: name it", where="--robot", hint=hint)
    agree = (lambda _: True) if yes else _ask
    return run(load_fleet(fleet), robot, agree if press else None, as_json=as_json)


def _ask(question: str) -> bool | None:
    """Ask at the terminal; None: there is none."""
    return typer.confirm(question, err=True) if sys.stdin.isatty() else None


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
    """The results of the two ways to a robot.

    Parameters
    ----------
    bus
        A BusState, or why there is none: no hub answers.
    ssh
        A Board, or why there is none; None: a simulated robot has no computer of its own.
    """

    bus: BusState | FullswarmError
    ssh: RobotComputer | FullswarmError | None

    @property
    def received(self) -> bool:
        """Return whether it is reachable on the bus."""
        return isinstance(self.bus, BusState) and self.bus.there

    @property
    def answers(self) -> bool:
        """Return whether its computer answers, even if it refuses the login."""
        return isinstance(self.ssh, RobotComputer | HostKeyProblem | LoginRefused)


def _checks(config: SwarmConfig, robot: RobotConfig, agree: Agree | None, reached: dict[str, bool]) -> Iterator[Check]:
    with ExitStack() as stack:
        line, view, bus = _listen(config, robot, stack)
        ways = Ways(bus, _look(config, robot))
        reached["bus"], reached["ssh"] = ways.received, isinstance(ways.ssh, RobotComputer)
        yield from checks.stopping(config)
        yield from check_certificates(config, (names_of(config)[-1], (robot.id, "robot")))
        yield _by_ssh(ways)
        if isinstance(ways.ssh, RobotComputer):
            port, net = port_of(robot)
            yield from computer(ways.ssh, robot.id, __version__, port=port, net=net)
        yield _by_bus(config, robot, ways)
        if isinstance(bus, BusState) and bus.there and line is not None and view is not None:
            yield from bus_checks(bus, config.agent.battery_low)
            if agree is None:
                yield Check(ESTOP, "ok", "not pressed: not wanted")
            else:
                yield estop_check(line, view, robot.id, agree)


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
    return line, view, listen(line, view, robot.id)


def _look(config: SwarmConfig, robot: RobotConfig) -> RobotComputer | FullswarmError | None:
    if robot.simulated and not robot.host:
        return None
    address = Address.of(robot)
    output.progress(f"logging in to {address.where} as {address.user}")
    try:
        need_asyncssh()
        return asyncio.run(inspect(login_for(config, Keys.default()), address, *port_of(robot)))
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


# ---------------------------------------------------------------- whether it is reached
def _by_ssh(ways: Ways) -> Check:
    if ways.ssh is None:
        return Check("ssh", "ok", "a simulated robot has no computer of its own")
    if isinstance(ways.ssh, RobotComputer):
        return Check("ssh", "ok", "the login works")
    what, where = ways.ssh.what, f"{ways.ssh.where}: " if ways.ssh.where else ""
    if ways.received:
        what += "; but its agent is received on the bus, so it is switched on and in the network"
    return Check("ssh", "failure", f"{where}{what}", ways.ssh.hint)


def _by_bus(config: SwarmConfig, robot: RobotConfig, ways: Ways) -> Check:
    hub, bus = config.hub.endpoint, ways.bus
    if not isinstance(bus, BusState):
        also = "; but its computer answers: only the hub is missing" if ways.answers else ""
        mend = f"start it there: `fullswarm hub --listen {hub} --insecure-network`; check network and firewall"
        return Check("bus", "failure", f"{hub}: {bus.what}{also}", mend)
    if ways.received:
        row = bus.row
        return Check("bus", "ok", f"{hub}: received, fullswarm {row.version if row else ''} on board")
    was = "no longer received" if bus.row is not None else "not received"
    what = f"{hub}: the hub answers, but {robot.id} is {was} in swarm '{config.swarm}'"
    if not ways.answers:
        return Check("bus", "failure", what, "is it switched on and in this network?")
    what += ", although its computer answers"
    if is_loopback(host_of(hub)) and not is_loopback(robot.host or robot.id):
        mend = "hub.endpoint in the fleet file is this machine's own loopback: name an address that robots reach"
    elif isinstance(ways.ssh, RobotComputer) and ways.ssh.facts.agent.active:
        mend = f"its agent runs but does not reach {hub}: firewall, other swarm or an old fleet file there; "
        mend += f"fullswarm deploy {robot.id} installs the new one"
    else:
        mend = f"its agent does not run: fullswarm logs {robot.id}"
    return Check("bus", "failure", what, mend)


# ---------------------------------------------------------------- on the bus
@dataclass(frozen=True, slots=True)
class BusState:
    """What was received from a robot on the bus.

    Parameters
    ----------
    row
        None: it was not received.
    trips_s
        How long each ping took there and back that was answered.
    lost
        How many were not.
    """

    row: RobotRow | None = None
    core: bool = False
    trips_s: tuple[float, ...] = ()
    lost: int = 0

    @property
    def there(self) -> bool:
        """Return whether it is received now."""
        return self.row is not None and not self.row.silent


def listen(line: Session, view: FleetView, robot: str) -> BusState:
    """Wait for a robot's messages, then ping it."""
    line.run(LISTEN_S)
    if _row(view, robot) is None:
        waiting = line.runtime.every(0.05, lambda: line.runtime.pause() if _row(view, robot) else None)
        line.run(PATIENCE_S - LISTEN_S)
        waiting.cancel()
    seen = view.snapshot()
    received = BusState(_row(view, robot), any(node.node == "core" and node.age_s < LISTEN_S for node in seen.nodes))
    if not received.there:
        return received
    trips_s = tuple(took_s for number in range(PINGS) if (took_s := _ping(line, robot, number)) is not None)
    return BusState(received.row, received.core, trips_s, PINGS - len(trips_s))


def _row(view: FleetView, robot: str) -> RobotRow | None:
    return next((row for row in view.snapshot().robots if row.robot == robot and row.health is not None), None)


def _ping(line: Session, robot: str, number: int) -> float | None:
    """Return how long one ping takes there and back, s; None: it was not answered in time."""
    ping, took_s, began_s = Ping(id=f"{line.source}/{number}", robot=robot), None, line.runtime.now_s()

    def answered(pong: Ping) -> None:
        nonlocal took_s
        if pong.id == ping.id and took_s is None:
            took_s = line.runtime.now_s() - began_s
            line.runtime.pause()

    waiting = line.bus.subscribe(line.keys.pong(robot), Ping, answered)
    line.bus.publish(line.keys.ping(robot), ping)
    line.run(PING_S)
    waiting.close()
    return took_s


# ---------------------------------------------------------------- what that means
def bus_checks(received: BusState, battery_low: float) -> Iterator[Check]:
    """Check a robot that is received.

    Parameters
    ----------
    battery_low
        Share at which its agent lets it stand.
    """
    row = received.row
    if row is None or row.health is None:
        return
    yield _round_trip(received)
    if not received.core:
        yield Check("core", "warning", "no core is received: behaviours cannot be requested", "start `fullswarm core`")
    yield _driver(row)
    yield _battery(row.health.battery, battery_low)


def _round_trip(received: BusState) -> Check:
    name = "round trip (bus)"
    if not received.trips_s:
        what = f"none of {received.lost} pings was answered, although its health reports arrive"
        return Check(name, "failure", what, "an older release? `fullswarm update` brings it to this one")
    middle_s, worst_s = statistics.median(received.trips_s), max(received.trips_s)
    what = f"half of {len(received.trips_s)} within {took(middle_s)}, all within {took(worst_s)}"
    if received.lost:
        what += f"; {received.lost} not answered in {took(PING_S)}"
    if received.lost or middle_s > FAR_S:
        return Check(name, "warning", what, "nearer to the access point, another channel, or a less busy hub")
    return Check(name, "ok", what)


def _driver(row: RobotRow) -> Check:
    """Report the agent's state, with the console's advice."""
    health = row.health
    assert health is not None  # noqa: S101  (narrows the type; checks() has looked)
    robot = " ".join(filter(None, (health.make, health.model, health.firmware)))
    troubles = [health.fault, "its e-stop is latched" if health.estop else health.stop_reason, health.pose_note]
    what = "; ".join(filter(None, (f"{robot}: {health.lifecycle}", *troubles)))
    bad = health.lifecycle not in READY or bool(health.fault)
    status: Status = "failure" if bad else "warning" if any(troubles) else "ok"
    if status == "ok":
        return Check("driver", "ok", what)
    mend = "fullswarm estop --clear, when the way is free" if health.estop and not bad else advise(row)
    return Check("driver", status, what, mend or "check its cable and power")


def _battery(share: float, low: float) -> Check:
    if share < 0.0:
        return Check("battery", "ok", "unknown: this robot does not report it")
    if share <= low:
        return Check("battery", "failure", f"{share:.0%}: at {low:.0%} it stops", "charge it")
    if share < LOW_BATTERY:
        return Check("battery", "warning", f"{share:.0%}", "charge it soon")
    return Check("battery", "ok", f"{share:.0%}")


# ---------------------------------------------------------------- its e-stop
def estop_check(line: Session, view: FleetView, robot: str, agree: Agree) -> Check:
    """Press and release if the robot is at standstill, is free and the operator agrees."""
    others = _Others(line, robot)
    try:
        line.run(FRESH_S)  # older messages may be minutes old: the operator may have taken so long to answer
        if reason := _unfit(view, robot, line.operator.name):
            return Check(ESTOP, "warning", f"not pressed: {reason}", f"then again: fullswarm doctor --robot {robot}")
        agreed = agree(f"Press the e-stop of {robot} for a moment and release it again? Nothing moves by this.")
        if agreed is None:
            return Check(
                ESTOP,
                "warning",
                "not pressed: no terminal to ask for confirmation",
                "--yes skips the confirmation prompt",
            )
        if not agreed:
            return Check(ESTOP, "ok", "not pressed: not wanted")
        line.run(FRESH_S)
        if others.pressed or (reason := _unfit(view, robot, line.operator.name)):
            what = f"not pressed: {reason or 'another operator has just pressed it'}"
            return Check(ESTOP, "warning", what, f"then again: fullswarm doctor --robot {robot}")
        return _press(line, robot, others)
    finally:
        others.close()


class _Others:
    """Watches whether another operator presses this robot's e-stop."""

    def __init__(self, line: Session, robot: str) -> None:
        self.pressed = ""
        self._robot, self._source = robot, line.source
        self._subscription = line.bus.subscribe(line.keys.estop, EStop, self._hear)

    def _hear(self, order: EStop) -> None:
        if order.engaged and order.source != self._source and (not order.robots or self._robot in order.robots):
            self.pressed = order.source or "another operator"

    def close(self) -> None:
        self._subscription.close()


def _unfit(view: FleetView, robot: str, name: str) -> str:
    """Return why it must not be pressed now; empty if it may."""
    seen = view.snapshot()
    row = next((each for each in seen.robots if each.robot == robot), None)
    if row is None or row.health is None or row.silent:
        return f"{robot} is not received"
    health, holder = row.health, seen.holders.get(robot, "")
    if health.estop:
        return "it is latched already, and stays so"
    if health.moving:
        return "it moves"
    if health.behaviour:
        return f"it runs {health.behaviour}, which this would end"
    if holder and holder != name:
        return f"{holder} holds it"
    if health.lifecycle not in ("READY", "ACTIVE"):
        return f"its driver is {health.lifecycle}: its standstill could not be verified"
    return ""


def _press(line: Session, robot: str, others: _Others) -> Check:
    interrupted = False

    def interrupt() -> None:
        nonlocal interrupted
        interrupted = True
        line.runtime.pause()

    released: EStopOrder | None = None
    line.on_interrupt = interrupt  # Ctrl-C now means: release it first
    try:
        pressed = _order(line, robot, engaged=True, within_s=PRESS_S)
    finally:
        line.on_interrupt = None
        if not others.pressed:
            released = _release(line, robot)
    if interrupted:
        raise KeyboardInterrupt
    if released is not None and not released.overruled_by:
        line.run(CROSSING_S)
        if others.pressed:  # on its way while we released: that must not have undone it
            _order(line, robot, engaged=True, within_s=PRESS_S)
            released = None
    return _judge(robot, pressed, released, others.pressed)


def _order(line: Session, robot: str, *, engaged: bool, within_s: float) -> EStopOrder:
    order = line.operator.estop(
        engaged,
        (robot,),
        "preflight: is released again at once" if engaged else "preflight",
        deadline_s=within_s,
        on_done=lambda _: line.runtime.pause(),
    )
    line.run(within_s + 0.5)
    order.close()
    return order


def _release(line: Session, robot: str) -> EStopOrder:
    try:
        return _order(line, robot, engaged=False, within_s=RELEASE_S)
    except BaseException:
        output.progress(f"{robot} may still be latched: fullswarm estop --clear {robot}")
        raise


def _judge(robot: str, pressed: EStopOrder, released: EStopOrder | None, other: str) -> Check:
    clear = f"fullswarm estop --clear {robot}"
    if released is None:
        return Check(ESTOP, "warning", f"{other} pressed it meanwhile: it stays latched", f"when that is over: {clear}")
    if released.overruled_by:
        return Check(ESTOP, "warning", "another operator pressed it during the release: it stays latched", clear)
    if released.unconfirmed():
        return Check(ESTOP, "failure", "pressed, but its release was not confirmed: it may still be latched", clear)
    if pressed.silent():
        what = f"not confirmed within {took(pressed.elapsed_s)}"
        return Check(ESTOP, "failure", what, "do not drive it before this works: check the network")
    if pressed.unconfirmed():
        what = "latched, but its agent does not see it standing"
        return Check(ESTOP, "failure", what, f"check the driver: fullswarm logs {robot}")
    answered_s, stood_s = pressed.answered_s[robot], pressed.confirmed_s[robot]
    what = f"receipt after {took(answered_s)}, seen standing after {took(stood_s)}, released again"
    if pressed.receipts[robot].rolled_m > ROLLED_M:
        what = f"{what}; it rolled {pressed.receipts[robot].rolled_m:.3f} m"
        return Check(ESTOP, "failure", what, "it was reported at standstill: check its wheels and its encoders")
    if answered_s > LATE_S:
        mend = "check the network before it drives"
        return Check(ESTOP, "failure" if answered_s > TOO_LATE_S else "warning", what, mend)
    return Check(ESTOP, "ok", what)
