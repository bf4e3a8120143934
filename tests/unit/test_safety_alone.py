"""A robot alone never leaves the arena and never comes nearer to wall or box than its margin, whatever the law wants.

The body is a unicycle that gains and loses speed and turn rate no faster than it can; between two ticks of 50 Hz its
place is looked at ten times.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm import kernels
from fullswarm.agent.neighbours.estimates import Nearby
from fullswarm.agent.safety.barrier import box_gap
from fullswarm.agent.safety.filter import (
    EXPLAIN,
    LIMITED,
    TOO_FAST,
    Measured,
    Requested,
    SafetyFilter,
    Tuning,
    robot_params,
)
from fullswarm.drivers.base import Description, Limits
from fullswarm.drivers.mavlink.settings import LIMITS as ROVER
from fullswarm.emulators.mavlink.driving import Motors

RADIUS_M, MARGIN_M, PERIOD_S, LOOKS = 0.17, 0.03, 0.02, 10
BOUNDS = np.array([0.0, 0.0, 6.0, 6.0])
THINGS = np.array([[2.0, 2.0, 0.5, 0.3, 0.7, 0.0], [4.5, 3.0, 0.4, 0.4, 0.0, 0.0], [3.0, 5.0, 0.0, 0.0, 0.0, 0.3]])
NO_NEIGHBOURS = Nearby(
    np.zeros(2, np.int64), np.zeros(1, np.int64), np.zeros((1, 2)), np.zeros((1, 6)), np.zeros(1), np.zeros(1),
    np.zeros(1),
)  # fmt: skip

CONFIDENCE = 3.0
NO_CONFIDENCE = Tuning(PERIOD_S, 3.0, 1.0, 3.0, 0.0)

PAPER = Limits(4.0, math.pi / 4, 8.0, 20.0)
CREATE = Limits(0.5, 4.25, 2.0, 20.0)
SLUGGISH = Limits(1.0, 2.0, 1.0, 5.0)


@pytest.fixture(autouse=True, scope="module")
def _compiled() -> None:
    kernels.compile_all()


def nearest(x: float, y: float) -> tuple[float, float, float]:
    """Return the gap between centre and the nearest thing or edge (m), and the direction of the nearest thing."""
    gaps = [box_gap(x, y, THINGS, row) for row in range(len(THINGS))]
    gap, towards_x, towards_y = min(gaps)
    edge = min(x - BOUNDS[0], y - BOUNDS[1], BOUNDS[2] - x, BOUNDS[3] - y)
    return min(gap, float(edge)), towards_x, towards_y


@dataclass
class Body:
    """A unicycle with ramps, behind the filter or not."""

    limits: Limits
    pose: np.ndarray
    filtered: bool = True
    sigma: tuple[float, float] = (0.0, 0.0)
    linear: bool = False
    noise: np.random.Generator = field(default_factory=lambda: np.random.default_rng(7))

    def __post_init__(self) -> None:
        limits, self.motion, self.twist = self.limits, np.zeros((1, 2)), np.zeros((1, 2))
        self.robots = robot_params(
            (Description("any", "any", RADIUS_M, limits),), np.array([limits.speed_m_s]),
            np.array([limits.turn_rad_s]), np.array([True]),
        )  # fmt: skip
        self.filter = SafetyFilter(("r",), self.robots, Tuning(PERIOD_S, 3.0, 1.0, 3.0, CONFIDENCE), BOUNDS)
        self.gain = np.array([min(2.0, limits.accel_m_s2 / limits.speed_m_s) if self.linear else 0.0])
        self.tick = 0
        self.verdicts: set[int] = set()

    def go(self, wish: tuple[float, float], twist: tuple[float, float] | None = None) -> float:
        """Go on for one period towards a velocity or with a twist; return the least gap meanwhile (m)."""
        now_s = self.tick * PERIOD_S
        planar = np.array([wish if twist is None else (math.nan, math.nan)])
        self.twist[0] = twist or (0.0, 0.0)
        requested = Requested(planar, np.array([self.filtered]), self.gain, np.array([MARGIN_M]))
        measured = Measured(self._sensed(), self.motion, np.array([now_s]), np.array([self.sigma]))
        self.filter.apply(now_s, requested, measured, NO_NEIGHBOURS, THINGS, self.twist)
        self.tick += 1
        self.verdicts.add(int(self.filter.verdict[0]))
        self._obey()
        return min(self._glide(PERIOD_S / LOOKS) for _ in range(LOOKS))

    def _sensed(self) -> np.ndarray:
        """Return the pose with an error anywhere within the bound that is counted, another one each time."""
        size, angle = CONFIDENCE * self.sigma[0] * math.sqrt(self.noise.random()), self.noise.uniform(-math.pi, math.pi)
        turn = CONFIDENCE * self.sigma[1] * self.noise.uniform(-1.0, 1.0)
        wrong: np.ndarray = self.pose + np.array([[size * math.cos(angle), size * math.sin(angle), turn]])
        return wrong

    def _obey(self) -> None:
        """Change speed and turn rate for a period as the wheels can."""
        limits = self.limits
        for axis, top, most in ((0, limits.speed_m_s, limits.accel_m_s2), (1, limits.turn_rad_s, 0.0)):
            step = (most or limits.turn_accel_rad_s2) * PERIOD_S
            change = np.clip(self.twist[0, axis], -top, top) - self.motion[0, axis]
            self.motion[0, axis] += np.clip(change, -step, step)

    def _glide(self, dt_s: float) -> float:
        speed, turn = self.motion[0].tolist()
        middle = self.pose[0, 2] + 0.5 * turn * dt_s
        self.pose[0] += dt_s * np.array([speed * math.cos(middle), speed * math.sin(middle), turn])
        return nearest(self.pose[0, 0], self.pose[0, 1])[0] - RADIUS_M


class Rover(Body):
    """A rover as recorded: its wheels answer late, and the last of a stop takes its time."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.motors = Motors()

    def _obey(self) -> None:
        self.motors.follow((self.twist[0, 0], self.twist[0, 1]), 1.0, ROVER.turn_accel_rad_s2, PERIOD_S)
        self.motion[0] = self.motors.speed_m_s, self.motors.turn_rad_s


class Delayed(Body):
    """A unicycle whose ramps follow the commands of `dead_time_s` ago; the controller before it ramps them, too."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.commands = [(0.0, 0.0)] * math.ceil(self.limits.dead_time_s / PERIOD_S - 1e-9)
        self.applied = np.zeros((1, 2))

    def go(self, wish: tuple[float, float], twist: tuple[float, float] | None = None) -> float:
        self.filter.commands.update(self.applied, self.tick * PERIOD_S)
        return super().go(wish, twist)

    def _obey(self) -> None:
        step, was, speed = self.limits.accel_m_s2 * PERIOD_S, self.applied[0, 0], self.twist[0, 0]
        if speed * was < 0.0:
            speed = np.clip(speed, -step, step)
        elif abs(speed) > abs(was):
            speed = np.clip(speed, was - step, was + step)
        self.applied[0] = speed, self.twist[0, 1]
        self.commands.append(tuple(self.applied[0]))
        self.twist[0] = self.commands.pop(0)
        super()._obey()


def attack(body: Body, rng: np.random.Generator, ticks: int) -> float:
    """Drive with random laws, half of them towards what is nearest; return the least gap to anything."""
    limits, least = body.limits, math.inf
    for _ in range(ticks // 40):
        planar, greedy = rng.random() < 0.5, rng.random() < 0.5
        angle, speed = rng.uniform(-math.pi, math.pi), 1.5 * limits.speed_m_s * rng.uniform(0.1, 1.0)
        turn, way = rng.uniform(-1.2, 1.2) * limits.turn_rad_s, rng.choice([-1.0, 1.0])
        for _ in range(rng.integers(1, 80)):
            if greedy:
                x, y, heading = body.pose[0]
                _, to_x, to_y = nearest(x, y)
                angle = math.atan2(to_y, to_x)
                turn = math.copysign(limits.turn_rad_s, way * math.sin(angle - heading))
            twist = None if planar else (way * speed, turn)
            least = min(least, body.go((speed * math.cos(angle), speed * math.sin(angle)), twist))
    return least


def start(seed: int) -> tuple[np.random.Generator, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng, np.array([[3.2, 1.0, rng.uniform(-math.pi, math.pi)]])


@pytest.mark.parametrize("linear", [False, True], ids=["braking", "linear"])
@pytest.mark.parametrize("limits", [PAPER, CREATE, SLUGGISH], ids=["paper", "create", "sluggish"])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=12, deadline=None)
def test_no_law_gets_a_lone_robot_out_or_into_its_margin(limits: Limits, linear: bool, seed: int) -> None:
    rng, pose = start(seed)
    body = Body(limits, pose, linear=linear)
    assert attack(body, rng, 800) >= MARGIN_M - 1e-5
    assert body.verdicts <= {0, LIMITED}, "what it promised could be driven at every tick"


@pytest.mark.parametrize("limits", [PAPER, CREATE, SLUGGISH], ids=["paper", "create", "sluggish"])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=12, deadline=None)
def test_nor_where_the_pose_is_wrong_by_as_much_as_is_counted(limits: Limits, seed: int) -> None:
    rng, pose = start(seed)
    assert attack(Body(limits, pose, sigma=(0.02, 0.03)), rng, 800) >= MARGIN_M - 1e-5


def test_an_error_that_is_not_counted_takes_the_margin() -> None:
    rng, pose = start(3)
    body = Body(CREATE, pose, sigma=(0.02, 0.03))
    body.filter = SafetyFilter(("r",), body.robots, NO_CONFIDENCE, BOUNDS)
    assert attack(body, rng, 2000) < MARGIN_M - 0.01


@pytest.mark.parametrize("top_m_s", [0.25, 0.5, 1.0])
def test_a_rover_that_stops_softly_keeps_its_margin_before_a_wall(top_m_s: float) -> None:
    """One that is believed to brake evenly, as its acceleration says, touches."""
    told = replace(ROVER, speed_m_s=top_m_s)
    gaps = {
        limits.overrun_m: min(body.go((0.0, -top_m_s)) for _ in range(400))
        for limits in (told, replace(told, overrun_s=0.0, overrun_m=0.0))
        for body in [Rover(limits, np.array([[3.0, 1.5, -0.5 * math.pi]]))]
    }
    assert gaps[ROVER.overrun_m] >= MARGIN_M - 1e-3  # the commands on their way to its wheels
    assert gaps[0.0] < gaps[ROVER.overrun_m]
    if top_m_s == 0.5:
        assert gaps[0.0] < 0.0


@pytest.mark.parametrize("limits", [PAPER, CREATE, SLUGGISH], ids=["paper", "create", "sluggish"])
@given(seed=st.integers(0, 2**32 - 1), dead_time_s=st.sampled_from([0.05, 0.1, 0.15]))
@settings(max_examples=12, deadline=None)
def test_no_law_gets_a_robot_with_a_stated_dead_time_into_its_margin(
    limits: Limits, seed: int, dead_time_s: float
) -> None:
    rng, pose = start(seed)
    body = Delayed(replace(limits, dead_time_s=dead_time_s), pose)
    assert attack(body, rng, 800) >= MARGIN_M - 1e-5


def test_a_dead_time_that_is_not_stated_does() -> None:
    gaps = []
    for seed in range(5):
        rng, pose = start(seed)
        body = Delayed(replace(CREATE, dead_time_s=0.15), pose)
        body.filter = Body(CREATE, pose).filter
        gaps.append(attack(body, rng, 800))
    assert min(gaps) < 0.0


@given(seed=st.integers(0, 2**32 - 1), top_m_s=st.sampled_from([0.5, 1.0]))
@settings(max_examples=12, deadline=None)
def test_no_law_gets_a_rover_to_touch(seed: int, top_m_s: float) -> None:
    rng, pose = start(seed)
    assert attack(Rover(replace(ROVER, speed_m_s=top_m_s), pose), rng, 800) > 0.0


@pytest.mark.parametrize("limits", [PAPER, CREATE], ids=["paper", "create"])
def test_without_the_filter_the_same_laws_do(limits: Limits) -> None:
    rng, pose = start(1)
    assert attack(Body(limits, pose, filtered=False), rng, 800) < 0.0


@pytest.mark.parametrize("limits", [PAPER, CREATE], ids=["paper", "create"])
def test_a_turn_towards_the_wall_at_full_speed_is_braked_in_time(limits: Limits) -> None:
    """What half-planes alone do not see: beside the wall they bind nothing, and a moment later the brakes are late."""
    body = Body(limits, np.array([[0.8, RADIUS_M + MARGIN_M + 1e-3, 0.0]]))
    body.motion[0, 0] = limits.speed_m_s
    gap = min(body.go((0.0, 0.0), (limits.speed_m_s, -limits.turn_rad_s)) for _ in range(25))
    assert gap >= MARGIN_M - 1e-5
    assert body.motion[0, 0] < 0.1 * limits.speed_m_s  # it turned in the end, and stands before the wall
    assert body.filter.deviation_m_s[0] > 0.0


def test_a_start_that_no_brake_can_save_is_braked_and_told() -> None:
    body = Body(CREATE, np.array([[3.0, RADIUS_M + MARGIN_M + 0.01, -0.5 * math.pi]]))
    body.motion[0, 0] = 0.5
    body.go((0.0, -1.0))
    assert body.twist[0].tolist() == [0.0, 0.0]
    assert body.filter.verdict[0] == TOO_FAST
    assert body.filter.note(0) == EXPLAIN[TOO_FAST]


def test_who_starts_inside_the_margin_may_leave_it_and_not_go_deeper() -> None:
    body = Body(CREATE, np.array([[3.0, RADIUS_M + 0.01, 0.5 * math.pi]]))
    assert min(body.go((0.0, -1.0)) for _ in range(50)) >= 0.01 - 1e-5
    for _ in range(100):  # it has turned to where it wanted to go, so it turns back first
        body.go((0.0, 1.0))
    assert body.pose[0, 1] > 0.5
