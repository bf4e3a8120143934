"""Runs the protocol with one e-puck2 as a state machine: bytes and time in, bytes out; no port, thread or clock."""

import math
from collections import deque

from fullswarm.drivers.base import STAND, Description, Hazard, Lifecycle, Limits, Pose, Reading, Twist
from fullswarm.drivers.linked import LinkSession
from fullswarm.geometry import wrap

from fullswarm_epuck2 import protocol as p

TOP_M_S = p.MOST_STEPS * p.STEP_M
LIMITS = Limits(TOP_M_S, 2.0 * TOP_M_S / p.BASE_M, accel_m_s2=1.0, turn_accel_rad_s2=20.0)
DESCRIPTION = Description("GCtronic", "e-puck2", radius_m=0.036, limits=LIMITS, watchdog_s=None)
PERIOD_S, SILENT_S = 0.05, 0.5
ANSWER_S, QUIET_S = 0.2, 0.1
"""Longest wait for an answer; then the robot is stopped, and what it still sends is ignored for the second."""
PAUSED_S = 0.3
"""A guardian has stopped the robot when this process did not run for so long."""
MEASURE_S = 0.1
"""The speed is that of the step counters over so long."""
STRANGE = 3
"""So many answers whose counters do not fit those before: the robot has restarted."""
LONGEST = 256


class Session(LinkSession[bytes]):
    """One e-puck2."""

    firmware = "advanced sercom v2"

    def __init__(self) -> None:
        self._buffer = b""
        self._target = self._asked = p.STOP
        self._asked_s: float | None = None  # of the request that waits for its answer
        self._sent_s = self._answered_s = self._ticked_s = -math.inf
        self._quiet_until_s = -math.inf
        self._out: list[bytes] = []
        self._counters: p.Steps | None = None
        self._strange, self._breaks = 0, 0
        self._pose = Pose(0.0, 0.0, 0.0)
        self._history: deque[tuple[float, float, float]] = deque()  # time, way, turn

    # ------------------------------------------------------------ the link
    def linked(self, now_s: float) -> None:
        """Begin anew: the port is open; the last driver may have been killed while it drove."""
        self._resync(now_s)

    def lost(self, reason: str, now_s: float) -> None:
        """Note that nothing answers, or the port is gone."""
        super().lost(reason, now_s)
        self._target = p.STOP

    def received(self, chunk: bytes, now_s: float) -> None:
        """Take bytes."""
        if now_s < self._quiet_until_s or self._asked_s is None:
            return  # the end of something that nobody waits for
        self._buffer = (self._buffer + chunk)[-LONGEST:]
        found = p.answer(self._buffer, self._asked)
        if found is not None:
            self._buffer, self._asked_s = b"", None
            self._take(found, now_s)

    def tick(self, now_s: float) -> list[bytes]:
        """Return what is to be sent now."""
        paused, self._ticked_s = now_s - self._ticked_s > PAUSED_S, now_s
        if paused and self.state is Lifecycle.ACTIVE:
            self.lost("this process did not run for a while: its commands were too late", now_s)
        if self.state in (Lifecycle.READY, Lifecycle.ACTIVE) and now_s - self._answered_s > SILENT_S:
            self.lost(f"no answer for {SILENT_S} s: is it on, with the selector at 3 or 8?", now_s)
        if self._asked_s is not None and now_s - self._asked_s > ANSWER_S:
            self._resync(now_s)
        due = now_s >= self._quiet_until_s and self._asked_s is None and now_s - self._sent_s >= PERIOD_S
        if due:
            self._asked, self._asked_s, self._sent_s, self._buffer = self._target, now_s, now_s, b""
            self._out.append(p.request(self._target))
        out, self._out = self._out, []
        return out

    def next_due_s(self, now_s: float) -> float:
        """Return when there is something to send next: a stop at once."""
        return now_s if self._out else super().next_due_s(now_s)

    # ------------------------------------------------------------ the agent
    def deactivate(self, now_s: float) -> None:
        """ACTIVE → READY with the wheels at zero."""
        if self.state is Lifecycle.ACTIVE:
            self.command(STAND, now_s)
            self.state = Lifecycle.READY

    def command(self, twist: Twist, now_s: float) -> Twist:
        """Take a set-point; return what is applied in whole steps."""
        target = p.to_steps(LIMITS.clip(twist))
        if target == p.STOP != self._target:
            self._out.append(p.drive(p.STOP))  # behind a request that is on its way, not after its answer
        self._target = target
        return p.to_twist(target)

    def final_stop(self) -> list[bytes]:
        """Return zero."""
        return [p.PARK]

    # ------------------------------------------------------------ within
    def _resync(self, now_s: float) -> None:
        """Stop it, and forget what it sends until it is quiet."""
        self._out = [p.RESYNC]
        self._buffer, self._asked_s, self._quiet_until_s = b"", None, now_s + QUIET_S

    def _take(self, found: p.Answer, now_s: float) -> None:
        if not self._fits(found.counters, now_s):
            return
        self._answered_s = now_s
        hazards = Hazard.BATTERY_LOW if found.charge < 0.1 else Hazard.NONE
        self.reading = Reading(
            now_s, self._pose, self._speed(now_s), self._breaks, hazards=hazards, battery=found.charge
        )
        if self.state in (Lifecycle.OPEN, Lifecycle.FAULT) and not self.unguarded:
            self.state, self.fault = Lifecycle.READY, ""

    def _fits(self, counters: p.Steps, now_s: float) -> bool:
        """Move on by the counters; False: noise, or a restart, which the next answers will show."""
        old = self._counters or counters
        left, right = p.difference(counters.left, old.left), p.difference(counters.right, old.right)
        passed_s = min(max(now_s - self._answered_s, PERIOD_S), SILENT_S)
        if max(abs(left), abs(right)) > 1.5 * p.MOST_STEPS * (passed_s + ANSWER_S):
            self._strange += 1
            if self._strange < STRANGE:
                return False
            left = right = 0
            self._breaks += 1
        self._counters, self._strange = counters, 0
        way_m, turn_rad = (left + right) * p.STEP_M / 2.0, (right - left) * p.STEP_M / p.BASE_M
        middle = self._pose.heading_rad + turn_rad / 2.0
        self._pose = Pose(
            self._pose.x_m + way_m * math.cos(middle), self._pose.y_m + way_m * math.sin(middle),
            wrap(self._pose.heading_rad + turn_rad),
        )  # fmt: skip
        self._history.append((now_s, way_m, turn_rad))
        return True

    def _speed(self, now_s: float) -> Twist:
        while len(self._history) > 2 and now_s - self._history[1][0] >= MEASURE_S:
            self._history.popleft()
        passed_s = now_s - self._history[0][0]
        if passed_s <= 0.0 or passed_s > SILENT_S:
            return STAND
        later = list(self._history)[1:]
        return Twist(sum(way for _, way, _ in later) / passed_s, sum(turn for _, _, turn in later) / passed_s)
