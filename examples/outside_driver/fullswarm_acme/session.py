"""Runs the protocol with one Scout as a state machine: bytes and time in, bytes out; no port, thread or clock."""

from __future__ import annotations

import math

from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Limits, Reading, Twist
from fullswarm.drivers.guardian import StopPlan
from fullswarm.drivers.linked import LinkSession, Odometer

from fullswarm_acme.protocol import LineParser, Robot, State, drive, line, parse_robot, parse_state, quantised

LIMITS = Limits(speed_m_s=0.5, turn_rad_s=2.0, accel_m_s2=2.0, turn_accel_rad_s2=8.0, can_reverse=False)
SILENT_S = 0.5
PERIOD_S = 0.05
AGAIN_S = 0.2
"""Between two repeats of what the robot does not confirm."""
LOW = 0.1
STOP, RELEASE = line(drive(STAND)), line("DISABLE")
PLAN = StopPlan(((0.0, STOP), (0.05, STOP), (0.1, STOP)), leave=((1.0, RELEASE),))
"""What the guardian sends when this process is killed or paused: the robot itself would drive on for a second."""


class Session(LinkSession[bytes]):
    """One Scout."""

    firmware = ""

    def __init__(self, where: str) -> None:
        self._where, self._parser = where, LineParser()
        self._robot: Robot | None = None
        self._mode = ""
        self._odometer = Odometer()
        self._received_s = self._sent_s = self._asked_s = -math.inf
        self._target = STAND
        self._activating = False  # activate() was called
        self._enabled = False  # and ENABLE sent, after the robot was seen idle
        self._urgent = False

    # ------------------------------------------------------------ the link
    def linked(self, now_s: float) -> None:
        """Begin anew: there is a connection."""
        self._parser, self._mode, self._asked_s = LineParser(), "", -math.inf

    def lost(self, reason: str, now_s: float) -> None:
        """Note that there is no connection, or that the guardian has stopped the robot."""
        self._stand()
        super().lost(f"{self._where}: {reason}", now_s)

    def received(self, chunk: bytes, now_s: float) -> None:
        """Take bytes."""
        for text in self._parser.feed(chunk):
            state, robot = parse_state(text), parse_robot(text)
            if state is not None and self._robot is not None:
                self._take(state, now_s)
            elif robot is not None:
                if self._robot is not None and robot.boot != self._robot.boot:
                    self._odometer.rebase()  # it counts from zero again
                self._robot, self.firmware = robot, f"{robot.model} {robot.firmware}"

    def tick(self, now_s: float) -> list[bytes]:
        """Return what is to be sent now."""
        if self.state in (Lifecycle.READY, Lifecycle.ACTIVE):
            if now_s - self._received_s > SILENT_S:
                self.lost(f"nothing received for {SILENT_S} s: is it on, and in reach of the network?", now_s)
            elif self.unguarded:
                self.lost(self.unguarded, now_s)
        if self.state is Lifecycle.ACTIVE:
            if not self._urgent and now_s - self._sent_s < PERIOD_S:
                return []
            self._sent_s, self._urgent = now_s, False
            return [line(drive(self._target))]
        if now_s - self._asked_s < AGAIN_S:
            return []
        self._asked_s = now_s
        if self.state is Lifecycle.READY:
            self._enabled = self._enabled or (self._activating and self._mode == "IDLE")
            return [line("ENABLE")] if self._enabled else [RELEASE] if self._mode == "ON" else []
        return [RELEASE, line("HELLO")]  # its last driver may have been killed while it drove

    def next_due_s(self, now_s: float) -> float:
        """Return when there is something to send next: a stop at once."""
        return now_s if self._urgent and self.state is Lifecycle.ACTIVE else super().next_due_s(now_s)

    # ------------------------------------------------------------ the agent
    def activate(self, now_s: float) -> None:
        """Ask for motors on; ACTIVE when the robot confirms it."""
        if self.state is Lifecycle.READY and not self._activating:
            self._activating, self._asked_s = True, -math.inf

    def deactivate(self, now_s: float) -> None:
        """Motors off."""
        self._stand()
        if self.state is Lifecycle.ACTIVE:
            self.state, self._asked_s = Lifecycle.READY, -math.inf

    def command(self, twist: Twist, now_s: float) -> Twist:
        """Take a set-point; return what is sent of it."""
        target = quantised(LIMITS.clip(twist))
        self._urgent = self._urgent or (target == STAND != self._target)
        self._target = target
        return target

    def final_stop(self) -> tuple[bytes, bytes]:
        """Return zero, and motors off."""
        return STOP, RELEASE

    def stop_plan(self, now_s: float) -> StopPlan[bytes] | None:
        """Return what the guardian sends while the motors may be on."""
        return PLAN if self._enabled else None

    # ------------------------------------------------------------ within
    def _take(self, state: State, now_s: float) -> None:
        self._received_s, self._mode = now_s, state.mode
        hazards = Hazard.BUMP if state.bumper else Hazard.NONE
        hazards |= Hazard.BATTERY_LOW if state.battery < LOW else Hazard.NONE
        hazards |= Hazard.ESTOP_BUTTON if state.mode == "ESTOP" else Hazard.NONE
        self.reading = Reading(
            now_s, self._odometer.update(state.pose), state.twist, hazards=hazards, battery=state.battery
        )
        if state.mode == "ESTOP":
            self.lost("its emergency stop button is pressed: release it", now_s)
        elif state.mode == "IDLE" and self.state is Lifecycle.ACTIVE:
            self.lost("it switched its motors off by itself", now_s)
        elif state.mode == "IDLE" and self.state in (Lifecycle.OPEN, Lifecycle.FAULT) and not self.unguarded:
            self.state, self.fault = Lifecycle.READY, ""
        elif state.mode == "ON" and self.state is Lifecycle.READY and self._enabled:
            self.state, self._activating, self._urgent = Lifecycle.ACTIVE, False, True

    def _stand(self) -> None:
        self._target, self._urgent, self._activating, self._enabled = STAND, True, False, False
