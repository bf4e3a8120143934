"""Drives one robot by the velocities that ROS publishes: teleoperation, with its lease and its dead-man.

A velocity that is not zero counts as a stick that is held. After `DEAD_MAN_S` without one the robot is released: zeros,
then its lease. A refusal, a stop or a loss of the lease blocks the robot until the stream has paused for that long, so
that nothing starts to move because the other operator lets go.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from fullswarm.errors import MessageError
from fullswarm.geometry import clamp
from fullswarm.messages import RequestStatus
from fullswarm.operator.client import Operator
from fullswarm.operator.leases import LeaseHolder
from fullswarm.operator.teleop import Teleop
from fullswarm.ros_bridge.values import RobotState
from fullswarm.runtime import Scheduler

BEHAVIOUR = "drive_bc"
DEAD_MAN_S = 0.3
NO_CORE = "no core of the swarm has answered yet"
SPEED_RANGE_M_S, TURN_RANGE_RAD_S = (0.01, 10.0), (0.01, 20.0)
"""Of the behaviour's parameters for full speed and full turn rate."""


@dataclass(frozen=True, slots=True)
class DriveContext:
    """What the driving of all robots shares."""

    operator: Operator
    leases: LeaseHolder
    scheduler: Scheduler
    connected: Callable[[], bool]  # to the swarm's hub
    on_refusal: Callable[[str, str], None]  # robot, reason


class Drive:
    """One robot as ROS drives it.

    Attributes
    ----------
    refusal : why the newest velocities were not carried out; empty: they were
    """

    def __init__(self, context: DriveContext, robot: str) -> None:
        self.robot, self.refusal = robot, ""
        self._context = context
        self._teleop = Teleop(context.operator, context.scheduler, (robot,), on_status=self._on_status)
        self._pressed_s = -math.inf
        self._limits = 0.0, 0.0

    @property
    def driving(self) -> bool:
        """Whether it is being driven."""
        return self._teleop.held

    def command(self, linear_m_s: float, angular_rad_s: float, state: RobotState | None) -> None:
        """Take a velocity; `state` has the robot's limits, None: nothing was received of it."""
        context = self._context
        if not (linear_m_s or angular_rad_s):
            if self._teleop.held:
                self._hold(0.0, 0.0)
            return
        self._pressed_s = context.scheduler.now_s()
        if self.refusal:
            return
        if problem := self._problem(state):
            self.block(problem)
            return
        if not self._teleop.held:
            context.leases.hold((self.robot,))
        self._hold(linear_m_s, angular_rad_s)

    def _problem(self, state: RobotState | None) -> str:
        context = self._context
        if not context.connected():
            return "the swarm's hub is not connected"
        if not context.leases.received:
            return NO_CORE
        if holder := context.leases.held_by_others((self.robot,)).get(self.robot):
            return f"{self.robot} is held by {holder}"
        if state is None or not (state.speed_limit_m_s > 0.0 and state.turn_limit_rad_s > 0.0):
            return f"{self.robot} has not stated its limits"
        self._limits = clamp(state.speed_limit_m_s, *SPEED_RANGE_M_S), clamp(state.turn_limit_rad_s, *TURN_RANGE_RAD_S)
        return ""

    def _hold(self, linear_m_s: float, angular_rad_s: float) -> None:
        speed_m_s, turn_rad_s = self._limits
        sticks = {
            "linear": clamp(linear_m_s / speed_m_s, -1.0, 1.0),
            "angular": clamp(angular_rad_s / turn_rad_s, -1.0, 1.0),
        }
        self._teleop.hold(BEHAVIOUR, sticks, {"speed_m_s": speed_m_s, "turn_rad_s": turn_rad_s})

    def check(self) -> None:
        """Release the robot when the stream has paused; to be called regularly."""
        if self._context.scheduler.now_s() - self._pressed_s < DEAD_MAN_S:
            return
        self.refusal = ""
        self.release()

    def block(self, reason: str) -> None:
        """Release the robot, and refuse velocities until the stream has paused."""
        if not self.refusal:
            self.refusal = reason
            self._context.on_refusal(self.robot, reason)
        self.release()

    def release(self, on_done: Callable[[], None] | None = None) -> None:
        """Send zero a few times, then return the lease."""
        if not self._teleop.held:
            if on_done is not None:
                on_done()
            return

        def done() -> None:
            if not self._teleop.held:
                self._context.leases.release((self.robot,))
            if on_done is not None:
                on_done()

        self._teleop.release(done)

    def _on_status(self, status: RequestStatus) -> None:
        # While it is held: afterwards it is the answer to the final zeros.
        if not self._teleop.held:
            return
        if status.phase == "refused" or self.robot in status.refused_by:
            self.block(status.reason or "refused without a reason")


def velocity(message: Any) -> tuple[float, float]:
    """Return forward speed (m/s) and turn rate (rad/s) of a ``geometry_msgs/Twist``; the rest does not apply here.

    Raises
    ------
    MessageError
        A value is not finite.
    """
    linear, angular = message.linear, message.angular
    values = (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
    if not all(map(math.isfinite, values)):
        raise MessageError("a velocity that is not finite")
    return float(linear.x), float(angular.z)
