"""Checks a robot over the bus before it drives: presence, round trip, health."""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from dataclasses import dataclass

from fullswarm.bringup.checks import Check, Status, took
from fullswarm.messages import Ping
from fullswarm.operator.robot_state import LOW_BATTERY, advise
from fullswarm.operator.session import Session
from fullswarm.operator.view import FleetView, RobotRow

LISTEN_S = 1.2
"""Two health reports, and the core's heartbeat of each second."""
PATIENCE_S = 3.0
PINGS = 20
PING_S = 0.5
FAR_S = 0.05
"""Half of the messages take longer there and back: driving by hand feels late."""
READY = ("READY", "ACTIVE")


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
    heard = BusState(_row(view, robot), any(node.node == "core" and node.age_s < LISTEN_S for node in seen.nodes))
    if not heard.there:
        return heard
    trips_s = tuple(took_s for number in range(PINGS) if (took_s := _ping(line, robot, number)) is not None)
    return BusState(heard.row, heard.core, trips_s, PINGS - len(trips_s))


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
def checks(heard: BusState, battery_low: float) -> Iterator[Check]:
    """Check a robot that is received.

    Parameters
    ----------
    battery_low
        Share at which its agent lets it stand.
    """
    row = heard.row
    if row is None or row.health is None:
        return
    yield _round_trip(heard)
    if not heard.core:
        yield Check("core", "warning", "no core is received: behaviours cannot be requested", "start `fullswarm core`")
    yield _driver(row)
    yield _battery(row.health.battery, battery_low)


def _round_trip(heard: BusState) -> Check:
    name = "round trip (bus)"
    if not heard.trips_s:
        what = f"none of {heard.lost} pings was answered, although its health reports arrive"
        return Check(name, "failure", what, "an older release? `fullswarm update` brings it to this one")
    middle_s, worst_s = statistics.median(heard.trips_s), max(heard.trips_s)
    what = f"half of {len(heard.trips_s)} within {took(middle_s)}, all within {took(worst_s)}"
    if heard.lost:
        what += f"; {heard.lost} not answered in {took(PING_S)}"
    if heard.lost or middle_s > FAR_S:
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
    return Check("driver", status, what, mend or "look at its cable and power")


def _battery(share: float, low: float) -> Check:
    if share < 0.0:
        return Check("battery", "ok", "not known: this robot does not report it")
    if share <= low:
        return Check("battery", "failure", f"{share:.0%}: at {low:.0%} it stands", "charge it")
    if share < LOW_BATTERY:
        return Check("battery", "warning", f"{share:.0%}", "charge it soon")
    return Check("battery", "ok", f"{share:.0%}")
