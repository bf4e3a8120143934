"""The conversation with one Scout as a state machine: lines and time in, bytes out. No port, no thread, no clock."""

from __future__ import annotations

import math

from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Limits, Pose, Reading, Twist
from fullswarm.geometry import wrap

from fullswarm_acme.protocol import (
    LineParser,
    Robot,
    State,
    drive,
    line,
    parse_robot,
    parse_state,
    quantised,
)

LIMITS = Limits(speed_m_s=0.5, turn_rad_s=2.0, accel_m_s2=2.0, turn_accel_rad_s2=8.0, can_reverse=False)
HOLD_S = 0.3
"""A set-point holds for so long; after that we say zero ourselves."""
SILENT_S = 0.5
PERIOD_S = 0.05
AGAIN_S = 0.2
"""Between two repeats of what the robot does not confirm."""
LOW = 0.1
ORIGIN = Pose(0.0, 0.0, 0.0)


class Session:
    """One robot from open() to close(). Not thread-safe; all times are seconds of one monotonic clock."""

    def __init__(self, where: str) -> None:
        self.state, self.fault, self.firmware = Lifecycle.CLOSED, "", ""
        self.reading: Reading | None = None
        self._where, self._parser = where, LineParser()
        self._linked = False
        self._robot: Robot | None = None
        self._mode = ""
        self._origin: Pose | None = None  # where the robot counted from when our odometry was zero
        self._heard_s = self._said_s = self._asked_s = self._wished_s = -math.inf
        self._wished = STAND
        self._wants = False  # activate() was called
        self._enabled = False  # and ENABLE said, after the robot was seen idle
        self._urgent = False

    # ------------------------------------------------------------ the link
    def linked(self) -> None:
        """Begin anew: there is a connection."""
        self._parser, self._linked, self._mode, self._asked_s = LineParser(), True, "", -math.inf
        if self.state is Lifecycle.CLOSED:
            self.state = Lifecycle.OPEN

    def lost(self, reason: str) -> None:
        """Take note that there is no connection."""
        self._linked = False
        self._fail(reason)

    def received(self, data: bytes, now_s: float) -> None:
        """Take bytes."""
        for text in self._parser.feed(data):
            told, robot = parse_state(text), parse_robot(text)
            if told is not None and self._robot is not None:
                self._take(told, now_s)
            elif robot is not None:
                self._meet(robot)

    def silent_for_s(self, now_s: float) -> float:
        """Return since when nothing good was heard."""
        return now_s - self._heard_s

    def tick(self, now_s: float) -> bytes:
        """Return what is to be said now."""
        if not self._linked:
            return b""
        if self.state in (Lifecycle.READY, Lifecycle.ACTIVE) and self.silent_for_s(now_s) > SILENT_S:
            self._fail(f"no word for {SILENT_S} s: is it switched on and in reach of the network?")
        if now_s - self._wished_s > HOLD_S and self._wished != STAND:
            self._wished = STAND
        words = self._words(now_s)
        return b"".join(map(line, words))

    def _words(self, now_s: float) -> list[str]:
        again = now_s - self._asked_s >= AGAIN_S
        if self.state is Lifecycle.ACTIVE:
            if not self._urgent and now_s - self._said_s < PERIOD_S:
                return []
            self._said_s, self._urgent = now_s, False
            return [drive(self._wished)]
        if not again:
            return []
        self._asked_s = now_s
        if self.state is Lifecycle.READY:
            if self._wants and self._mode == "IDLE":
                self._enabled = True
            return ["ENABLE"] if self._enabled else ["DISABLE"] if self._mode == "ON" else []
        return ["DISABLE", "HELLO"]  # its last controller may have died while it drove

    # ------------------------------------------------------------ the agent
    def activate(self) -> None:
        """Ask for motors on; ACTIVE when the robot shows it."""
        if self.state is Lifecycle.READY and not self._wants:
            self._wants, self._asked_s = True, -math.inf

    def deactivate(self) -> None:
        """Motors off."""
        self._stand()
        if self.state is Lifecycle.ACTIVE:
            self.state = Lifecycle.READY
            self._asked_s = -math.inf

    def command(self, twist: Twist, now_s: float) -> Twist:
        """Take a set-point; ``ValueError`` and zero if it is not finite."""
        if not (math.isfinite(twist.linear_m_s) and math.isfinite(twist.angular_rad_s)):
            self._wished, self._urgent = STAND, True
            raise ValueError(f"a twist must be finite, not {twist}")
        if self.state is not Lifecycle.ACTIVE:
            return STAND
        v, w = min(max(twist.linear_m_s, 0.0), LIMITS.speed_m_s), LIMITS.turn_rad_s
        wished = quantised(Twist(v, min(max(twist.angular_rad_s, -w), w)))
        self._urgent = self._urgent or (wished == STAND != self._wished)
        self._wished, self._wished_s = wished, now_s
        return wished

    def closed(self) -> bytes:
        """Return the last words."""
        self._stand()
        linked, self._linked, self.state, self.fault = self._linked, False, Lifecycle.CLOSED, ""
        return line(drive(STAND)) + line("DISABLE") if linked else b""

    # ------------------------------------------------------------ within
    def _meet(self, robot: Robot) -> None:
        if self._robot is not None and robot.boot != self._robot.boot:
            self._origin = None  # it counts from zero again: our odometry goes on from where it was
        self._robot, self.firmware = robot, f"{robot.model} {robot.firmware}"

    def _take(self, told: State, now_s: float) -> None:
        self._heard_s, self._mode = now_s, told.mode
        before = ORIGIN if self.reading is None else self.reading.odometry
        if self._origin is None:
            self._origin = _minus(told.pose, before)
        hazards = Hazard.BUMP if told.bumper else Hazard.NONE
        hazards |= Hazard.BATTERY_LOW if told.battery < LOW else Hazard.NONE
        hazards |= Hazard.ESTOP_BUTTON if told.mode == "ESTOP" else Hazard.NONE
        odometry = _seen_from(self._origin, told.pose)
        self.reading = Reading(now_s, odometry, told.twist, hazards=hazards, battery=told.battery)
        self._judge(told.mode)

    def _judge(self, mode: str) -> None:
        if mode == "ESTOP":
            self._fail("its emergency stop button is pressed: release it")
        elif mode == "IDLE" and self.state is Lifecycle.ACTIVE:
            self._fail("it switched its motors off by itself")
        elif mode == "IDLE" and self.state in (Lifecycle.OPEN, Lifecycle.FAULT):
            self.state, self.fault = Lifecycle.READY, ""
        elif mode == "ON" and self.state is Lifecycle.READY and self._enabled:
            self.state, self._wants, self._urgent = Lifecycle.ACTIVE, False, True

    def _stand(self) -> None:
        self._wished, self._urgent, self._wants, self._enabled = STAND, True, False, False

    def _fail(self, reason: str) -> None:
        self._stand()
        self.state, self.fault = Lifecycle.FAULT, f"{self._where}: {reason}"


def _minus(told: Pose, ours: Pose) -> Pose:
    """Return the frame in which the robot's pose `told` is `ours`."""
    turn = wrap(told.heading_rad - ours.heading_rad)
    c, s = math.cos(turn), math.sin(turn)
    return Pose(told.x_m - c * ours.x_m + s * ours.y_m, told.y_m - s * ours.x_m - c * ours.y_m, turn)


def _seen_from(frame: Pose, told: Pose) -> Pose:
    """Return the robot's pose `told` in `frame`."""
    dx, dy = told.x_m - frame.x_m, told.y_m - frame.y_m
    c, s = math.cos(frame.heading_rad), math.sin(frame.heading_rad)
    return Pose(c * dx + s * dy, c * dy - s * dx, wrap(told.heading_rad - frame.heading_rad))
