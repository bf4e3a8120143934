"""The testbed under the name of its interface in ``rps``: here, interface and simulator are one class."""

from __future__ import annotations

from fullswarm.robotarium.robotarium import Robotarium as RobotariumABC

__all__ = ["RobotariumABC"]
