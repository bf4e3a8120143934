"""The node of the centralised behaviours: from the robots' states to a command for each, 20 times per second."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
import structlog

from fullswarm.bus import Bus
from fullswarm.bus.report_query import ReportsOnQuery
from fullswarm.config import SwarmConfig
from fullswarm.config.parameter import FILTER
from fullswarm.core.centralised.joint_filter import Arena, JointFilter, to_twists
from fullswarm.core.centralised.law import Law, State, load
from fullswarm.core.centralised.view import View
from fullswarm.errors import ConfigError, FullswarmError
from fullswarm.geometry import clamp, unicycle
from fullswarm.kernels import Array, Index
from fullswarm.keys import Keys
from fullswarm.messages import (
    CentralisedCommands,
    CentralisedRequest,
    Heartbeat,
    ReportQuery,
    RobotProfile,
    RobotProfiles,
    RobotStates,
    Value,
)
from fullswarm.parameters import Params
from fullswarm.recent import Names, Recent
from fullswarm.runtime import Scheduler

NODE = "centralised"
RATE_HZ = 20.0
HEARTBEAT_HZ = 10.0
STALE_S = 0.5
"""A robot whose state is older gets no command: it stops when its last one expires."""

MEMORY = 1024
LOG_S = 1.0
MOST_JOBS = 256
"""Requests at most: the core ends those that it does not know."""
STRANGERS = 1000
"""Robots that are not of the fleet file, at most; see :class:`~fullswarm.recent.Names`."""
AT_REST = 0.02
"""m/s and rad/s, below which a robot stands."""

log = structlog.get_logger()


@dataclass(slots=True)
class Job:
    """One active request."""

    request: CentralisedRequest
    law: Law
    state: State
    joint: JointFilter | None = None
    error: str = ""


@dataclass(frozen=True, slots=True)
class Scene:
    """The robots of a job whose state is fresh."""

    rows: Index  # (n,) places in the request's list
    positions: Array  # (n, 2)
    headings: Array  # (n,)
    radii: Array  # (n,)
    twists: Array  # (n, 2)


class CentralisedNode:
    """Computes all centralised behaviours.

    Parameters
    ----------
    process
        Name of this start, unique.
    """

    def __init__(self, bus: Bus, scheduler: Scheduler, config: SwarmConfig, process: str) -> None:
        self._bus, self._scheduler, self._keys, self._process = bus, scheduler, Keys(config.swarm), process
        self._config, (x_low, y_low, x_high, y_high) = config.agent, config.bounds_m
        self._bounds = config.bounds_m
        self._low, self._high = np.array([x_low, y_low]), np.array([x_high, y_high])
        self._jobs: dict[str, Job] = {}
        self._newest: Recent[str, tuple[str, int]] = Recent(MEMORY)
        self._states: dict[str, tuple[float, tuple[float, ...]]] = {}
        self._names = Names(STRANGERS, lambda robot: self._states.pop(robot, None), config.robots)
        self._profiles: dict[str, RobotProfile] = {}  # of the robots of the jobs
        self._held: set[str] = set()
        self._logged: Recent[str, None] = Recent(MEMORY)
        self._logged_s = -math.inf
        self._beats, self._sequence = itertools.count(1), itertools.count(1)
        self._subscriptions = [
            bus.subscribe(self._keys.centralised_request(), CentralisedRequest, self._requested),
            bus.subscribe(self._keys.state(), RobotStates, self._update_states, latest=True),
            bus.subscribe(self._keys.profile(), RobotProfiles, self._describe),
        ]
        self._queries = ReportsOnQuery(bus, self._keys, scheduler, self._beat)
        self._timers = [
            scheduler.every(1.0 / RATE_HZ, self._tick),
            scheduler.every(1.0 / HEARTBEAT_HZ, self._beat, first_s=0.0),
        ]

    def close(self) -> None:
        """Stop computing; the robots stop when their last command expires."""
        for subscription in self._subscriptions:
            subscription.close()
        self._queries.close()
        for timer in self._timers:
            timer.cancel()
        self._jobs.clear()

    # ------------------------------------------------------------ laws under development
    def hold(self, law: str) -> None:
        """Compute nothing with a law: its robots stop for want of commands."""
        self._held.add(law)

    def at_rest(self, law: str) -> bool:
        """Tell whether the robots whose state is fresh stand, of all requests with this law."""
        scenes = [self._scene(job) for job in self._jobs.values() if job.law.name == law]
        return all(bool((np.abs(scene.twists) < AT_REST).all()) for scene in scenes if scene is not None)

    def release(self, law: str) -> None:
        """Go on with a law as it is now, with new memory; a law that is none ends its requests."""
        self._held.discard(law)
        for job in [job for job in self._jobs.values() if job.law.name == law]:
            del self._jobs[job.request.request_id]
            self._start(job.request)

    # ------------------------------------------------------------ requests
    def _requested(self, request: CentralisedRequest) -> None:
        core, sequence = self._newest.get(request.request_id, ("", 0))
        if core == request.core and request.sequence <= sequence:
            return
        self._newest[request.request_id] = (request.core, request.sequence)
        if request.enable:
            self._start(request)
        elif self._jobs.pop(request.request_id, None):
            robots = {robot for job in self._jobs.values() for robot in job.request.robots}
            self._profiles = {robot: each for robot, each in self._profiles.items() if robot in robots}
            if not self._jobs:
                self._states.clear()

    def _start(self, request: CentralisedRequest) -> None:
        job = self._jobs.get(request.request_id)
        try:
            for name in FILTER.keys() & request.parameters.keys():
                FILTER[name].check(name, request.parameters[name])
        except ValueError as error:  # any process on the bus can send one
            self._log_once(request, error)
            return
        if job is not None:
            job.state.narrow(request.robots)
            job.request = request
            return
        try:
            law = load(request.law)
            if request.filtered and not law.planar:
                hint = "define velocity(view, params)"
                raise ConfigError("the joint filter takes planar velocities, not twists", where=law.name, hint=hint)
        except FullswarmError as error:
            self._log_once(request, error)
            return
        if len(self._jobs) >= MOST_JOBS:
            self._log_once(request, ConfigError(f"{MOST_JOBS} centralised requests run already"))
            return
        state = State(law, request.robots, self._scheduler.now_s())
        job = Job(request, law, state, JointFilter() if request.filtered else None)
        for other in self._jobs.values():
            # The next frame of the same stick continues from the last one.
            if (other.request.behaviour, other.request.robots) == (request.behaviour, request.robots):
                job.state, job.joint = other.state.copy(), other.joint
        self._jobs[request.request_id] = job
        if not self._profiles.keys() >= set(request.robots):
            self._bus.publish(self._keys.report_query, ReportQuery(source=NODE))

    def _log_once(self, request: CentralisedRequest, error: Exception) -> None:
        """Log once per request, which the core repeats, and of a flood of requests one per second."""
        now_s = self._scheduler.now_s()
        if request.request_id in self._logged or now_s - self._logged_s < LOG_S:
            return
        self._logged[request.request_id], self._logged_s = None, now_s
        log.error("centralised behaviour cannot run", behaviour=request.behaviour, error=str(error))

    def _update_states(self, states: RobotStates) -> None:
        columns = (
            states.x_m, states.y_m, states.heading_rad, states.radius_m, states.speed_m_s, states.turn_rad_s,
        )  # fmt: skip
        if not self._jobs or any(len(column) != len(states.robots) for column in columns):
            return
        now_s = self._scheduler.now_s()
        for robot, state in zip(states.robots, zip(*columns, strict=True), strict=True):
            if all(map(math.isfinite, state)) and self._names.admit(robot, now_s):
                self._states[robot] = (now_s, state)

    def _describe(self, message: RobotProfiles) -> None:
        robots = {robot for job in self._jobs.values() for robot in job.request.robots}
        self._profiles |= {each.robot: each for each in message.robots if each.robot in robots}

    def _beat(self) -> None:
        self._names.sweep(self._scheduler.now_s())
        heartbeat = Heartbeat(
            node=NODE,
            process=self._process,
            sequence=next(self._beats),
            active=tuple(self._jobs),
            stamp_s=self._scheduler.now_s(),
        )
        self._bus.publish(self._keys.heartbeat(NODE), heartbeat)

    def _tick(self) -> None:
        for job in self._jobs.values():
            scene = self._scene(job) if job.law.name not in self._held else None
            if scene is None:
                continue
            try:
                twists = self._twists(job, scene)
            except Exception as error:
                # Whatever a law raises, one request must not end the others. Its robots stop for want of a command.
                if str(error) != job.error:
                    job.error = str(error)
                    log.error("centralised law failed", behaviour=job.request.behaviour, error=job.error)
                continue
            self._publish(job, scene, twists)

    def _scene(self, job: Job) -> Scene | None:
        """Return the robots of a job that can be commanded now; None when there are none."""
        oldest_s = self._scheduler.now_s() - STALE_S
        fresh = [
            (row, found[1])
            for row, robot in enumerate(job.request.robots)
            if (found := self._states.get(robot)) is not None and found[0] >= oldest_s
        ]
        if not fresh:
            return None
        table = np.array([state for _, state in fresh], float)
        rows = np.array([row for row, _ in fresh], np.int64)
        return Scene(rows, table[:, :2].copy(), table[:, 2].copy(), table[:, 3].copy(), table[:, 4:].copy())

    def _twists(self, job: Job, scene: Scene) -> Array:
        """Return speed and turn rate (n, 2) of the robots of `scene`."""
        parameters, config = job.request.parameters, self._config
        desired = self._desired(job, scene)
        speed_m_s = _number(parameters.get("speed_m_s"), 0.5)
        turn_rad_s = _number(parameters.get("turn_rad_s"), 2.0)
        if not job.law.planar:
            return np.clip(desired, [-speed_m_s, -turn_rad_s], [speed_m_s, turn_rad_s])
        if job.joint is None:
            twists = []
            for (vx_m_s, vy_m_s), heading in zip(desired.tolist(), scene.headings.tolist(), strict=True):
                v, w = unicycle(vx_m_s, vy_m_s, heading, config.speed_gain, config.turn_gain_per_s)
                twists.append((clamp(v, -speed_m_s, speed_m_s), clamp(w, -turn_rad_s, turn_rad_s)))
            return np.array(twists)
        size = np.linalg.norm(desired, axis=1, keepdims=True)
        desired = desired * np.minimum(1.0, speed_m_s / np.maximum(size * config.speed_gain, 1e-9)) * config.speed_gain
        arena = Arena(
            self._low,
            self._high,
            speed_m_s,
            _number(parameters.get("barrier_gain_per_s"), config.barrier_gain_per_s),
            _number(parameters.get("safety_margin_m"), config.safety_margin_m),
        )
        allowed, near = job.joint.filter(desired, scene.positions, scene.radii, arena)
        turn = np.array([config.turn_gain_per_s, turn_rad_s])
        return to_twists(allowed, near, scene.positions, scene.headings, scene.radii, arena, turn)

    def _desired(self, job: Job, scene: Scene) -> Array:
        """Return what the law of a job answers, (n, 2)."""
        state, now_s, count = job.state, self._scheduler.now_s(), len(scene.rows)
        dt_s = 1.0 / RATE_HZ if state.last_s is None else now_s - state.last_s
        view = View(
            scene.rows, job.request.robots, scene.positions, scene.headings, scene.twists, scene.radii,
            state.appeared(scene.rows), now_s - state.since_s, dt_s, self._bounds,
            job.request.roles, self._profiles,
        )  # fmt: skip
        state.last_s = now_s
        return state.call(view, Params([job.request.parameters] * count))

    def _publish(self, job: Job, scene: Scene, twists: Array) -> None:
        request = job.request
        linear, angular = twists.T.tolist()
        commands = CentralisedCommands(
            request_id=request.request_id,
            behaviour=request.behaviour,
            robots=tuple(request.robots[row] for row in scene.rows.tolist()),
            linear_m_s=tuple(linear),
            angular_rad_s=tuple(angular),
            sequence=next(self._sequence),
            stamp_s=self._scheduler.now_s(),
        )
        self._bus.publish(self._keys.centralised_commands(request.behaviour), commands)


def _number(value: Value | None, usual: float) -> float:
    return float(value) if isinstance(value, int | float) else usual
