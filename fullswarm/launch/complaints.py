"""Tells the person at the terminal of `up` what goes wrong: processes that end, drivers that fail.

Each log has it too, but there may be sixteen of them. What repeats is printed
once, and later how often it came again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.launch.supervisor import Child
from fullswarm.messages import HealthReport
from fullswarm.output import one_line
from fullswarm.runtime import Scheduler

AGAIN_S = 10.0
"""How often it is printed at most that something came again."""
MOST = 256
"""Different complaints that are remembered: the names in them come from the network."""
LASTS_S = 0.7
"""A fault that is over sooner is not printed."""
LONGEST = 300
TAIL_BYTES = 8192


@dataclass(slots=True)
class _Seen:
    count: int = 1
    printed: int = 1
    at_s: float = 0.0


class Complaints:
    """Prints what goes wrong, once each, with the log's path.

    Parameters
    ----------
    log_file : returns the log of a process by its name
    say : prints a line
    """

    def __init__(self, scheduler: Scheduler, log_file: Callable[[str], Path], say: Callable[[str], None]) -> None:
        self._scheduler, self._log_file, self._say = scheduler, log_file, say
        self._seen: dict[str, _Seen] = {}
        self._faults: dict[str, str] = {}
        self._failing: set[str] = set()
        scheduler.every(AGAIN_S, self._count)

    def listen(self, bus: Bus, keys: Keys) -> None:
        """Take the faults that drivers report from the bus."""
        bus.subscribe(keys.health(), HealthReport, self.on_health)

    def ended(self, child: Child) -> None:
        """Report a process that has ended by itself."""
        how = {"frozen": "was frozen and was killed", "signal": f"was killed by signal {child.code}"}
        what = how.get(child.ended, f"ended with exit code {child.code}")
        why = "" if child.ended == "frozen" else last_line(self._log_file(child.name))
        self._complain(child.name, f"{what}{f': {why}' if why else ''}; it is started again")

    def on_health(self, report: HealthReport) -> None:
        """Report the faults of robots that are new."""
        for health in report.robots[:MOST]:
            robot, fault = health.robot, health.fault
            before = self._faults.get(robot, "")
            if fault == before or (robot not in self._faults and len(self._faults) >= MOST):
                continue
            self._faults[robot] = fault
            if fault:
                self._scheduler.after(LASTS_S, partial(self._check, robot, fault))
            elif robot in self._failing:
                self._failing.discard(robot)
                self._say(f"{robot}: works again")

    def _check(self, robot: str, fault: str) -> None:
        """Report a fault that is still there: while a swarm starts, drivers wait for the world for a moment."""
        if self._faults.get(robot) == fault:
            self._failing.add(robot)
            self._complain(robot, fault)

    def _complain(self, name: str, what: str) -> None:
        text = one_line(f"{name}: {what[:LONGEST]}")
        seen = self._seen.get(text)
        if seen is not None:
            seen.count += 1
            return
        if len(self._seen) >= MOST:
            del self._seen[next(iter(self._seen))]
        self._seen[text] = _Seen(at_s=self._scheduler.now_s())
        log = self._log_file(name)
        self._say(f"{text} (log: {log})" if log.exists() else text)

    def _count(self) -> None:
        """Print how often each complaint came again, and was not counted yet."""
        for text, seen in self._seen.items():
            if seen.count > seen.printed:
                self._say(f"{text} ({seen.count} times since {self._scheduler.now_s() - seen.at_s:.0f} s)")
                seen.printed = seen.count


def last_line(log: Path) -> str:
    """Return the line of a log that says why its process ended: the last error, else the last line."""
    try:
        with log.open("rb") as file:
            file.seek(max(0, log.stat().st_size - TAIL_BYTES))
            lines = [line.strip() for line in file.read().decode(errors="replace").splitlines() if line.strip()]
    except OSError:
        return ""
    errors = [line for line in lines if line.startswith("error: ")]
    return (errors or lines or [""])[-1].removeprefix("error: ")
