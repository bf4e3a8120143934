"""What an agent tells the others about its robots: states and health."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from fullswarm.agent.robot_controller import EXPLAIN, Reason, explain_hazards
from fullswarm.agent.view import Array
from fullswarm.kernels import kernel
from fullswarm.keys import Keys, cell_of
from fullswarm.messages import ControlRequest, HealthReport, RobotHealth, RobotStates
from fullswarm.runtime import LoopStats

if TYPE_CHECKING:
    from fullswarm.agent.node import AgentNode

NO_REQUEST = ControlRequest(request_id="", robot="", behaviour="", enable=False)

LONGEST_S = 0.2
"""A state is moved on from its reading by so much at most."""


def states(
    agent: AgentNode, keys: Keys, cell_m: float, sequence: int, now_s: float
) -> Iterator[tuple[str, RobotStates]]:
    """Yield (key, message): one per grid cell that holds robots of this agent."""
    pose, twist = agent.pose, agent.twist
    if len(pose) > 1 and agent.reading is not None:
        there = np.empty_like(pose)
        moved_on.run(pose, twist, agent.reading.stamp_s, now_s, there)
        pose = there
    if len(pose) == 1:
        yield from _state_of_one(agent, keys, cell_m, sequence, now_s)
        return
    cells: dict[str, list[int]] = {}
    if cell_m <= 0.0 and np.logical_and.reduce(agent.driver_ready) and math.isfinite(np.add.reduce(pose[:, 0])):
        known = np.arange(len(pose))
    else:
        known = np.flatnonzero(~np.isnan(pose[:, 0]) & agent.driver_ready)
    if cell_m <= 0.0 and len(known):
        cells[cell_of(0.0, 0.0, cell_m)] = known.tolist()
    elif cell_m > 0.0:
        for row in known.tolist():
            cells.setdefault(cell_of(pose[row, 0], pose[row, 1], cell_m), []).append(row)
    ids, host = agent.fleet.ids, agent.identity.host
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
                radius_m=tuple((agent.radius if everyone else agent.radius[rows]).tolist()),
                teams=tuple((agent.tasks.team if everyone else agent.tasks.team[rows]).tolist()),
                own_frame=agent.pose_conflicts.own_frame,
            ),
        )


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


def _state_of_one(
    agent: AgentNode, keys: Keys, cell_m: float, sequence: int, now_s: float
) -> Iterator[tuple[str, RobotStates]]:
    """Do the same on board, without array operations: twenty times a second that is what publishing costs."""
    x_m, y_m, heading_rad = agent.pose[0].tolist()
    if math.isnan(x_m) or not agent.driver_ready[0]:
        return
    speed_m_s, turn_rad_s = agent.twist[0].tolist()
    if agent.reading is not None:
        age_s = min(max(now_s - float(agent.reading.stamp_s[0]), 0.0), LONGEST_S)
        middle = heading_rad + 0.5 * age_s * turn_rad_s
        x_m += speed_m_s * age_s * math.cos(middle)
        y_m += speed_m_s * age_s * math.sin(middle)
        heading_rad += turn_rad_s * age_s
    host = agent.identity.host
    yield (
        keys.state(cell_of(x_m, y_m, cell_m), host),
        RobotStates(
            host=host,
            sequence=sequence,
            stamp_s=now_s,
            robots=agent.fleet.ids,
            x_m=(x_m,),
            y_m=(y_m,),
            heading_rad=(heading_rad,),
            speed_m_s=(speed_m_s,),
            turn_rad_s=(turn_rad_s,),
            radius_m=(float(agent.radius[0]),),
            teams=(int(agent.tasks.team[0]),),
            own_frame=agent.pose_conflicts.own_frame,
        ),
    )


def health(agent: AgentNode, loop: LoopStats, version: str, now_s: float) -> HealthReport:
    """Return the health of all robots of this agent."""
    return HealthReport(
        host=agent.identity.host,
        process=agent.identity.process,
        version=version,
        robots=tuple(_robots(agent)),
        ticks=loop.ticks,
        late_ticks=loop.late,
        missed_ticks=loop.missed,
        worst_late_s=loop.worst_late_s,
        stamp_s=now_s,
    )


def _why(agent: AgentNode, row: int, reason: int) -> str:
    if reason == Reason.LAW:
        return agent.wishes.law_error[row]
    if reason == Reason.HAZARD and agent.reading is not None:
        return explain_hazards(int(agent.reading.hazards[row]), agent.fleet.fault(row))[0]
    if reason in (Reason.OVERLAP, Reason.FRAME):
        return agent.pose_conflicts.reason(row)
    return agent.ended[row] if reason == Reason.IDLE else EXPLAIN.get(reason, "")


def _robots(agent: AgentNode) -> Iterator[RobotHealth]:
    """Yield one entry per robot; whole columns become lists first, which a large swarm feels."""
    fleet, count = agent.fleet, len(agent.fleet.ids)
    reading = agent.reading
    battery = reading.battery.tolist() if reading else [-1.0] * count
    contacts = agent.contacts.tolist()
    stated = reading.position_sigma_m.tolist() if reading else [math.nan] * count
    sensed = np.isfinite(reading.pose[:, 0]).tolist() if reading else [False] * count
    reasons, estops = agent.controller.reason.tolist(), agent.controller.estop.tolist()
    collisions = agent.calculators.collisions.tolist()
    deviation_m_s, deviation_m, filter_note = agent.filter.report(agent.tasks.filtered)
    standing = agent.standstill.standing.tolist()
    for row, robot in enumerate(fleet.ids):
        task, description = agent.tasks.of[row], fleet.descriptions[row]
        request = task.request if task else NO_REQUEST
        pose = agent.fixes.health(row, sensed[row])
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
            stop_reason=_why(agent, row, reasons[row]),
            fault=fleet.fault(row),
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
