"""The mixed swarm of examples/mixed.toml: who takes part, in which role, and that it gets there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from fullswarm.config import load_swarm
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.messages import RequestStatus
from fullswarm.operator.client import Operator

FLEET = Path(__file__).parents[2] / "mixed.toml"
CARRIERS, SCOUTS = ("hauler1", "hauler2"), ("scout1", "scout2", "scout3", "create")


def test_carriers_arrive_with_scouts_around_them_and_the_slow_robot_is_left_out() -> None:
    config = load_swarm(FLEET, ["world.engine=kinematic", "agent.sensing_radius_m=6.0"])
    lockstep, statuses, contacts = Lockstep(config), list[RequestStatus](), list[int]()
    try:
        operator = Operator(lockstep.bus, Keys(config.swarm), lockstep.runtime, "test")
        lockstep.run(1.5)
        lockstep.runtime.every(0.02, lambda: contacts.append(int(lockstep.world.contacts.sum())))
        operator.request("convoy_bc", (), {"goal": [11.0, 6.0], "speed_m_s": 0.28}, statuses.append)
        lockstep.run(42.0)
        world = lockstep.world
        places = dict(zip(world.ids, world.pose[:, :2].copy(), strict=True))
        lamps = {robot: world.actuators[row]["lamp"] for row, robot in enumerate(world.ids)}
        still = np.abs(world.twist[:, 0]) < 0.01
    finally:
        lockstep.close()
    newest = statuses[-1]
    assert (newest.left_out, newest.phase) == (("turtle",), "running")
    assert newest.roles == {**dict.fromkeys(CARRIERS, "carrier"), **dict.fromkeys(SCOUTS, "scout")}
    assert {(each.robot, each.outcome) for each in newest.results} == {(robot, "arrived") for robot in CARRIERS}
    assert not any(contacts)
    assert {robot for robot, lamp in lamps.items() if lamp == "red"} == set(CARRIERS)
    for robot in SCOUTS:  # also after the carriers have arrived
        nearest = min(float(np.linalg.norm(places[robot] - places[carrier])) for carrier in CARRIERS)
        assert 0.6 < nearest < 2.0, (robot, nearest)
    assert still[[world.row(robot) for robot in (*CARRIERS, "turtle")]].all()
    assert not still[[world.row(robot) for robot in SCOUTS]].all()
