"""What the page's detail pane shows of one robot: its newest values, its last minutes, its last requests.

All robots are sampled, so that a pane that is opened shows what led to the present; frames are made of those robots
alone whose pane is open.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import msgspec

from fullswarm.messages import RobotHealth
from fullswarm.operator.view import RobotRow, Snapshot

DETAIL_HZ = 2.0
MOTION_S, BATTERY_S, BATTERY_EVERY_S = 60.0, 1800.0, 10.0
MESSAGES = 20
"""The newest messages of a robot that are kept."""
LONGEST = 300
"""Characters of a message."""


@dataclass(slots=True)
class Samples:
    """The last minutes of one robot."""

    motion: deque[tuple[float, float, float]] = field(
        default_factory=lambda: deque(maxlen=int(MOTION_S * DETAIL_HZ))
    )  # time in s, speed and commanded speed in m/s
    battery: deque[tuple[float, float]] = field(
        default_factory=lambda: deque(maxlen=int(BATTERY_S / BATTERY_EVERY_S))
    )  # time in s, share
    messages: deque[tuple[str, str]] = field(default_factory=lambda: deque(maxlen=MESSAGES))  # time of day, text
    said: tuple[str, ...] = ()


class Details:
    """Samples all robots, and makes the frame of one.

    Parameters
    ----------
    wall_s : returns the time of day in s since 1970, for the times of messages
    """

    def __init__(self, wall_s: Callable[[], float]) -> None:
        self._wall_s = wall_s
        self._samples: dict[str, Samples] = {}

    def sample(self, seen: Snapshot, now_s: float) -> None:
        """Add the present values of all robots; forget robots that are gone."""
        if len(self._samples) > len(seen.robots):
            there = {row.robot for row in seen.robots}
            self._samples = {robot: each for robot, each in self._samples.items() if robot in there}
        for row in seen.robots:
            if row.health is not None and not row.silent:
                self._add(self._samples.setdefault(row.robot, Samples()), row, row.health, now_s)

    def _add(self, samples: Samples, row: RobotRow, health: RobotHealth, now_s: float) -> None:
        if math.isfinite(row.speed_m_s):
            samples.motion.append((now_s, row.speed_m_s, health.command_m_s))
        due = not samples.battery or now_s - samples.battery[-1][0] >= BATTERY_EVERY_S
        if health.battery >= 0.0 and due:
            samples.battery.append((now_s, health.battery))
        said = tuple(filter(None, _messages(health)))
        for text in said:
            if text not in samples.said:
                clock = f"{datetime.fromtimestamp(self._wall_s()):%H:%M:%S}"
                samples.messages.append((clock, text[:LONGEST]))
        samples.said = said

    def shown(self, row: RobotRow, now_s: float, more: Mapping[str, Any]) -> dict[str, Any]:
        """Return the frame ``detail`` of a robot, with `more` of what others know of it."""
        health, samples = row.health, self._samples.get(row.robot, Samples())
        return {
            "t": "detail",
            "robot": row.robot,
            "at": round(now_s, 2),
            "pose": _pose(row),
            "motion": _ago(samples.motion, now_s),
            "battery": _ago(samples.battery, now_s),
            "messages": [{"clock": clock, "text": text} for clock, text in reversed(samples.messages)],
            "turn_rad_s": _finite(row.turn_rad_s),
            "command_rad_s": None if health is None else _finite(health.command_rad_s),
            "deviation_m_s": None if health is None else _finite(health.deviation_m_s),
            "deviation_m": None if health is None else _finite(health.deviation_m),
            "round_trip_s": None if row.round_trip_s < 0.0 else round(row.round_trip_s, 4),
            "dropped": dict(row.dropped),
            **more,
        }


def _messages(health: RobotHealth) -> Iterable[str]:
    """Yield what a robot and its driver say now: each with what it is about."""
    if health.fault or health.lifecycle == "FAULT":
        yield f"driver: {health.fault or 'FAULT without a reason'}"
    yield f"driver is {health.lifecycle}"
    for about, text in (
        ("stands", health.stop_reason), ("pose", health.pose_note), ("messages", health.message_note),
        ("filter", health.filter_note),
    ):  # fmt: skip
        if text:
            yield f"{about}: {text}"


def _pose(row: RobotRow) -> dict[str, Any]:
    health = row.health
    return {
        "x_m": _finite(row.x_m),
        "y_m": _finite(row.y_m),
        "heading_rad": _finite(row.heading_rad),
        "source": "" if health is None else health.pose_source,
        "note": "" if health is None else health.pose_note,
        "sigma_m": _known(-1.0 if health is None else health.position_sigma_m),
        "heading_sigma_rad": _known(-1.0 if health is None else health.heading_sigma_rad),
        "sources": [] if health is None else [msgspec.to_builtins(each) for each in health.pose_sources],
    }


def _ago(samples: Iterable[tuple[float, ...]], now_s: float) -> list[list[float]]:
    """Return rows with their times relative to now, in s."""
    return [[round(at_s - now_s, 1), *(round(value, 3) for value in values)] for at_s, *values in samples]


def _finite(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None


def _known(value: float) -> float | None:
    return None if value < 0.0 or not math.isfinite(value) else round(value, 4)
