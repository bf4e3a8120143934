"""Two emulated Creates drive on what Motive streams, named in their fleet file; then Motive ends."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import pytest

from fullswarm.drivers.base import Pose
from fullswarm.emulators.mocap.natnet import NatNetServer
from fullswarm.emulators.mocap.server import Shown
from fullswarm.launch.world import start_emulator
from fullswarm.messages import RobotHealth
from fullswarm.simulation.bodies import FreeBody
from tests.system.live import LiveSwarm

NAMES = {"Rigid Body 1": "r1", "Rigid Body 2": "r2"}
FRAME_S = 0.01


class Lab:
    """Robots on ports, cameras above them, and the swarm's processes."""

    def __init__(self, folder: Path) -> None:
        self.bodies = {"r1": FreeBody(Pose(0.0, 0.0, 1.0)), "r2": FreeBody(Pose(3.0, 0.0, 2.0))}
        urls = {robot: f"create://{folder}/{robot}?model=create2" for robot in self.bodies}
        self._emulators = [start_emulator("create2", urls[robot], body) for robot, body in self.bodies.items()]
        self.motive: NatNetServer | None = NatNetServer(list(NAMES), port=0, version=(4, 1))
        self.motive.start()
        self.port = self.motive.port
        source = f"natnet://127.0.0.1:{self.port}"
        config = {
            "fixes": {"source": source, "axes": "y-up", "map": NAMES},
            "agent": {"bounds_m": (-10.0, -10.0, 10.0, 10.0)},
            # Where the file says they are, they are not: only the fixes can tell.
            "robot": [
                {"id": "r1", "driver": urls["r1"], "pose": (-5.0, 1.0, 0.0)},
                {"id": "r2", "driver": urls["r2"], "pose": (-5.0, -1.0, 0.0)},
            ],
        }
        self.swarm = LiveSwarm(config, watch=False)
        self._timer = self.swarm.runtime.every(FRAME_S, self._show)
        self.nearest_m = math.inf

    def _show(self) -> None:
        states = {robot: body.state() for robot, body in self.bodies.items()}
        one, two = states.values()
        self.nearest_m = min(self.nearest_m, math.dist((one.x_m, one.y_m), (two.x_m, two.y_m)))
        if self.motive is None:
            return
        shown = []
        for name, robot in NAMES.items():
            at = states[robot]
            half = at.heading_rad / 2.0
            shown.append(Shown(name, (at.x_m, 0.1, -at.y_m), (0.0, math.sin(half), 0.0, math.cos(half))))
        self.motive.frame(shown)

    def end_motive(self) -> None:
        if self.motive is not None:
            self.motive.close()
        self.motive = None

    def start_motive(self) -> None:
        self.motive = NatNetServer(list(NAMES), port=self.port, version=(4, 1))
        self.motive.start()

    def health(self, robot: str) -> RobotHealth:
        found = self.swarm.row(robot).health
        assert found is not None
        return found

    def all_on(self, source: str) -> bool:
        return all(self.health(robot).pose_source == source for robot in self.bodies)

    def error_m(self, robot: str) -> float:
        row, true = self.swarm.row(robot), self.bodies[robot].state()
        return math.dist((row.x_m, row.y_m), (true.x_m, true.y_m))

    def close(self) -> None:
        self._timer.cancel()
        self.end_motive()
        self.swarm.close()
        for each in self._emulators:
            each.close()


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    lab = Lab(tmp_path)
    yield lab
    lab.close()


def test_creates_drive_on_what_motive_streams_and_say_within_a_second_that_it_has_ended(lab: Lab) -> None:
    swarm = lab.swarm
    swarm.until(lambda: lab.all_on("fixes"), 30.0, "the fixes are used")
    swarm.until(lambda: max(lab.error_m(robot) for robot in lab.bodies) < 0.05, 10.0, "they know where they are")
    swarm.request("move_to_goal_bc", {"goal": [1.5, 3.0]})

    def near() -> bool:
        states = [body.state() for body in lab.bodies.values()]
        return all(math.dist((each.x_m, each.y_m), (1.5, 3.0)) < 0.8 for each in states)

    swarm.until(near, 40.0, "both are at the goal")
    assert lab.nearest_m > 0.34  # two radii: they have not touched
    assert max(lab.error_m(robot) for robot in lab.bodies) < 0.1
    lab.end_motive()
    lost_s = swarm.until(lambda: lab.all_on("odometry"), 10.0, "its end is noticed")
    assert lost_s < 0.5 + 0.5 + 1.0  # fix_timeout_s, a health report's period, and a machine with other work
    assert all("stopped" in lab.health(robot).pose_note for robot in lab.bodies)
    lab.start_motive()
    swarm.until(lambda: lab.all_on("fixes"), 20.0, "it is used again")
    assert "Traceback" not in swarm.supervisor.log_tail("fixes", 100)
