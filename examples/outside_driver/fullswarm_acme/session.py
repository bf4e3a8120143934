"""Runs the protocol with one Scout as a state machine: bytes and time in, bytes out; no port, thread or clock."""

import math

from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Limits, Reading, Twist
from fullswarm.drivers.guardian import StopPlan
from fullswarm.drivers.linked import LinkSession, Odometer

from fullswarm_acme.protocol import Drive, Enable, Hello, LineParser, Robot, State, line

LIMITS = Limits(speed_m_s=0.5, turn_rad_s=2.0, accel_m_s2=2.0, turn_accel_rad_s2=8.0, can_reverse=False)
SILENT_S = 0.5
PERIOD_S = 0.05
AGAIN_S = 0.2  # between two repeats of what the robot does not confirm
STOP, RELEASE = line(Drive.of(STAND)), line(Enable(on=False))
PLAN = StopPlan(((0.0, STOP), (0.05, STOP), (0.1, STOP)), leave=((1.0, RELEASE),))
"""What the guardian sends when this process is killed or paused: the robot itself would drive on for a second."""


class Session(LinkSession[bytes]):
    """One Scout."""

    firmware = ""

    def __init__(self) -> None:
        self._parser, self._odometer = LineParser(), Odometer()
        self._robot: Robot | None = None
        self._received_s = self._sent_s = self._asked_s = -math.inf
        self._mode, self._target = "", STAND
        self._activating = False  # activate() was called
        self._enabled = False  # and ENABLE sent, after the robot was seen idle

    # ------------------------------------------------------------ the link
    def linked(self, now_s: float) -> None:
        """Begin anew: there is a connection."""
        self._parser, self._mode, self._asked_s = LineParser(), "", -math.inf

    def lost(self, reason: str, now_s: float) -> None:
        """Note that there is no connection, or that the guardian has stopped the robot."""
        self._stand()
        super().lost(reason, now_s)

    def received(self, chunk: bytes, now_s: float) -> None:
        """Take bytes."""
        for message in self._parser.feed(chunk):
            if isinstance(message, State) and self._robot is not None:
                self._take(message, now_s)
            elif isinstance(message, Robot):
                if self._robot is not None and message.boot != self._robot.boot:
                    self._odometer.rebase()  # it counts from zero again
                self._robot, self.firmware = message, f"{message.model} {message.firmware}"

    def tick(self, now_s: float) -> list[bytes]:
        """Return what is to be sent now."""
        if self.state in (Lifecycle.READY, Lifecycle.ACTIVE):
            if now_s - self._received_s > SILENT_S:
                self.lost(f"nothing received for {SILENT_S} s: is it on, and in reach of the network?", now_s)
            elif self.unguarded:
                self.lost(self.unguarded, now_s)
        if self.state is Lifecycle.ACTIVE:
            if now_s - self._sent_s < PERIOD_S:
                return []
            self._sent_s = now_s
            return [line(Drive.of(self._target))]
        if now_s - self._asked_s < AGAIN_S:
            return []
        self._asked_s = now_s
        if self.state is Lifecycle.READY:
            self._enabled = self._enabled or (self._activating and self._mode == "IDLE")
            return [line(Enable(on=True))] if self._enabled else [RELEASE] if self._mode == "ON" else []
        return [RELEASE, line(Hello())]  # its last driver may have been killed while it drove

    def next_due_s(self, now_s: float) -> float:
        """Return when there is something to send next: a stop at once."""
        return max(now_s, min(self._sent_s + PERIOD_S, super().next_due_s(now_s)))

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
        target = Drive.of(LIMITS.clip(twist)).twist
        if target == STAND != self._target:
            self._sent_s = -math.inf
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
        self._received_s, self._mode, battery = now_s, state.mode, state.percent / 100.0
        hazards = Hazard.BUMP if state.bumper else Hazard.NONE
        hazards |= Hazard.BATTERY_LOW if battery < 0.1 else Hazard.NONE
        hazards |= Hazard.ESTOP_BUTTON if state.mode == "ESTOP" else Hazard.NONE
        odometry = self._odometer.update(state.pose)
        self.reading = Reading(now_s, odometry, state.twist, hazards=hazards, battery=battery)
        if state.mode == "ESTOP":
            self.lost("its emergency stop button is pressed: release it", now_s)
        elif state.mode == "IDLE" and self.state is Lifecycle.ACTIVE:
            self.lost("it switched its motors off by itself", now_s)
        elif state.mode == "IDLE" and self.state in (Lifecycle.OPEN, Lifecycle.FAULT) and not self.unguarded:
            self.state, self.fault = Lifecycle.READY, ""
        elif state.mode == "ON" and self.state is Lifecycle.READY and self._enabled:
            self.state, self._activating, self._sent_s = Lifecycle.ACTIVE, False, -math.inf

    def _stand(self) -> None:
        self._target, self._sent_s, self._activating, self._enabled = STAND, -math.inf, False, False
