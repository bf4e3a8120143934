"""Real robots in a simulated world: bodies where they report to be."""

from __future__ import annotations

import math
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest

from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.config import SwarmConfig
from fullswarm.drivers.base import Hazard
from fullswarm.drivers.create_oi.protocol import CREATE2
from fullswarm.keys import Keys
from fullswarm.launch.nodes import start_poses
from fullswarm.launch.world import WorldNode
from fullswarm.messages import RobotStates
from fullswarm.runtime import Mailbox, Runtime

KEYS = Keys()
CREATE_M = CREATE2.radius_m


class Arena:
    """A world process with two simulated robots, and two real ones that report whatever the test says."""

    def __init__(self, engine: str) -> None:
        self.runtime = Runtime(SimClock(), Mailbox())
        self.bus = LocalBus(self.runtime.mailbox)
        self.config = SwarmConfig.model_validate(
            {
                "world": {
                    "engine": engine, "address": "127.0.0.1:0", "bounds_m": (0.0, 0.0, 8.0, 8.0),
                    "movers": [{"waypoints": [(7.0, 7.0)], "radius_m": 0.2}],
                    "bodies": {"c1": {"radius_m": 0.4}, "c2": {"radius_m": 0.5}},
                },
                "robot": [
                    {"id": "s1", "pose": (2.0, 2.0, 0.0)},
                    {"id": "c1", "driver": "create:///dev/nothing"},
                    {"id": "s2", "pose": (2.0, 5.0, 0.0)},
                    {"id": "c2", "driver": "absent://here"},
                ],
            }
        )  # fmt: skip
        self.node = WorldNode(self.bus, self.runtime, self.config, "world-here")
        self.world = self.node.world
        self._sequence = 0
        self.runtime.run(0.1)

    def report(self, robot: str, x_m: float, y_m: float, speed_m_s: float = 0.0, *, own_frame: bool = False) -> None:
        self._sequence += 1
        states = RobotStates(
            host=robot, sequence=self._sequence, stamp_s=self.runtime.now_s(), robots=(robot,), x_m=(x_m,),
            y_m=(y_m,), heading_rad=(math.pi / 2,), speed_m_s=(speed_m_s,), turn_rad_s=(0.0,), radius_m=(0.25,),
            own_frame=own_frame,
        )  # fmt: skip
        self.bus.publish(KEYS.state("all", robot), states)
        self.runtime.mailbox.drain()

    def drive(self, row: int, speed_m_s: float, seconds: float) -> int:
        """Drive a simulated robot; return in how many steps it touched something."""
        touched = 0
        for _ in range(round(seconds / 0.02)):
            self.world.set_twists(np.array([speed_m_s, 0.0]), row)
            self.runtime.run(0.02)
            touched += int(self.world.contacts[row] > 0)
        return touched


@pytest.fixture(params=["kinematic", "pybullet"])
def arena(request: pytest.FixtureRequest) -> Iterator[Arena]:
    made = Arena(request.param)
    yield made
    made.node.close()


def test_real_robots_are_bodies_where_they_report_to_be(arena: Arena) -> None:
    world = arena.world
    assert world.ids == ("s1", "s2")
    assert world.movers.radius_m.tolist()[1:] == [
        CREATE_M,
        0.5,
    ]  # by its make; by the file, where no driver is installed
    bounds = arena.config.bounds_m
    assert (world.movers.place[1:] > np.array(bounds[2:]) + 50.0).all()  # nothing is known of them yet
    arena.report("c1", 3.0, 2.0, 0.5)
    arena.runtime.run(0.1)
    assert world.movers.place[1] == pytest.approx([3.0, 2.05], abs=0.02)
    seen = world.seen_bodies(0, 2.0)
    assert seen is not None
    assert seen.tolist() == [pytest.approx([3.0, 2.05, CREATE_M], abs=0.02)]
    arena.runtime.run(5.0)  # it is silent: it stands somewhere near
    assert world.movers.place[1] == pytest.approx([3.0, 2.15], abs=0.02)
    arena.report("c1", 6.0, 6.0, own_frame=True)  # from where it was switched on
    arena.runtime.run(0.1)
    assert world.movers.place[1] == pytest.approx([3.0, 2.15], abs=0.02)
    assert world.movers.place[0] == pytest.approx([7.0, 7.0])


def test_a_simulated_robot_bumps_into_a_real_one_and_does_not_push_it(arena: Arena) -> None:
    arena.report("c1", 3.0, 2.0)
    assert arena.drive(0, 0.5, 2.5) > 10
    assert arena.world.pose[0, 0] == pytest.approx(3.0 - 0.17 - CREATE_M, abs=0.03)
    assert arena.world.hazards[0] == Hazard.BUMP
    assert arena.world.movers.place[1].tolist() == [3.0, 2.0]
    assert arena.world.contacts[1] == 0


def test_a_real_robot_that_drives_into_a_simulated_one_pushes_it(arena: Arena) -> None:
    arena.report("c1", 2.0, 3.0)
    arena.runtime.run(0.1)
    touched = 0
    for step in range(225):
        arena.report("c1", 2.0, 3.0 + 0.01 * step, 0.5)
        arena.runtime.run(0.02)
        touched += int(arena.world.contacts[1] > 0)
    assert touched > 10
    assert arena.world.pose[1, 1] > 5.2 + 0.17 + CREATE_M - 0.05


def test_a_jump_sweeps_nothing_on_its_way(arena: Arena) -> None:
    arena.report("c1", 1.0, 2.0)
    arena.runtime.run(0.2)
    arena.report("c1", 3.5, 2.0)  # past s1, at (2, 2): its pose was corrected
    assert arena.drive(0, 0.0, 0.2) == 0
    assert arena.world.pose[0, :2] == pytest.approx([2.0, 2.0], abs=1e-3)


def test_messages_that_do_not_fit_move_nothing(arena: Arena) -> None:
    arena.report("c1", 3.0, 2.0)
    arena.runtime.run(0.1)
    broken = RobotStates(
        host="c1", sequence=9, stamp_s=1.0, robots=("c1",), x_m=(5.0,), y_m=(), heading_rad=(0.0,), speed_m_s=(0.0,),
        turn_rad_s=(0.0,), radius_m=(0.2,),
    )  # fmt: skip
    for each in (broken, msgspec.structs.replace(broken, y_m=(math.nan,))):
        arena.bus.publish(KEYS.state("all", "c1"), each)
    arena.runtime.run(0.1)
    assert arena.world.movers.place[1].tolist() == [3.0, 2.0]


def test_free_places_keep_clear_of_real_robots() -> None:
    config = SwarmConfig.model_validate(
        {"world": {"engine": "kinematic"}, "robot": [
            {"id": "c1", "driver": "create:///dev/nothing", "pose": (0.25, 0.25, 0.0)}, {"id": "s1"}, {"id": "s2"},
        ]}
    )  # fmt: skip
    simulated = [each for each in config.robot if each.simulated]
    places = start_poses(config, simulated)
    assert len(places) == 2
    assert np.hypot(*(places[:, :2] - [0.25, 0.25]).T).min() > 0.34
    assert len(start_poses(config)) == 3
