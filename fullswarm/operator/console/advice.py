"""What to do about a robot that needs somebody: one short sentence, for people who stand beside it."""

from __future__ import annotations

from fullswarm.messages import RobotHealth
from fullswarm.operator.view import RobotRow

LOW_BATTERY = 0.2

_STOPS = (
    ("driver is not ready", "Wait a moment; if it stays so, look at its cable, power and `fullswarm doctor`."),
    ("told nothing new", "Its link is up but mute: look at the cable, then switch the robot off and on."),
    ("sees no floor", "Put all its wheels on the floor, away from edges."),
    ("wheel hangs", "Put all its wheels on the floor, away from edges."),
    ("overcurrent", "Free its wheels."),
    ("safety switch", "Release its safety switch."),
    ("stop button", "Release the button on the robot."),
    ("law failed", "Ask for another behaviour; the robot's log has the error."),
    ("hub is lost", "Bring the hub or its network back; the robot goes on by itself then."),
    ("core's heartbeat", "Start the core again (`fullswarm core`); the robot goes on by itself then."),
    ("no fresh command", "The process that computes this behaviour is silent: start `fullswarm centralised`."),
    ("battery is low", "Charge it, or drive it to its charger by hand."),
    ("computer stood still", "Its computer is overloaded or was suspended: close other work there."),
    ("no pose", "Let its cameras or motion capture see it; check that pose fixes arrive for this robot."),
    ("leave the arena", "Drive it back by hand, or give it a goal inside the arena."),
)
_GUARDIAN = "Its computer is slow, overloaded or out of memory: close other work there; its link is not the cause."
_FAULTS = (
    ("guards this port", _GUARDIAN),
    ("guardian", _GUARDIAN),
    ("is the world running", "Start the simulated world again: `fullswarm sim`."),
    ("permission", "Give this user access to the device: `fullswarm doctor` says how."),
    ("no such", "Plug the robot's adapter in; `fullswarm robots find` shows what is there."),
    ("charger", "Take it off its charger."),
    ("wheel hangs", "Put all its wheels on the floor, away from edges."),
    ("sees no floor", "Put all its wheels on the floor, away from edges."),
    ("battery", "Charge or change its battery."),
    ("overcurrent", "Free the wheels, then switch the robot off and on."),
    ("watchdog", "The link was silent too long: check the cable; it connects again by itself."),
    ("disarmed", "Arm it, or release its safety switch."),
)


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
        return of_fault(health.fault) or "Check power and cable; it connects again by itself. Its log has more."
    if health.fault:
        return of_fault(health.fault) or "It is connected, but bars motion: mend what it says, then ask again."
    if health.estop:
        return "Look whether the way is free, then clear the e-stop."
    if health.stop_reason and (known := _first(_STOPS, health.stop_reason)):
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


def of_fault(fault: str) -> str:
    """Return what to do about a driver's fault; empty when its text says nothing that is known here."""
    return _first(_FAULTS, fault)


def _first(table: tuple[tuple[str, str], ...], text: str) -> str:
    low = text.lower()
    return next((advice for sign, advice in table if sign in low), "")
