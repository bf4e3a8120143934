"""The page's table of robots, and the states that its map draws."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from fullswarm.messages import RobotHealth
from fullswarm.operator.robot_state import advise, ended_text, pose_text, row_state
from fullswarm.operator.view import Pose, RobotRow, Snapshot, memory_text

CORE = "core"
LONGEST_MEMORY = 200
"""Characters of what a control law remembers."""
UNKNOWN = RobotHealth(robot="", driver="", make="", model="", firmware="", lifecycle="")
"""A robot of which only the position is received."""


def states(poses: Iterable[Pose]) -> list[list[Any]]:
    """Return ``[id, x, y, heading, speed, age_s]`` for each of :meth:`FleetView.poses`, rounded to what can be seen."""
    return [
        [robot, round(x_m, 3), round(y_m, 3), round(heading_rad, 3), round(speed_m_s, 3), round(age_s, 2)]
        for robot, x_m, y_m, heading_rad, speed_m_s, age_s in poses
    ]


def core_age_s(seen: Snapshot) -> float | None:
    """Return how long the core has been silent; None: it was never received."""
    return next((node.age_s for node in seen.nodes if node.node == CORE), None)


def fleet(seen: Snapshot, now_s: float) -> dict[str, Any]:
    """Return the frame ``fleet``."""
    age_s = core_age_s(seen)
    return {
        "t": "fleet",
        "at": round(now_s, 3),
        "hub": seen.connected,
        "core_age_s": None if age_s is None else round(age_s, 2),
        "nodes": [{"node": node.node, "age_s": round(node.age_s, 2), "active": node.active} for node in seen.nodes],
        "robots": [_robot(row) for row in seen.robots],
        "missing": seen.missing,
        "docks": [
            {
                "dock": each.dock,
                "x": round(each.x_m, 3),
                "y": round(each.y_m, 3),
                "heading": round(each.heading_rad, 3),
                "approach_m": each.approach_m,
                "robot": each.robot,
                "phase": each.phase,
                "reason": each.reason,
            }
            for each in seen.docks
        ],
        "silent": seen.silent,
    }


def _robot(row: RobotRow) -> dict[str, Any]:
    state = row_state(row, "page")
    health = row.health or UNKNOWN
    return {
        "robot": row.robot,
        "age_s": round(row.age_s, 2),
        "silent": row.silent,
        "host": row.host,
        "version": row.version,
        "make": health.make,
        "model": health.model,
        "driver": health.driver,
        "firmware": health.firmware,
        "lifecycle": health.lifecycle,
        "behaviour": health.behaviour,
        "request_id": health.request_id,
        "moving": health.moving,
        "estop": health.estop,
        "state": state.text,
        "state_word": state.word,
        "state_why": state.why,
        "attention": state.attention,
        "brief": state.brief,
        "ended": ended_text(row),
        "stop_reason": health.stop_reason,
        "stop_code": health.stop_code,
        "fault": health.fault,
        "advice": advise(row, "page"),
        "battery": None if health.battery < 0.0 else _finite(health.battery),
        "contacts": health.contacts,
        "collisions": health.collisions,
        "radius_m": _finite(row.radius_m),
        "pose_source": health.pose_source,
        "pose_note": health.pose_note,
        "pose_by": pose_text(health),
        "deviation_m_s": _finite(health.deviation_m_s),
        "filter_note": health.filter_note,
        "capabilities": [] if row.profile is None else row.profile.capabilities,
        "actuators": dict(row.actuators),
        "memory": memory_text(row.memory)[:LONGEST_MEMORY],
    }


def _finite(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None
