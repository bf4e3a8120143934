"""A simulated world that a study holds still: nothing moves, and it goes on by itself when the hold is not repeated."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.config import SwarmConfig
from fullswarm.keys import Keys
from fullswarm.launch.world import HELD_S, WorldNode
from fullswarm.messages import WorldHold
from fullswarm.runtime import Mailbox, Runtime


class Driving:
    """A world in which robot s1 drives ahead at 0.2 m/s."""

    def __init__(self, *others: dict[str, Any]) -> None:
        self.runtime = Runtime(SimClock(), Mailbox())
        self.bus = LocalBus(self.runtime.mailbox)
        config = SwarmConfig.model_validate(
            {
                "world": {"engine": "kinematic", "address": "127.0.0.1:0", "bounds_m": (0.0, 0.0, 8.0, 8.0)},
                "robot": [{"id": "s1", "pose": (1.0, 2.0, 0.0)}, *others],
            }
        )
        self.node = WorldNode(self.bus, self.runtime, config, "world-here")
        world, row = self.node.world, self.node.world.rows["s1"]
        self.runtime.every(
            0.05, lambda: world.set_twists(np.array([0.2, 0.0]), row)
        )  # as its driver: set-points expire
        self.runtime.run(2.0)

    def hold(self, held: bool) -> None:
        self.bus.publish(Keys().world_hold, WorldHold(held=held))
        self.runtime.run(0.1)

    def moved_m(self, seconds: float) -> float:
        before_m = float(self.node.world.pose[0, 0])
        self.runtime.run(seconds)
        return float(self.node.world.pose[0, 0]) - before_m


@pytest.fixture
def driving() -> Iterator[Driving]:
    world = Driving()
    yield world
    world.node.close()


def test_a_held_world_stands_still_and_goes_on_from_there(driving: Driving) -> None:
    assert driving.moved_m(1.0) == pytest.approx(0.2, abs=0.02)
    driving.hold(True)
    assert driving.moved_m(1.0) == 0.0
    driving.hold(False)
    assert driving.moved_m(1.0) == pytest.approx(0.2, abs=0.02), "no time is made up for"


def test_a_hold_that_is_not_repeated_ends(driving: Driving) -> None:
    driving.hold(True)
    assert driving.moved_m(HELD_S - 0.2) == 0.0
    assert driving.moved_m(1.2) == pytest.approx(0.2, abs=0.05)


def test_a_world_with_real_robots_in_it_is_not_held() -> None:
    world = Driving({"id": "c1", "driver": "create:///dev/nothing"})
    try:
        world.hold(True)
        assert world.moved_m(1.0) == pytest.approx(0.2, abs=0.02)
    finally:
        world.node.close()
