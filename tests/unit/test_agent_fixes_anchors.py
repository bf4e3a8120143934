"""Distances to radio anchors: positions from them, and poses that they correct."""

from __future__ import annotations

import math
import random
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.agent.pose.anchors import located
from fullswarm.agent.pose.pose_filter import Distance
from fullswarm.messages import RangeFix
from tests.unit import fix_lab
from tests.unit.fix_lab import KEYS, START, TIMEOUT_S, Lab

lab = fix_lab.lab

ROOM = ((0.0, 0.0, 2.2), (8.0, 0.0, 2.4), (8.0, 6.0, 2.1), (0.0, 6.0, 2.3))


def measured(x: float, y: float, noise_m: float = 0.0, seed: int = 0) -> list[Distance]:
    noise = random.Random(seed)
    return [
        Distance(0.0, ax, ay, up, math.sqrt((x - ax) ** 2 + (y - ay) ** 2 + up * up) + noise.gauss(0.0, noise_m), 0.1)
        for ax, ay, up in ROOM
    ]


places = st.tuples(st.floats(0.3, 7.7), st.floats(0.3, 5.7))


@given(places)
def test_exact_distances_give_the_exact_position(place: tuple[float, float]) -> None:
    found = located(measured(*place))
    assert found is not None
    assert (found.x_m, found.y_m) == pytest.approx(place, abs=1e-3)


def searched(distances: list[Distance]) -> tuple[float, float]:
    """The best place of a fine grid: it shares nothing with the solver."""
    x, y = np.meshgrid(np.linspace(-1.0, 9.0, 1001), np.linspace(-1.0, 7.0, 801))
    cost = sum(
        (np.sqrt((x - each.x_m) ** 2 + (y - each.y_m) ** 2 + each.up_m**2) - each.distance_m) ** 2 for each in distances
    )
    best = np.unravel_index(np.argmin(cost), x.shape)
    return float(x[best]), float(y[best])


@pytest.mark.parametrize("seed", range(6))
def test_noisy_distances_give_the_place_that_a_search_finds(seed: int) -> None:
    noise = random.Random(100 + seed)
    distances = measured(noise.uniform(1.0, 7.0), noise.uniform(1.0, 5.0), 0.1, seed)
    found = located(distances)
    assert found is not None
    assert (found.x_m, found.y_m) == pytest.approx(searched(distances), abs=0.02)


def test_its_covariance_is_how_positions_scatter() -> None:
    found = [each for seed in range(400) if (each := located(measured(2.0, 5.0, 0.1, seed))) is not None]
    assert len(found) > 390
    scatter = np.cov(np.array([(each.x_m, each.y_m) for each in found]).T)
    xx, xy, yy = np.mean([each.covariance_m2 for each in found], axis=0)
    assert np.array([[xx, xy], [xy, yy]]) == pytest.approx(scatter, rel=0.25, abs=8e-4)


def test_what_gives_no_position() -> None:
    four = measured(3.0, 3.0)
    assert located(four[:2]) is None
    line = [Distance(0.0, x, 0.0, 2.0, math.sqrt((3.0 - x) ** 2 + 9.0 + 4.0), 0.1) for x in (0.0, 2.0, 5.0)]
    assert located(line) is None, "the mirrored place fits as well"
    reflected = [*four[:3], Distance(0.0, *ROOM[3], four[3].distance_m + 2.0, 0.1)]
    assert located(reflected) is None


@given(
    st.lists(st.builds(Distance, *[st.floats(-1e6, 1e6)] * 4, st.floats(0.0, 1e6), st.floats(1e-3, 100.0)), max_size=6)
)
def test_any_distances_give_a_finite_position_or_none(distances: list[Distance]) -> None:
    found = located(distances)
    assert found is None or math.isfinite(found.x_m + found.y_m + found.sigma_m)


# ---------------------------------------------------------------- through the agent
def measure(lab: Lab, anchors: int, rng: random.Random, wrong_m: float = 0.0, **more: Any) -> None:
    x, y, _ = lab.truth()
    for number, (ax, ay, up) in enumerate(ROOM[:anchors]):
        away = math.sqrt((x - ax) ** 2 + (y - ay) ** 2 + up * up) + rng.gauss(0.0, 0.05) + wrong_m
        fix = RangeFix(
            robot="r1", anchor=f"a{number}", x_m=ax, y_m=ay, up_m=up, distance_m=away, sigma_m=0.05, source="uwb",
            stamp_s=50.0 + lab.runtime.now_s(), sensor="uwb hall", **more,
        )  # fmt: skip
        lab.bus.publish(KEYS.range_fix("r1"), fix)


def walk(lab: Lab, seconds: float, anchors: int = 4, **more: Any) -> float:
    """Measure ten times per second; return the mean distance from the true place in the last second."""
    rng, away = random.Random(7), list[float]()
    for step in range(round(seconds / 0.1)):
        measure(lab, anchors, rng, **more)
        lab.run(0.1)
        if step >= seconds / 0.1 - 10:
            away.append(math.dist(lab.pose[:2], lab.truth()[:2]))
    return sum(away) / len(away)


def test_distances_find_a_robot_that_was_put_elsewhere_and_its_heading_when_it_drives() -> None:
    lab = Lab(estimator="ekf")
    try:
        lab.origin = (5.0, 4.0, -2.0)  # not where the fleet file says
        walk(lab, 3.0)
        assert math.dist(lab.pose[:2], lab.truth()[:2]) < 0.15
        health = lab.now()
        assert health.pose_source == "fixes"
        assert [(each.sensor, each.used) for each in health.pose_sources] == [("uwb hall", True)]
        lab.drive(0.3, 0.2)
        assert walk(lab, 20.0) < 0.12
        assert abs(math.remainder(lab.pose[2] - lab.truth()[2], math.tau)) < 0.35
    finally:
        lab.agent.close()


def test_two_anchors_keep_a_known_pose(lab: Lab) -> None:
    walk(lab, 1.0)
    lab.drive(0.2, 0.3)
    assert walk(lab, 15.0, anchors=2) < 0.2


def test_distances_that_do_not_fit_are_refused_and_their_absence_is_said(lab: Lab) -> None:
    walk(lab, 1.0)
    before = lab.pose
    measure(lab, 1, random.Random(1), wrong_m=3.0)
    lab.run(0.05)
    assert lab.pose == pytest.approx(before, abs=1e-6)
    lab.run(TIMEOUT_S + 0.2)
    assert lab.now().pose_note.startswith("its fixes have stopped")
    assert START
