"""Where the robots of the swarm benchmark meet it: a folder. Imports next to nothing, so that bare stays bare.

A robot touches ``<robot>.ready`` once it receives from all its senders, finds the window in ``window.json``, and leaves
what it measured in ``<robot>.json``. All stamps are of one machine's monotonic clock.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

GRACE_S = 0.5
"""Wait for stragglers after the window."""


@dataclass
class Result:
    """What one robot measured within the window."""

    sent: int = 0
    received: dict[str, int] = field(default_factory=dict)  # sender → arrived messages that were sent within the window
    ages_s: list[float] = field(default_factory=list)
    late_s: list[float] = field(default_factory=list)  # of each tick of its loop
    missed: int = 0
    tick_cpu_us: float = 0.0  # mean CPU time of a tick
    window_s: float = 0.0
    threads_cpu_s: dict[str, float] = field(default_factory=dict)

    def book(self, sender: str, stamp_s: float, arrived_s: float) -> None:
        """Note an arrival."""
        self.received[sender] = self.received.get(sender, 0) + 1
        self.ages_s.append(round(arrived_s - stamp_s, 6))


class Meeting:
    """The folder as one robot sees it."""

    def __init__(self, folder: Path, robot: str) -> None:
        self._folder, self._robot = folder, robot

    def ready(self) -> None:
        """Report that all senders are received."""
        (self._folder / f"{self._robot}.ready").touch()

    def window(self) -> tuple[float, float] | None:
        """Return begin and end once they are set."""
        file = self._folder / "window.json"
        if not file.exists():
            return None
        begin_s, end_s = json.loads(file.read_text())
        return begin_s, end_s

    def report(self, result: Result) -> None:
        """Leave the result, whole or not at all."""
        leave(self._folder / f"{self._robot}.json", asdict(result))


def leave(path: Path, value: object) -> None:
    """Write JSON so that no reader sees half of it."""
    part = path.with_suffix(".part")
    part.write_text(json.dumps(value))
    part.rename(path)


def threads_cpu_s() -> dict[str, float]:
    """Return the CPU seconds of this process by the name of the thread, numbers left off."""
    total: dict[str, float] = {}
    for task in Path("/proc/self/task").iterdir():
        name = (task / "comm").read_text().strip().rstrip("0123456789-")
        total[name] = total.get(name, 0.0) + int((task / "schedstat").read_text().split()[0]) * 1e-9
    return total


def spent_since(before_s: dict[str, float]) -> dict[str, float]:
    """Return what each kind of thread has used since then."""
    return {name: spent_s - before_s.get(name, 0.0) for name, spent_s in threads_cpu_s().items()}
