"""The missions of the swarm as the page shows them, and the lines of the log for what becomes of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec

from fullswarm.messages import MissionStatus
from fullswarm.operator.missions import ENDED, SILENT_S

SHOWN_S = 60.0
"""A mission that has ended is shown for so long."""
MOST = 16


@dataclass(slots=True)
class Shown:
    """A mission's newest status, and when it was received."""

    status: MissionStatus
    received_s: float


class MissionBoard:
    """The newest status of each mission.

    Attributes
    ----------
    changed : something is to be sent
    """

    def __init__(self) -> None:
        self.changed = False
        self._missions: dict[str, Shown] = {}

    def add(self, status: MissionStatus, now_s: float) -> str:
        """Take in a status; return the line of the log for a mission that has changed its phase, else nothing."""
        before = self._missions.get(status.mission)
        if before is not None and before.status.core == status.core and before.status.sequence >= status.sequence:
            return ""
        if before is None and len(self._missions) >= MOST:
            oldest = min(self._missions, key=lambda key: self._missions[key].received_s)
            del self._missions[oldest]
        self._missions[status.mission] = Shown(status, now_s)
        self.changed = True
        if before is not None and before.status.phase == status.phase:
            return ""
        words = f"mission {status.name} is {status.phase}" if before or status.phase != "running" else (
            f"{status.operator} starts mission {status.name}"
        )  # fmt: skip
        return f"{words}: {status.reason}" if status.reason else words

    def statuses(self) -> tuple[MissionStatus, ...]:
        """Return the newest status of each mission."""
        return tuple(each.status for each in self._missions.values())

    def expire(self, now_s: float) -> None:
        """Leave out missions that ended some time ago."""
        for key, each in list(self._missions.items()):
            if each.status.phase in ENDED and now_s - each.received_s > SHOWN_S:
                del self._missions[key]
                self.changed = True

    def shown(self, now_s: float) -> dict[str, Any]:
        """Return the frame; the newest mission first."""
        missions = []
        for each in reversed(self._missions.values()):
            plain = msgspec.to_builtins(each.status)
            plain["silent"] = each.status.phase not in ENDED and now_s - each.received_s > SILENT_S
            missions.append(plain)
        return {"t": "missions", "missions": missions}
