"""Keeps the newest of each robot in one table: a topic that does not depend on grid cells, hosts or their number.

States are published on keys that name a grid cell, and health by host: a chart of one robot would need all of them.
"""

from __future__ import annotations

import json

import msgspec

from fullswarm.messages import HealthReport, Message, RobotHealth, RobotStates
from fullswarm.recent import Recent
from fullswarm.record.recording import Schema
from fullswarm.record.scene import MOST_BODIES, SILENT_S, Drawn

ROBOTS = "/robots"
MOTION = ("x_m", "y_m", "heading_rad", "speed_m_s", "turn_rad_s")
"""Columns of the states that are shown."""


Kind = dict[str, str | list[str]]
NUMBER: Kind = {"type": ["number", "null"]}
TEXT: Kind = {"type": ["string", "null"]}
FLAG: Kind = {"type": ["boolean", "null"]}
COLUMNS: dict[str, Kind] = {
    "robot": {"type": "string"}, **dict.fromkeys(MOTION, NUMBER), "battery": NUMBER, "lifecycle": TEXT,
    "behaviour": TEXT, "moving": FLAG, "estop": FLAG, "stop_reason": TEXT, "fault": TEXT, "deviation_m_s": NUMBER,
    "age_s": NUMBER,
}  # fmt: skip
"""What is not known is null; `age_s` is the time since the robot's last message."""
ROWS = {"type": "array", "items": {"type": "object", "required": list(COLUMNS), "properties": COLUMNS}}
SCHEMA = Schema(
    "fullswarm.Robots",
    "jsonschema",
    json.dumps(
        {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            "type": "object",
            "required": ["robots"],
            "properties": {"robots": ROWS},
        }
    ).encode(),
    "json",
)
"""A row per robot, by id."""


class Table:
    """The newest state and health of each robot that has sent something within `SILENT_S`."""

    def __init__(self) -> None:
        self._states: Recent[str, tuple[float, RobotStates, int]] = Recent(MOST_BODIES)  # by robot: arrival, row
        self._health: Recent[str, tuple[float, RobotHealth]] = Recent(MOST_BODIES)

    def take(self, message: Message, now_s: float) -> None:
        """Take in a message; most are of no concern."""
        if isinstance(message, RobotStates):
            for row, robot in enumerate(message.robots):
                self._states[robot] = now_s, message, row
        elif isinstance(message, HealthReport):
            for health in message.robots:
                self._health[health.robot] = now_s, health

    def whole(self, now_s: float) -> Drawn:
        """Return the table as a message."""
        arrivals = [(robot, each[0]) for table in (self._states, self._health) for robot, each in table.items()]
        newest: dict[str, float] = {}
        for robot, arrival_s in arrivals:
            if now_s - arrival_s < SILENT_S:
                newest[robot] = max(arrival_s, newest.get(robot, arrival_s))
        rows = [self._row(robot) | {"age_s": now_s - newest[robot]} for robot in sorted(newest)]
        return Drawn(ROBOTS, SCHEMA, msgspec.json.encode({"robots": rows}))

    def _row(self, robot: str) -> dict[str, object]:
        row: dict[str, object] = {**dict.fromkeys(COLUMNS), "robot": robot}
        if robot in self._states:
            _, states, at = self._states[robot]
            row |= {name: getattr(states, name)[at] for name in MOTION}
        if robot in self._health:
            health = self._health[robot][1]
            row |= {
                "battery": health.battery if health.battery >= 0.0 else None, "lifecycle": health.lifecycle,
                "behaviour": health.behaviour, "moving": health.moving, "estop": health.estop,
                "stop_reason": health.stop_reason, "fault": health.fault, "deviation_m_s": health.deviation_m_s,
            }  # fmt: skip
        return row
