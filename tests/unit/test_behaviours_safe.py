"""All behaviours behind the safety filter with noisy sensors, each in its scene: no contact."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fullswarm.core.behaviours import load_records
from fullswarm.lab import gallery

NOISE = {"world.noise.position_m": 0.02, "world.noise.heading_rad": 0.02}
ELSEWHERE = ("move_", "drive", "teleop", "formation", "voronoi", "navigate", "rendezvous", "flocking_bc", "paper_bc")
"""Older behaviours, which the safety table covers."""
FILTERED = [name for name in load_records() if name.endswith("_bc") and not name.startswith(ELSEWHERE)]


@pytest.mark.parametrize("behaviour", FILTERED)
def test_no_robot_touches_anything(behaviour: str) -> None:
    scene = gallery.scene_of(behaviour, {"seconds": 12.0, "seed": 11}, {})
    found = gallery.run(behaviour, replace(scene, settings=NOISE))
    assert not found.touching.any()
    apart_m = abs(found.pose[-1, :, :2] - found.pose[0, :, :2]).max()
    assert apart_m > 0.3 or behaviour == "average_consensus_bc"  # they did move
