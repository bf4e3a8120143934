from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from fullswarm import kernels
from fullswarm.agent.motion.robot_controller import StopReason
from fullswarm.agent.neighbours.estimates import Nearby
from fullswarm.agent.safety.barrier import Arena
from fullswarm.agent.safety.filter import BLIND, EXPLAIN
from fullswarm.agent.telemetry.interventions import EDGE, LEAST_M_S, NOTHING, OBSTACLE, PERIOD_S, ROBOT, Blamed, blame
from fullswarm.config import WorldConfig
from fullswarm.messages import Interventions
from tests.unit.agent_bench import Bench
from tests.unit.test_safety_silence import go, one_filter, state, table

EAST = {"direction": [1.0, 0.0], "magnitude": 1.0, "speed_m_s": 0.5}


class Watched(Bench):
    """A bench that hears what the filter changes."""

    def __post_init__(self) -> None:
        self.heard: list[Interventions] = []
        super().__post_init__()
        self.bus.subscribe(self.keys.intervention(), Interventions, self.heard.append)

    @property
    def newest(self) -> Interventions:
        return self.heard[-1]


def bench(*poses: tuple[float, float, float], **world: object) -> Watched:
    return Watched(list(poses), world={"bounds_m": (0.0, 0.0, 10.0, 10.0), **world})


def test_a_robot_in_the_way_is_named_with_its_distance() -> None:
    made = bench((4.0, 5.0, 0.0), (4.8, 5.0, 0.0))
    made.enable("move", EAST, "r1", filtered=True)
    made.run(1.5)
    message = made.newest
    assert (message.host, message.robots) == ("bench", ("r1",))
    gap_m = float(np.hypot(*(made.agent.pose[1, :2] - made.agent.pose[0, :2]))) - 2 * 0.17
    assert message.reasons == (f"r2 at {gap_m:.2f} m",)
    assert message.x_m_s[0] < -LEAST_M_S, "the vector leads away from it"
    assert abs(message.y_m_s[0]) < 0.1 * abs(message.x_m_s[0])


def test_an_obstacle_and_the_edge_are_named(subtests: pytest.Subtests) -> None:
    for word, made in (
        ("obstacle", bench((4.0, 5.0, 0.0), boxes=((5.0, 5.0, 0.4, 2.0, 0.0),))),
        ("edge of the arena", bench((9.3, 5.0, 0.0))),
    ):
        with subtests.test(word):
            made.enable("move", EAST, filtered=True)
            made.run(1.5)
            assert made.newest.reasons[0].startswith(f"{word} at 0.")
            assert made.newest.x_m_s[0] < -LEAST_M_S


def test_it_speaks_five_times_a_second_and_once_more_at_the_end() -> None:
    made = bench((4.0, 5.0, 0.0), (4.8, 5.0, 0.0))
    made.enable("move", EAST, "r1", filtered=True, expires_s=60.0)  # a stick's, which is not turned aside
    made.run(1.0)
    before = len(made.heard)
    made.run(2.0)
    assert len(made.heard) - before == round(2.0 / PERIOD_S)
    made.stop("s")
    made.run(1.0)
    last = made.newest
    assert (last.robots, last.x_m_s, last.y_m_s, last.reasons) == ((), (), (), ())
    assert [bool(each.robots) for each in made.heard].count(False) == 1


def test_in_the_open_and_without_the_filter_it_says_nothing() -> None:
    free = bench((4.0, 5.0, 0.0))
    free.enable("move", EAST, filtered=True)
    free.run(1.0)
    bare = bench((4.0, 5.0, 0.0), (4.8, 5.0, 0.0))
    bare.enable("move", EAST, "r1")
    bare.run(1.0)
    assert free.heard == bare.heard == []


def test_a_robot_that_stands_anyway_is_not_held_by_the_filter() -> None:
    made = bench((4.0, 5.0, 0.0), (4.8, 5.0, 0.0))
    made.enable("move", EAST, "r1", filtered=True)
    made.run(1.0)
    assert len(made.newest.robots) == 1
    made.agent.controller.reason[0] = StopReason.BATTERY
    made.agent.interventions.publish()
    made.runtime.mailbox.drain()
    assert len(made.newest.robots) == 0


def test_a_stick_is_held_back_along_the_heading() -> None:
    others, made = table(), one_filter()
    others.receive(state(0.27, 0.27), 0.0)
    half_right = math.pi / 4
    assert go(others, 0.0, (math.nan, math.nan), (0.0, 0.0, half_right), made=made) < 0.1
    assert made.deviation_m_s[0] > 0.01
    assert made.change_m_s[0] == pytest.approx([-math.sqrt(0.5) * made.deviation_m_s[0]] * 2)


def test_the_vector_is_what_was_let_through_minus_what_was_wished() -> None:
    made = bench((4.0, 5.0, 0.0), (4.8, 5.0, 0.0))
    made.enable("move", EAST, "r1", filtered=True)
    made.run(1.5)
    used = made.agent.filter
    size = np.hypot(*used.change_m_s[0])
    assert size == pytest.approx(used.deviation_m_s[0], rel=1e-9)
    # In front of the other, which holds half of the gap, it may go on for 0.1 s and then stop within its half.
    gap_m = float(np.hypot(*(made.agent.pose[1, :2] - made.agent.pose[0, :2]))) - 2 * 0.17 - 0.03
    allowed = 0.5 + used.change_m_s[0, 0]
    way_m = 0.1 * allowed + 0.5 * allowed**2 / WorldConfig().accel_limit_m_s2
    assert way_m == pytest.approx(0.5 * gap_m, abs=0.01)


def test_a_brake_without_a_thing_is_told_in_words() -> None:
    made = bench((4.0, 5.0, 0.0))
    made.enable("move", EAST, filtered=True)
    made.run(0.5)
    made.agent.filter.verdict[0], made.agent.filter.deviation_m_s[0] = BLIND, 0.5
    made.agent.interventions.publish()
    made.runtime.mailbox.drain()
    assert made.newest.reasons == (EXPLAIN[BLIND],)


NO_BOXES = np.zeros((0, 6))
ARENA = np.array([0.0, 0.0, 10.0, 10.0])


def blamed(
    change: tuple[float, float], others: list[tuple[float, float]], boxes: np.ndarray = NO_BOXES, at: float = 5.0,
    run: Callable[..., None] = blame,
) -> tuple[int, int, object]:  # fmt: skip
    places = np.array(others, float).reshape(-1, 2)
    heard = np.full((len(places), 6), 0.1)
    kind, which, gap = np.zeros(1, np.int64), np.zeros(1, np.int64), np.zeros(1)
    zeros = np.zeros(len(places))
    near = Nearby(np.array([0, len(places)]), np.arange(len(places)), places, heard, zeros, zeros, zeros)
    run(
        np.zeros(1, np.int64), np.array([change]), np.array([[at, 5.0, 0.0]]), np.array([0.1]), near,
        Arena(boxes, ARENA), 3.0, Blamed(kind, which, gap),
    )  # fmt: skip
    return int(kind[0]), int(which[0]), float(gap[0])


def test_what_lies_opposite_to_the_change_is_blamed_before_what_is_a_little_nearer() -> None:
    others = [(5.0, 5.5), (5.6, 5.0), (math.nan, math.nan), (5.0, 5.0)]
    assert blamed((-0.3, 0.0), others) == (ROBOT, 1, pytest.approx(0.4))
    assert blamed((0.0, -0.3), others) == (ROBOT, 0, pytest.approx(0.3))
    assert blamed((0.3, 0.0), [(8.0, 5.0)])[0] == ROBOT, "better than nothing"
    assert blamed((0.0, 0.3), [])[0] == NOTHING


def test_the_edge_counts_like_a_thing() -> None:
    assert blamed((-0.3, 0.0), [(8.5, 5.0)], at=9.5) == (EDGE, -1, pytest.approx(0.4))
    box = np.array([[9.9, 5.0, 0.1, 1.0, 0.0, 0.0]])
    assert blamed((-0.3, 0.0), [], box, at=9.5) == (OBSTACLE, -1, pytest.approx(0.2))


def test_compiled_and_plain_blame_the_same() -> None:
    kernels.compile_all()
    rng = np.random.default_rng(1)
    for _ in range(20):
        change = (float(rng.normal()), float(rng.normal()))
        others = [(float(x), float(y)) for x, y in rng.uniform(3.0, 7.0, (6, 2))]
        box = np.array([[*rng.uniform(3.0, 7.0, 2), 0.3, 0.2, 0.5, 0.0]])
        kind, which, gap = blamed(change, others, box, run=blame.plain)
        assert blamed(change, others, box) == (kind, which, pytest.approx(gap))
