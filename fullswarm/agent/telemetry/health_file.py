"""The agent's own verdict on itself, as a file: what a base, or a robot alone, judges a new release by.

A release is good when the robot is READY or ACTIVE, its control loop keeps its rate, its driver answers, and something
the core or another robot is received over any link. A latched e-stop does not count: it outlives releases.
"""

from __future__ import annotations

import json
from collections import deque
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from fullswarm import __version__
from fullswarm.drivers.base import Lifecycle
from fullswarm.kernels import Array
from fullswarm.messages import RobotHealth

PERIOD_S = 1.0
RATE_SHARE = 0.9
"""A control loop that keeps so much of its rate is a healthy one."""
RATE_OVER_S = 3.0
NEVER = -1.0
UPTIME = Path("/proc/uptime")
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


@dataclass(frozen=True, slots=True)
class Vitals:
    """How a robot is right now; ages in seconds, -1: never."""

    robot: str
    lifecycle: str
    behaviour: str
    moving: bool
    estop: bool
    fault: str
    driver: str
    driver_answers: bool
    control_rate_hz: float
    control_rate_wanted_hz: float
    core_heard_s: float
    neighbours: int  # received recently
    battery: float  # 0 to 1; -1: unknown


@dataclass(frozen=True, slots=True)
class Process:
    """The process that wrote the verdict. `machine_s`, which no change of the clock affects, shows how old it is."""

    release: str  # id; empty: not run from a release
    pid: int
    boot_id: str
    machine_s: float  # since the machine was switched on, when this was written
    uptime_s: float  # since the agent was started
    version: str = __version__


def why_not(vitals: Vitals, core_silence_s: float) -> tuple[str, ...]:
    """Return what keeps a robot from being healthy, in words; empty when it is."""
    why = []
    if vitals.lifecycle not in (Lifecycle.READY, Lifecycle.ACTIVE):
        why.append(f"the robot is {vitals.lifecycle}{f': {vitals.fault}' if vitals.fault else ''}")
    if not vitals.driver_answers:
        why.append("its driver does not answer")
    if vitals.control_rate_hz < RATE_SHARE * vitals.control_rate_wanted_hz:
        slow, wanted = vitals.control_rate_hz, vitals.control_rate_wanted_hz
        why.append(f"its control loop runs at {slow:.1f} Hz instead of {wanted:g}")
    if not 0.0 <= vitals.core_heard_s <= core_silence_s and vitals.neighbours == 0:
        why.append("it receives neither the core nor another robot")
    return tuple(why)


class Rate:
    """Ticks per second over the last `RATE_OVER_S`."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, int]] = deque()

    def see(self, now_s: float, ticks: int) -> float:
        """Take the count of all ticks so far; return the rate in Hz, 0 before there is one."""
        self._seen.append((now_s, ticks))
        while len(self._seen) > 2 and now_s - self._seen[1][0] >= RATE_OVER_S:
            self._seen.popleft()
        since_s, before = self._seen[0]
        return (ticks - before) / (now_s - since_s) if now_s > since_s else 0.0


def vitals_of(
    report: RobotHealth, reading_age_s: float, core_age_s: float, neighbour_age_s: Array, rate_hz: float,
    wanted_hz: float, patience_s: tuple[float, float],
) -> Vitals:  # fmt: skip
    """Sum up the state of the one robot of an agent on board.

    Parameters
    ----------
    reading_age_s, core_age_s, neighbour_age_s
        Ages of the driver's reading, of the core's heartbeat and of each neighbour's state (k,), s; infinite: none.
    patience_s
        How old a reading of the driver and a state of a neighbour may be, s.
    """
    return Vitals(
        robot=report.robot,
        lifecycle=report.lifecycle,
        behaviour=report.behaviour,
        moving=report.moving,
        estop=report.estop,
        fault=report.fault,
        driver=report.driver,
        driver_answers=reading_age_s <= patience_s[0],
        control_rate_hz=round(rate_hz, 2),
        control_rate_wanted_hz=wanted_hz,
        core_heard_s=round(core_age_s, 3) if np.isfinite(core_age_s) else NEVER,
        neighbours=int(np.count_nonzero(neighbour_age_s <= patience_s[1])),
        battery=report.battery,
    )


def text_of(vitals: Vitals, process: Process, why: tuple[str, ...]) -> str:
    """Return the file: JSON, one key a line, so that a shell can read it as well."""
    value = {**asdict(vitals), **asdict(process), "healthy": not why, "why": list(why)}
    return json.dumps(value, indent=1, allow_nan=False) + "\n"


def machine_s() -> float:
    """Return how long this machine has been up, seconds, asleep or not: a shell reads the same number."""
    return float(UPTIME.read_text(encoding="ascii").split()[0])


def boot_id() -> str:
    """Return the id of this boot of the machine; empty where the kernel has none."""
    try:
        return BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        return ""
