"""Wires the parts of an agent to the bus and the clock, and runs the tick."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import structlog
from numpy.typing import NDArray

from fullswarm import __version__
from fullswarm.agent.core_clock import CoreClock
from fullswarm.agent.mapping.sense import RangeSense
from fullswarm.agent.mapping.sharing import GridSharing
from fullswarm.agent.messaging.exchange import Exchange
from fullswarm.agent.motion.actuation import ActuatorCommands
from fullswarm.agent.motion.desired import DesiredMotion
from fullswarm.agent.motion.evade import Evasion
from fullswarm.agent.motion.reflexes import DriverWatch, Reflexes, Standstill, Thresholds
from fullswarm.agent.motion.robot_controller import Doubt, Link, RobotController, Sensed, Task
from fullswarm.agent.motion.settling import Settling, Wanted
from fullswarm.agent.neighbours.estimates import Assumed, CellSubscriptions, Neighbours
from fullswarm.agent.neighbours.objects import ObjectTracker
from fullswarm.agent.neighbours.obstacle_map import ObstacleMap, ObstacleSharing, map_of
from fullswarm.agent.neighbours.profiles import Profiles, profiles_of
from fullswarm.agent.neighbours.reception import ReceptionReporter
from fullswarm.agent.neighbours.silent import SilentSearch
from fullswarm.agent.orders.inbox import Inbox
from fullswarm.agent.orders.tasks import Group, Tasks
from fullswarm.agent.pose.conflicts import PoseConflicts
from fullswarm.agent.pose.estimator import estimator_for
from fullswarm.agent.pose.fixes import Fixes
from fullswarm.agent.safety.deadlock import Deadlocks
from fullswarm.agent.safety.filter import SafetyFilter, Tuning, robot_params
from fullswarm.agent.safety.stalls import Stalls
from fullswarm.agent.safety.startup import check_stopping, vaguest_fix_m
from fullswarm.agent.state import AgentState, Identity
from fullswarm.agent.telemetry.actuated import ActuatorReporter
from fullswarm.agent.telemetry.interventions import PERIOD_S as INTERVENTION_PERIOD_S
from fullswarm.agent.telemetry.interventions import InterventionReporter
from fullswarm.agent.telemetry.metrics import MetricSampler
from fullswarm.agent.telemetry.remembered import PERIOD_S as MEMORY_PERIOD_S
from fullswarm.agent.telemetry.remembered import MemoryReporter
from fullswarm.agent.telemetry.reports import Reports
from fullswarm.agent.telemetry.scans import ScanReporter
from fullswarm.agent.telemetry.waiting import Waiting
from fullswarm.bus.base import Bus, CountingBus
from fullswarm.bus.report_query import ReportsOnQuery
from fullswarm.clock import wall_time_s
from fullswarm.config import AgentConfig, SwarmConfig
from fullswarm.drivers.base import Fleet, FleetReading
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array
from fullswarm.keys import Keys
from fullswarm.messages import HealthReport, ObjectFix, PoseFix, RobotStates
from fullswarm.perf.calculators import Calculators
from fullswarm.reasons import Reason
from fullswarm.runtime import LoopStats, Scheduler, Timer

if TYPE_CHECKING:
    from fullswarm.agent.pose.map_poses import MapPoses

log = structlog.get_logger()

SENSE_PERIOD_S = 0.1
LEAST_SPARE_M = 0.03
"""By so much a position may always become less certain before motion is barred, however small the filter's margin."""
FOLLOW_PERIOD_S = 0.5
"""How often the subscriptions to neighbours' cells follow the robot."""


class AgentNode:
    """Carries the n robots of `fleet`: one on board, the whole swarm in lockstep.

    Parameters
    ----------
    start : (n, 3) start poses for robots that sense odometry only
    loop : how the runtime keeps its deadlines, for the health report
    wall_s : this computer's time of day, seconds since 1970
    """

    def __init__(
        self,
        bus: Bus,
        scheduler: Scheduler,
        config: SwarmConfig,
        fleet: Fleet,
        identity: Identity,
        start: Array,
        loop: Callable[[], LoopStats],
        thresholds: Thresholds | None = None,
        wall_s: Callable[[], float] = wall_time_s,
    ) -> None:
        check_stopping(config, fleet.descriptions)
        self._bus = bus = CountingBus(bus)
        self._scheduler, self._fleet = scheduler, fleet
        self._config = settings = config.agent
        self._keys = keys = Keys(config.swarm)
        self._identity, self._loop = identity, loop
        limits = tuple(each.limits for each in fleet.descriptions)
        self.controller = RobotController(limits, settings.speed_limit_m_s, settings.turn_limit_rad_s)
        accel = np.array([each.accel_m_s2 for each in limits])
        self.reflexes = _reflexes(config, fleet, accel, thresholds or _thresholds(settings))
        self.standstill = Standstill(fleet.descriptions, settings.control_rate_hz)
        self._state = state = AgentState(
            radius=np.array([each.radius_m for each in fleet.descriptions]),
            pose=start.copy(),
            estop=self.controller.estop,
            stop_reason=self.controller.reason,
            battery_low=self.reflexes.battery_low,
            at_standstill=self.standstill.at_standstill,
            standstill_since_s=self.standstill.since_s,
        )
        # γ v is the hardest braking the filter will ask for; it must not exceed what the wheels can do.
        gain_limit = accel / self.controller.speed_limit
        self.tasks = Tasks(
            len(limits), settings.safety_margin_m, settings.barrier_gain_per_s, gain_limit, settings.barrier,
            settings.coordination, fleet.ids, config.world_or_default.seed,
        )  # fmt: skip
        top_speed = self.controller.speed_limit.tolist()
        extra = np.array([each.stop_extra(top) for each, top in zip(limits, top_speed, strict=True)]).reshape(-1, 2)
        self.neighbours = _neighbours(config, fleet, self.controller, accel, extra)
        self.core_clock = CoreClock(bus, keys, scheduler, identity.host, settings.state_delay_s, wall_s)
        self.neighbours.delay_of = self.core_clock.delay_s
        self._state_subscriptions = CellSubscriptions(
            bus, keys.state, RobotStates, config.state_cell_m, self._on_states
        )  # fmt: skip
        self.reception = ReceptionReporter(
            bus, keys, scheduler, identity.host, fleet.ids, state, self.neighbours, settings.state_rate_hz,
            alone=len(fleet.ids) > 1 and set(config.robots) <= set(fleet.ids),
        )  # fmt: skip
        self.obstacle_map = ObstacleMap(len(limits), map_of(config))
        if len(self.obstacle_map.given):
            from fullswarm.agent.behaviours.navigate import prepare  # most robots have no map, and start sooner without

            prepare(self.obstacle_map.given, config.bounds_m, state.radius, settings.safety_margin_m)
        self._obstacle_sharing = ObstacleSharing(
            bus, keys, scheduler, identity.host, self.obstacle_map, (*config.robots, *fleet.ids)
        )
        range_m = min(each.bodies_range_m for each in fleet.descriptions)
        self.ranges = RangeSense(
            fleet.descriptions, self.neighbours, config.bounds_m, settings.grid_cell_m, state.radius
        )  # fmt: skip
        self._grid_sharing = self._scan_reporter = None
        if self.ranges.any:
            self._scan_reporter = ScanReporter(bus, keys, scheduler, fleet.ids, state)
            self._grid_sharing = GridSharing(
                bus, keys, scheduler, identity.host, self.ranges, self.obstacle_map, config.bounds_m,
                (*config.robots, *fleet.ids),
            )  # fmt: skip
        self.objects = ObjectTracker(
            self.neighbours, self.ranges.range_m if self.ranges.any else range_m, settings.object_speed_m_s,
            settings.object_accel_m_s2,
        )  # fmt: skip
        self.silent_search = SilentSearch(bus, keys, identity.host, self.neighbours, range_m, state.radius)
        self._object_subscription = bus.subscribe(keys.object_fix(), ObjectFix, self._on_object, latest=True)
        self.filter, self.deadlocks = _filter(config, fleet, self.controller, self.objects), Deadlocks(fleet.ids)
        evasion = Evasion(
            self.objects.objects, state.radius + settings.safety_margin_m, self.controller.speed_limit,
            self.controller.turn_limit,
        )  # fmt: skip
        tasks = self.tasks
        wanted = Wanted(
            tasks.goal_m, tasks.reach_m, tasks.lasting, state.radius, tasks.margin_m, self.controller.speed_limit
        )
        self.settling = Settling(wanted, np.array(config.bounds_m), settings.pose_confidence_sigma)
        self.desired = DesiredMotion(
            settings, config.bounds_m, state, self.tasks,
            self.neighbours, self.obstacle_map, self.settling, self.deadlocks, self.filter, self.controller, evasion,
        )  # fmt: skip
        self.actuators = ActuatorCommands(fleet)
        own_frame = any(each.own_frame for each in fleet.descriptions)
        self.pose_conflicts = PoseConflicts(own_frame, state, self.neighbours, self.desired.near)
        self.inbox = Inbox(
            bus, keys, scheduler, settings, fleet, state, self.tasks, self.controller, self.pose_conflicts, self.wake,
            lambda row: self.profiles.present(row),
        )  # fmt: skip
        self.neighbours.own_away = self.inbox.charging.flags
        self._drivers = DriverWatch(
            fleet, state, self.controller.drive_on, end_task=self._end_task, conflict_of=self.pose_conflicts.reason
        )
        self._estimator = estimator_for(config, fleet, start)
        state.sigma = self._estimator.sigma
        self.fixes = Fixes(
            bus, keys, scheduler, settings, self._estimator, fleet, state, self.publish_health,
            vague_m=vaguest_fix_m(config, fleet.descriptions),
        )  # fmt: skip
        self._map_poses = _map_poses(config, fleet, self.obstacle_map.given, state.radius, start, self.fixes.receive)
        self.desired.context.contacts = self.fixes.touches
        self.exchange = Exchange(
            bus, keys, scheduler, identity.host, fleet.ids, config.state_cell_m, state, self.tasks, self.neighbours,
            settings.sensing_radius_m, 1.0 / settings.control_rate_hz,
            FOLLOW_PERIOD_S * float(self.controller.speed_limit.max()),
        )  # fmt: skip
        self.desired.context.channel = self.exchange.channel
        stated = np.column_stack([self.controller.speed_limit, self.controller.turn_limit, accel])
        self.profiles = Profiles(
            bus, keys, scheduler, identity, config.state_cell_m, state, self.neighbours,
            profiles_of(fleet.ids, fleet.descriptions, stated, {each.id: each.capabilities for each in config.robot}),
            settings.sensing_radius_m + FOLLOW_PERIOD_S * float(self.controller.speed_limit.max()),
        )  # fmt: skip
        self.desired.context.profiles = self.profiles
        self.calculators = Calculators(
            fleet.ids,
            config.bounds_m,
            config.performance.coverage_cell_m,
            state.radius,
            np.array([each.speed_m_s for each in limits]),
        )
        self.metrics = MetricSampler(
            fleet.ids, config.performance.arrive_radius_m, state, self.tasks, self.desired.near, self.deadlocks
        )
        self.interventions = InterventionReporter(
            bus, keys, scheduler, identity.host, fleet.ids, state, self.tasks, self.filter, self.neighbours.names
        )
        self._remembered = MemoryReporter(bus, keys, scheduler, identity.host, fleet.ids, self.tasks)
        self._actuated = ActuatorReporter(bus, keys, scheduler, identity.host, fleet)
        self._reports = Reports(
            identity, fleet, state, self.tasks, self.filter, self.calculators, self.fixes, self.pose_conflicts,
            law_error=self.desired.law_error, blocked=self.desired.blocked, ended=self.inbox.ended,
            results=self.inbox.results, halts=self.inbox.halts, answered=self.inbox.answered,
            charging=self.inbox.charging,
            waiting=Waiting(state, self.tasks, self.filter, self.neighbours), message_note=self.exchange.note,
            settled_by=self.settling.rule,
            limits=np.column_stack([self.controller.speed_limit, self.controller.turn_limit, accel, extra]),
        )  # fmt: skip
        self._task = Task(self.tasks.active, self.tasks.survives_core, self.tasks.expires_at_s)
        self._link = Link(core_alive=False, hub_alive=False, driver_ready=state.driver_ready)
        self._sensed: Sensed | None = None
        self._sees_obstacles = any(each.senses_obstacles for each in fleet.descriptions)
        self._static: Array | None = None
        self._measured: Array | None = None
        self._doubt = _doubt(self.reflexes, self.pose_conflicts, self.ranges)
        self._patience_s = max(settings.command_ttl_s, 3.0 / settings.control_rate_hz)
        self._last_tick_s = self._last_act_s = scheduler.now_s() - 1.0 / settings.control_rate_hz
        self._stalls = Stalls(1.0 / settings.control_rate_hz)
        self._cell_m, self._sequence, self._dirty = config.state_cell_m, 0, False
        self.failed_measurements = 0
        self._on_query = ReportsOnQuery(bus, keys, scheduler, self._report)
        fleet.open()
        self._timers = self._start_timers()

    def _start_timers(self) -> list[Timer]:
        every, settings = self._scheduler.every, self._config
        return [
            every(1.0 / settings.control_rate_hz, self.tick, first_s=0.0),
            every(1.0 / settings.state_rate_hz, self._publish_states, first_s=0.0),
            every(1.0 / settings.health_rate_hz, self.publish_health, first_s=0.0),
            every(1.0 / settings.measurement_rate_hz, partial(self.publish_measurements, whole=False)),
            every(FOLLOW_PERIOD_S, self._follow, first_s=0.0),
            every(INTERVENTION_PERIOD_S, self.interventions.publish),
            every(MEMORY_PERIOD_S, self._publish_for_people),
            every(SENSE_PERIOD_S, self._sense_obstacles, first_s=0.0),
        ]

    # ------------------------------------------------------------------ what is known of the robots now
    @property
    def pose(self) -> Array:
        """Estimated poses, (n, 3) m and rad; NaN where none is known."""
        return self._state.pose

    @property
    def twist(self) -> Array:
        """Measured twists, (n, 2) m/s and rad/s."""
        return self._state.twist

    @property
    def reading(self) -> FleetReading | None:
        """What the drivers read in the last tick; None before the first one."""
        return self._state.reading

    @property
    def fleet(self) -> Fleet:
        """The drivers."""
        return self._fleet

    @property
    def identity(self) -> Identity:
        """Name of this agent on the bus."""
        return self._identity

    def wake(self) -> None:
        """Act on a message now instead of at the next period; the next tick does it with many robots.

        It also does with a control law that remembers, which is called once per tick.
        """
        self._dirty = True
        if len(self._fleet.ids) == 1 and self._state.reading is not None:
            groups = self.tasks.groups()
            if not self.tasks.any_apart:
                self._act(self._scheduler.now_s(), self._state.reading, groups, at_tick=False)

    # ------------------------------------------------------------------ the tick
    def tick(self) -> None:
        """Read, estimate, act, measure."""
        now_s = self._scheduler.now_s()
        state = self._state
        state.reading = reading = self._fleet.read()
        if self._map_poses is not None:
            self._map_poses.update(reading, state.pose)
        state.pose = self._estimate(reading, now_s - self._last_tick_s)
        state.twist = reading.twist
        self._sense_static(now_s, reading)
        self.standstill.update(reading)
        self.reflexes.update(reading, state.pose)
        if self.fixes.any_unsettled:
            self.reflexes.pose_uncertain |= self.fixes.unsettled
        if self._map_poses is not None:
            self.reflexes.pose_uncertain |= self._map_poses.lost
        if self.ranges.any:
            self.objects.update(now_s, state.pose, self.ranges.bodies, self.ranges.stamp_s)
        elif reading.bodies is not None or self.objects.any:
            self.objects.update(now_s, state.pose, reading.bodies, float(reading.stamp_s.max()))
        self.reflexes.watch_clock(now_s, self._last_tick_s, self._patience_s)
        self.filter.stall_s = self._stalls.note(now_s - self._last_tick_s)
        self.inbox.charging.update()
        if self.inbox.charging.changed:
            self.inbox.charging.changed, self._dirty = False, True
        self._act(now_s, reading, self.tasks.groups())
        self.exchange.send()
        period_s = 1.0 / self._config.control_rate_hz
        try:
            contacts = self.fixes.touches() if self.fixes.touching else reading.contacts
            self.calculators.update(
                now_s, state.pose, contacts, period_s, reading.odometry, reading.twist, state.setpoints
            )
        except Exception as error:
            self._measurement_failed(error)
        self.inbox.watch_estops(now_s)
        self._last_tick_s = now_s
        if self._dirty:
            self.publish_health()

    def _sense_static(self, now_s: float, reading: FleetReading) -> None:
        """Set the static obstacles that the filter keeps off: those sensed, or else the map, and those measured."""
        state = self._state
        static = reading.obstacles if self._sees_obstacles else self.obstacle_map.given
        if not self.ranges.any:
            state.obstacles = static
            return
        self.ranges.update(now_s, state.pose, state.sigma, state.twist, reading.ranges)
        if static is not self._static or self.ranges.obstacles is not self._measured:
            self._static, self._measured = static, self.ranges.obstacles
            state.obstacles = np.vstack([static, self.ranges.obstacles])

    def _measurement_failed(self, error: Exception) -> None:
        """Count and log a failed measurement; whatever it raised must not end the process that drives the robot."""
        self.failed_measurements += 1
        if self.failed_measurements == 1:
            log.error("a measurement failed; the robots are not concerned", exc_info=error)

    def _estimate(self, reading: FleetReading, dt_s: float) -> Array:
        """Return the poses (n, 3); NaN, on which no robot drives, from an estimator that fails."""
        try:
            return self._estimator.update(reading, dt_s)
        except (ArithmeticError, ValueError) as error:  # numpy's LinAlgError is a ValueError
            if not self.reflexes.pose_unknown.all():
                log.error("the estimator failed; its robots stand", error=str(error), exc_info=error)
            return np.full((len(self._fleet.ids), 3), math.nan)

    def _act(self, now_s: float, reading: FleetReading, groups: list[Group], *, at_tick: bool = True) -> None:
        """Evaluate the control laws, decide and command the drivers."""
        period_s = 1.0 / self._config.control_rate_hz
        dt_s = min(max(now_s - self._last_act_s, 0.0), 2.0 * period_s)
        self._last_act_s = now_s
        self.desired.gather(groups, now_s, reading, dt_s, at_tick=at_tick)
        if self.desired.endings:
            self._end_tasks()
        self.reflexes.watch_geofence(
            self._state.pose, self._state.twist, self.controller.desired, self.filter.commands.underway
        )
        # Tuples are kept while nothing in them changed: to make them takes longer than to decide.
        link, core_alive, hub_alive = self._link, self.inbox.core_alive(now_s), self._bus.connected()
        ready = self._drivers.look()
        if core_alive is not link.core_alive or hub_alive is not link.hub_alive or ready is not link.driver_ready:
            self._link = link = Link(core_alive, hub_alive, ready)
        sensed = self._sensed
        if sensed is None or reading.stamp_s is not sensed.stamp_s or reading.hazards is not sensed.hazards:
            self._sensed = sensed = Sensed(reading.stamp_s, reading.hazards)
        doubt, jumped, foreign = self._doubt, self.reflexes.clock_jumped, self.pose_conflicts.frame_conflict
        if jumped is not doubt.clock_jumped or foreign is not doubt.frame_conflict:
            self._doubt = doubt = doubt._replace(clock_jumped=jumped, frame_conflict=foreign)
        # Judged for the middle of the period in which what is commanded now will be in force.
        read_since_s = now_s + 0.5 * period_s - self._config.reading_timeout_s
        twists = self.controller.step(now_s, dt_s, read_since_s, self._task, link, sensed, doubt)
        self._state.setpoints = self._fleet.command(twists, self.controller.drive_on)
        if self.desired.asked:
            self.actuators.carry_out(self.desired.asked, self.controller.drive_on)
            self._actuated.note(self.desired.asked, self.controller.drive_on, self.actuators.refused)
            self.desired.asked.clear()
        if self.desired.news:
            self.desired.news, self._dirty = False, True
        if self.controller.changed or not self._state.driver_ready[0]:
            self._dirty |= self.controller.changed
            self._drivers.end_unsafe_tasks(reading.hazards)

    def _publish_for_people(self) -> None:
        self._remembered.publish()
        self._actuated.publish()

    def _end_task(self, row: int, why: Reason) -> None:
        """End a robot's task because of its driver, unless that has found its dock by itself: it lets go there."""
        if not (self.inbox.charging.away(row) and self._fleet.docked(row)):
            self.inbox.void(row, why)

    def _end_tasks(self) -> None:
        """End the behaviours that have ended themselves, before anything is commanded: their robots stand."""
        for row, ending in self.desired.endings.items():
            self.inbox.end(row, ending.outcome, ending.text)
        self.desired.endings.clear()
        self._dirty = True

    # ------------------------------------------------------------------ what goes out
    def _on_states(self, states: RobotStates) -> None:
        now_s = self._scheduler.now_s()
        self.neighbours.receive(states, now_s)
        if not self.reception.alone:
            self.reception.note(states, now_s)

    def _on_object(self, fix: ObjectFix) -> None:
        self.objects.tell(fix, self._scheduler.now_s())

    def _follow(self) -> None:
        reaches_m = [group.hearing_m for group in self.tasks.groups()]
        # What comes within reach before the next call must be subscribed already.
        way_m = FOLLOW_PERIOD_S * float(self.controller.speed_limit.max())
        reach_m = max([self._config.sensing_radius_m, self.exchange.reach_m, *reaches_m]) + way_m
        self._state_subscriptions.follow(self._state.pose[:, :2], reach_m)
        self.exchange.follow()
        self.profiles.follow(self._state.pose[:, :2])
        self.neighbours.forget(self._scheduler.now_s(), self._state_subscriptions.covers)

    def _sense_obstacles(self) -> None:
        """Take in the obstacles in sight, and tell the others: at once what is new, all now and then."""
        reading = self._state.reading
        if reading is None:
            return
        now_s = self._scheduler.now_s()
        self.pose_conflicts.update(now_s)
        self.reception.update()
        self.exchange.watch()
        self.profiles.update(now_s)
        try:
            self.metrics.sample(now_s)
        except Exception as error:
            self._measurement_failed(error)
        known = self.objects.obstacles = self._state.obstacles
        if self._grid_sharing is not None:
            self._grid_sharing.update(now_s)
        if reading.bodies is not None and self.neighbours.silent:
            strange = self.objects.strange(reading.bodies, now_s)
            self.silent_search.look(now_s, self._state.pose[:, :2], reading.bodies, strange, known)
        self._obstacle_sharing.add_sensed(
            now_s, self._state.pose[:, :2], reading.obstacles, self._config.sensing_radius_m
        )

    def _publish_states(self) -> None:
        if self._state.reading is None:
            return
        self._sequence += 1
        now_s = self._scheduler.now_s()
        for key, message in self._reports.states(self._keys, self._cell_m, self._sequence, now_s, self.core_clock):
            self._bus.publish(key, message)

    def publish_health(self) -> None:
        """Publish the health of all robots."""
        self._dirty = False
        now_s = self._scheduler.now_s()
        self._bus.publish(self._keys.health(self._identity.host), self.health(now_s))

    def health(self, now_s: float) -> HealthReport:
        """Return the health of all robots."""
        return self._reports.health(self._loop(), __version__, now_s, self.core_clock)

    def _report(self) -> None:
        """Publish, on request, what is otherwise published seldom."""
        self.profiles.report()
        self._publish_for_people()
        self._dirty = True

    def publish_measurements(self, *, whole: bool = True) -> None:
        """Publish what the robots have measured of themselves; the grid of coverage not always unless `whole`."""
        try:
            self._publish_measurements(whole=whole)
        except Exception as error:
            self._measurement_failed(error)

    def _publish_measurements(self, *, whole: bool) -> None:
        now_s, host = self._scheduler.now_s(), self._identity.host
        self.calculators.publish(self._bus, self._keys, host, now_s, whole=whole)
        if self._state.reading is not None:
            self.metrics.sample(now_s)
            columns = {
                "deviation_m": self.filter.deviation_m,
                "no_way": np.array([float(row in self.desired.blocked) for row in range(len(self._fleet.ids))]),
                "settled": np.where(self.settling.settled, 1.0, math.nan),
                "delay_s": np.full(len(self._fleet.ids), self.neighbours.longest_delay_s(now_s)),
                **self.calculators.columns(),
            }
            message = self.metrics.message(
                now_s, self._identity, self._loop(), self._bus, self.exchange.counts, columns
            )
            self._bus.publish(self._keys.measurement("robots", host), message)

    @property
    def setpoints(self) -> Array:
        """What the drivers applied in the last tick, (n, 2) m/s and rad/s."""
        return self._state.setpoints

    @property
    def contacts(self) -> NDArray[np.int64]:
        """How many bodies each robot touches now, as it feels itself or as a source outside sees it, (n,)."""
        return self.fixes.touches()

    @property
    def radius(self) -> Array:
        """Footprints, (n,) m."""
        return self._state.radius

    @property
    def driver_ready(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Which drivers were READY or ACTIVE at the last tick, (n,)."""
        return self._state.driver_ready

    def close(self) -> None:
        """Stop all wheels, publish the last measurements, close the drivers."""
        for timer in self._timers:
            timer.cancel()
        for row in range(len(self._fleet.ids)):
            self.tasks.disable(row)
        self._fleet.command(np.zeros_like(self._state.setpoints), self.tasks.active)
        self.publish_measurements()
        self.core_clock.close()
        self._state_subscriptions.close()
        self._obstacle_sharing.close()
        if self._grid_sharing is not None:
            self._grid_sharing.close()
        if self._scan_reporter is not None:
            self._scan_reporter.close()
        self.reception.close()
        self.exchange.close()
        self.profiles.close()
        self._on_query.close()
        self._object_subscription.close()
        self.silent_search.close()
        self.fixes.close()
        self.inbox.close()
        self._fleet.close()


def _map_poses(
    config: SwarmConfig, fleet: Fleet, given: Array, radius_m: Array, start: Array, receive: Callable[[PoseFix], None]
) -> MapPoses | None:
    """Return what locates the robots on the map, if the fleet file asks for it."""
    if not config.agent.locate_on_map:
        return None
    if not any(each.ranges_max_m > 0.0 for each in fleet.descriptions):
        raise ConfigError(
            "no robot here has a range sensor", where="agent.locate_on_map",
            hint="use a driver whose robots have one, or simulated ones: [world] ranges = {}",
        )  # fmt: skip
    if not len(given) and not (config.world is not None and config.world.walls):
        raise ConfigError(
            "there is no map", where="agent.locate_on_map", hint='name one: [world] map = "lab.yaml", or give boxes'
        )
    from fullswarm.agent.pose.map_poses import MapPoses  # few robots need it

    return MapPoses(config, fleet.ids, given, radius_m, start, receive)


def _thresholds(settings: AgentConfig) -> Thresholds:
    return Thresholds(settings.battery_low, settings.battery_rise, settings.fence_margin_m, settings.fence_delay_s)


def _reflexes(config: SwarmConfig, fleet: Fleet, accel: Array, thresholds: Thresholds) -> Reflexes:
    # The filter keeps its margin for what it does not know: a position may become less certain by so much.
    spare_m = max(config.agent.safety_margin_m, LEAST_SPARE_M)
    sigma_limit_m = np.array([each.pose_sigma_m + spare_m for each in fleet.descriptions])
    return Reflexes(config.bounds_m, thresholds, accel, sigma_limit_m)


def _doubt(reflexes: Reflexes, conflicts: PoseConflicts, ranges: RangeSense) -> Doubt:
    return Doubt(
        battery_low=reflexes.battery_low, clock_jumped=reflexes.clock_jumped,
        pose_unknown=reflexes.pose_unknown, pose_uncertain=reflexes.pose_uncertain, overlap=conflicts.overlap,
        frame_conflict=conflicts.frame_conflict, blind=ranges.blind, floor=reflexes.floor, ceiling=reflexes.ceiling,
    )  # fmt: skip


def _neighbours(
    config: SwarmConfig, fleet: Fleet, controller: RobotController, accel: Array, extra: Array
) -> Neighbours:
    settings = config.agent
    # A robot that states no limits is taken for one like this one.
    assumed = Assumed(
        accel_m_s2=float(accel.max()),
        speed_m_s=float(controller.speed_limit.max()),
        turn_rad_s=float(controller.turn_limit.max()),
        # A silent robot has lost its agent, the hub or the core, and is at standstill by then.
        halt_s=settings.core_silence_s + settings.command_ttl_s,
        confidence=settings.pose_confidence_sigma,
        extra_m=float(extra[:, 0].max()),
        extra_s=float(extra[:, 1].max()),
    )
    return Neighbours(fleet.ids, settings.neighbour_timeout_s, assumed, config.robots)


def _filter(config: SwarmConfig, fleet: Fleet, controller: RobotController, tracker: ObjectTracker) -> SafetyFilter:
    settings = config.agent
    tuning = Tuning(
        period_s=1.0 / settings.control_rate_hz,
        reach_m=settings.sensing_radius_m,
        speed_gain=settings.speed_gain,
        turn_gain_per_s=settings.turn_gain_per_s,
        confidence=settings.pose_confidence_sigma,
    )
    robots = robot_params(fleet.descriptions, controller.speed_limit, controller.turn_limit, controller.reverse)
    return SafetyFilter(fleet.ids, robots, tuning, np.array(config.bounds_m), tracker.objects)
