"""States in a few words what a robot does, whether it needs attention, and what to do about that.

Only a reason with a code gets advice of its own. For all others the driver's own text, which is shown beside the
advice, is all that is known.
"""

from __future__ import annotations

from dataclasses import dataclass

from fullswarm.messages import RobotHealth
from fullswarm.operator.view import RobotRow
from fullswarm.reasons import BRIEF, CHARGES, DELIBERATE, Advice, Code, Reader, Reason, worded

STANDSTILL_M_S = 0.005
LOW_BATTERY = 0.2
FULL = 0.95
_CHARGES_NOT: dict[str, str] = {Code.CHARGE_WAITS: "WAITING", Code.DOCKED: "NOT CHARGED"}
_CHARGES: dict[str, str] = {
    Code.CHARGE_WAITS: "waiting for a dock", Code.CHARGE_GOING: "going to charge", Code.CHARGE_DOCKING: "docking",
    Code.CHARGING: "charging", Code.DOCKED: "charged", Code.CHARGE_LEAVING: "leaving its dock",
    Code.CHARGE_RETURNS: "returning to its task",
}  # fmt: skip
UNKNOWN = "Follow its driver's message; if that names no cause, see the robot's log."
PREVENTED = "It is connected, but prevents motion: remove the reported cause, then request again."

_FLOOR = "Put all its wheels on the floor, away from edges."
_CAUSES: dict[str, str] = {
    Code.CHARGER: "Take it off its charger.",
    Code.CLIFF: _FLOOR,
    Code.WHEEL_DROP: _FLOOR,
    Code.OVERCURRENT: "Free its wheels.",
    Code.MOTORS_OFF: "Release its safety switch.",
    Code.RANGES: "Check cable and power of its range sensor, and that nothing covers it; it continues by itself.",
}
_STOPS: dict[str, str | Advice] = {
    **_CAUSES,
    Code.DRIVER: "Wait a moment; if it persists, the robot's log shows what its driver waits for.",
    Code.READING: "No sensor data comes, the cause is unknown: see the robot's log.",
    Code.HUB: "Restart the hub or its network; the robot then continues by itself.",
    Code.CORE: "Check that the core runs and its network is up; the robot then continues by itself.",
    Code.STALE: "Check that the process which computes this behaviour runs and its network is up.",
    Code.BATTERY: "Charge it, or drive it there by hand.",
    Code.CLOCK: "Its computer is overloaded or was suspended: close other work there.",
    Code.POSE: "Check that pose fixes arrive for this robot, and that its cameras or the motion capture see it.",
    Code.NO_WAY: "Widen the way, lower the behaviour's safety_margin_m, or give it another goal.",
    Code.GOAL_CLOSED: "Give it a goal farther from the obstacle, or a larger arrive_radius_m.",
    Code.CHARGE_WAITS: Advice(
        "See `fullswarm docks`: free a dock that is blocked or has failed, or add one.",
        "See the docks on the map: free one that is blocked or has failed, or add one.",
    ),
    Code.DOCKED: "Check the dock's power and its contacts; the core sends the robot to another dock by itself.",
    Code.GEOFENCE: "Drive it back by hand, or give it a goal inside the arena.",
}


@dataclass(frozen=True, slots=True)
class RowState:
    """What a robot is doing, the reason of a problem, and whether it needs attention."""

    word: str
    why: str = ""
    attention: bool = False
    brief: str = ""  # what needs attention, in a word or two

    @property
    def text(self) -> str:
        """Return both in one line."""
        return f"{self.word}: {self.why}" if self.why else self.word


_DOUBTS = frozenset({Code.POSE, Code.UNSURE})


def row_state(row: RobotRow, reader: Reader = "shell") -> RowState:
    """Return what a robot is doing, in words for a reader."""
    health = row.health
    if row.silent:
        return RowState(f"SILENT for {row.age_s:.0f} s", attention=True, brief="silent")
    if health is None:
        return RowState("no health report", attention=True, brief="no health report")
    if health.fault or health.lifecycle == "FAULT":
        latched = "E-STOP, " if health.estop else ""
        # A robot that is connected, but prevents motion (a charger, a pilot), is stopped, not faulty.
        word = "FAULT" if health.lifecycle == "FAULT" else "STOPPED"
        brief = BRIEF.get(health.fault_code, word.lower())
        return RowState(latched + word, health.fault or "no reason given", attention=True, brief=brief)
    if health.estop:
        # Health comes twice a second, states twenty times: a robot at standstill must not be shown as moving.
        rolls = health.moving and not abs(row.speed_m_s) < STANDSTILL_M_S
        return RowState("E-STOP, still rolling" if rolls else "E-STOP", attention=True, brief="e-stop")
    if health.stop_code in CHARGES:
        # A robot that waits for a dock, or is in one that does not charge, may need help; the others do as planned.
        problem = _CHARGES_NOT.get(health.stop_code, "") if health.battery < FULL else ""
        brief = BRIEF[health.stop_code] if problem else ""
        return RowState(problem or _CHARGES[health.stop_code], health.stop_reason, bool(problem), brief)
    alarm = health.behaviour or health.stop_code not in DELIBERATE
    settled = health.stop_code == Code.SETTLED
    arrived = health.stop_code == Code.ARRIVED and not health.behaviour
    if health.stop_reason and health.stop_code != Code.EXPIRED and alarm and not settled:
        doubt = f": {health.pose_note}" if health.pose_note and health.stop_code in _DOUBTS else ""
        why = worded(Reason(health.stop_code, health.stop_reason, health.stop_parameters), reader) + doubt
        return RowState("STOPPED", why, attention=True, brief=_brief(health))
    doing = "moving" if health.moving else "settled" if settled else "arrived" if arrived else "standing"
    if health.lifecycle not in ("READY", "ACTIVE"):
        doing = f"{health.lifecycle.lower()}, not ready"
    if health.contacts:
        return RowState(f"{doing}, TOUCHING", attention=True, brief="touching")
    if 0.0 <= health.battery < LOW_BATTERY:
        return RowState(f"{doing}, BATTERY {health.battery:.0%}", attention=True, brief=f"battery {health.battery:.0%}")
    if health.message_note:
        return RowState(doing, health.message_note, attention=True, brief=BRIEF.get(health.message_code, "messages"))
    if health.pose_note:
        return RowState(doing, health.pose_note, attention=True, brief="pose uncertain")
    return RowState(doing, health.stop_reason if doing in ("settled", "arrived") else "")


def _brief(health: RobotHealth) -> str:
    """Return why it stands in a word or two: a hazard by its own name, if it is the only one."""
    code = health.stop_parameters.get("hazards", "") if health.stop_code == Code.HAZARD else health.stop_code
    return BRIEF.get(code, BRIEF.get(health.stop_code, "stopped"))


def ended_text(row: RobotRow) -> str:
    """Return how the newest behaviour of a robot has ended, if that was intended; empty: otherwise, or it runs one.

    A robot keeps the behaviour of a stick after the stick was released, and stands.
    """
    health = row.health
    if health is None or row.silent or health.estop or health.fault or health.stop_code in CHARGES:
        return ""
    if health.behaviour and health.stop_code != Code.EXPIRED:
        return ""
    return BRIEF.get(health.stop_code, "") if health.stop_code in DELIBERATE else ""


def pose_text(health: RobotHealth) -> str:
    """Return in words which sources of fixes a robot uses and how well they fit; empty when none comes."""
    return ", ".join(
        " ".join(
            filter(
                None,
                (
                    each.sensor,
                    f"({each.marker})" if each.marker else "",
                    "" if each.used else "not used:",
                    "" if each.used else each.refused or f"silent for {each.age_s:.1f} s",
                    f"{each.residual_m:.3f} m off" if each.residual_m >= 0.0 else "",
                ),
            )
        )
        for each in health.pose_sources
    )


def advise(row: RobotRow, reader: Reader = "shell") -> str:
    """Return what a reader can do about a robot; empty when there is nothing to do."""
    health = row.health
    if row.silent:
        return "Check its power and network, and that its agent runs; without its hub it stops by itself."
    if health is None:
        return "Only its position is received: its agent may be starting."
    return _of(health, reader)


def _of(health: RobotHealth, reader: Reader) -> str:
    if health.lifecycle == "FAULT":
        return _CAUSES.get(health.fault_code, UNKNOWN)
    if health.fault:
        return _CAUSES.get(health.fault_code, PREVENTED)
    if health.estop:
        return "Check that its surroundings are free, then clear the e-stop."
    if health.stop_code == Code.SETTLED:
        return "Nothing, if that is near enough; else give it another goal, or make room."
    if health.stop_code in CHARGES and health.stop_code not in _CHARGES_NOT:
        return ""
    if health.stop_reason and (known := _on_stop(health, reader)):
        return known
    if 0.0 <= health.battery < LOW_BATTERY:
        return "Charge it soon."
    if health.contacts:
        return "It touches something: drive it back by hand, or move the obstacle."
    if health.message_code == Code.FLOOD:
        return "Restart the agent that floods, or stop its behaviour; the others go on meanwhile."
    if health.pose_note:
        return "Its pose is uncertain: check that its position source sees it, and that it was not carried."
    if health.filter_note:
        return "The safety filter holds it back: give it more room, or another goal."
    return ""


def _on_stop(health: RobotHealth, reader: Reader) -> str:
    """Return what to do about its stop; empty if one of several causes is not known."""
    if health.stop_code != Code.HAZARD:
        known = _STOPS.get(health.stop_code, "")
        return str(getattr(known, reader)) if isinstance(known, Advice) else known
    found = dict.fromkeys(_CAUSES.get(each, "") for each in health.stop_parameters.get("hazards", "").split())
    return " ".join(found) if all(found) else ""
