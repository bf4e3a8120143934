"""The testbed of the Robotarium as a laboratory: robots of its size and limits in its arena, behind the safety filter.

Facts about the testbed, from its simulator and from Wilson et al., IEEE Control Systems Magazine 40(1), 2020: an arena
of 3.2 by 2 m around the origin, robots 0.11 m wide, wheels of 0.016 m radius on an axis of 0.105 m, 0.2 m/s, and a
period of 0.033 s, in which a script reads the poses once and steps once.

Its simulator has neither bodies nor accelerations: robots drive through each other, which its report counts. Here they
have both, and by default the safety filter has the last word: it lets a velocity pass that is safe, and slows the robot
down otherwise. The boundary is one for centres, as in the simulator: a wall stands a radius and a margin outside it.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from fullswarm.errors import ConfigError
from fullswarm.kernels import Array
from fullswarm.lab import Lab
from fullswarm.output import data
from fullswarm.robotarium.figure import ArenaFigure
from fullswarm.robotarium.utilities.arguments import columns, require
from fullswarm.robotarium.utilities.misc import generate_initial_conditions

__all__ = ["Report", "Robotarium"]

TIME_STEP_S = 0.033
TICKS = 4
"""Control periods of the robots in a step: a command acts after one of them, 8 ms; in the simulator it acts at once."""
MOST_ROBOTS = 50
ROBOT_DIAMETER_M = 0.11
WHEEL_RADIUS_M = 0.016
BASE_LENGTH_M = 0.105
TOP_SPEED_M_S = 0.2
BOUNDARIES = (-1.6, -1.0, 3.2, 2.0)
"""x, y of the lower left corner, width and height, m."""
ACCEL_M_S2, TURN_ACCEL_RAD_S2 = 4.0, 80.0
"""From rest to the limits in about 0.05 s; the simulator's robots need no time."""
MARGIN_M = 0.01
"""Between bodies: with it the filter keeps centres 0.12 m apart, the least safety radius of the certificates."""

_ANYWHERE: Array = np.array([])


@dataclass(frozen=True)
class Report:
    """What has happened since the start; the first four as the Robotarium judges a script.

    Attributes
    ----------
    steps : how many
    outside : robots whose centre was outside the boundaries, added up over the steps
    too_near : pairs of robots whose centres were within a diameter, added up over the steps
    over_wheel_limit : steps in which a wheel was commanded more than its limit
    contacts : between robots, or of robots with the wall, as the world judges them from the paths of the bodies
    filtered_m : by how much the safety filter changed the motion of all robots, m
    """

    steps: int
    outside: int
    too_near: int
    over_wheel_limit: int
    contacts: int
    filtered_m: float


class Robotarium:
    """The testbed with N robots.

    Parameters
    ----------
    number_of_robots : 1 to 50
    show_figure : draw the testbed while the script runs
    sim_in_real_time : with a figure, a step takes 0.033 s; False: as fast as it can
    initial_conditions : (3, N) poses; empty: random ones, from NumPy's global generator
    filtered : commands pass the safety filter; False: they reach the robots as they are

    Attributes
    ----------
    lab : the laboratory, for its metrics, record, pictures and animations
    velocities : (2, N) as commanded last, within the limits of speed and turn rate
    figure, axes, chassis_patches : matplotlib's, with `show_figure`; otherwise empty

    Raises
    ------
    ConfigError
        An argument is wrong, or robots would start in contact or outside the arena.
    """

    def __init__(
        self,
        number_of_robots: int = -1,
        show_figure: bool = True,
        sim_in_real_time: bool = True,
        initial_conditions: Array = _ANYWHERE,
        *,
        filtered: bool = True,
    ) -> None:
        right = isinstance(number_of_robots, int | np.integer) and 1 <= number_of_robots <= MOST_ROBOTS
        require(right, "number_of_robots", number_of_robots, f"1 to {MOST_ROBOTS}")
        self.number_of_robots, self.filtered = int(number_of_robots), filtered
        self.show_figure, self.sim_in_real_time = show_figure, sim_in_real_time
        if np.size(initial_conditions):
            starts = columns(initial_conditions, 3, "initial_conditions", self.number_of_robots)
        else:
            starts = generate_initial_conditions(self.number_of_robots, spacing=0.2, width=2.5, height=1.5)
        self.initial_conditions: Array = starts
        self.boundaries = list(BOUNDARIES)
        self.time_step, self.robot_diameter, self.robot_radius = TIME_STEP_S, ROBOT_DIAMETER_M, ROBOT_DIAMETER_M / 2.0
        self.wheel_radius, self.base_length = WHEEL_RADIUS_M, BASE_LENGTH_M
        self.max_linear_velocity = TOP_SPEED_M_S
        self.max_angular_velocity = 2.0 * TOP_SPEED_M_S / ROBOT_DIAMETER_M
        self.max_wheel_velocity = TOP_SPEED_M_S / WHEEL_RADIUS_M
        self.velocities: Array = np.zeros((2, self.number_of_robots))
        self.lab = _laboratory(starts, self.max_angular_velocity)
        weakref.finalize(self, self.lab.close)
        self._stepped, self._read = True, False
        self._steps = self._outside = self._too_near = self._over_wheel_limit = 0
        self._drawing = ArenaFigure(starts, BOUNDARIES, self.robot_radius) if show_figure else None
        self.figure: Any = self._drawing.figure if self._drawing else []
        self.axes: Any = self._drawing.axes if self._drawing else []
        self.chassis_patches: list[Any] = self._drawing.bodies if self._drawing else []

    @property
    def poses(self) -> Array:
        """Poses (3, N) now; scripts read them with :meth:`get_poses`."""
        return self.lab.poses.T.copy()

    def get_poses(self) -> Array:
        """Return the poses, (3, N) m, m, rad; once per step, as the testbed measures them once.

        Raises
        ------
        ConfigError
            They were read in this step already.
        """
        if self._read:
            raise ConfigError("the poses of this step were read already", where="get_poses", hint="call step() before")
        self._stepped, self._read = False, True
        return self.poses

    def set_velocities(self, ids: Iterable[int] | int, velocities: Array) -> None:
        """Command robots; a command stays until the next one for the robot, and acts with the next step.

        Parameters
        ----------
        ids : indices of k robots
        velocities : (2, k) speed and turn rate; cut off at the robots' limits, the array itself is left as it is

        Raises
        ------
        ConfigError
            There is no such robot, or the velocities have another shape or are not finite.
        """
        chosen = np.atleast_1d(np.asarray(ids))
        known = chosen.ndim == 1 and chosen.dtype.kind in "iu"
        known = known and bool(((chosen >= 0) & (chosen < self.number_of_robots)).all())
        require(known, "ids", ids, f"indices of robots, 0 to {self.number_of_robots - 1}")
        commanded = columns(velocities, 2, "velocities", len(chosen))
        if not np.isfinite(commanded).all():
            raise ConfigError("velocities are not finite", where="set_velocities", hint="a division by zero?")
        limits = np.array([[self.max_linear_velocity], [self.max_angular_velocity]])
        self.velocities[:, chosen] = np.clip(commanded, -limits, limits)

    def step(self) -> None:
        """Let a period of 0.033 s pass.

        Raises
        ------
        ConfigError
            The poses were not read since the step before.
        """
        if self._stepped:
            raise ConfigError("the poses of this step were not read", where="step", hint="call get_poses() before")
        self._stepped, self._read = True, False
        self._judge()
        self.lab.set_velocities(None, self.velocities.T, filtered=self.filtered)
        self.lab.run(TIME_STEP_S)
        if self._drawing is not None:
            self._drawing.update(self.poses, TIME_STEP_S if self.sim_in_real_time else 0.0)

    def _judge(self) -> None:
        """Count what the Robotarium counts against a script."""
        self._steps += 1
        places = self.poses[:2]
        low = np.array(BOUNDARIES[:2])[:, None]
        size = np.array(BOUNDARIES[2:])[:, None]
        self._outside += int(((places < low) | (places > low + size)).any(axis=0).sum())
        first, second = np.triu_indices(self.number_of_robots, 1)
        distance = np.linalg.norm(places[:, first] - places[:, second], axis=0)
        self._too_near += int((distance <= self.robot_diameter).sum())
        speed, turn = np.abs(self.velocities)
        fastest = (speed + 0.5 * self.base_length * turn) / self.wheel_radius  # of a robot's two wheels
        self._over_wheel_limit += bool((fastest > self.max_wheel_velocity + 1e-9).any())

    def report(self) -> Report:
        """Return what has happened until now."""
        metrics = self.lab.metrics
        return Report(
            self._steps, self._outside, self._too_near, self._over_wheel_limit,
            int(metrics["collisions.events"]), metrics["filter.total_m"],
        )  # fmt: skip

    def call_at_scripts_end(self) -> None:
        """Print the report, and what the Robotarium would refuse."""
        report = self.report()
        data(f"Robotarium: {report.steps} steps, {math.ceil(report.steps * TIME_STEP_S)} s on the testbed")
        for count, what in (
            (report.outside, "robots outside the boundaries, added up over the steps"),
            (report.too_near, f"pairs within {ROBOT_DIAMETER_M} m, added up over the steps"),
            (report.over_wheel_limit, f"steps with a wheel commanded more than {self.max_wheel_velocity:g} rad/s"),
            (report.contacts, "contacts"),
        ):
            data(f"  {count:6d} {what}")
        if self.filtered:
            data(f"  {report.filtered_m:6.2f} m of motion changed by the safety filter, all robots together")


def _laboratory(starts: Array, turn_limit_rad_s: float) -> Lab:
    x, y, width, height = BOUNDARIES
    rim_m = ROBOT_DIAMETER_M / 2.0 + MARGIN_M  # so that the filter lets a centre reach the boundary
    rate_hz = TICKS / TIME_STEP_S
    settings = {
        "world.rate_hz": rate_hz, "agent.control_rate_hz": rate_hz, "agent.state_rate_hz": rate_hz,
        "world.radius_m": ROBOT_DIAMETER_M / 2.0, "agent.safety_margin_m": MARGIN_M,
        "world.speed_limit_m_s": TOP_SPEED_M_S, "world.turn_limit_rad_s": turn_limit_rad_s,
        "world.accel_limit_m_s2": ACCEL_M_S2, "world.turn_accel_limit_rad_s2": TURN_ACCEL_RAD_S2,
    }  # fmt: skip
    bounds = (x - rim_m, y - rim_m, x + width + rim_m, y + height + rim_m)
    return Lab(starts=starts.T, bounds=bounds, settings=settings, record_period_s=TIME_STEP_S)
