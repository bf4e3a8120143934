"""A real robot among simulated ones, as processes: an emulated Create behind a port of its own stands for the real one.

Its body is known to nothing but its emulator: the simulated world must show it where its own agent reports it to be.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from fullswarm.drivers.base import Pose
from fullswarm.drivers.create_oi.protocol import CREATE2
from fullswarm.emulators.create_oi.emulator import CreateEmulator
from fullswarm.messages import RequestStatus
from fullswarm.simulation.bodies import FreeBody
from tests.system.live import LiveSwarm

REAL = Pose(2.0, 3.0, 0.0)
S1, S2 = 0, 1


class Ghostly(LiveSwarm):
    """Two simulated robots and the Create; the world runs in this process."""

    def __init__(self, url: str, body: FreeBody) -> None:
        self.body = body
        self.nearest_m, self.off_m, self.touched = math.inf, math.inf, np.zeros(2, np.int64)
        robots = [
            {"id": "s1", "pose": (4.5, 3.0, math.pi)},
            {"id": "real", "driver": url, "pose": (REAL.x_m, REAL.y_m, REAL.heading_rad)},
            {"id": "s2", "pose": (3.2, 5.0, 0.0)},
        ]
        world = {"engine": "kinematic", "bounds_m": (0.0, 0.0, 7.0, 7.0)}
        super().__init__({"world": world, "robot": robots, "agent": {"safety_margin_m": 0.06}}, watch=True)
        assert self.node is not None
        self.seen = self.node.world
        self.runtime.every(0.02, self._look)

    def _look(self) -> None:
        true = self.body.state()
        gaps = np.hypot(*(self.seen.pose[:, :2] - [true.x_m, true.y_m]).T) - self.seen.radius_m - CREATE2.radius_m
        self.nearest_m = min(self.nearest_m, float(gaps.min()))
        off_m = float(np.hypot(*(self.seen.movers.place[0] - [true.x_m, true.y_m])))
        self.off_m = off_m if math.isinf(self.off_m) or self.off_m > 10.0 else max(self.off_m, off_m)
        self.touched += self.seen.contacts > 0

    def ask(self, behaviour: str, robots: tuple[str, ...], **parameters: object) -> None:
        answers: list[RequestStatus] = []
        self.operator.request(behaviour, robots, parameters, answers.append)  # type: ignore[arg-type]
        self.until(lambda: bool(answers) and answers[-1].running == robots, 10.0, f"{behaviour} is confirmed")


@pytest.fixture(scope="module")
def swarm() -> Iterator[Ghostly]:
    body = FreeBody(REAL)
    with CreateEmulator(CREATE2, body).start() as robot:
        made = Ghostly(robot.url, body)
        yield made
        made.close()


def test_real_and_simulated_robots_see_and_avoid_each_other(swarm: Ghostly) -> None:
    swarm.until(lambda: swarm.off_m < 1.0, 10.0, "the Create has reported where it is")
    swarm.until(lambda: all(row.profile for row in swarm.view.snapshot().robots), 5.0, "all have said what they are")
    makes = {row.robot: row.profile.make for row in swarm.view.snapshot().robots if row.profile}
    assert makes == {"real": "iRobot", "s1": "sim", "s2": "sim"}
    targets = [[4.5, 3.0], [2.0, 3.0], [3.2, 2.0]]  # the Create and s1 change places, s2 crosses their way
    swarm.ask("formation_bc", ("real", "s1", "s2"), targets=targets)

    def arrived() -> bool:
        true = swarm.body.state()
        places = [[true.x_m, true.y_m], *swarm.seen.pose[[S1, S2], :2].tolist()]
        return bool((np.hypot(*(np.array(places) - targets).T) < 0.15).all())

    swarm.until(arrived, 40.0, "all three are at their places")
    assert swarm.nearest_m > 0.0
    assert swarm.off_m < 0.1  # from the true body to the ghost, at up to 0.5 m/s, odometry and network included
    assert not swarm.touched.any()


def test_a_simulated_robot_sees_the_real_one_as_a_body_and_feels_it(swarm: Ghostly) -> None:
    swarm.operator.stop(("real",))  # or it would go out of the way
    swarm.until(lambda: (row := swarm.row("real")).health is not None and not row.health.moving, 5.0, "it stands")
    swarm.rest(0.3)
    true = swarm.body.state()
    found = swarm.seen.seen_bodies(S1, 10.0)
    assert found is not None
    near = np.hypot(*(found[:, :2] - [true.x_m, true.y_m]).T)
    assert near.min() < 0.05
    assert found[near.argmin(), 2] == CREATE2.radius_m
    before = swarm.touched.copy()
    swarm.ask("move_to_goal", ("s1",), goal=[true.x_m, true.y_m])  # no filter: it drives into the Create
    swarm.until(lambda: swarm.touched[S1] > before[S1] + 5, 20.0, "s1 touches the Create")
    swarm.until(lambda: (health := swarm.row("s1").health) is not None and health.collisions > 0, 5.0, "s1 counts it")
    swarm.rest(1.0)
    assert math.dist(swarm.seen.pose[S1, :2], (true.x_m, true.y_m)) > 0.17 + CREATE2.radius_m - 0.02  # and not through
    after = swarm.body.state()
    assert math.dist((after.x_m, after.y_m), (true.x_m, true.y_m)) < 0.02  # nothing that is simulated moves a robot
