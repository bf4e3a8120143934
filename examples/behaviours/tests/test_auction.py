"""Each task finds one robot, and the sum of the ways is not far from the least one."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from swarm import Swarm

STARTS = [(3.0, 3.0, 0.0), (3.0, 6.0, 1.0), (6.0, 3.0, 2.0), (9.0, 6.0, 3.0), (12.0, 4.0, -2.0)]
TASKS = [[4.0, 10.0], [8.0, 9.0], [12.0, 9.0], [3.5, 7.5], [7.0, 6.0]]


@pytest.mark.parametrize("network", [None, "loss=30%,delay=50ms±40"])
def test_each_task_is_done_by_one_robot(network: str | None) -> None:
    swarm = Swarm(STARTS, network, sensing_radius_m=6.5)  # not all robots receive each other
    try:
        swarm.request("auction_bc", {"tasks": TASKS}, run_s=30.0)
        places, taken = swarm.lockstep.world.pose[:, :2], [int(each["task"][0]) for each in swarm.memory()]
    finally:
        swarm.lockstep.close()
    assert sorted(taken) == list(range(len(TASKS)))
    assert np.abs(places - np.array(TASKS)[taken]).max() < 0.15
    ways = np.linalg.norm(np.array(STARTS)[:, None, :2] - np.array(TASKS), axis=2)
    least = min(ways[range(5), list(order)].sum() for order in itertools.permutations(range(5)))
    assert ways[range(5), taken].sum() < 1.5 * least
    assert (swarm.lockstep.world.contacts == 0).all()


def test_robots_without_a_task_stay_where_they_are() -> None:
    swarm = Swarm(STARTS[:3], sensing_radius_m=6.5)
    try:
        swarm.request("auction_bc", {"tasks": [[4.0, 8.0]]}, run_s=10.0)
        taken = [int(each["task"][0]) for each in swarm.memory()]
        moved = np.linalg.norm(swarm.lockstep.world.pose[:, :2] - np.array(STARTS[:3])[:, :2], axis=1)
    finally:
        swarm.lockstep.close()
    assert taken == [-1, 0, -1]
    assert moved[[0, 2]].max() < 0.3  # until they were outbid
