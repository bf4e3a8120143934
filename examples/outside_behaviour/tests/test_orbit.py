"""The law by itself, and the whole way in lockstep: the record that the core has found, a request, robots on the circle."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from fullswarm.agent.view import Params, View
from fullswarm.config import SwarmConfig
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.messages import RequestStatus
from fullswarm.operator.client import Operator

from fullswarm_orbit import orbit

CENTRE = [5.0, 5.0]


def test_law_points_along_the_tangent_on_the_circle_and_inwards_outside_of_it() -> None:
    # The law looks at nothing but the positions.
    view = cast(View, SimpleNamespace(position=np.array([[2.0, 0.0], [0.0, 4.0]])))
    params = Params([{"centre": [0.0, 0.0], "radius_m": 2.0, "speed_m_s": 0.3, "gain": 1.0}] * 2)
    assert orbit.velocity(view, params) == pytest.approx(np.array([[0.0, 0.3], [-0.3, -2.0]]))


def test_robots_go_round() -> None:
    robots = [{"id": f"r{k}", "pose": [3.0 + 2.0 * k, 2.0, 0.0]} for k in (1, 2)]
    config = SwarmConfig.model_validate({"world": {"engine": "kinematic", "bounds_m": [0, 0, 10, 10]}, "robot": robots})
    statuses: list[RequestStatus] = []
    lockstep = Lockstep(config)
    try:
        operator = Operator(lockstep.bus, Keys(config.swarm), lockstep.runtime, "test")
        lockstep.run(1.0)
        operator.request("orbit_bc", (), {"centre": CENTRE}, statuses.append)
        lockstep.run(15.0)
        before = _angles(lockstep)
        lockstep.run(5.0)
        turned = np.angle(np.exp(1j * (_angles(lockstep) - before)))
        distance = np.hypot(*(lockstep.world.pose[:, :2] - CENTRE).T)
    finally:
        lockstep.close()
    assert statuses[-1].running == ("r1", "r2")
    assert distance == pytest.approx([2.0, 2.0], abs=0.2)
    assert turned == pytest.approx([0.3 * 5.0 / 2.0] * 2, rel=0.15)  # speed x time / radius
    assert (lockstep.world.contacts == 0).all()


def _angles(lockstep: Lockstep) -> np.ndarray:
    x, y = (lockstep.world.pose[:, :2] - CENTRE).T
    return np.array([math.atan2(b, a) for a, b in zip(x, y, strict=True)])
