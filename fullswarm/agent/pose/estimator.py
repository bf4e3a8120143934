"""Estimates the pose of each robot from its driver's readings and from fixes.

``"ekf"`` fuses odometry, the start pose, noisy poses that a driver senses and fixes by their certainty. ``"direct"``
takes a sensed pose as it is; where there is none, odometry is laid on the last fix as that is. ``"auto"`` chooses:
``direct`` where the driver's own pose is exact or filtered already, ``ekf`` elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Protocol

import numpy as np
import structlog

from fullswarm.agent.pose.pose_filter import UNSEEN_RAD, Distance, Fix, PoseEstimate, PoseFilter, Taken, breaks_of, fuse
from fullswarm.config import AgentConfig, SwarmConfig
from fullswarm.drivers.base import POSE_SIGMA_M, Description, Fleet, FleetReading
from fullswarm.kernels import Array, sum_of

log = structlog.get_logger()

USUAL_SIGMA = POSE_SIGMA_M
"""Standard deviation (m, rad) of the pose that a real driver senses, unless its reading states it."""

FEW = 5
SIMULATED = "sim"
LEAST_SIGMA = 1e-3
"""m and rad: what a filter takes the noise of a sensed pose for that is declared as none."""


class Estimator(Protocol):
    """Turns readings and fixes into poses."""

    fuses: bool
    """The poses that a driver senses are filtered too, so their certainty is known."""

    sigma: Array
    """Standard deviations of position (m, worse axis) and heading (rad) at the last update, (n, 2)."""

    def update(self, reading: FleetReading, dt_s: float) -> Array:
        """Return the poses (n, 3): x, y (m), heading (rad), world frame, after `dt_s` more."""
        ...

    def take(self, row: int, fix: Fix) -> Taken:
        """Judge a fix of a robot whose driver senses no pose, and use it from the next update on."""
        ...

    def take_distance(self, row: int, measured: Distance) -> Taken:
        """Judge a distance to a known place in the same way."""
        ...

    def insisted_s(self, row: int, source: str, at_s: float) -> float:
        """Return for how long fixes of a source have agreed with each other and not with the pose; 0: they fit."""
        ...

    def known_sigma(self, row: int) -> tuple[float, float]:
        """Return the standard deviations of position (m) and heading (rad); -1 when nothing is known."""
        ...


class DirectEstimator:
    """Takes the pose that a driver senses; where it senses none, the last fix or the start pose, and odometry since.

    Parameters
    ----------
    start : (n, 3) poses at `open()`, for robots that know their odometry only
    placed : (n,) whether the robot was placed on its start pose; all when None
    top_speed_m_s : (n,)
    sensed_sigma : (n, 2) standard deviations (m, rad) of the poses that drivers sense; None: `USUAL_SIGMA`
    """

    fuses = False

    def __init__(
        self,
        start: Array,
        config: AgentConfig | None = None,
        placed: list[bool] | None = None,
        top_speed_m_s: list[float] | None = None,
        sensed_sigma: Array | None = None,
    ) -> None:
        count = len(start)
        rows = zip(start.tolist(), placed or [True] * count, top_speed_m_s or [math.inf] * count, strict=True)
        self._filters = [PoseFilter(*row, config or AgentConfig(), _replace) for row in rows]
        self._sensed: list[float] | None = None
        self._sensed_sigma = np.full((count, 2), USUAL_SIGMA) if sensed_sigma is None else sensed_sigma
        self.sigma = self._sensed_sigma.copy()

    def update(self, reading: FleetReading, dt_s: float) -> Array:
        """Return the poses (n, 3)."""
        del dt_s
        pose = reading.pose
        # On board there is one robot, and reducing an array costs it five times as much as three numbers.
        if len(pose) == 1:
            values = pose[0].tolist()
            if not math.isnan(sum(values)):
                self._sensed = values
                stated_m = reading.position_sigma_m[0]
                self.sigma[0, 0] = self._sensed_sigma[0, 0] if math.isnan(stated_m) else stated_m
                self.sigma[0, 1] = self._sensed_sigma[0, 1]
                return pose
        elif not math.isnan(sum_of(pose)):
            return pose  # simulated robots: their sigma does not change
        return self._dead_reckon(reading)

    def _dead_reckon(self, reading: FleetReading) -> Array:
        if self._sensed is not None:
            # The driver has lost the pose that it sensed until now: odometry goes on from there.
            self._filters[0].begin_at(PoseEstimate.around(self._sensed, USUAL_SIGMA, USUAL_SIGMA))
            self._sensed = None
        rows = zip(
            self._filters, reading.stamp_s.tolist(), reading.odometry.tolist(), reading.twist.tolist(),
            reading.pose.tolist(), breaks_of(reading), strict=True,
        )  # fmt: skip
        poses = []
        for row, (pose_filter, stamp_s, odometry, twist, pose, breaks) in enumerate(rows):
            pose_filter.follow(stamp_s, odometry, twist, breaks)
            unsensed = math.isnan(sum(pose))
            poses.append(pose_filter.estimate.mean if unsensed else pose)
            self.sigma[row] = pose_filter.assumed_sigma if unsensed else self._sensed_sigma[row]
        return np.array(poses)

    def take(self, row: int, fix: Fix) -> Taken:
        """Judge a fix of robot `row` and go on from it."""
        return self._filters[row].take(fix)

    def take_distance(self, row: int, measured: Distance) -> Taken:
        """Judge a distance of robot `row` and fuse it."""
        return self._filters[row].take_distance(measured)

    def insisted_s(self, row: int, source: str, at_s: float) -> float:
        """Return for how long fixes of a source have agreed with each other and not with the pose; 0: they fit."""
        return self._filters[row].insisted_s(source, at_s)

    def known_sigma(self, row: int) -> tuple[float, float]:
        """Return the standard deviations of position (m) and heading (rad); -1 when nothing is known."""
        return self._filters[row].sigma


def _replace(estimate: PoseEstimate, seen: PoseEstimate) -> None:
    """Take the measurement as it is; a heading that was not seen stays what odometry makes of it."""
    heading_rad, hh = estimate.heading_rad, estimate.hh
    unseen = seen.hh >= UNSEEN_RAD**2
    estimate.set(np.array(seen.mean), seen.covariance())
    if unseen:
        estimate.heading_rad, estimate.hh, estimate.xh, estimate.yh = heading_rad, hh, 0.0, 0.0


def chosen(config: SwarmConfig, description: Description) -> str:
    """Return which estimator a robot gets: ``direct`` or ``ekf``, where the fleet file says ``auto`` as well."""
    if config.agent.estimator != "auto":
        return config.agent.estimator
    return "ekf" if needs_filter(config, description) else "direct"


def needs_filter(config: SwarmConfig, description: Description) -> bool:
    """Tell whether a robot's pose is noise that nothing has filtered: fixes, or a simulated sensor with noise.

    An autopilot has its own filter; what it reports must not be fused a second time.
    """
    noisy = description.make == SIMULATED and max(sensed_sigma(config, description)) > 0.0
    return noisy or not description.senses_pose


def sensed_sigma(config: SwarmConfig, description: Description) -> tuple[float, float]:
    """Return the standard deviations (m, rad) of the pose that a robot's driver senses; zero: none for sure."""
    if description.make == SIMULATED:
        noise = config.world_or_default.noise
        return noise.position_m, noise.heading_rad
    return description.pose_sigma_m, USUAL_SIGMA


def estimator_for(config: SwarmConfig, fleet: Fleet, start: Array) -> Estimator:
    """Return the estimator that the fleet file asks for, for the robots of `fleet` starting at `start` (n, 3)."""
    poses = {each.id: each.pose for each in config.robot}
    placed = [poses.get(robot) is not None for robot in fleet.ids]
    top_speeds = [each.limits.speed_m_s for each in fleet.descriptions]
    sigma = np.array([sensed_sigma(config, each) for each in fleet.descriptions]).reshape(-1, 2)
    if any(chosen(config, each) == "ekf" for each in fleet.descriptions):
        return EkfEstimator(start, sigma, config.agent, placed, top_speeds)
    if warning := unfiltered(config, fleet.descriptions):
        log.warning(warning, robots=fleet.ids[:FEW])
    return DirectEstimator(start, config.agent, placed, top_speeds, sigma)


def unfiltered(config: SwarmConfig, descriptions: Iterable[Description]) -> str:
    """Return a warning where the fleet file asks for ``direct`` although poses are noisy; else the empty text."""
    if config.agent.estimator != "direct" or not any(needs_filter(config, each) for each in descriptions):
        return ""
    return (
        "agent.estimator = 'direct' takes noisy poses as they are: the safety filter keeps more distance, and robots "
        "may not get past each other; leave it out, or write 'ekf'"
    )


class EkfEstimator:
    """Fuses odometry with fixes, or with the noisy poses that a driver senses, robot by robot.

    Parameters
    ----------
    start : (n, 3) poses at ``open()``
    sensed_sigma : (n, 2) standard deviations (m, rad) of the poses that drivers sense
    placed : (n,) whether the robot was placed on its start pose; all when None
    top_speed_m_s : (n,)
    """

    fuses = True

    def __init__(
        self,
        start: Array,
        sensed_sigma: Array,
        config: AgentConfig | None = None,
        placed: list[bool] | None = None,
        top_speed_m_s: list[float] | None = None,
    ) -> None:
        count = len(start)
        self._sigma: list[list[float]] = np.maximum(sensed_sigma, LEAST_SIGMA).tolist()
        rows = zip(start.tolist(), placed or [True] * count, top_speed_m_s or [math.inf] * count, strict=True)
        self._filters = [PoseFilter(*row, config or AgentConfig(), fuse) for row in rows]
        self.sigma = np.array([each.assumed_sigma for each in self._filters]).reshape(-1, 2)

    def update(self, reading: FleetReading, dt_s: float) -> Array:
        """Return the fused poses (n, 3)."""
        del dt_s
        rows = zip(
            self._filters, reading.stamp_s.tolist(), reading.odometry.tolist(), reading.twist.tolist(),
            reading.pose.tolist(), breaks_of(reading), reading.position_sigma_m.tolist(), self._sigma, strict=True,
        )  # fmt: skip
        for pose_filter, stamp_s, odometry, twist, pose, breaks, stated_m, (usual_m, heading_rad) in rows:
            if not pose_filter.follow(stamp_s, odometry, twist, breaks) or math.isnan(sum(pose)):
                continue
            seen = PoseEstimate.around(pose, usual_m if math.isnan(stated_m) else stated_m, heading_rad)
            if pose_filter.anchored:
                fuse(pose_filter.estimate, seen)
            else:
                pose_filter.estimate, pose_filter.anchored = seen, True
        self.sigma[:] = [pose_filter.assumed_sigma for pose_filter in self._filters]
        return np.array([pose_filter.estimate.mean for pose_filter in self._filters])

    def take(self, row: int, fix: Fix) -> Taken:
        """Judge a fix of robot `row` and fuse it."""
        return self._filters[row].take(fix)

    def take_distance(self, row: int, measured: Distance) -> Taken:
        """Judge a distance of robot `row` and fuse it."""
        return self._filters[row].take_distance(measured)

    def insisted_s(self, row: int, source: str, at_s: float) -> float:
        """Return for how long fixes of a source have agreed with each other and not with the pose; 0: they fit."""
        return self._filters[row].insisted_s(source, at_s)

    def known_sigma(self, row: int) -> tuple[float, float]:
        """Return the standard deviations of position (m) and heading (rad); -1 when nothing is known."""
        return self._filters[row].sigma
