"""What commands under way will still do, against a simulation of the body that carries them out."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.agent.safety.barrier import MAX_ROWS, HalfPlanes, shorten
from fullswarm.agent.safety.dead_time import Commands

PERIOD_S, ACCEL, TURN_ACCEL = 0.02, 2.0, 20.0


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.04, 0.1, 0.15]), st.booleans())
@settings(max_examples=60, deadline=None)
def test_the_way_under_way_is_the_one_that_the_body_takes(seed: int, dead_time_s: float, between: bool) -> None:
    """Set-points rise by the acceleration at most and may fall at once; some come between two ticks."""
    rng, fine = np.random.default_rng(seed), 0.001
    commands = Commands(np.array([dead_time_s]), np.array([ACCEL]), np.array([TURN_ACCEL]), PERIOD_S)
    history: list[tuple[float, float, float]] = []  # issued at, speed, turn rate
    applied, now_s = np.zeros((1, 2)), 0.0
    goal = rng.uniform(-0.5, 0.5), rng.uniform(-4.0, 4.0)
    for _ in range(60):
        commands.update(applied, now_s)
        step_s = PERIOD_S if not between or rng.random() < 0.7 else rng.choice([0.002, 0.007, 0.013])
        if rng.random() < 0.1:
            goal = rng.uniform(-0.5, 0.5), rng.uniform(-4.0, 4.0)
        if rng.random() < 0.05:
            applied[0] = 0.0
        else:
            for axis, most in ((0, ACCEL * step_s), (1, TURN_ACCEL * step_s)):
                applied[0, axis] += np.clip(goal[axis] - applied[0, axis], -most, most)
        history.append((now_s, *applied[0].tolist()))
        now_s += step_s
    commands.update(applied, now_s)
    # The body: its ramp follows the set-point of a dead time ago. From `now_s` until the next command acts.
    speed = turn = x = y = heading = way = 0.0
    for tick in range(round((now_s + dead_time_s) / fine)):
        time_s = tick * fine
        due = [each for each in history if each[0] <= time_s - dead_time_s + 1e-9]
        wanted = due[-1][1:] if due else (0.0, 0.0)
        speed += float(np.clip(wanted[0] - speed, -ACCEL * fine, ACCEL * fine))
        turn += float(np.clip(wanted[1] - turn, -TURN_ACCEL * fine, TURN_ACCEL * fine))
        if time_s >= now_s - 1e-9:
            x += speed * fine * math.cos(heading)
            y += speed * fine * math.sin(heading)
            heading += turn * fine
            way += abs(speed) * fine
    found = commands.underway
    assert found.way[0] >= way - 2e-3
    if not between:  # a rise is counted from its beginning
        assert found.way[0] <= way + 0.5 * PERIOD_S + ACCEL * PERIOD_S * dead_time_s + 5e-3
    assert abs(found.speed[0]) >= abs(speed) - ACCEL * PERIOD_S - 1e-9
    assert abs(found.turned[0] - heading) <= found.unsure[0] + TURN_ACCEL * PERIOD_S * (dead_time_s + PERIOD_S)
    if not between:
        assert found.unsure[0] <= 4.0 * PERIOD_S


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=100, deadline=None)
def test_rooms_lose_at_least_what_the_path_uses_up(seed: int) -> None:
    """For any path: what it takes of each room on its way is no more than what the filter takes off."""
    rng = np.random.default_rng(seed)
    speeds = rng.uniform(0.0, 1.0, 12) * rng.choice([1.0, -1.0])
    if rng.random() < 0.3:
        speeds[6:] *= -1.0
    turns = rng.uniform(-1.0, 1.0, 12) * rng.choice([0.05, 0.3, 2.0])
    headings = np.cumsum(turns) - 0.5 * turns
    path = np.cumsum(speeds[:, None] * np.column_stack((np.cos(headings), np.sin(headings))), axis=0)
    angles = rng.uniform(-math.pi, math.pi, 5)
    normals = np.column_stack((np.cos(angles), np.sin(angles)))
    planes = HalfPlanes(*np.zeros((len(HalfPlanes._fields), MAX_ROWS)))
    planes.normal_x[:5], planes.normal_y[:5] = normals.T
    planes.room[:5] = 20.0
    way, swing = float(np.abs(speeds).sum()), float(np.abs(turns).sum())
    shorten(
        planes, 5, path[-1, 0], path[-1, 1], way, swing, bool(speeds.min() < 0.0 < speeds.max()), 0.1, 2.0, 1.0, 0.1
    )
    used = np.maximum(0.0, (path @ normals.T).max(axis=0))
    assert (20.0 - planes.room[:5] >= used - 1e-9).all()
    assert (20.0 - planes.room[:5] <= way + 1e-9).all()
    assert planes.blur[:5].tolist() == [0.1] * 5
    assert planes.limit[:5] == pytest.approx(2.0 * planes.room[:5])


def test_robots_without_a_dead_time_have_nothing_under_way() -> None:
    commands = Commands(np.zeros(2), np.full(2, ACCEL), np.full(2, TURN_ACCEL), PERIOD_S)
    assert not commands.any
    for tick in range(10):
        commands.update(np.full((2, 2), 0.3), tick * PERIOD_S)
    assert commands.underway.way.tolist() == [0.0, 0.0]
