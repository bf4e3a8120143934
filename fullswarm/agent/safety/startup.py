"""Checks before a start whether robots sense each other early enough to stop, and says what would be enough.

The safety filter keeps robots apart that satisfy its stopping condition when they first sense each other. Whether they
can is a matter of settings alone: speed limit, brakes, sensing radius, margin, the error of poses and the age of states
(``docs/explanation-safety-filter.md``, "Before a start").
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from fullswarm.agent.pose.estimator import chosen, sensed_sigma
from fullswarm.agent.pose.pose_filter import CREEP_M
from fullswarm.bus.network_faults import parse_network
from fullswarm.config import SwarmConfig
from fullswarm.config.models import SPEED_LIMIT_M_S
from fullswarm.drivers.base import Description
from fullswarm.errors import ConfigError

VAGUEST_M = 100.0
STEP_M, STEP_M_S = 0.05, 0.01
"""What is proposed is rounded to the safe side, by so much at most."""


@dataclass(frozen=True, slots=True)
class Distances:
    """What has to fit between the centres of two robots when they first sense each other, m.

    Attributes
    ----------
    stopping_m : of one of them, its dead time and the next period included
    bodies_m, margin_m : both radii; the filter's margin
    errors_m : of both poses, at the confidence that is counted, and of the own one by its age
    overrun_m : how much farther than the accelerations say a stop goes
    states_m : what the other may have done since its state was measured
    """

    stopping_m: float
    bodies_m: float
    margin_m: float
    errors_m: float
    overrun_m: float
    states_m: float

    @property
    def needed_m(self) -> float:
        """The least sensing radius."""
        return 2.0 * self.stopping_m + self.bodies_m + self.margin_m + self.errors_m + self.overrun_m + self.states_m


def check_stopping(config: SwarmConfig, descriptions: Sequence[Description], where: str = "agent") -> None:
    """Refuse settings with which robots cannot stop in time.

    Raises
    ------
    ConfigError
        Says which distances are needed and what would be enough.
    """
    if problem := stopping_problem(config, descriptions):
        raise ConfigError(problem[0], where=f"{where}.sensing_radius_m", hint=problem[1])


def stopping_problem(config: SwarmConfig, descriptions: Sequence[Description]) -> tuple[str, str] | None:
    """Return what is wrong and what would be enough; None: robots sense each other early enough to stop."""
    sensed_m, kinds = config.agent.sensing_radius_m, tuple(dict.fromkeys(descriptions))
    if not kinds or len(config.robot) == 1:
        return None  # nothing else that moves counts on this robot
    worst = max(kinds, key=lambda each: distances(config, each, kinds).needed_m)
    found = distances(config, worst, kinds)
    if found.needed_m <= sensed_m:
        return None
    speed_m_s, limits = top_speed_m_s(config, worst), worst.limits
    parts = (
        (2.0 * found.stopping_m, f"to stop, each {found.stopping_m:.2f} m at {limits.accel_m_s2:g} m/s²"),
        (found.bodies_m, "radii of both"),
        (found.margin_m, "safety margin"),
        (found.errors_m, "errors of both poses"),
        (found.overrun_m, "overrun of the make"),
        (found.states_m, f"age of states, {state_age_s(config):.2f} s"),
    )
    words = "; ".join(f"{size_m:.2f} m: {what}" for size_m, what in parts if size_m >= 0.005)
    what = (
        f"robots cannot stop in time: two at {speed_m_s:g} m/s need {found.needed_m:.2f} m between their centres "
        f"when they first sense each other ({words}), and the sensing radius is {sensed_m:g} m"
    )
    return what, _remedy(config, kinds, found.needed_m)


def summary(config: SwarmConfig, descriptions: Sequence[Description]) -> str:
    """Return in words what robots need, and what they have."""
    if not descriptions or len(config.robot) == 1:
        return "one robot alone: no other one to stop for"
    needed_m = max(distances(config, each, descriptions).needed_m for each in dict.fromkeys(descriptions))
    return f"robots need {needed_m:.2f} m to stop for each other, and sense {config.agent.sensing_radius_m:g} m"


def vaguest_fix_m(config: SwarmConfig, descriptions: Sequence[Description]) -> float:
    """Return the greatest sigma of fixes with which robots can still stop for each other, m.

    A fleet file does not say how exact the fixes will be: each states it itself.
    """
    kinds = tuple(dict.fromkeys(descriptions))
    if len(config.robot) == 1 or all(each.senses_pose for each in kinds):
        return VAGUEST_M
    low_m, high_m = 0.0, VAGUEST_M
    for _ in range(40):
        middle_m = 0.5 * (low_m + high_m)
        needed_m = max(distances(config, each, kinds, fix_sigma_m=middle_m).needed_m for each in kinds)
        low_m, high_m = (middle_m, high_m) if needed_m <= config.agent.sensing_radius_m else (low_m, middle_m)
    return low_m


def _remedy(config: SwarmConfig, kinds: Sequence[Description], needed_m: float) -> str:
    """Return what would be enough: another sensing radius, or another speed limit where there is one."""
    enough_m = STEP_M * math.ceil(needed_m / STEP_M - 1e-9)
    hint = f"sensing_radius_m = {enough_m:g}"
    low, high = 0.0, max(top_speed_m_s(config, each) for each in kinds)
    for _ in range(40):
        middle = 0.5 * (low + high)
        fits = all(distances(config, each, kinds, middle).needed_m <= config.agent.sensing_radius_m for each in kinds)
        low, high = (middle, high) if fits else (low, middle)
    slow_m_s = STEP_M_S * math.floor(low / STEP_M_S)
    return f"{hint} or more, or speed_limit_m_s = {slow_m_s:g} or less" if slow_m_s >= SPEED_LIMIT_M_S[0] else hint


def top_speed_m_s(config: SwarmConfig, description: Description) -> float:
    """Return the speed limit in force of a robot."""
    return min(description.limits.speed_m_s, config.agent.speed_limit_m_s or math.inf)


def state_age_s(config: SwarmConfig) -> float:
    """Return how old a neighbour's state is when the next one arrives: both periods and the network's delay."""
    delay_s = config.agent.state_delay_s
    if config.network.conditions is not None:
        network = parse_network(config.network.conditions, where="")
        delay_s = max(delay_s, network.delay_s + network.jitter_s)
    return 1.0 / config.agent.state_rate_hz + 1.0 / config.agent.control_rate_hz + delay_s


def expected_sigma_m(config: SwarmConfig, description: Description, fix_sigma_m: float = 0.0) -> float:
    """Return the standard deviation of a robot's position that its estimator will reach, m.

    A filter that weighs noise R against odometry whose variance grows by q per period reaches sqrt(q R). `fix_sigma_m`
    is that of fixes, for a robot whose driver senses no pose.
    """
    sigma_m = sensed_sigma(config, description)[0]
    if not description.senses_pose:
        sigma_m = max(fix_sigma_m, config.world_or_default.noise.position_m)
    if sigma_m <= 0.0 or chosen(config, description) == "direct":
        return sigma_m
    settings = config.agent
    speed_m_s = top_speed_m_s(config, description)
    growth_m2 = (settings.odometry_sigma_m**2 * speed_m_s + CREEP_M**2) / settings.control_rate_hz
    return min(sigma_m, math.sqrt(math.sqrt(growth_m2) * sigma_m))


def distances(
    config: SwarmConfig, description: Description, others: Sequence[Description], speed_m_s: float = math.inf,
    fix_sigma_m: float = 0.0,
) -> Distances:  # fmt: skip
    """Return what robots of one kind need when they meet the worst of the others, none faster than `speed_m_s`."""
    settings, limits = config.agent, description.limits
    period_s, age_s = 1.0 / settings.control_rate_hz, state_age_s(config)
    top_m_s = min(speed_m_s, top_speed_m_s(config, description))
    own_sigma_m = expected_sigma_m(config, description, fix_sigma_m)
    sigma_m = max(expected_sigma_m(config, each, fix_sigma_m) for each in others)
    # The worst of the others has gained speed since its last state and is at its limit now. One that has turned instead
    # comes nearer more slowly than it was predicted to.
    states_m = max(
        min(0.5 * each.limits.accel_m_s2 * age_s * age_s, min(speed_m_s, top_speed_m_s(config, each)) * age_s)
        for each in others
    )
    return Distances(
        stopping_m=top_m_s * (period_s + limits.dead_time_s) + top_m_s * top_m_s / (2.0 * limits.accel_m_s2),
        bodies_m=description.radius_m + max(each.radius_m for each in others),
        margin_m=settings.safety_margin_m,
        errors_m=settings.pose_confidence_sigma * math.hypot(own_sigma_m, sigma_m) + top_m_s * period_s,
        overrun_m=min(limits.overrun_s * top_m_s, limits.overrun_m),
        states_m=states_m,
    )
