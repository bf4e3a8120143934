"""A control loop that hangs: the robot drives on meanwhile, and yet touches nothing once that has happened before."""

from __future__ import annotations

import math
import random
from collections.abc import Callable

import numpy as np
import pytest

from fullswarm.agent.node import AgentNode
from fullswarm.agent.safety.stalls import FADES_S, LONGEST_S, Stalls
from tests.unit.agent_bench import TICK_S, Bench

RADIUS_M, HANG_S = 0.17, 0.3
BOX = (8.0, 5.0, 0.4, 0.4)
"""Centre x, y, half width, half height, m."""


def hanging(monkeypatch: pytest.MonkeyPatch, hangs: Callable[[float], bool]) -> None:
    """Have agents skip all ticks at the times for which `hangs` is true."""
    tick = AgentNode.tick

    def late(agent: AgentNode) -> None:
        if not hangs(agent._scheduler.now_s()):
            tick(agent)

    monkeypatch.setattr(AgentNode, "tick", late)


def drive(seed: int) -> tuple[float, float]:
    """Drive at a box and past another robot; return the least gap to both and the way driven, in m."""
    x_m, y_m, half_x_m, half_y_m = BOX
    bench = Bench(
        [(5.0, 5.0, 0.0), (5.0, 6.5, -1.5)],
        world={"bounds_m": [0, 0, 16, 10], "boxes": [[x_m, y_m, 2 * half_x_m, 2 * half_y_m, 0.0]]},
    )
    chance = random.Random(seed)
    least_m, way_m, before = np.inf, 0.0, bench.simulated.pose[:, :2].copy()
    for step in range(20 * 50):
        if step % 150 == 0:
            for robot in ("r1", "r2"):
                goal = [x_m + chance.uniform(-1.0, 1.0), y_m + chance.uniform(-1.0, 1.0)]
                bench.enable(
                    "move_to_goal",
                    {"goal": goal, "gain": 1.0, "arrive_radius_m": 0.05},
                    robot,
                    request_id=f"{robot} {step}",
                    filtered=True,
                )
        bench.run(TICK_S)
        place = bench.simulated.pose[:, :2]
        beside = np.maximum(np.abs(place - (x_m, y_m)) - (half_x_m, half_y_m), 0.0)
        gaps = [*(np.hypot(*beside.T) - RADIUS_M), np.hypot(*(place[0] - place[1])) - 2.0 * RADIUS_M]
        least_m, way_m = min(least_m, *gaps), way_m + float(np.hypot(*(place - before).T).sum())
        before = place.copy()
    return float(least_m), way_m


def hang_now_and_then(seed: int) -> Callable[[float], bool]:
    """Return a loop that hangs for `HANG_S` in each second, at first while the robot still stands."""
    chance = random.Random(seed)
    begins_s = [0.2, *(second + chance.uniform(0.0, 1.0 - HANG_S) for second in range(1, 30))]
    return lambda now_s: any(0.0 <= now_s - begin_s < HANG_S for begin_s in begins_s)


@pytest.mark.parametrize("seed", range(6))
def test_a_robot_whose_loop_hangs_now_and_then_touches_nothing(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    hanging(monkeypatch, hang_now_and_then(seed))
    least_m, way_m = drive(seed)
    assert least_m > 0.02
    assert way_m > 5.0


def test_without_room_for_it_some_would_touch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Stalls, "note", lambda _self, _gap_s: 0.0)
    found = []
    for seed in range(6):
        with monkeypatch.context() as patch:
            hanging(patch, hang_now_and_then(seed))
            found.append(drive(seed)[0])
    assert min(found) < 0.001


def test_what_was_long_ago_and_what_is_short_does_not_count() -> None:
    stalls = Stalls(0.02)
    assert [stalls.note(gap_s) for gap_s in (0.02, 0.035, 0.02)] == [0.0, 0.0, 0.0]
    assert stalls.note(0.22) == pytest.approx(0.2)
    assert stalls.note(0.02) == pytest.approx(0.2, abs=1e-3)
    assert stalls.note(0.12) == pytest.approx(0.2, abs=3e-3)
    assert stalls.note(60.0) == LONGEST_S
    for _ in range(round(FADES_S / 0.02)):
        left_s = stalls.note(0.02)
    assert left_s == pytest.approx(LONGEST_S / math.e, rel=0.01)
    for _ in range(round(5 * FADES_S / 0.02)):
        left_s = stalls.note(0.02)
    assert left_s == 0.0
