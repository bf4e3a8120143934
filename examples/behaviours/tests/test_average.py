"""The mean is agreed on over a ring whatever the network loses; then the robots line up."""

from __future__ import annotations

import math

import numpy as np
import pytest
from swarm import Swarm

RING = 16
RADIUS_M = 8.0
CHORD_M = 2.0 * RADIUS_M * math.sin(math.pi / RING)


def ring() -> list[tuple[float, float, float]]:
    """Return a circle whose radius is drawn anew for each robot, so that the mean is not its middle."""
    chance = np.random.default_rng(3)
    turns = np.arange(RING) * math.tau / RING
    radii = RADIUS_M + chance.uniform(-0.6, 0.6, RING)
    return [(10.0 + r * math.cos(t), 10.0 + r * math.sin(t), 0.0) for r, t in zip(radii, turns, strict=True)]


@pytest.mark.parametrize("network", ["loss=30%", "loss=30%,delay=50ms±40,duplicate=10%,reorder=10%"])
def test_the_mean_is_agreed_on_over_a_ring(network: str | None) -> None:
    starts = ring()
    # Each robot receives its two neighbours only; the starts are spread over 16 m, 160 times the bar of 1 %.
    swarm = Swarm(starts, network, sensing_radius_m=1.35 * CHORD_M)
    try:
        status = swarm.request("average_bc", {"wait_s": 3600.0}, run_s=8.0)
        found = np.array([each["mean_m"][0] for each in swarm.memory()])
    finally:
        swarm.lockstep.close()
    mean_m = float(np.mean([x for x, _, _ in starts]))
    assert len(status.robots) == RING
    assert np.abs(found - mean_m).max() < 0.01 * mean_m


def test_robots_line_up_on_the_mean() -> None:
    swarm = Swarm([(4.0, 4.0, 0.0), (6.0, 7.0, 1.0), (11.0, 10.0, 2.0)], "loss=30%", sensing_radius_m=6.5)
    try:
        swarm.request("average_bc", {"wait_s": 5.0}, run_s=20.0)
        assert swarm.lockstep.world.pose[:, 0] == pytest.approx([7.0] * 3, abs=0.1)
        assert (swarm.lockstep.world.contacts == 0).all()
    finally:
        swarm.lockstep.close()
