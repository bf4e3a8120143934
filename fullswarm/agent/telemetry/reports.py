"""Makes the messages of an agent about its robots: states and health."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TypeVar

import numpy as np

from fullswarm.agent.core_clock import CoreClock
from fullswarm.agent.motion.robot_controller import CODES, MOVING, StopReason, explain_hazards
from fullswarm.agent.orders.charging import Charging
from fullswarm.agent.orders.tasks import Tasks
from fullswarm.agent.pose.conflicts import PoseConflicts
from fullswarm.agent.pose.fixes import Fixes
from fullswarm.agent.safety.filter import SafetyFilter
from fullswarm.agent.state import AgentState, Identity
from fullswarm.agent.telemetry.waiting import Waiting
from fullswarm.drivers.base import Fleet
from fullswarm.kernels import Array, Index, kernel
from fullswarm.keys import Keys, cell_of
from fullswarm.messages import AWAY, ControlRequest, Halt, HealthReport, Result, RobotHealth, RobotStates
from fullswarm.perf.calculators import Calculators
from fullswarm.reasons import NONE, Code, Reason, reason
from fullswarm.runtime import LoopStats

T = TypeVar("T")

NO_REQUEST = ControlRequest(request_id="", robot="", behaviour="", enable=False)

LARGEST_LIMITS = 1e4, 1e4, 1e5, 1e7, 1e7
"""m/s, rad/s, m/s², m, s: what :class:`RobotStates` can state. A driver may have no limits; its states must arrive."""
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


@kernel
def driving_to(reason: Index, aim: Array, there: Array, out: Array) -> bool:
    """Fill `out` (n, 2) with the aims of robots that move and have one, else with `there`; tell if there are any."""
    found = False
    for i in range(out.shape[0]):
        going = reason[i] == MOVING and math.isfinite(aim[i, 0])
        found = found or going
        out[i, 0] = aim[i, 0] if going else there[i, 0]
        out[i, 1] = aim[i, 1] if going else there[i, 1]
    return found


class Reports:
    """Makes the messages of one agent: states of its robots for the neighbours, health for the core and operators.

    Parameters
    ----------
    law_error, ended : (n,) the last failure of each robot's control law, and why its last task was ended on board
    results : (n,) how its control law has ended it; None: it has not
    halts : (n,) the stop since which it has started nothing; None: none
    answered : (n,) core and sequence of the newest control request that it has answered
    settled_by : (n,) by which rule each has settled, 0: by none; see ``Settling``
    blocked : by robot, why its control law knows no way
    limits : (n, 5) what each can do: m/s, rad/s, m/s²; what a stop takes beyond that: m, s
    message_note : returns what is wrong with the broadcasts that a robot receives
    """

    def __init__(
        self, identity: Identity, fleet: Fleet, state: AgentState, tasks: Tasks, safety: SafetyFilter,
        calculators: Calculators, fixes: Fixes, conflicts: PoseConflicts, law_error: Sequence[Reason],
        blocked: Mapping[int, Reason], ended: Sequence[Reason], limits: Array, waiting: Waiting, settled_by: Index,
        message_note: Callable[[int], Reason],
        results: Sequence[Result | None], halts: Sequence[Halt | None],
        answered: Sequence[tuple[str, int]], charging: Charging,
    ) -> None:  # fmt: skip
        self._identity, self._fleet, self._state, self._tasks = identity, fleet, state, tasks
        self._filter, self._calculators, self._fixes, self._conflicts = safety, calculators, fixes, conflicts
        self._law_error, self._blocked, self._ended = law_error, blocked, ended
        self._settled_by, self._message_note = settled_by, message_note
        self._results, self._halts, self._charging = results, halts, charging
        self._answered = answered
        self._waiting, self._now_s = waiting, -math.inf
        stated = np.minimum(limits, LARGEST_LIMITS)
        self._speed_limit_m_s, self._turn_limit_rad_s, self._accel_m_s2 = map(tuple, stated[:, :3].T.tolist())
        self._stop_extra: list[list[float]] = stated[:, 3:].T.tolist() if stated[:, 3:].any() else [[], []]
        self._radius_m: tuple[float, ...] = tuple(state.radius.tolist())
        self._aim = np.zeros((len(state.radius), 2))

    def states(
        self, keys: Keys, cell_m: float, sequence: int, now_s: float, clock: CoreClock
    ) -> Iterator[tuple[str, RobotStates]]:
        """Yield (key, message): one per grid cell that holds robots of this agent."""
        state, ids, host = self._state, self._fleet.ids, self._identity.host
        if state.reading is None:
            return
        there = np.empty_like(state.pose)
        moved_on.run(state.pose, state.twist, state.reading.stamp_s, now_s, there)
        x_m, y_m, heading_rad = there.T.tolist()
        known = [row for row, ready in enumerate(state.driver_ready.tolist()) if ready and not math.isnan(x_m[row])]
        cells: dict[str, list[int]] = {}
        if cell_m <= 0.0 and known:
            cells[cell_of(0.0, 0.0, cell_m)] = known
        elif cell_m > 0.0:
            for row in known:
                cells.setdefault(cell_of(x_m[row], y_m[row], cell_m), []).append(row)
        speed_m_s, turn_rad_s = state.twist.T.tolist()
        sigma_m, sigma_rad = state.sigma.T.tolist()
        if not any(sigma_m) and not any(sigma_rad):
            sigma_m, sigma_rad = [], []
        teams = self._tasks.team.tolist()
        if self._charging.any:
            teams = [AWAY if self._charging.away(row) else team for row, team in enumerate(teams)]
        aim_x_m, aim_y_m = self._aims(there)
        extra_m, extra_s = self._stop_extra
        for cell, rows in cells.items():
            message = RobotStates(
                host=host,
                sequence=sequence,
                stamp_s=now_s,
                robots=_pick(ids, rows),
                x_m=_pick(x_m, rows),
                y_m=_pick(y_m, rows),
                heading_rad=_pick(heading_rad, rows),
                speed_m_s=_pick(speed_m_s, rows),
                turn_rad_s=_pick(turn_rad_s, rows),
                radius_m=_pick(self._radius_m, rows),
                teams=_pick(teams, rows),
                speed_limit_m_s=_pick(self._speed_limit_m_s, rows),
                turn_limit_rad_s=_pick(self._turn_limit_rad_s, rows),
                accel_m_s2=_pick(self._accel_m_s2, rows),
                stop_extra_m=_pick(extra_m, rows) if extra_m else (),
                stop_extra_s=_pick(extra_s, rows) if extra_s else (),
                own_frame=self._conflicts.own_frame,
                aim_x_m=_pick(aim_x_m, rows) if aim_x_m else (),
                aim_y_m=_pick(aim_y_m, rows) if aim_y_m else (),
                sigma_m=_pick(sigma_m, rows) if sigma_m else (),
                sigma_rad=_pick(sigma_rad, rows) if sigma_rad else (),
                core=clock.core,
                offset_s=clock.offset_s,
            )
            yield keys.state(cell, host), message

    def _aims(self, there: Array) -> tuple[list[float], list[float]]:
        """Return where the robots are driving to, their own places where they drive nowhere, as columns in m.

        Both empty when no robot says that it is driving anywhere.
        """
        if not driving_to.run(self._state.stop_reason, self._state.aim, there, self._aim):
            return [], []
        x_m, y_m = self._aim.T.tolist()
        return x_m, y_m

    def health(self, loop: LoopStats, version: str, now_s: float, clock: CoreClock) -> HealthReport:
        """Return the health of all robots of this agent."""
        self._now_s = now_s
        return HealthReport(
            host=self._identity.host,
            process=self._identity.process,
            version=version,
            robots=tuple(self._robots()),
            ticks=loop.ticks,
            late_ticks=loop.late,
            missed_ticks=loop.missed,
            worst_late_s=loop.worst_late_s,
            dropped=dict(loop.dropped),
            wall_offset_s=clock.wall_offset_s,
            round_trip_s=clock.round_trip_s if math.isfinite(clock.round_trip_s) else -1.0,
            stamp_s=now_s,
        )

    def _why(self, row: int, number: int) -> Reason:
        if number == StopReason.LAW:
            return self._law_error[row]
        if number == StopReason.HAZARD and self._state.reading is not None:
            return explain_hazards(int(self._state.reading.hazards[row]), self._fleet.fault(row))[0]
        if number in (StopReason.OVERLAP, StopReason.FRAME):
            return self._conflicts.reason(row)
        if number == StopReason.MOVING:
            why = self._blocked.get(row, NONE) or self._waiting.reason(row, self._now_s) or self._charging.reason(row)
            return why or (reason(Code.SETTLED) if self._settled_by[row] else NONE)
        if number == StopReason.IDLE and (why := self._charging.reason(row)):
            return why
        if number in (StopReason.IDLE, StopReason.HAZARD):
            return self._ended[row] if number == StopReason.IDLE else NONE
        return reason(CODES[number])

    def _robots(self) -> Iterator[RobotHealth]:
        """Yield one entry per robot; whole columns become lists first, which a large swarm feels."""
        fleet, count = self._fleet, len(self._fleet.ids)
        reading = self._state.reading
        battery = reading.battery.tolist() if reading else [-1.0] * count
        flows = reading.charging.tolist() if reading and reading.charging is not None else [-1] * count
        contacts = self._fixes.touches().tolist()
        stated = reading.position_sigma_m.tolist() if reading else [math.nan] * count
        sensed = np.isfinite(reading.pose[:, 0]).tolist() if reading else [False] * count
        reasons, estops = self._state.stop_reason.tolist(), self._state.estop.tolist()
        collisions = self._calculators.collisions.tolist()
        deviation_m_s, deviation_m, filter_note = self._filter.report(self._tasks.filtered)
        standing = self._state.at_standstill.tolist()
        command_m_s, command_rad_s = self._state.setpoints.T.tolist()
        for row, robot in enumerate(fleet.ids):
            task, description = self._tasks.asked(row), fleet.descriptions[row]
            request = task.request if task else NO_REQUEST
            core, sequence = (request.core, request.sequence) if task else self._answered[row]
            pose = self._fixes.health(row, sensed[row])
            why, messages = self._why(row, reasons[row]), self._message_note(row)
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
                core=core,
                sequence=sequence,
                moving=not standing[row],
                estop=estops[row],
                stop_reason=why.text,
                stop_code=why.code,
                stop_parameters=dict(why.parameters),
                fault=fleet.fault(row),
                fault_code=fleet.fault_code(row),
                battery=battery[row],
                charging=None if flows[row] < 0 else bool(flows[row]),
                charge=self._charging.report(row, self._now_s),
                contacts=contacts[row],
                collisions=collisions[row],
                pose_source=pose.source,
                position_sigma_m=pose.position_sigma_m if math.isnan(stated_m) else stated_m,
                heading_sigma_rad=pose.heading_sigma_rad,
                pose_note=pose.note,
                pose_sources=pose.sources,
                command_m_s=command_m_s[row],
                command_rad_s=command_rad_s[row],
                deviation_m_s=deviation_m_s[row],
                deviation_m=deviation_m[row],
                filter_note=filter_note[row],
                message_note=messages.text,
                message_code=messages.code,
                result=self._results[row],
                halt=self._halts[row],
            )


def _pick(column: Sequence[T], rows: list[int]) -> tuple[T, ...]:
    return tuple(column) if len(rows) == len(column) else tuple(column[row] for row in rows)
