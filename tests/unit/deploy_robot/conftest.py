"""Robots in folders, in the states that most tests begin with."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.unit.deploy_robot.script import Robot


@pytest.fixture(scope="session")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return Robot(tmp_path_factory.mktemp("bare"))


@pytest.fixture(scope="session")
def running(bare: Robot, tmp_path_factory: pytest.TempPathFactory) -> tuple[Robot, Path, Path]:
    robot = bare.copy(tmp_path_factory.mktemp("running") / "robot")
    old, new = robot.make("1.0.0"), robot.make("1.0.1")
    robot.run_release(old)
    robot.ship(new)
    return robot, old, new


@pytest.fixture
def robot(bare: Robot, tmp_path: Path) -> Robot:
    return bare.copy(tmp_path / "robot")


@pytest.fixture
def two(running: tuple[Robot, Path, Path], tmp_path: Path) -> tuple[Robot, Path, Path]:
    """A robot that runs the first of two releases and has the second."""
    robot, old, new = running
    own = robot.copy(tmp_path / "robot")
    return own, own.store / old.name, own.store / new.name
