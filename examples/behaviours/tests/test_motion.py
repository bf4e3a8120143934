"""The examples that move by memory, members and chance: each against what its sources promise, alone and on a network."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import example_behaviours

from .swarm import Swarm

LAWS = Path(example_behaviours.__file__).parent
NETWORKS = [None, "loss=20%,delay=50ms±30"]


@pytest.mark.parametrize("network", NETWORKS)
def test_followers_drive_behind_the_leader_in_the_order_of_the_request(network: str | None) -> None:
    swarm = Swarm([(3.0, 3.0, 0.0), (2.0, 4.0, 0.0), (1.0, 2.0, 0.0), (2.5, 1.5, 0.0)], network, sensing_radius_m=6.0)
    try:
        swarm.request("follow_the_leader_bc", {"leader_goal": [15.0, 10.0], "gap_m": 0.8}, run_s=60.0)
        places, contacts = swarm.lockstep.world.pose[:, :2].copy(), swarm.lockstep.world.contacts.copy()
    finally:
        swarm.lockstep.close()
    gaps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert places[0] == pytest.approx((15.0, 10.0), abs=0.1)
    assert gaps == pytest.approx([0.8] * 3, abs=0.1)
    ahead = (places - places[0]) @ [12.0, 7.0] / math.hypot(12.0, 7.0)
    assert (np.diff(ahead) < -0.4).all()  # in line behind it
    assert (contacts == 0).all()


@pytest.mark.parametrize("network", NETWORKS)
def test_pursuers_drive_around_one_circle_at_equal_distances(network: str | None) -> None:
    starts = [(10.0, 12.0, 0.0), (7.0, 10.0, 1.0), (9.0, 7.0, 2.0), (13.0, 8.0, 3.0), (12.0, 11.5, -2.0)]
    swarm = Swarm(starts, network)
    try:
        swarm.request("pursue_next_bc", {"radius_m": 2.0}, run_s=80.0)
        places = swarm.lockstep.world.pose[:, :2].copy()
        swarm.lockstep.run(1.0)
        later = swarm.lockstep.world.pose[:, :2].copy()
    finally:
        swarm.lockstep.close()
    centre = places.mean(axis=0)
    assert np.linalg.norm(places - centre, axis=1) == pytest.approx([2.0] * 5, abs=0.15)
    angles = np.arctan2(*(places - centre).T[::-1])
    assert np.diff(np.unwrap(angles)) == pytest.approx([math.tau / 5] * 4, abs=0.12)
    turned = np.angle(np.exp(1j * (np.arctan2(*(later - centre).T[::-1]) - angles)))
    assert turned == pytest.approx([0.3 / 2.0] * 5, rel=0.2)


@pytest.mark.parametrize("network", NETWORKS)
def test_waypoints_are_passed_in_order_and_end_with_a_result(network: str | None) -> None:
    points = [[5.0, 3.0], [5.0, 6.0], [2.0, 6.0]]
    swarm = Swarm([(2.0, 3.0, 0.0)], network)
    passed: list[int] = []

    def look() -> None:
        near = np.linalg.norm(swarm.lockstep.world.pose[0, :2] - points, axis=1) < 0.11
        passed.extend(k for k in np.flatnonzero(near).tolist() if k not in passed)

    try:
        swarm.lockstep.runtime.every(0.02, look)
        status = swarm.request("waypoints_bc", {"waypoints": points}, run_s=60.0)
    finally:
        swarm.lockstep.close()
    assert passed == [0, 1, 2]
    assert (status.phase, status.code) == ("ended", "arrived")
    assert [each.text for each in status.results] == ["all 3 waypoints"]


def test_foragers_bring_their_loads_and_the_same_seed_gives_the_same_search() -> None:
    def run(rest_s: float) -> tuple[np.ndarray, set[int], str]:
        swarm = Swarm([(9.0, 9.0, 0.0), (11.0, 11.0, 2.0), (9.0, 11.0, 4.0)])
        states: set[int] = set()

        def look() -> None:
            states.update(int(each["state"][0]) for each in swarm.memory() if each)

        try:
            swarm.lockstep.runtime.every(0.5, look)
            food, nest = [[4.0, 4.0], [16.0, 15.0]], [10.0, 10.0]
            given = {"food": food, "nest": nest, "loads": 1, "sight_m": 5.0, "reach_m": 0.9}
            swarm.request("forage_bc", given, run_s=10.0)
            early = swarm.lockstep.world.pose.copy()
            swarm.lockstep.run(rest_s)
            status = swarm.statuses[-1]
            assert (swarm.lockstep.world.contacts == 0).all()
        finally:
            swarm.lockstep.close()
        return early, states, f"{status.phase} {status.code}"

    early, states, end = run(300.0)
    assert states == {0, 1, 2}
    assert end == "ended arrived"
    again, _, _ = run(0.1)
    assert np.array_equal(early, again)


@pytest.mark.parametrize("name", ["auction", "average", "pursue_next", "forage", "follow_the_leader", "waypoints"])
def test_law_and_record_together_have_at_most_40_lines(name: str) -> None:
    files = [LAWS / f"{name}{end}" for end in (".py", ".toml")]
    assert sum(len(file.read_text("utf-8").splitlines()) for file in files) <= 40
