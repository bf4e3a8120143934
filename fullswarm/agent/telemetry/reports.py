"""What an agent tells the others about its robots: states and health."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from fullswarm.agent.motion.desired import DesiredMotion
from fullswarm.agent.motion.reflexes import DriverWatch, Standstill
from fullswarm.agent.motion.robot_controller import CODES, RobotController, StopReason, explain_hazards
from fullswarm.agent.orders.inbox import Inbox
from fullswarm.agent.orders.tasks import Tasks
from fullswarm.agent.pose.conflicts import PoseConflicts
from fullswarm.agent.pose.fixes import Fixes
from fullswarm.agent.safety.filter import SafetyFilter
from fullswarm.agent.state import AgentState, Identity
from fullswarm.drivers.base import Fleet
from fullswarm.kernels import Array, kernel
from fullswarm.keys import Keys, cell_of
from fullswarm.messages import ControlRequest, HealthReport, RobotHealth, RobotStates
from fullswarm.perf.calculators import Calculators
from fullswarm.reasons import NONE, Reason, reason
from fullswarm.runtime import LoopStats

NO_REQUEST = ControlRequest(request_id="", robot="", behaviour="", enable=False)

LONGEST_S = 0.2
"""A state is moved on from its reading by so much at most."""


@kernel
def moved_on(pose: Array, twist: Array, stamp_s: Array, now_s: float, there: Array) -> None:
    """Fill `there` (n, 3) with where robots are by now: a fast one goes its own radius between two readings."""
    for i in range(pose.shape[0]):
        age_s = min(max(now_s - stamp_s[i], 0.0), LONGEST_S)
        middle = pose[i, 2] + 0.5 * age_s * twist[i, 1]
        step_m = twist[i, 0] * age_s
        there[i, 0] = pose[i, 0] + step_m * math.cos(middle)
        there[i, 1] = pose[i, 1] + step_m * math.sin(middle)
        there[i, 2] = pose[i, 2] + age_s * twist[i, 1]


class Reports:
    """Makes the messages of one agent: states of its robots for the neighbours, health for the core and operators."""

    def __init__(
        self, identity: Identity, fleet: Fleet, state: AgentState, tasks: Tasks, controller: RobotController,
        drivers: DriverWatch, safety: SafetyFilter, calculators: Calculators, standstill: Standstill, fixes: Fixes,
        conflicts: PoseConflicts, wishes: DesiredMotion, inbox: Inbox,
    ) -> None:  # fmt: skip
        self._identity, self._fleet, self._state, self._tasks = identity, fleet, state, tasks
        self._controller, self._drivers, self._filter = controller, drivers, safety
        self._calculators, self._standstill, self._fixes = calculators, standstill, fixes
        self._conflicts, self._desired_motion, self._inbox = conflicts, wishes, inbox

    def states(self, keys: Keys, cell_m: float, sequence: int, now_s: float) -> Iterator[tuple[str, RobotStates]]:
        """Yield (key, message): one per grid cell that holds robots of this agent."""
        pose, twist = self._state.pose, self._state.twist
        if len(pose) > 1 and self._state.reading is not None:
            there = np.empty_like(pose)
            moved_on.run(pose, twist, self._state.reading.stamp_s, now_s, there)
            pose = there
        if len(pose) == 1:
            yield from self._state_of_one(keys, cell_m, sequence, now_s)
            return
        cells: dict[str, list[int]] = {}
        if cell_m <= 0.0 and np.logical_and.reduce(self._drivers.ready) and math.isfinite(np.add.reduce(pose[:, 0])):
            known = np.arange(len(pose))
        else:
            known = np.flatnonzero(~np.isnan(pose[:, 0]) & self._drivers.ready)
        if cell_m <= 0.0 and len(known):
            cells[cell_of(0.0, 0.0, cell_m)] = known.tolist()
        elif cell_m > 0.0:
            for row in known.tolist():
                cells.setdefault(cell_of(pose[row, 0], pose[row, 1], cell_m), []).append(row)
        ids, host = self._fleet.ids, self._identity.host
        for cell, rows in cells.items():
            everyone = len(rows) == len(ids)
            x, y, heading = (pose if everyone else pose[rows]).T.tolist()
            speed, turn = (twist if everyone else twist[rows]).T.tolist()
            yield (
                keys.state(cell, host),
                RobotStates(
                    host=host,
                    sequence=sequence,
                    stamp_s=now_s,
                    robots=ids if everyone else tuple(ids[row] for row in rows),
                    x_m=tuple(x),
                    y_m=tuple(y),
                    heading_rad=tuple(heading),
                    speed_m_s=tuple(speed),
                    turn_rad_s=tuple(turn),
                    radius_m=tuple((self._state.radius if everyone else self._state.radius[rows]).tolist()),
                    teams=tuple((self._tasks.team if everyone else self._tasks.team[rows]).tolist()),
                    own_frame=self._conflicts.own_frame,
                ),
            )

    def _state_of_one(
        self, keys: Keys, cell_m: float, sequence: int, now_s: float
    ) -> Iterator[tuple[str, RobotStates]]:
        """Do the same on board, without array operations: twenty times a second that is what publishing costs."""
        x_m, y_m, heading_rad = self._state.pose[0].tolist()
        if math.isnan(x_m) or not self._drivers.ready[0]:
            return
        speed_m_s, turn_rad_s = self._state.twist[0].tolist()
        if self._state.reading is not None:
            age_s = min(max(now_s - float(self._state.reading.stamp_s[0]), 0.0), LONGEST_S)
            middle = heading_rad + 0.5 * age_s * turn_rad_s
            x_m += speed_m_s * age_s * math.cos(middle)
            y_m += speed_m_s * age_s * math.sin(middle)
            heading_rad += turn_rad_s * age_s
        host = self._identity.host
        yield (
            keys.state(cell_of(x_m, y_m, cell_m), host),
            RobotStates(
                host=host,
                sequence=sequence,
                stamp_s=now_s,
                robots=self._fleet.ids,
                x_m=(x_m,),
                y_m=(y_m,),
                heading_rad=(heading_rad,),
                speed_m_s=(speed_m_s,),
                turn_rad_s=(turn_rad_s,),
                radius_m=(float(self._state.radius[0]),),
                teams=(int(self._tasks.team[0]),),
                own_frame=self._conflicts.own_frame,
            ),
        )

    def health(self, loop: LoopStats, version: str, now_s: float) -> HealthReport:
        """Return the health of all robots of this agent."""
        return HealthReport(
            host=self._identity.host,
            process=self._identity.process,
            version=version,
            robots=tuple(self._robots()),
            ticks=loop.ticks,
            late_ticks=loop.late,
            missed_ticks=loop.missed,
            worst_late_s=loop.worst_late_s,
            stamp_s=now_s,
        )

    def _why(self, row: int, number: int) -> Reason:
        if number == StopReason.LAW:
            return self._desired_motion.law_error[row]
        if number == StopReason.HAZARD and self._state.reading is not None:
            return explain_hazards(int(self._state.reading.hazards[row]), self._fleet.fault(row))[0]
        if number in (StopReason.OVERLAP, StopReason.FRAME):
            return self._conflicts.reason(row)
        if number in (StopReason.IDLE, StopReason.MOVING, StopReason.HAZARD):
            return self._inbox.ended[row] if number == StopReason.IDLE else NONE
        return reason(CODES[number])

    def _robots(self) -> Iterator[RobotHealth]:
        """Yield one entry per robot; whole columns become lists first, which a large swarm feels."""
        fleet, count = self._fleet, len(self._fleet.ids)
        reading = self._state.reading
        battery = reading.battery.tolist() if reading else [-1.0] * count
        contacts = self._fixes.touches().tolist()
        stated = reading.position_sigma_m.tolist() if reading else [math.nan] * count
        sensed = np.isfinite(reading.pose[:, 0]).tolist() if reading else [False] * count
        reasons, estops = self._controller.reason.tolist(), self._controller.estop.tolist()
        collisions = self._calculators.collisions.tolist()
        deviation_m_s, deviation_m, filter_note = self._filter.report(self._tasks.filtered)
        standing = self._standstill.at_standstill.tolist()
        for row, robot in enumerate(fleet.ids):
            task, description = self._tasks.of[row], fleet.descriptions[row]
            request = task.request if task else NO_REQUEST
            pose = self._fixes.health(row, sensed[row])
            why = self._why(row, reasons[row])
            stated_m = stated[row] if pose.position_sigma_m < 0.0 else math.nan
            yield RobotHealth(
                robot=robot,
                driver=fleet.urls[row],
                make=description.make,
                model=description.model,
                firmware=fleet.firmware(row),
                lifecycle=str(fleet.lifecycle(row)),
                behaviour=request.behaviour,
                request_id=request.request_id,
                core=request.core,
                sequence=request.sequence,
                moving=not standing[row],
                estop=estops[row],
                stop_reason=why.text,
                stop_code=why.code,
                stop_parameters=dict(why.parameters),
                fault=fleet.fault(row),
                fault_code=fleet.fault_code(row),
                battery=battery[row],
                contacts=contacts[row],
                collisions=collisions[row],
                pose_source=pose.source,
                position_sigma_m=pose.position_sigma_m if math.isnan(stated_m) else stated_m,
                heading_sigma_rad=pose.heading_sigma_rad,
                pose_note=pose.note,
                deviation_m_s=deviation_m_s[row],
                deviation_m=deviation_m[row],
                filter_note=filter_note[row],
            )
