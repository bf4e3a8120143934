"""The published check of laws on the examples."""

from __future__ import annotations

from typing import Any

import pytest
from fullswarm.testing import check_behaviour

PARAMETERS: dict[str, dict[str, Any]] = {
    "follow_the_leader": {"leader_goal": [3.0, 4.0], "gap_m": 0.8, "speed_m_s": 0.3, "gain": 1.0},
    "pursue_next": {"radius_m": 2.0, "speed_m_s": 0.3, "gain": 0.5},
    "average": {"gain": 0.5, "wait_s": 0.0},
    "auction": {"tasks": [[1.0, 1.0], [5.0, 5.0], [8.0, 2.0]], "gain": 0.5},
    "waypoints": {"waypoints": [[1.0, 1.0], [5.0, 5.0]], "reach_m": 0.1, "kp": 0.8, "ki": 0.05, "kd": 0.1},
    "forage": {
        "food": [[2.0, 2.0], [8.0, 8.0]], "nest": [5.0, 5.0], "loads": 3.0, "sight_m": 1.5, "reach_m": 0.6,
        "speed_m_s": 0.4,
    },
}  # fmt: skip


@pytest.mark.parametrize("name", PARAMETERS)
def test_the_law_keeps_the_rules(name: str) -> None:
    check_behaviour(name, PARAMETERS[name], seeds=range(5))


def test_the_law_of_a_mixed_swarm_keeps_the_rules() -> None:
    check_behaviour(
        "convoy", {"goal": [5.0, 5.0], "speed_m_s": 0.2, "ring_m": 1.2, "reach_m": 1.0}, seeds=range(5),
        roles=("carrier", "scout"), capabilities=("carry", "gripper"),
    )  # fmt: skip
