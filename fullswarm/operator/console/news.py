"""What happens to hub, core, robots and leases, as lines of the log: each change once."""

from __future__ import annotations

from dataclasses import dataclass, field

from fullswarm.messages import Lease
from fullswarm.operator.console import report
from fullswarm.operator.console.history import Journal
from fullswarm.operator.console.requests import named
from fullswarm.operator.view import Snapshot

CORE_SILENT_S = 1.0
NO_REASON = "a fault without a reason"


@dataclass(slots=True)
class News:
    """Compares what is seen with what was seen before."""

    journal: Journal
    _hub: bool | None = None
    _core: bool | None = None
    _silent: dict[str, bool] = field(default_factory=dict)
    _faults: dict[str, str] = field(default_factory=dict)
    _leases: dict[str, str] = field(default_factory=dict)

    def look(self, seen: Snapshot, now_s: float) -> None:
        """Write down what has changed of hub, core and robots."""
        if seen.connected != self._hub:
            if self._hub is not None or not seen.connected:
                self.journal.add(now_s, "link", "the hub is there" if seen.connected else "the hub is not there")
            self._hub = seen.connected
        age_s = report.core_age_s(seen)
        core = age_s is not None and age_s <= CORE_SILENT_S
        if core != self._core:
            if self._core is not None:
                self.journal.add(now_s, "link", "the core is there" if core else "the core is silent")
            self._core = core
        self._robots(seen, now_s)

    def _robots(self, seen: Snapshot, now_s: float) -> None:
        gone: list[str] = []
        back: list[str] = []
        faults: dict[str, list[str]] = {}
        for row in seen.robots:
            if row.silent != self._silent.get(row.robot, False):
                (gone if row.silent else back).append(row.robot)
            self._silent[row.robot] = row.silent
            health = row.health
            fault = "" if health is None or row.silent else health.fault or NO_REASON * (health.lifecycle == "FAULT")
            if fault and fault != self._faults.get(row.robot):
                faults.setdefault(fault, []).append(row.robot)
            self._faults[row.robot] = fault
        for fault, robots in faults.items():
            self.journal.add(now_s, "fault", f"{named(robots)}: {fault}", tuple(robots))
        for robots, text in ((gone, "silent"), (back, "heard again")):
            if robots:
                self.journal.add(now_s, "link", f"{named(robots)}: {text}", tuple(robots))

    def leased(self, leases: tuple[Lease, ...], now_s: float) -> bool:
        """Log which operator drives which robots; True when that has changed."""
        before, self._leases = self._leases, {lease.robot: lease.operator for lease in leases}
        if before == self._leases:
            return False
        taken: dict[tuple[str, str], list[str]] = {}
        for robot in sorted({*before, *self._leases}):
            change = before.get(robot, ""), self._leases.get(robot, "")
            if change[0] != change[1]:
                taken.setdefault(change, []).append(robot)
        for (old, new), robots in taken.items():
            whom = named(robots)
            text = f"{new} holds {whom}" + (f", taken from {old}" if old else "") if new else f"{old} gives {whom} back"
            self.journal.add(now_s, "lease", text, tuple(robots), by=new or old)
        return True
