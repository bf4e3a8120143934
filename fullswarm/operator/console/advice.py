"""What to do about a robot that needs attention: one short sentence, for people who stand beside it.

Only a reason with a code gets advice of its own. For all others the driver's own words, which stand beside the advice,
are all that is known.
"""

from __future__ import annotations

from fullswarm.messages import RobotHealth
from fullswarm.operator.view import RobotRow
from fullswarm.reasons import Code

LOW_BATTERY = 0.2
UNKNOWN = "Do what its driver says; where that names no cause, the cause is unknown: see the robot's log."
BARRED = "It is connected, but bars motion: mend what it says, then ask again."

_FLOOR = "Put all its wheels on the floor, away from edges."
_CAUSES: dict[str, str] = {
    Code.CHARGER: "Take it off its charger.",
    Code.CLIFF: _FLOOR,
    Code.WHEEL_DROP: _FLOOR,
    Code.OVERCURRENT: "Free its wheels.",
    Code.MOTORS_OFF: "Release its safety switch.",
}
_STOPS: dict[str, str] = _CAUSES | {
    Code.DRIVER: "Wait a moment; if it stays so, the robot's log says what its driver waits for.",
    Code.READING: "No sensor data comes, the cause is unknown: see the robot's log.",
    Code.HUB: "Bring the hub or its network back; the robot goes on by itself then.",
    Code.CORE: "See that the core runs and its network is up; the robot goes on by itself then.",
    Code.STALE: "See that the process which computes this behaviour runs and its network is up.",
    Code.BATTERY: "Charge it, or drive it there by hand.",
    Code.CLOCK: "Its computer is overloaded or was suspended: close other work there.",
    Code.POSE: "See that pose fixes arrive for this robot, and that its cameras or the motion capture see it.",
    Code.FENCE: "Drive it back by hand, or give it a goal inside the arena.",
}


def advise(row: RobotRow) -> str:
    """Return what to do about a robot; empty when there is nothing to do."""
    health = row.health
    if row.silent:
        return "Look whether it has power and network, and whether its agent runs; without its hub it stands by itself."
    if health is None:
        return "Only its place is heard: its agent may be starting."
    return _of(health)


def _of(health: RobotHealth) -> str:
    if health.lifecycle == "FAULT":
        return _CAUSES.get(health.fault_code, UNKNOWN)
    if health.fault:
        return _CAUSES.get(health.fault_code, BARRED)
    if health.estop:
        return "Look whether the way is free, then clear the e-stop."
    if health.stop_reason and (known := _on_stop(health)):
        return known
    if 0.0 <= health.battery < LOW_BATTERY:
        return "Charge it soon."
    if health.contacts:
        return "It touches something: drive it back by hand, or move the obstacle."
    if health.pose_note:
        return "Its pose is doubtful: see that its position source can see it, and that nobody carried it."
    if health.filter_note:
        return "The safety filter holds it back: give it more room, or another goal."
    return ""


def _on_stop(health: RobotHealth) -> str:
    """Return what to do about why it stands; empty where one of several causes is not known."""
    if health.stop_code != Code.HAZARD:
        return _STOPS.get(health.stop_code, "")
    found = dict.fromkeys(_CAUSES.get(each, "") for each in health.stop_parameters.get("hazards", "").split())
    return " ".join(found) if all(found) else ""
