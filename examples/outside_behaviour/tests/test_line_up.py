"""The centralised law by itself, and the whole way in lockstep: a request, robots on their line."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from fullswarm.config import SwarmConfig
from fullswarm.core.centralised.view import View
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.messages import RequestStatus
from fullswarm.operator.client import Operator
from fullswarm.parameters import Params

from fullswarm_orbit import line_up


def test_places_are_taken_in_the_order_along_the_line() -> None:
    # The law looks at nothing but the positions.
    view = cast(View, SimpleNamespace(position=np.array([[5.0, 1.0], [0.0, 3.0]])))
    params = Params([{"start": [0.0, 0.0], "end": [8.0, 0.0], "gain": 1.0}] * 2)
    assert line_up.velocity(view, params) == pytest.approx(np.array([[1.0, -1.0], [2.0, -3.0]]))


def test_robots_line_up() -> None:
    poses = [[6.0, 2.0, 0.0], [2.0, 7.0, 0.0], [4.0, 5.0, 3.0]]
    robots = [{"id": f"r{k}", "pose": pose} for k, pose in enumerate(poses)]
    config = SwarmConfig.model_validate({"world": {"engine": "kinematic", "bounds_m": [0, 0, 10, 10]}, "robot": robots})
    statuses: list[RequestStatus] = []
    lockstep = Lockstep(config)
    try:
        operator = Operator(lockstep.bus, Keys(config.swarm), lockstep.runtime, "test")
        lockstep.run(1.0)
        operator.request("line_up_bc", (), {"start": [2.0, 5.0], "end": [8.0, 5.0]}, statuses.append)
        lockstep.run(30.0)
        places = np.array(lockstep.world.pose[:, :2])
    finally:
        lockstep.close()
    assert statuses[-1].running == ("r0", "r1", "r2")
    assert places == pytest.approx(np.array([[7.0, 5.0], [3.0, 5.0], [5.0, 5.0]]), abs=0.1)
    assert (lockstep.world.contacts == 0).all()
