"""Watches whether the drivers are ready, and ends the tasks of robots that must not drive on by themselves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fullswarm.agent.inbox import Inbox
from fullswarm.agent.pose_conflicts import PoseConflicts
from fullswarm.agent.robot_controller import RobotController, StopReason, explain_hazards
from fullswarm.drivers.base import Fleet, Lifecycle
from fullswarm.reasons import Code, given, reason

ENDING = [StopReason.DRIVER, StopReason.HAZARD, StopReason.BATTERY, StopReason.OVERLAP, StopReason.FRAME]


class DriverWatch:
    """Of one robot the lifecycle is followed; a whole swarm in lockstep has drivers that are always ready.

    Attributes
    ----------
    ready : which drivers were READY or ACTIVE at the last look, (n,)
    """

    def __init__(self, fleet: Fleet, controller: RobotController, inbox: Inbox, conflicts: PoseConflicts) -> None:
        self._fleet, self._controller, self._inbox, self._conflicts = fleet, controller, inbox, conflicts
        self.ready = np.zeros(len(fleet.ids), bool)
        self._state = Lifecycle.CLOSED
        self._been_ready = self._engaged = False

    def look(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Return which drivers are READY or ACTIVE, (n,)."""
        fleet = self._fleet
        if len(fleet.ids) == 1:
            state = fleet.lifecycle(0)
            self.ready[0] = state in (Lifecycle.READY, Lifecycle.ACTIVE)
            self._been_ready |= state in (Lifecycle.READY, Lifecycle.ACTIVE)
            self._watch_engaged(state)
        else:
            self.ready[:] = True
        return self.ready

    def _watch_engaged(self, state: Lifecycle) -> None:
        """Notice a driver that fell from ACTIVE to READY although its task goes on: a fault that came and went."""
        wished = bool(self._controller.drive_on[0])
        if self._engaged and wished and state is Lifecycle.READY:
            fault = given(self._fleet.fault(0), self._fleet.fault_code(0))
            self._inbox.spend(0, fault or reason(Code.DRIVER_STOPPED))
        # Engaged by the present wish: a driver still standing down from an earlier one will be READY on purpose.
        fresh = self._engaged or self._state is Lifecycle.READY
        self._engaged = wished and state is Lifecycle.ACTIVE and fresh
        self._state = state

    def end_unsafe_tasks(self, hazards: NDArray[np.uint8]) -> None:
        """End the tasks of robots that stand for a reason of `ENDING`; `hazards` (n,) of the newest reading."""
        reasons = self._controller.reason
        for row in np.flatnonzero(np.isin(reasons, ENDING)).tolist():
            if reasons[row] in (StopReason.OVERLAP, StopReason.FRAME):
                self._inbox.spend(row, self._conflicts.reason(row))
            elif reasons[row] == StopReason.HAZARD:
                self._inbox.spend(row, explain_hazards(int(hazards[row]), self._fleet.fault(row))[0])
            elif reasons[row] == StopReason.BATTERY:
                self._inbox.spend(row, reason(Code.BATTERY))
            elif self._been_ready and self._fleet.lifecycle(row) is Lifecycle.FAULT:
                # Before it was ever ready it has not stopped from anything: a base may be switched on late.
                self._inbox.spend(row, reason(Code.DRIVER_FAILED, fault=self._fleet.fault(row)))
