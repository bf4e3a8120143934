"""The conversation with the two controllers of a base as a state machine: frames and time in, frames out.

One faulted wheel stops both; silence is a stop; a stop is repeated until a heartbeat confirms it; after a fault
the way leads over OPEN to READY, never to ACTIVE.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from fullswarm.drivers.base import Hazard, Lifecycle, Reading, Twist
from fullswarm.drivers.can.kinematics import Odometry, WheelTrack, body_twist, wheel_speeds
from fullswarm.drivers.can.protocol import Beat, Frame, Mode, Motion, Power, Version, Want, WheelCodec
from fullswarm.drivers.guardian import StopPlan
from fullswarm.drivers.linked import LinkSession

PERIOD_S = 0.02  # of the set-points
EARLY_S = 0.001  # by which a wait may end too soon
ENGAGE_S = 0.5  # within which both wheels must confirm that they obey
SILENT_OPEN_S = 3.0  # after opening, until silence is a fault
RETRY_S = 0.5  # between two start sequences
BEAT_S = 0.1  # between polls, keep-alives and repeated stops
ASK_S = 1.0  # between questions for what changes slowly
HOLD_S = 1.0  # a fault stays visible at least that long
STOPPING_S = 0.5  # at most for rolling out before the motors are let go
STANDING_M_S = 0.01
PUSHED_M_S = 2.0  # a wheel pushed by hand may turn that fast
TRIPS, TRIPS_WITHIN_S = 3, 30.0  # so many faults of the robot while driving latch the fault
BATTERY_LOW = 0.15
ROLLED_OUT_S, REPEAT_S = 1.0, 0.05  # for so long, and so often, a guardian brakes

SILENT_S = 1.0
"""Without a heartbeat for that long a wheel counts as lost."""
BLIND_S = 0.5
"""Without a report of its motion for that long too: an agent does not drive on older readings."""
STUCK_S = 0.5
"""For so long a wheel may report a speed without counting."""

SILENCE = Beat(Mode.UNKNOWN)


@dataclass(slots=True)
class Axis:
    """One wheel and the newest that its controller has reported."""

    side: str
    codec: WheelCodec
    track: WheelTrack
    beat_s: float = -math.inf
    motion_s: float = -math.inf
    beat: Beat = SILENCE
    firmware: str = ""
    volts: float | None = None

    @property
    def name(self) -> str:
        """Return how messages call it."""
        return f"{self.side} wheel (node {self.codec.node})"

    def forget(self) -> None:
        """Forget when it last reported."""
        self.beat_s = self.motion_s = -math.inf

    def complaint(self, now_s: float) -> str:
        """Return what this wheel fails to report; empty when it is alive."""
        blind = now_s - self.motion_s > BLIND_S
        if now_s - self.beat_s > (BLIND_S / 2.0 if blind else SILENT_S):
            return f"no heartbeat from the {self.name}: check its power, node number and the bus' bitrate"
        if blind:
            return (
                f"no motion from the {self.name}: switch its cyclic messages on "
                "(ODrive: encoder estimates, VESC: CAN status 1 and 5)"
            )
        if self.track.stuck_for(now_s) > STUCK_S:
            return f"the encoder of the {self.name} is stuck: it reports a speed, but its position stays"
        return ""

    def well(self, started_s: float, now_s: float) -> bool:
        """Tell whether it has answered a start sequence in good health."""
        return self.beat_s > started_s and not (self.complaint(now_s) or self.unwell())

    def unwell(self) -> str:
        """Return what keeps it from driving although it is alive; empty: nothing."""
        if self.beat.error:
            return f"{self.name} reports {self.beat.error}"
        return f"{self.name} is busy: {self.beat.state}" if self.beat.mode is Mode.BUSY else ""


class Session(LinkSession[Frame]):
    """Two wheels driven as one, from open() to close(); odometry starts at zero.

    Parameters
    ----------
    volts
        Of the empty and the full battery; None: no battery reading.
    """

    closing_s = 1.0

    def __init__(
        self,
        codecs: tuple[WheelCodec, WheelCodec],
        base_m: float,
        limit_m_s: float,
        volts: tuple[float, float] | None,
        now_s: float,
    ) -> None:
        self._codecs, self._base_m, self._limit_m_s, self._volts = codecs, base_m, limit_m_s, volts
        self.urgent = True  # something waits to be sent: tick now
        self._due_s = now_s  # of the next set-points
        self._odometry = Odometry(self._base_m, max(PUSHED_M_S, 3.0 * self._limit_m_s))
        tracks = zip(("left", "right"), self._codecs, self._odometry.wheels, strict=True)
        self.axes = tuple(Axis(side, codec, track) for side, codec, track in tracks)
        self._target = (0.0, 0.0)
        self._since_s = now_s  # when the present state began
        self._engaging_s: float | None = None
        self._stopping_s: float | None = None
        self._start_s: float | None = None  # when the start sequence was sent last
        self._back_s = -math.inf  # when the bus came back
        self._next_beat_s = self._next_ask_s = -math.inf
        self._met = False  # has been READY
        self._trips: deque[float] = deque(maxlen=TRIPS)
        self._latched = ""  # why it stays in FAULT until it is opened anew; empty: it does not
        self._leaving = False
        self._bus_up = True
        # Brakes while this process is silent, and lets go once it has died.
        rounds, after = range(round(ROLLED_OUT_S / REPEAT_S)), (ROLLED_OUT_S, ROLLED_OUT_S + REPEAT_S)
        brakes = tuple((number * REPEAT_S, frame) for number in rounds for frame in self._driven(0.0, 0.0))
        self._plan = StopPlan(brakes, tuple((after_s, frame) for after_s in after for frame in self._released()))

    # ------------------------------------------------------------ what the driver is asked
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
        """Take a set-point; return what the wheels make of it."""
        del now_s
        moving = self._target != (0.0, 0.0)
        left, right = wheel_speeds(twist, self._base_m, self._limit_m_s)
        self._target = (self._codecs[0].quantised(left), self._codecs[1].quantised(right))
        self.urgent = self.urgent or (moving and self._target == (0.0, 0.0))
        return body_twist(*self._target, self._base_m)

    def halt(self, why: str, now_s: float) -> None:
        """Set both wheels to zero."""
        del why, now_s
        if self._target != (0.0, 0.0):
            self._stand()

    def closing(self, now_s: float) -> None:
        """Begin to close: stop, let go, never activate again."""
        self._leaving = True
        self.deactivate(now_s)
        self._next_beat_s = -math.inf
        self.urgent = True

    @property
    def at_rest(self) -> bool:
        """Whether nothing is left to do before the bus may be closed."""
        driving = any(axis.beat.mode is Mode.DRIVING for axis in self.axes)
        return not self._bus_up or (self._stopping_s is None and not self.urgent and not driving)

    def final_stop(self) -> tuple[Frame, ...]:
        """Return the frames that let both wheels go."""
        return self._released()

    def stop_plan(self, now_s: float) -> StopPlan[Frame] | None:
        """Return how a guardian brakes, while the wheels may be turning because of this driver."""
        del now_s
        drives = self.state is Lifecycle.ACTIVE or self._engaging_s is not None or self._stopping_s is not None
        return self._plan if drives else None

    def stopped_by_guardian(self, now_s: float) -> None:
        """Go on: the wheels were only braked, and obey the next set-points."""

    def linked(self, now_s: float) -> None:
        """Note that the bus was opened; a fault of the bus ends when both wheels report."""
        if self._bus_up:
            return
        self._bus_up = True
        self.fault = self._latched or "the bus is open again, waiting for both wheels"
        self._back_s = now_s
        self._next_beat_s = -math.inf
        self.urgent = True

    def lost(self, reason: str, now_s: float) -> None:
        """Note that the bus cannot be used: FAULT, and nothing known of the wheels."""
        if self._bus_up or self.state is not Lifecycle.FAULT:
            self._trip(reason, now_s)
        self._bus_up = False
        self.fault = f"{reason}; before that: {self._latched}" if self._latched else reason
        self._odometry.interrupt()
        for axis in self.axes:
            axis.forget()

    @property
    def firmware(self) -> str:
        """What the wheels report that they run, or what is known without; empty before they were READY."""
        generic = {axis.codec.generic_firmware for axis in self.axes} if self._met else set()
        reported = {axis.firmware for axis in self.axes} - {""}
        return ", ".join(sorted(reported or generic))

    # ------------------------------------------------------------ what the wheels report
    def received(self, chunk: Frame, now_s: float) -> None:
        """Take one frame; those of others are ignored."""
        for side, axis in enumerate(self.axes):
            report = axis.codec.decode(chunk)
            if report is None:
                continue
            if isinstance(report, Beat):
                axis.beat, axis.beat_s = report, now_s
                self._on_beat(axis, now_s)
            elif isinstance(report, Motion):
                if report.speed_m_s is not None:  # a count alone does not show whether the wheel stands
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
        odometry = self._odometry
        return Reading(now_s, odometry.pose, odometry.twist, odometry.breaks, hazards=hazards, battery=battery)

    def _battery(self) -> float | None:
        """Return how full it is by the lower of the two voltages."""
        volts = [axis.volts for axis in self.axes if axis.volts is not None]
        if self._volts is None or not volts:
            return None
        empty, full = self._volts
        return max(0.0, min(1.0, (min(volts) - empty) / (full - empty)))

    def _on_beat(self, axis: Axis, now_s: float) -> None:
        beat = axis.beat
        if beat.estop:  # never cleared from here: a person has pressed it
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
    def next_due_s(self, now_s: float) -> float:
        """Return the time of the next set-points: at once while something is urgent."""
        return now_s if self.urgent else self._due_s

    def tick(self, now_s: float) -> list[Frame]:
        """Return the frames that are due: at 50 Hz, and at once while something is urgent."""
        if now_s >= self._due_s - EARLY_S:
            self._due_s = max(self._due_s + PERIOD_S, now_s)  # missed periods are skipped
        elif not self.urgent:
            return []
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
        if due and self._bus_up:
            frames += self._questions(now_s)
        return frames

    def _questions(self, now_s: float) -> list[Frame]:
        """Return the requests for what the wheels do not report by themselves."""
        slow = Want(0)
        if now_s >= self._next_ask_s:
            self._next_ask_s = now_s + ASK_S
            slow = Want.VERSION if self._volts is None else Want.VERSION | Want.POWER
        frames: list[Frame] = []
        for axis in self.axes:
            wants = Want.BEAT | (slow & ~Want.VERSION if axis.firmware else slow)
            frames += axis.codec.poll(wants | Want.MOTION if now_s - axis.motion_s > BEAT_S / 2.0 else wants)
        return frames

    def _tick_open(self, now_s: float, due: bool, frames: list[Frame]) -> None:
        """Listen, then clear and configure, then wait until both wheels are well."""
        alive = all(now_s - axis.beat_s <= SILENT_S for axis in self.axes)
        started_s = self._start_s
        if not alive:
            frames += self._released() if due else ()
        elif started_s is None or now_s - started_s >= RETRY_S:
            self._start_s = now_s
            for axis in self.axes:
                frames += axis.codec.release() + axis.codec.start()
        elif not self.unguarded and all(axis.well(started_s, now_s) for axis in self.axes):
            self._met = True
            self._enter(Lifecycle.READY, now_s)
            return
        if now_s - self._since_s > SILENT_OPEN_S:
            complaints = [axis.complaint(now_s) or axis.unwell() for axis in self.axes]
            self._trip("; ".join(filter(None, [*complaints, self.unguarded])), now_s)

    def _tick_ready(self, now_s: float, due: bool, frames: list[Frame]) -> None:
        if self._silent(now_s):
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
        if self._silent(now_s):
            return
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
            if now_s - max(self._since_s, self._back_s) > SILENT_OPEN_S:  # by now this is what keeps it in FAULT
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

    def _silent(self, now_s: float) -> bool:
        """Go to FAULT and return True when a wheel has gone silent, or no guardian watches any more."""
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
