"""Rovers whose maps begin where each was switched on: they swap places behind real ports, judged on the true bodies."""

from __future__ import annotations

import math
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fullswarm.config import SwarmConfig
from fullswarm.evaluate.live_swarm import LiveSwarm
from fullswarm.launch.network import on_free_ports

RING_M, ARRIVED_M = 2.5, 0.3
LIMIT_S = 120.0  # 13 s on an idle machine; what is judged is whether they touch, not when they arrive
CENTRE_M = 6.0
MARGIN_M = 0.15
"""Fixes come 20 times a second, and states of the other through two processes, on a machine that has other work."""


def fleet(robots: int, seed: int) -> tuple[SwarmConfig, list[list[float]]]:
    """Return rovers on a ring, and goals: each one's is where the next one stands."""
    dice = random.Random(seed)
    turn = dice.uniform(0.0, 2.0 * math.pi)
    angles = [turn + 2.0 * math.pi * row / robots for row in range(robots)]
    places = [[CENTRE_M + RING_M * math.cos(each), CENTRE_M + RING_M * math.sin(each)] for each in angles]
    config = SwarmConfig.model_validate(
        {
            "swarm": f"frames{seed}",
            "world": {"engine": "kinematic", "bounds_m": (0, 0, 12, 12), "origin": (52.5163, 13.3777)},
            "agent": {"safety_margin_m": MARGIN_M, "speed_limit_m_s": 0.5},
            "robot": [
                {"id": f"r{row}", "emulate": "rover", "pose": (*place, dice.uniform(-math.pi, math.pi))}
                for row, place in enumerate(places)
            ],
        }
    )
    return on_free_ports(config, prefer_configured=False), places[1:] + places[:1]


def swap(robots: int, seed: int) -> tuple[float, int, float]:
    """Return the smallest distance between centres, the most contacts at once, and the largest error at the end."""
    config, goals = fleet(robots, seed)
    nearest, touched = math.inf, 0
    with LiveSwarm(config) as swarm:
        swarm.start()
        world = swarm.bodies
        for robot, goal in zip(config.robots, goals, strict=True):
            swarm.operator.request("move_to_goal_bc", parameters={"goal": [*goal]}, robots=(robot,))

        def look() -> bool:
            nonlocal nearest, touched
            places = world.pose[:, :2]
            apart = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1)) + 99.0 * np.eye(robots)
            nearest, touched = min(nearest, float(apart.min())), max(touched, int(world.contacts.sum()))
            return touched > 0 or bool((np.hypot(*(places - np.array(goals)).T) < ARRIVED_M).all())

        swarm.serve(look, LIMIT_S)
        error_m = float(np.hypot(*(world.pose[:, :2] - np.array(goals)).T).max())
    return nearest, touched, error_m


SEEDS = [
    pytest.param(robots, seed, marks=[pytest.mark.slow] if seed else []) for robots in (2, 3) for seed in range(10)
]


@pytest.mark.parametrize(("robots", "seed"), SEEDS)
def test_rovers_with_origins_of_their_own_swap_places(robots: int, seed: int) -> None:
    nearest_m, touched, error_m = swap(robots, seed)
    assert touched == 0
    assert nearest_m > 2.0 * 0.17
    assert error_m < ARRIVED_M  # in the true frame, too


def test_the_same_fleet_without_an_origin_is_refused_with_what_to_write(tmp_path: Path) -> None:
    file = tmp_path / "rovers.toml"
    robots = "".join(
        f'[[robot]]\nid = "r{row}"\ndriver = "mavlink+udp://127.0.0.1:{14950 + row}?sysid={row}"\n' for row in (1, 2)
    )
    file.write_text(robots, encoding="utf-8")
    for command in (("up", str(file)), ("agent", "r1", "--fleet", str(file))):
        done = subprocess.run(
            [sys.executable, "-m", "fullswarm", *command], capture_output=True, text=True, timeout=60, check=False
        )
        assert done.returncode == 2, done.stderr
        assert "r1" in done.stderr
        assert "[world] origin = [latitude, longitude]" in done.stderr
