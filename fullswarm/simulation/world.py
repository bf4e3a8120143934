"""The simulated world: an engine, and what every robot has whatever the physics.

Limits, acceleration ramps, the device's watchdog, odometry, noisy poses, bumpers, sensed obstacles. Time is the
world's own: it advances by ``1 / rate_hz`` per step, however long the step takes. Rows of obstacles in kernels are
those of :func:`fullswarm.simulation.obstacles.with_trigonometry`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from fullswarm.config import WorldConfig
from fullswarm.config.docks import Slot
from fullswarm.drivers.actuators import ActuatorValue, checked
from fullswarm.drivers.base import Hazard, Limits
from fullswarm.drivers.sim.settings import describe
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.kernels import Array, kernel
from fullswarm.simulation.batteries import Batteries
from fullswarm.simulation.engine import make_engine
from fullswarm.simulation.movers import Movers
from fullswarm.simulation.obstacles import obstacle_gap, static_obstacles
from fullswarm.simulation.ranges import SimulatedSensor
from fullswarm.simulation.sight import look
from fullswarm.simulation.starts import fill_starts

BUMP_BIT = int(Hazard.BUMP)  # as a number that a compiled kernel can hold


class World:
    """n bodies in one arena. All arrays are the same objects for the world's life; do not write to them.

    Parameters
    ----------
    slots : where bodies with batteries are charged

    Attributes
    ----------
    pose, sensed_pose : (n, 3) true, and as the robots sense it with noise
    odometry : (n, 3) from the measured twist, in the start frame
    twist : (n, 2) measured, m/s and rad/s
    contacts : (n,) bodies and obstacles touched during the last step, see ``contacts.ContactReferee``
    hazards : (n,) ``Hazard`` bits
    radius_m : (n,) of the bodies
    target, drive : (n, 2) set-points as requested, and after limits and ramps
    limits : (n, 4) m/s, rad/s, m/s², rad/s²
    radius_m : (n,) of the bodies, which their drivers may state otherwise
    bodies, descriptions : the settings of each body, and what its driver states
    obstacles : (k, 6) all boxes, then the walls, rows as in ``Reading.obstacles``
    shapes : (k + m, 8) the same with trigonometry, then the movers where they are
    actuators : of each body, the state of each actuator by name
    sensors : of each body, its range sensor; None: it has none
    batteries : of the bodies; None: they have none
    movers : bodies that no robot's agent commands
    watchers : called after each step

    Raises
    ------
    ConfigError
        Start poses overlap each other or an obstacle, ids repeat, or the arena has no room.
    MissingExtra
        The engine is not installed.
    """

    def __init__(
        self,
        config: WorldConfig,
        ids: Sequence[str],
        starts: Sequence[Sequence[float] | None] | Array | None = None,
        slots: Sequence[Slot] = (),
    ) -> None:
        n = len(ids)
        self.config, self.ids = config, tuple(ids)
        self.rows = {robot: row for row, robot in enumerate(self.ids)}
        if len(self.rows) < n:
            twice = sorted({robot for robot in ids if self.ids.count(robot) > 1})
            raise ConfigError(f"robot ids repeat: {', '.join(twice)}", where="robot.id")
        self.dt_s = 1.0 / config.rate_hz
        self.obstacles = static_obstacles(config)
        self.obstacles.flags.writeable = False
        self.bodies = tuple(config.of_body(robot) for robot in ids)
        self.descriptions = tuple(describe(body) for body in self.bodies)
        self.actuators: tuple[dict[str, ActuatorValue], ...] = tuple(
            {part.name: part.choices[0] for part in each.actuators} for each in self.descriptions
        )
        self.engine = make_engine(config, fill_starts(config, ids, starts), self.bodies)
        self.firmware = self.engine.firmware
        self.referee = self.engine.referee
        self.radius_m = self.referee.radius_m
        self.pose, self.twist, self.contacts = self.engine.pose, self.engine.twist, self.referee.contacts
        self.sensed_pose = self.pose if _perfect(config) else self.pose.copy()
        self.odometry = np.zeros((n, 3))
        self.hazards = np.zeros(n, np.uint8)
        self.target, self.drive = np.zeros((n, 2)), np.zeros((n, 2))
        self.commanded_s = np.full(n, -math.inf)
        self.limits = np.array([body_limits(body) for body in self.bodies], float).reshape(n, 4)
        self.movers = Movers(config.movers)
        self.shapes = self.referee.solids.obstacles
        self._discs = np.zeros((n + len(self.movers), 3))
        self._discs[:n, 2], self._discs[n:] = self.radius_m, self.movers.bodies()
        self._sight_rng = np.random.default_rng((config.seed, 1))
        self.sensors = tuple(
            None
            if body.ranges is None
            else SimulatedSensor(body.ranges, row, np.random.default_rng((config.seed, 2, row)))
            for row, body in enumerate(self.bodies)
        )
        scale = config.noise.odometry
        drawn = np.random.default_rng((config.seed, 3)).normal(1.0, scale, (n, 2))
        self._odometry_scale = np.clip(drawn, 1.0 - 2.0 * scale, 1.0 + 2.0 * scale) if scale > 0.0 else None
        self._rng = np.random.default_rng(config.seed)
        self._sigma = np.array([config.noise.position_m, config.noise.position_m, config.noise.heading_rad])
        self.batteries = None if config.battery is None else Batteries(config, n, slots)
        self._steps = 0
        self._touching = False
        self.watchers: list[Callable[[], None]] = []
        self._add_noise()

    @property
    def time_s(self) -> float:
        """Seconds since the world began."""
        return self._steps * self.dt_s

    @property
    def pairs(self) -> NDArray[np.int64]:
        """Touching pairs of the last step (m, 2); the second is -1-k for obstacle k."""
        return self.referee.pairs

    def row(self, robot: str) -> int:
        """Return the row of a robot; `ConfigError` if it has none."""
        row = self.rows.get(robot)
        if row is None:
            raise ConfigError(f"the world has no robot '{robot}'", hint=did_you_mean(robot, self.ids))
        return row

    def set_limits(self, row: int, limits: Limits) -> None:
        """Give one body the limits of its make."""
        self.limits[row] = limits.speed_m_s, limits.turn_rad_s, limits.accel_m_s2, limits.turn_accel_rad_s2

    def set_twists(self, twists: Array, rows: NDArray[np.int64] | slice | int = slice(None)) -> None:
        """Set set-points (m, 2) of all bodies or of `rows`, and feed their watchdogs.

        A non-finite value raises ``ValueError``; the bodies of that call get zero.
        """
        self.commanded_s[rows] = self.time_s
        self.target[rows] = 0.0
        if not np.isfinite(twists).all():
            raise ValueError(f"a twist must be finite, not {np.asarray(twists).tolist()}")
        self.target[rows] = twists

    def actuate(self, row: int, name: str, value: object) -> None:
        """Bring an actuator into a state; ``ValueError`` if the body has none of that name or it takes other values."""
        self.actuators[row][name] = checked(self.descriptions[row].actuators, name, value)

    def step(self) -> None:
        """Advance by one world step."""
        if self.batteries is not None:
            self.batteries.hold_flat(self.target)
        ramp.run(
            self.target,
            self.commanded_s,
            self.limits,
            self.drive,
            self._steps * self.dt_s,
            self.config.watchdog_s,
            self.dt_s,
        )
        if len(self.movers):
            self.movers.set_time((self._steps + 1) * self.dt_s)
            self.engine.place_movers(self.movers.place)
        self.engine.step(self.drive)
        self._steps += 1
        rolled = self.twist if self._odometry_scale is None else self.twist * self._odometry_scale
        dead_reckon.run(self.odometry, rolled, self.dt_s)
        if self.batteries is not None:
            self.batteries.step(self.pose, self.twist, self.dt_s)
        pairs = self.referee.pairs
        touching = len(pairs) > 0
        if touching or self._touching:
            front_bumps(self.pose, pairs, self.shapes, self.hazards)
            self._touching = touching
        self._add_noise()
        for watch in self.watchers:
            watch()

    def _add_noise(self) -> None:
        if self.sensed_pose is self.pose:
            return
        sensed = self.sensed_pose
        if not self.config.sight.pose:
            sensed.fill(math.nan)
            return
        self._rng.standard_normal(out=sensed)
        sensed *= self._sigma
        sensed += self.pose
        sensed[:, 2] -= np.round(sensed[:, 2] / (2 * math.pi)) * (2 * math.pi)

    def scan(self, row: int) -> Array | None:
        """Return the distances (k,) m that the range sensor of a body measures now; None: it has none."""
        sensor = self.sensors[row]
        if sensor is None:
            return None
        n = len(self.ids)
        self._discs[:n, :2] = self.pose[:, :2]
        return sensor.scan(self.pose[row], self._discs, n, self.shapes)

    def sensed_obstacles(self, row: int, radius_m: float) -> Array:
        """Return the obstacles (k, 6) whose surface is within `radius_m` of a body's centre; none with ranges."""
        seen = np.zeros(len(self.obstacles), np.bool_)
        if self.sensors[row] is not None:
            return self.obstacles[seen]
        sense(self.pose[row : row + 1], self.shapes, radius_m, seen)
        return self.obstacles[seen]

    def seen_bodies(self, row: int | None, range_m: float) -> Array | None:
        """Return the bodies that robot `row` sees, (k, 3): x, y, radius in m; None: the movers that any robot sees.

        A fleet that carries all robots knows where they are without seeing them. Returns None if robots see no bodies.
        """
        sight, n = self.config.sight, len(self.ids)
        if not sight.bodies or (row is not None and self.sensors[row] is not None):
            return None
        bodies = self._discs
        bodies[:n, :2], bodies[n:, :2] = self.pose[:, :2], self.movers.place
        seen = np.zeros(len(bodies), np.bool_)
        if row is None:
            marks = np.zeros(len(bodies), np.bool_)
            for eye, (x, y, _) in enumerate(self.pose.tolist()):
                if self.sensors[eye] is None and look.run(
                    x, y, eye, bodies, self.shapes, len(self.obstacles), range_m, marks
                ):
                    seen |= marks
            seen[:n] = False
        else:
            x, y, _ = self.pose[row].tolist()
            look.run(x, y, row, bodies, self.shapes, len(self.obstacles), range_m, seen)
        if sight.dropout > 0.0:
            seen &= self._sight_rng.random(len(seen)) >= sight.dropout
        found = bodies[seen]
        if sight.noise_m > 0.0:
            found[:, :2] += self._sight_rng.normal(0.0, sight.noise_m, (len(found), 2))
        return found

    def close(self) -> None:
        """Release the physics. Closing twice is fine."""
        self.engine.close()


def body_limits(body: WorldConfig) -> tuple[float, float, float, float]:
    """Return what a body can do, whatever its driver states: m/s, rad/s, m/s², rad/s²."""
    return body.speed_limit_m_s, body.turn_limit_rad_s, body.accel_limit_m_s2, body.turn_accel_limit_rad_s2


def _perfect(config: WorldConfig) -> bool:
    return config.noise.position_m == 0.0 and config.noise.heading_rad == 0.0 and config.sight.pose


@kernel
def ramp(
    target: Array, commanded_s: Array, limits: Array, drive: Array, now_s: float, watchdog_s: float, dt: float
) -> None:
    """Move `drive` (n, 2) towards `target` within `limits` (n, 4: m/s, rad/s, m/s², rad/s²).

    A body that got no command for `watchdog_s` gets the target zero.
    """
    for i in range(target.shape[0]):
        if now_s - commanded_s[i] > watchdog_s + 1e-9:
            target[i, 0] = 0.0
            target[i, 1] = 0.0
        for axis in range(2):
            cap, most = limits[i, axis], limits[i, axis + 2] * dt
            goal = max(-cap, min(cap, target[i, axis]))
            drive[i, axis] += max(-most, min(most, goal - drive[i, axis]))


@kernel
def dead_reckon(odometry: Array, twist: Array, dt: float) -> None:
    """Advance `odometry` (n, 3) along the arcs of the measured `twist` (n, 2)."""
    for i in range(odometry.shape[0]):
        half = 0.5 * twist[i, 1] * dt
        ratio = math.sin(half) / half if abs(half) > 1e-4 else 1.0 - half * half / 6.0
        middle, chord = odometry[i, 2] + half, twist[i, 0] * dt * ratio
        odometry[i, 0] += chord * math.cos(middle)
        odometry[i, 1] += chord * math.sin(middle)
        heading = middle + half
        if heading > math.pi or heading < -math.pi:
            heading = math.atan2(math.sin(heading), math.cos(heading))
        odometry[i, 2] = heading


@kernel
def front_bumps(pose: Array, pairs: NDArray[np.int64], obstacles: Array, hazards: NDArray[np.uint8]) -> None:
    """Set `hazards` (n,) to BUMP where a touching pair lies in the front half of a body, else to none."""
    hazards[:] = 0
    for p in range(pairs.shape[0]):
        i, j = pairs[p, 0], pairs[p, 1]
        if j >= 0:
            nx, ny = pose[i, 0] - pose[j, 0], pose[i, 1] - pose[j, 1]
            if nx * math.cos(pose[j, 2]) + ny * math.sin(pose[j, 2]) > 0.0:
                hazards[j] = BUMP_BIT
        else:
            _, nx, ny = obstacle_gap(pose[i, 0], pose[i, 1], obstacles, -1 - j)
        if nx * math.cos(pose[i, 2]) + ny * math.sin(pose[i, 2]) < 0.0:
            hazards[i] = BUMP_BIT


@kernel
def sense(pose: Array, obstacles: Array, radius: float, seen: NDArray[np.bool_]) -> int:
    """Mark in `seen` (k,) which of the first k obstacles are within `radius` of any pose; return how many changed."""
    changed = 0
    for k in range(seen.shape[0]):
        near = False
        far = obstacles[k, 7] + radius
        for i in range(pose.shape[0]):
            dx, dy = pose[i, 0] - obstacles[k, 0], pose[i, 1] - obstacles[k, 1]
            if dx * dx + dy * dy <= far * far and obstacle_gap(pose[i, 0], pose[i, 1], obstacles, k)[0] <= radius:
                near = True
                break
        if near != seen[k]:
            seen[k] = near
            changed += 1
    return changed
