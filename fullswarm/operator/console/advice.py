"""What to do about a robot that needs attention: one short sentence, for people who stand beside it.

Only words that name one cause get advice of their own, and only as a whole: part of a sentence may be about something
else. For all others the driver's own words, which stand beside the advice, are all that is known.
"""

from __future__ import annotations

from fullswarm.messages import RobotHealth
from fullswarm.operator.view import RobotRow

LOW_BATTERY = 0.2
UNKNOWN = "Do what its driver says; where that names no cause, the cause is unknown: see the robot's log."
BARRED = "It is connected, but bars motion: mend what it says, then ask again."

_FLOOR = "Put all its wheels on the floor, away from edges."
_CAUSES = {
    "the charger is plugged in": "Take it off its charger.",
    "a cliff sensor sees no floor": _FLOOR,
    "a wheel hangs": _FLOOR,
    "a wheel motor draws too much current (overcurrent)": "Free its wheels.",
    "its safety switch keeps the motors off": "Release its safety switch.",
}
_STOPS = _CAUSES | {
    "the driver is not ready": "Wait a moment; if it stays so, the robot's log says what its driver waits for.",
    "the robot has told nothing new for too long": "No sensor data comes, the cause is unknown: see the robot's log.",
    "the hub is lost": "Bring the hub or its network back; the robot goes on by itself then.",
    "the core's heartbeat is silent": "See that the core runs and its network is up; the robot goes on by itself then.",
    "no fresh command": "See that the process which computes this behaviour runs and its network is up.",
    "the battery is low; charge it, or drive it to its charger by hand": "Charge it, or drive it there by hand.",
    "this computer stood still; what it knows is too old": "Its computer is overloaded or was suspended: close other "
    "work there.",
    "the estimator has no pose": "See that pose fixes arrive for this robot, and that its cameras or the motion "
    "capture see it.",
    "it would leave the arena": "Drive it back by hand, or give it a goal inside the arena.",
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
        return _known(_CAUSES, health.fault) or UNKNOWN
    if health.fault:
        return _known(_CAUSES, health.fault) or BARRED
    if health.estop:
        return "Look whether the way is free, then clear the e-stop."
    if health.stop_reason and (known := _known(_STOPS, health.stop_reason)):
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


def _known(table: dict[str, str], text: str) -> str:
    """Return the advice on a text that is a known cause, or several of them, and names nothing else."""
    causes = text.rpartition(": ")[2].split(" and ")  # a driver says first where
    found = dict.fromkeys(table.get(cause, "") for cause in causes)
    return " ".join(found) if all(found) else ""
