"""Which estimator a robot gets, and what that one needs."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from fullswarm.agent.pose.estimator import DirectEstimator, EkfEstimator, estimator_for
from fullswarm.config import SwarmConfig
from fullswarm.drivers.fleet import OneRobot
from fullswarm.drivers.null.driver import NullDriver
from fullswarm.errors import ConfigError, MissingExtra


def test_filterpy_is_imported_only_where_it_is_used() -> None:
    script = "import sys, fullswarm.agent.node; print('filterpy' in sys.modules, 'scipy' in sys.modules)"
    out = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert out.split() == ["False", "False"]


def test_a_missing_filterpy_is_said_with_what_mends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "filterpy.kalman", None)
    with pytest.raises(MissingExtra, match=r"needs filterpy") as caught:
        EkfEstimator(np.zeros((1, 3)), 0.1, 0.1)
    assert "fullswarm[estimation]" in caught.value.hint
    DirectEstimator(np.zeros((1, 3)))


def test_a_robot_without_pose_needs_no_noise_of_the_world_for_the_filter() -> None:
    fleet = OneRobot("r1", NullDriver("null://r1"))
    config = SwarmConfig.model_validate({"agent": {"estimator": "ekf"}, "world": {}, "robot": [{"id": "r1"}]})
    assert isinstance(estimator_for(config, fleet, np.zeros((1, 3))), EkfEstimator)
    with pytest.raises(ConfigError, match=r"world\.noise"):
        EkfEstimator(np.zeros((1, 3)), 0.0, 0.0)
