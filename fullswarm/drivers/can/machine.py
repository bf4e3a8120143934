"""The lifecycle of a base, without input or output: frames and the time go in, frames come out.

One faulted wheel stops both; silence is a stop; a stop is repeated until a heartbeat confirms it; after a fault
the way leads over OPEN to READY, never to ACTIVE. The driver calls `receive` and `tick`; nothing here waits.
"""

from __future__ import annotations

import math
from collections import deque

from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Reading, Twist
from fullswarm.drivers.can.axis import SILENT_S, Axis
from fullswarm.drivers.can.kinematics import Odometry, body_twist, wheel_speeds
from fullswarm.drivers.can.protocol import Beat, Frame, Mode, Motion, Power, Version, Want, WheelCodec

COMMAND_TTL_S = 0.3  # without `command` for that long the set-points are zero
ENGAGE_S = 0.5  # within which both wheels must confirm that they obey
PATIENCE_S = 3.0  # after opening, until silence is called a fault
RETRY_S = 0.5  # between two start sequences
BEAT_S = 0.1  # between polls, keep-alives and repeated stops
TELL_S = 1.0  # between questions for what changes slowly
HOLD_S = 1.0  # a fault stays to be seen at least that long
STOPPING_S = 0.5  # at most for rolling out before the motors are let go
STANDING_M_S = 0.01
PUSHED_M_S = 2.0  # a wheel pushed by hand may turn that fast
TRIPS, TRIPS_WITHIN_S = 3, 30.0  # so many faults of the robot while driving latch the fault
BATTERY_LOW = 0.15
ROLLED_OUT_S, REPEAT_S = 1.0, 0.05  # for so long, and so often, a guardian brakes


class BaseMachine:
    """Two wheels driven as one. All times are seconds of one monotonic clock.

    Parameters
    ----------
    volts
        Of the empty and the full battery; None: no battery reading.
    """

    def __init__(
        self,
        codecs: tuple[WheelCodec, WheelCodec],
        base_m: float,
        limit_m_s: float,
        volts: tuple[float, float] | None = None,
    ) -> None:
        self._codecs, self._base_m, self._limit_m_s, self._volts = codecs, base_m, limit_m_s, volts
        self.state = Lifecycle.CLOSED
        self.fault = ""
        self.reading: Reading | None = None
        self.urgent = False  # something waits to be sent: tick now
        self.unguarded = ""  # why nothing would stop the wheels if this process died: bars motion
        self._reset(-math.inf)

    def _reset(self, now_s: float) -> None:
        self._odometry = Odometry(self._base_m, max(PUSHED_M_S, 3.0 * self._limit_m_s))
        tracks = zip(("left", "right"), self._codecs, self._odometry.wheels, strict=True)
        self.axes = tuple(Axis(side, codec, track) for side, codec, track in tracks)
        self._target = (0.0, 0.0)
        self._commanded_s = -math.inf
        self._since_s = now_s  # when the present state began
        self._engaging_s: float | None = None
        self._stopping_s: float | None = None
        self._start_s: float | None = None  # when the start sequence was sent last
        self._back_s = -math.inf  # when the bus came back
        self._next_beat_s = self._next_tell_s = -math.inf
        self._met = False  # has been READY
        self._trips: deque[float] = deque(maxlen=TRIPS)
        self._latched = ""  # why it stays in FAULT until it is opened anew; empty: it does not
        self._leaving = False
        self._bus_up = True

    # ------------------------------------------------------------ what the driver is asked
    def opened(self, now_s: float) -> None:
        """CLOSED → OPEN with the bus in hand; odometry starts at zero."""
        self._reset(now_s)
        self.reading = None
        self._enter(Lifecycle.OPEN, now_s)

    def activate(self, now_s: float) -> None:
        """Ask both wheels into closed loop; ACTIVE follows when both confirm. Ignored unless READY."""
        if self.state is Lifecycle.READY and self._engaging_s is None and not self._leaving:
            self._engaging_s, self._stopping_s = now_s, None
            self._next_beat_s = -math.inf
            self.urgent = True

    def deactivate(self, now_s: float) -> None:
        """Wheels to zero, then let go; READY at once."""
        if self.state is Lifecycle.ACTIVE or self._engaging_s is not None:
            self._stopping_s = now_s
            self._enter(Lifecycle.READY, now_s)

    def command(self, twist: Twist, now_s: float) -> Twist:
        """Take a set-point; return what the wheels make of it. ``ValueError`` if not finite, and a stop."""
        if not (math.isfinite(twist.linear_m_s) and math.isfinite(twist.angular_rad_s)):
            self._stand()
            raise ValueError(f"a twist must be finite, not {twist}")
        if self.state is not Lifecycle.ACTIVE:
            return STAND
        moving = self._target != (0.0, 0.0)
        left, right = wheel_speeds(twist, self._base_m, self._limit_m_s)
        self._target = (self._codecs[0].quantised(left), self._codecs[1].quantised(right))
        self._commanded_s = now_s
        self.urgent = self.urgent or (moving and self._target == (0.0, 0.0))
        return body_twist(*self._target, self._base_m)

    def leave(self, now_s: float) -> None:
        """Begin to close: stop, let go, never activate again."""
        self._leaving = True
        self.deactivate(now_s)
        self._next_beat_s = -math.inf
        self.urgent = True

    @property
    def drives(self) -> bool:
        """Tell whether the wheels may be turning because of us."""
        return self.state is Lifecycle.ACTIVE or self._engaging_s is not None or self._stopping_s is not None

    def stop_frames(self) -> tuple[list[tuple[float, Frame]], list[tuple[float, Frame]]]:
        """Return what a guardian sends, and when: brakes while this process is silent, and lets go once it is gone."""
        rounds = range(round(ROLLED_OUT_S / REPEAT_S))
        brakes = [(number * REPEAT_S, frame) for number in rounds for frame in self._driven(0.0, 0.0)]
        lets_go = [(ROLLED_OUT_S + after_s, frame) for after_s in (0.0, REPEAT_S) for frame in self._released()]
        return brakes, lets_go

    @property
    def at_rest(self) -> bool:
        """Tell whether nothing is left to do before the bus may be closed."""
        if not self._bus_up:
            return True
        return self._stopping_s is None and all(axis.beat.mode is not Mode.DRIVING for axis in self.axes)

    def closed(self, now_s: float) -> tuple[Frame, ...]:
        """Whatever → CLOSED; returns the last frames for the bus: both wheels let go."""
        self._enter(Lifecycle.CLOSED, now_s)
        return self._released() if self._bus_up else ()

    def bus_lost(self, why: str, now_s: float) -> None:
        """The bus cannot be used (still, or any more): FAULT, and nothing known of the wheels."""
        if self._bus_up or self.state is not Lifecycle.FAULT:
            self._trip(why, now_s)
        self._bus_up = False
        self.fault = f"{why}; before that: {self._latched}" if self._latched else why
        for axis in self.axes:
            axis.forget()

    def bus_back(self, now_s: float) -> None:
        """The bus was opened again; the fault ends when both wheels are heard."""
        self._bus_up = True
        self.fault = self._latched or "the bus is open again, waiting for both wheels"
        self._back_s = now_s
        self._next_beat_s = -math.inf
        self.urgent = True

    @property
    def firmware(self) -> str:
        """Return what the wheels say they run, or what is known without; empty before they were READY."""
        generic = {axis.codec.generic_firmware for axis in self.axes} if self._met else set()
        told = {axis.firmware for axis in self.axes} - {""}
        return ", ".join(sorted(told or generic))

    # ------------------------------------------------------------ what the wheels tell
    def receive(self, frame: Frame, now_s: float) -> None:
        """Take in one frame; those of others are ignored."""
        for side, axis in enumerate(self.axes):
            report = axis.codec.decode(frame)
            if report is None:
                continue
            if isinstance(report, Beat):
                axis.beat, axis.beat_s = report, now_s
                self._on_beat(axis, now_s)
            elif isinstance(report, Motion):
                if report.speed_m_s is not None:  # a count alone does not tell whether the wheel stands
                    axis.motion_s = now_s
                axis.volts = report.power.volts if report.power else axis.volts
                if self._odometry.update(side, report, now_s):
                    self.reading = self._read(now_s)
            elif isinstance(report, Power):
                axis.volts = report.volts
            elif isinstance(report, Version):
                axis.firmware = report.firmware

    def _read(self, now_s: float) -> Reading:
        hazards = Hazard.ESTOP_BUTTON if any(axis.beat.estop for axis in self.axes) else Hazard.NONE
        battery = self._battery()
        if battery is not None and battery < BATTERY_LOW:
            hazards |= Hazard.BATTERY_LOW
        return Reading(now_s, self._odometry.pose, self._odometry.twist, hazards=hazards, battery=battery)

    def _battery(self) -> float | None:
        """Return how full it is by the lower of the two voltages."""
        told = [axis.volts for axis in self.axes if axis.volts is not None]
        if self._volts is None or not told:
            return None
        empty, full = self._volts
        return max(0.0, min(1.0, (min(told) - empty) / (full - empty)))

    def _on_beat(self, axis: Axis, now_s: float) -> None:
        beat = axis.beat
        if beat.estop:  # never cleared from here: whoever pressed it must mean it
            if self.state is Lifecycle.FAULT:
                self.fault = _estopped(axis)
            else:
                self._trip(_estopped(axis), now_s)
        elif self.state in (Lifecycle.READY, Lifecycle.ACTIVE):
            if beat.error:
                self._trip(f"{axis.name} reports {beat.error}", now_s, own=True)
            elif self.state is Lifecycle.ACTIVE and beat.mode not in (Mode.DRIVING, Mode.UNKNOWN):
                why = f"{axis.name} left closed loop by itself (now {beat.state}), no error given"
                self._trip(why, now_s, own=True)

    # ------------------------------------------------------------ what goes to the wheels
    def tick(self, now_s: float) -> list[Frame]:
        """Return the frames that are due. Call at 50 Hz, and at once while `urgent`."""
        self.urgent = False
        due = now_s >= self._next_beat_s
        if due:
            self._next_beat_s = now_s + BEAT_S
        frames: list[Frame] = []
        if self.state is Lifecycle.OPEN:
            self._tick_open(now_s, due, frames)
        elif self.state is Lifecycle.READY:
            self._tick_ready(now_s, due, frames)
        elif self.state is Lifecycle.ACTIVE:
            self._tick_active(now_s, frames)
        if self.state is Lifecycle.FAULT and self._bus_up:  # also when it has just become one
            self._tick_fault(now_s, due or self.urgent, frames)
            self.urgent = False
        if due and self._bus_up and self.state is not Lifecycle.CLOSED:
            frames += self._questions(now_s)
        return frames

    def _questions(self, now_s: float) -> list[Frame]:
        """Return the requests for what the wheels do not tell by themselves."""
        slow = Want(0)
        if now_s >= self._next_tell_s:
            self._next_tell_s = now_s + TELL_S
            slow = Want.VERSION if self._volts is None else Want.VERSION | Want.POWER
        frames: list[Frame] = []
        for axis in self.axes:
            wants = Want.BEAT | (slow & ~Want.VERSION if axis.firmware else slow)
            frames += axis.codec.poll(wants | Want.MOTION if now_s - axis.motion_s > BEAT_S / 2.0 else wants)
        return frames

    def _tick_open(self, now_s: float, due: bool, frames: list[Frame]) -> None:
        """Listen, then clear and configure, then wait until both wheels are well."""
        heard = all(now_s - axis.beat_s <= SILENT_S for axis in self.axes)
        started_s = self._start_s
        if not heard:
            frames += self._released() if due else ()
        elif started_s is None or now_s - started_s >= RETRY_S:
            self._start_s = now_s
            for axis in self.axes:
                frames += axis.codec.release() + axis.codec.start()
        elif not self.unguarded and all(axis.well(started_s, now_s) for axis in self.axes):
            self._met = True
            self._enter(Lifecycle.READY, now_s)
            return
        if now_s - self._since_s > PATIENCE_S:
            complaints = [axis.complaint(now_s) or axis.unwell() for axis in self.axes]
            self._trip("; ".join(filter(None, [*complaints, self.unguarded])), now_s)

    def _tick_ready(self, now_s: float, due: bool, frames: list[Frame]) -> None:
        if self._lost(now_s):
            return
        if self._engaging_s is not None:
            self._tick_engaging(self._engaging_s, now_s, due, frames)
        elif self._stopping_s is not None:
            left, right = self._odometry.wheels
            standing = max(abs(left.speed_m_s), abs(right.speed_m_s)) <= STANDING_M_S
            if standing or now_s - self._stopping_s >= STOPPING_S:
                self._stopping_s = None
                frames += self._released()
            else:
                frames += self._driven(0.0, 0.0)
        elif due:
            driving = self._leaving or any(axis.beat.mode is Mode.DRIVING for axis in self.axes)
            for axis in self.axes:
                frames += axis.codec.release() if driving else axis.codec.keep_alive()

    def _tick_engaging(self, since_s: float, now_s: float, due: bool, frames: list[Frame]) -> None:
        obeying = [axis.beat_s > since_s and axis.beat.mode in (Mode.DRIVING, Mode.UNKNOWN) for axis in self.axes]
        if all(obeying):
            self._stand()
            self._enter(Lifecycle.ACTIVE, now_s)
            frames += self._driven(0.0, 0.0)
        elif now_s - since_s > ENGAGE_S:
            axis = self.axes[obeying.index(False)]
            state = f" (now {axis.beat.state})" if axis.beat.state else ""
            self._trip(
                f"{axis.name} did not enter closed loop within {ENGAGE_S} s{state}: are motor and encoder calibrated?",
                now_s,
                own=True,
            )
        else:
            for axis, obeys in zip(self.axes, obeying, strict=True):
                if obeys or not due:
                    frames += axis.codec.drive(0.0) if obeys else ()
                else:
                    frames += axis.codec.engage()

    def _tick_active(self, now_s: float, frames: list[Frame]) -> None:
        if self._lost(now_s):
            return
        if now_s - self._commanded_s > COMMAND_TTL_S:
            self._target = (0.0, 0.0)
        frames += self._driven(*self._target)

    def _tick_fault(self, now_s: float, due: bool, frames: list[Frame]) -> None:
        """Keep both wheels let go; after a while clear the errors and, when both are well, start anew."""
        if due:
            frames += self._released()
        if self._latched or self._leaving or now_s - self._since_s < HOLD_S:
            return
        complaints = [text for axis in self.axes if (text := axis.complaint(now_s))]
        if self.unguarded:
            complaints.append(self.unguarded)
        if complaints:
            if now_s - max(self._since_s, self._back_s) > PATIENCE_S:  # by now this is what keeps it in FAULT
                self.fault = "; ".join(complaints)
            return
        if any(axis.beat.estop for axis in self.axes):
            return
        if not any(axis.beat.error for axis in self.axes):
            self._enter(Lifecycle.OPEN, now_s)
        elif self._start_s is None or now_s - self._start_s >= RETRY_S:
            self._start_s = now_s
            for axis in self.axes:
                frames += axis.codec.start()

    def _lost(self, now_s: float) -> bool:
        """Go to FAULT and return True when a wheel has gone silent, or nothing watches over us any more."""
        complaints = [text for axis in self.axes if (text := axis.complaint(now_s))]
        complaints += [self.unguarded] if self.unguarded else []
        if complaints:
            self._trip("; ".join(complaints), now_s)
        return bool(complaints)

    def _driven(self, left_m_s: float, right_m_s: float) -> tuple[Frame, ...]:
        left, right = self._codecs
        return left.drive(left_m_s) + right.drive(right_m_s)

    def _released(self) -> tuple[Frame, ...]:
        left, right = self._codecs
        return left.release() + right.release()

    def _stand(self) -> None:
        self._target = (0.0, 0.0)
        self._commanded_s = -math.inf
        self.urgent = True

    # ------------------------------------------------------------ states
    def _trip(self, why: str, now_s: float, *, own: bool = False) -> None:
        """Any state → FAULT; both wheels are let go with the next tick. `own`: the robot's fault, not the link's."""
        if own and (self.state is Lifecycle.ACTIVE or self._engaging_s is not None):
            self._trips.append(now_s)
            if len(self._trips) == TRIPS and now_s - self._trips[0] < TRIPS_WITHIN_S:
                why += f"; {TRIPS} faults within {TRIPS_WITHIN_S:.0f} s: find the cause, then restart the agent"
                self._latched = why
        self._stopping_s = None
        self._enter(Lifecycle.FAULT, now_s, why)

    def _enter(self, state: Lifecycle, now_s: float, fault: str = "") -> None:
        self.state, self.fault, self._since_s = state, fault, now_s
        self._engaging_s = self._start_s = None
        self._next_beat_s = -math.inf
        self._stand()


def _estopped(axis: Axis) -> str:
    return f"{axis.name} reports {axis.beat.error}: release the stop and clear the error at the controller"
