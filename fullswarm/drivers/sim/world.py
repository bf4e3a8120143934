"""The simulated world: an engine, and what every robot has whatever the physics.

Limits, acceleration ramps, the device's watchdog, odometry, noisy poses, bumpers, sensed obstacles. Time is the
world's own: it advances by ``1 / rate_hz`` per step, however long the step takes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from fullswarm.config import WorldConfig
from fullswarm.drivers.base import Description, Limits
from fullswarm.drivers.sim.engine import make_engine
from fullswarm.drivers.sim.obstacles import static_obstacles, with_trigonometry
from fullswarm.drivers.sim.starts import fill_starts
from fullswarm.drivers.sim.world_kernels import dead_reckon, front_bumps, ramp, sense
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.kernels import Array


def describe(config: WorldConfig) -> Description:
    """Return what a robot of this world is."""
    return Description(
        make="sim",
        model=config.engine,
        radius_m=config.radius_m,
        limits=Limits(
            speed_m_s=config.speed_limit_m_s,
            turn_rad_s=config.turn_limit_rad_s,
            accel_m_s2=config.accel_limit_m_s2,
            turn_accel_rad_s2=config.turn_accel_limit_rad_s2,
        ),
        senses_pose=True,
        senses_obstacles=True,
        senses_bumps=True,
        watchdog_s=config.watchdog_s,
    )


class World:
    """n bodies in one arena. All arrays are the same objects for the world's life; do not write to them.

    Attributes
    ----------
    pose, sensed_pose : (n, 3) true, and as the robots sense it with noise
    odometry : (n, 3) from the measured twist, in the start frame
    twist : (n, 2) measured, m/s and rad/s
    contacts : (n,) bodies and obstacles touched during the last step, see ``contacts.ContactReferee``
    hazards : (n,) ``Hazard`` bits
    target, drive : (n, 2) set-points as asked, and after limits and ramps
    limits : (n, 4) m/s, rad/s, m/s², rad/s²
    obstacles : (k, 6) all boxes, then the walls, rows as in ``Reading.obstacles``
    watchers : called after each step: who must not miss one adds itself

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
        self.description = describe(config)
        self.engine = make_engine(config, fill_starts(config, ids, starts))
        self.firmware = self.engine.firmware
        self.referee = self.engine.referee
        self.pose, self.twist, self.contacts = self.engine.pose, self.engine.twist, self.referee.contacts
        self.sensed_pose = self.pose if _perfect(config) else self.pose.copy()
        self.odometry = np.zeros((n, 3))
        self.hazards = np.zeros(n, np.uint8)
        self.target, self.drive = np.zeros((n, 2)), np.zeros((n, 2))
        self.commanded_s = np.full(n, -math.inf)
        limits = self.description.limits
        self.limits = np.empty((n, 4))
        self.limits[:] = limits.speed_m_s, limits.turn_rad_s, limits.accel_m_s2, limits.turn_accel_rad_s2
        self.shapes = with_trigonometry(self.obstacles)
        self._rng = np.random.default_rng(config.seed)
        self._sigma = np.array([config.noise.position_m, config.noise.position_m, config.noise.heading_rad])
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

    def step(self) -> None:
        """Advance by one world step."""
        ramp.run(
            self.target,
            self.commanded_s,
            self.limits,
            self.drive,
            self._steps * self.dt_s,
            self.config.watchdog_s,
            self.dt_s,
        )
        self.engine.step(self.drive)
        self._steps += 1
        dead_reckon.run(self.odometry, self.twist, self.dt_s)
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
        self._rng.standard_normal(out=sensed)
        sensed *= self._sigma
        sensed += self.pose
        sensed[:, 2] -= np.round(sensed[:, 2] / (2 * math.pi)) * (2 * math.pi)

    def sensed_obstacles(self, row: int, radius_m: float) -> Array:
        """Return the obstacles (k, 6) whose surface is within `radius_m` of a body's centre."""
        seen = np.zeros(len(self.obstacles), np.bool_)
        sense(self.pose[row : row + 1], self.shapes, radius_m, seen)
        return self.obstacles[seen]

    def close(self) -> None:
        """Let go of the physics. Closing twice is fine."""
        self.engine.close()


def _perfect(config: WorldConfig) -> bool:
    return config.noise.position_m == 0.0 and config.noise.heading_rad == 0.0
