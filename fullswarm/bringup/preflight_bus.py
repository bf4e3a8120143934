"""A robot before it drives, as the bus knows it: is it heard, how far away, how does it feel."""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from dataclasses import dataclass

from fullswarm.bringup.checks import Check, Status, took
from fullswarm.messages import Ping
from fullswarm.operator.console.advice import LOW_BATTERY, advise
from fullswarm.operator.session import Session
from fullswarm.operator.view import FleetView, RobotRow

LISTEN_S = 1.2
"""Two health reports, and what the core says each second."""
PATIENCE_S = 3.0
PINGS = 20
PING_S = 0.5
FAR_S = 0.05
"""Half of the messages take longer there and back: driving by hand feels late."""
READY = ("READY", "ACTIVE")


@dataclass(frozen=True, slots=True)
class Heard:
    """What the bus told of a robot.

    Parameters
    ----------
    row
        None: it was not heard.
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
        """Tell whether it is heard now."""
        return self.row is not None and not self.row.silent


def listen(line: Session, view: FleetView, robot: str) -> Heard:
    """Wait for a robot to be heard, then ping it."""
    line.run(LISTEN_S)
    if _row(view, robot) is None:
        waiting = line.runtime.every(0.05, lambda: line.runtime.pause() if _row(view, robot) else None)
        line.run(PATIENCE_S - LISTEN_S)
        waiting.cancel()
    seen = view.snapshot()
    heard = Heard(_row(view, robot), any(node.node == "core" and node.age_s < LISTEN_S for node in seen.nodes))
    if not heard.there:
        return heard
    trips_s = tuple(took_s for number in range(PINGS) if (took_s := _ping(line, robot, number)) is not None)
    return Heard(heard.row, heard.core, trips_s, PINGS - len(trips_s))


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
def checks(heard: Heard, battery_low: float) -> Iterator[Check]:
    """Judge a robot that is heard.

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
        yield Check("core", "warning", "no core is heard: nobody can ask for a behaviour", "start `fullswarm core`")
    yield _driver(row)
    yield _battery(row.health.battery, battery_low)


def _round_trip(heard: Heard) -> Check:
    name = "round trip (bus)"
    if not heard.trips_s:
        what = f"none of {heard.lost} pings was answered, although it is heard"
        return Check(name, "failure", what, "an older release? `fullswarm update` brings it to this one")
    middle_s, worst_s = statistics.median(heard.trips_s), max(heard.trips_s)
    what = f"half of {len(heard.trips_s)} within {took(middle_s)}, all within {took(worst_s)}"
    if heard.lost:
        what += f"; {heard.lost} not answered in {took(PING_S)}"
    if heard.lost or middle_s > FAR_S:
        return Check(name, "warning", what, "nearer to the access point, another channel, or a less busy hub")
    return Check(name, "ok", what)


def _driver(row: RobotRow) -> Check:
    """Tell what the agent says of its robot, with what the console would advise."""
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
        return Check("battery", "ok", "not known: this robot does not tell")
    if share <= low:
        return Check("battery", "failure", f"{share:.0%}: at {low:.0%} it stands", "charge it")
    if share < LOW_BATTERY:
        return Check("battery", "warning", f"{share:.0%}", "charge it soon")
    return Check("battery", "ok", f"{share:.0%}")
