"""The conversation with one Create as a state machine: bytes and time in, bytes and state out. No port, no thread.

::

    linked() -> OPEN: 145 0 0, 128, 148 -> first good frame in Passive mode -> READY (wheels cannot move)
    READY -> activate(): 131 -> packet 35 shows Safe -> 145 0 0 -> ACTIVE
    ACTIVE -> the robot falls to Passive by itself (cliff, wheel drop, charger) -> READY, third time in 10 s -> FAULT
    ACTIVE -> dock(): 143, the robot drives by itself -> on its dock -> READY; deactivate() or silence stops it
    ACTIVE -> a set-point neither confirmed nor followed for 1 s (its sensors are stuck) -> FAULT, hello again
    READY, ACTIVE -> no good frame for 0.5 s -> FAULT, hello again each 0.5 s -> READY
    FAULT of three falls -> 10 s in a row without cliff, wheel drop, charger or silence -> READY

Safe mode, never Full: the robot's own reflexes stay on. It has no command timeout, so :meth:`Session.tick` repeats a
set-point until packets 41 and 42 confirm it: for ever where a slow stream has no room for both.

Ten calm seconds are what a person needs to put the robot down; READY moves nothing, and the task that drove it has
ended with the FAULT, so that motion takes a new request.

In Passive mode a Create falls asleep after five minutes, and its serial port with it. Only a low pulse at its BRC pin
(pin 5 of the connector) wakes it again; many cables do not have that line, and a pseudo-terminal has none. So the line
is a function that the caller provides (:data:`Brc`), for a GPIO, an RTS line or a test.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from fullswarm.drivers.actuators import ActuatorValue
from fullswarm.drivers.base import STAND, Lifecycle, Reading, Twist
from fullswarm.drivers.create_oi.odometry import Odometry
from fullswarm.drivers.create_oi.panel import Panel
from fullswarm.drivers.create_oi.protocol import (
    Mode,
    Op,
    Sensors,
    StreamParser,
    drive_direct,
    frame_size,
    simple,
    stream,
)
from fullswarm.drivers.create_oi.senses import Banner, Power, Senses, charges, power, stream_ids, wheel_speeds
from fullswarm.drivers.create_oi.settings import Settings
from fullswarm.drivers.linked import TICK_S, LinkSession
from fullswarm.errors import DriverError
from fullswarm.reasons import NONE, Reason, given

SILENT_S = 0.5
HELLO_PERIOD_S, HELLO_GAP_S, HELLOS = 0.5, 0.05, 10
CONFIRM_S = 0.5
"""For the mode asked for to show up in packet 35."""
REPEAT_S = 0.06
"""Between two repeats of a set-point or a mode that the robot does not confirm."""
STUCK_S = 1.0
"""A set-point neither confirmed nor followed for so long: what the robot reports is not true."""
FALLS, FALL_WINDOW_S = 3, 10.0
CALM_S = 10.0
NEWS_S = 2.0
"""For so long after motion was asked for, or ended, what bars the robot is reported as its fault."""
PULSE_S = 0.7
"""Longer than 0.5 s: three pulses of 0.05 to 0.5 s after power-on switch the robot to 19200 baud."""
PULSE_AGAIN_S = 5.0
KEEP_S = 60.0
NUDGE_S = 240.0
"""Without a line: so often Safe mode, with the wheels at zero, for some 30 ms. Not documented by the maker."""

Brc = Callable[[bool], None]
"""Called with True to pull the BRC pin low, with False to let go. Must return at once: the link waits for it."""

PARK = drive_direct(0, 0) + simple(Op.START)
"""Stops the wheels and takes the drive away. Begins with zero: mode changes alone do not stop every firmware."""


class Waking:
    """Says when to pulse, or to nudge where there is no line.

    Parameters
    ----------
    brc
        None: this robot cannot be woken.
    """

    def __init__(self, brc: Brc | None) -> None:
        self._brc = brc
        self._low = False
        self._pulsed_s = -math.inf
        self._active_s = -math.inf

    @property
    def can_wake(self) -> bool:
        """There is a line."""
        return self._brc is not None

    def active(self, now_s: float) -> None:
        """Note that the robot was out of Passive mode, or has just answered: five minutes begin anew."""
        self._active_s = now_s

    def tick(self, now_s: float, asleep: bool) -> bool:
        """Do what is due on the line; `asleep`: it does not answer. Return whether to nudge the robot instead."""
        if self._brc is None:
            return not asleep and now_s - self._active_s > NUDGE_S
        if self._low:
            if now_s - self._pulsed_s >= PULSE_S:
                self.release()
        elif (
            now_s - self._pulsed_s >= PULSE_AGAIN_S if asleep else now_s - max(self._pulsed_s, self._active_s) >= KEEP_S
        ):
            self._low, self._pulsed_s = True, now_s
            self._brc(True)
        return False

    def release(self) -> None:
        """Let the line go."""
        if self._low and self._brc is not None:
            self._low = False
            self._brc(False)


class Session(LinkSession[bytes]):
    """One robot, from its port's opening to its closing. Not thread-safe.

    Parameters
    ----------
    brc
        The line that wakes the robot, if there is one; called from `tick`, `lost` and `closed`.
    """

    def __init__(self, settings: Settings, *, brc: Brc | None = None) -> None:
        self._out: list[bytes] = []  # to be sent
        self.blocked = ""  # why the robot left ACTIVE or does not become it
        self._cause = self._fault_cause = NONE  # what the robot sensed that has led to `blocked`, to `fault`
        self.docking = False
        generation = settings.generation
        self._settings, self._base_m = settings, generation.wheel_base_m
        self._ids = stream_ids(generation, settings.baud)
        self._parser = StreamParser(self._ids, both_checksums=generation.both_checksums)
        self._odometry, self._senses = Odometry(generation), Senses()
        self._waking, self._banner, self._panel = Waking(brc), Banner(), Panel()
        self._newest: Sensors | None = None
        self._met = False  # has been READY
        self._latched = ""  # the fault of too many falls
        self._calm_s = -math.inf  # since when nothing would make the robot fall again
        self._hello_s: float | None = None  # when to send the next hello; None: connected
        self._hellos = 0
        self._list_s: float | None = None
        self._bytes = self._mode = -1  # received since the first hello; newest mode
        self._good_bytes = self._skipped = 0  # `_bytes` at the newest frame; the parser's at the last activate()
        self._frame_s = self._sent_s = self._followed_s = -math.inf
        self._activate_by_s: float | None = None  # activation asked for, not confirmed
        self._safe_sent = False
        self._wheels = (0, 0)
        self._falls: list[float] = []
        self._barred_s = -math.inf  # when `blocked` was news

    def trouble(self, now_s: float) -> Reason:
        """Return the fault, or why motion that was asked for does not come about; false when there is neither.

        A robot on its charger that is not asked to drive is in no trouble.
        """
        if self.fault:
            return given(self.fault, self._fault_cause.code)
        barred = self.blocked and now_s - self._barred_s <= NEWS_S
        return given(self._about(self.blocked), self._cause.code) if barred else NONE

    @property
    def power(self) -> Power | None:
        """The battery as last reported."""
        return None if self._newest is None else power(self._newest)

    @property
    def firmware(self) -> str:
        """What the robot is and, if it was seen starting, the version it runs; empty before it answers."""
        if self._newest is None:
            return ""
        version = f", firmware {self._banner.version}" if self._banner.version else ""
        return f"Open Interface, {self._settings.generation.label}{version}"

    # ------------------------------------------------------------ link events
    def linked(self, now_s: float) -> None:
        """Greet the robot: its port has just been opened."""
        self.state, self.fault = Lifecycle.OPEN, ""
        self._out.clear()
        self._greet(now_s)

    def lost(self, reason: str, now_s: float) -> None:
        """Mark the port as gone."""
        del now_s
        self._fail(reason)
        self._hello_s = None
        self._forget()
        self._waking.release()

    def closed(self) -> None:
        """Let go of the BRC line."""
        self._waking.release()

    def final_stop(self) -> tuple[bytes]:
        """Return the stop that leaves the robot in Passive mode."""
        return (PARK,)

    def received(self, data: bytes, now_s: float) -> None:
        """Take bytes from the robot."""
        self._bytes += len(data)
        if self._hello_s is not None and self._banner.feed(data):
            self._odometry.restarted()
        for frame in self._parser.feed(data):
            self._take(frame.sensors, now_s)

    def next_due_s(self, now_s: float) -> float:
        """Return the time of the next tick: at once if there is something to send."""
        return now_s if self._out else now_s + TICK_S

    def tick(self, now_s: float) -> list[bytes]:
        """Do what is due; return what is to be sent."""
        if self._hello_s is not None:
            self._hello(now_s)
        elif now_s - self._frame_s > SILENT_S:
            self._fail(self._silence())
            self._greet(now_s)
            self._hello(now_s)
        elif self.state is Lifecycle.ACTIVE:
            self._watch(now_s)
        elif self._activate_by_s is not None and now_s > self._activate_by_s:
            self._forget()
            self._park(now_s)
            self._bar(f"the robot did not go into Safe mode within {CONFIRM_S} s: {self._unmoved()}", now_s)
        asleep = self._hello_s is not None and self._hellos > 1 and self._bytes == 0
        if self._waking.tick(now_s, asleep) and self.state is Lifecycle.READY and self._may_nudge():
            self._waking.active(now_s)
            self._sent_s = now_s
            self._out.append(simple(Op.SAFE))  # the next frame reports it, and is answered with Passive
        out, self._out = self._out, []
        return out

    # ------------------------------------------------------------ what the agent asks
    def activate(self, now_s: float) -> None:
        """Ask for Safe mode; refused while a cause to fall out of it lasts."""
        if self.state is not Lifecycle.READY or self._activate_by_s is not None:
            return
        if self._senses.cause:
            self._refuse(now_s)
        else:  # what barred it before stands until it is ACTIVE: an agent tries again before anyone could read it
            self._activate_by_s, self._safe_sent = now_s + CONFIRM_S, False
            self._skipped = self._parser.skipped

    def deactivate(self, now_s: float) -> None:
        """Stop the wheels and take the drive away."""
        self._forget()
        if self.state is Lifecycle.ACTIVE:
            self._stand_down(now_s, "")

    def command(self, twist: Twist, now_s: float) -> Twist:
        """Turn the wheels; return what was sent to them, in whole mm/s."""
        if self.docking:
            return STAND
        wheels = wheel_speeds(twist, self._base_m, self._settings.speed_step_mm_s)
        if wheels != self._wheels:
            self._turn_wheels(wheels, now_s)
        left, right = wheels
        return Twist((left + right) / 2000.0, (right - left) / 1000.0 / self._base_m)

    def halt(self, why: str, now_s: float) -> None:
        """Stop the wheels, and a search for the dock."""
        if self.docking:
            self._stand_down(now_s, f"it stopped looking for its dock: {why}")
        elif self._wheels != (0, 0):
            self._turn_wheels((0, 0), now_s)

    def dock(self, now_s: float) -> None:
        """Let the robot look for its dock. Raises ``DriverError`` unless ACTIVE."""
        self._demand_active("look for its dock")
        self._turn_wheels((0, 0), now_s)
        self.docking = True
        self._out.append(simple(Op.DOCK))

    def send(self, data: bytes, what: str) -> None:
        """Send a command that only works in Safe mode. Raises ``DriverError`` unless ACTIVE."""
        self._demand_active(what)
        self._out.append(data)

    def actuate(self, name: str, value: ActuatorValue, now_s: float) -> None:
        """Note what a lamp, the display or the speaker shall do; the robot takes it while ACTIVE."""
        del now_s
        self._demand_active(f"set '{name}'")
        self._panel.put(name, value)

    def deferred(self, now_s: float) -> bytes | None:
        """Return a command of the panel; never before zero that has yet to be sent, or to be confirmed."""
        stopping = self._wheels == (0, 0) and self._moving
        return None if self._out or stopping or self.state is not Lifecycle.ACTIVE else self._panel.next(now_s)

    @property
    def _moving(self) -> bool:
        newest = self._newest
        return newest is not None and any((newest.left_mm_s, newest.right_mm_s))

    def _demand_active(self, what: str) -> None:
        if self.state is not Lifecycle.ACTIVE or self.docking:
            doing = "looking for its dock" if self.docking else self.state.value
            raise DriverError(f"it cannot {what} while {doing}", where=self._settings.path, hint="activate it first")

    # ------------------------------------------------------------ within
    def _greet(self, now_s: float) -> None:
        self._parser.reset()
        self._odometry.gap()
        self._waking.active(now_s)
        self._hello_s, self._hellos, self._list_s, self._bytes, self._mode = now_s, 0, None, 0, -1
        self.blocked = ""
        self._forget()

    def _hello(self, now_s: float) -> None:
        if self._list_s is not None and now_s >= self._list_s:
            self._list_s = None
            self._out.append(stream(self._ids))
        if self._hello_s is None or now_s < self._hello_s:
            return
        if self._hellos >= HELLOS and self.state is Lifecycle.OPEN:
            self._fail(self._no_answer())
        self._hellos += 1
        # A robot whose last driver was killed may still be driving: zero first, then the greeting.
        self._park(now_s)
        self._list_s, self._hello_s = now_s + HELLO_GAP_S, now_s + HELLO_PERIOD_S

    def _no_answer(self) -> str:
        if self._mode >= 0:
            return f"it answers, but stays in mode {self._mode} instead of Passive; some need '?mode_offset=1'"
        if self._bytes > 0:
            return "it sends bytes, but none that make a frame: wrong model or baud rate in its URL, or a bad cable?"
        asleep = "it does not wake up" if self._waking.can_wake else "it may be asleep: press its power button"
        return f"no answer: {asleep}, check the cable, and 'model' and 'baud' in its URL"

    def _silence(self) -> str:
        """Return what is known of a robot that has sent no good frame for `SILENT_S`."""
        bad = self._bytes - self._good_bytes
        if bad > frame_size(self._ids):  # more than the rest of a frame that a pulled cable cut
            return f"no good frame for {SILENT_S} s, only {bad} damaged bytes: check the cable and the baud rate"
        return f"silent for {SILENT_S} s: check its power and the cable; the driver keeps trying"

    def _unmoved(self) -> str:
        """Return what is known of why the robot does not take the mode that was asked for."""
        if self._newest is not None and self._newest.chargers:
            return "it is on its charger; take it off"
        lost = self._parser.skipped - self._skipped
        if lost:
            return f"the line is bad, {lost} bytes were damaged meanwhile; check the cable and its plugs"
        return (
            "the cause is unknown; check the cable, then restart the robot, which may need it after charging for days"
        )

    def _take(self, sensors: Sensors, now_s: float) -> None:
        self._frame_s, self._newest, self._good_bytes = now_s, sensors, self._bytes
        if not self._met:
            self._odometry.rebase()  # frames of an earlier drive may still be on the way
        moved = self._odometry.update(sensors, now_s)
        self._senses.note(sensors, now_s)
        self._mode = mode = (sensors.mode or 0) - self._settings.mode_offset
        if mode != Mode.PASSIVE:
            self._waking.active(now_s)
        if self._hello_s is not None:
            if mode == Mode.PASSIVE:
                self._settle(now_s)
        elif self.state is Lifecycle.ACTIVE:
            self._drive_on(mode, sensors, moved, now_s)
        elif self._activate_by_s is not None:
            self._go_on_activating(mode, now_s)
        elif mode != Mode.PASSIVE and now_s - self._sent_s > REPEAT_S:
            self._park(now_s)
        if self._latched:
            self._calm_down(now_s)
        self._publish(sensors, now_s)

    def _settle(self, now_s: float) -> None:
        """End the greeting: the robot is there and its wheels cannot move."""
        self._hello_s = self._list_s = None
        self._met = True
        self.state, self.fault = Lifecycle.READY, ""
        self._waking.active(now_s)
        if self._latched:
            self._calm_s = now_s
            self._fail(self._latched, self._cause)

    def _calm_down(self, now_s: float) -> None:
        """End the fault of too many falls when nothing has been wrong for long enough."""
        if self._senses.cause or self._hello_s is not None:
            self._calm_s = now_s
        elif now_s - self._calm_s >= CALM_S:
            self._latched, self._falls = "", []
            self.state, self.fault = Lifecycle.READY, ""

    def _go_on_activating(self, mode: int, now_s: float) -> None:
        if self._senses.cause:
            self._refuse(now_s)
            self._forget()
            self._park(now_s)
        elif not self._safe_sent:
            # Only after Passive was seen: a late frame from an earlier ACTIVE must not confirm this one.
            if mode == Mode.PASSIVE:
                self._safe_sent = True
                self._out.append(simple(Op.SAFE))
        elif mode == Mode.SAFE:
            self._forget()
            self.state, self.blocked = Lifecycle.ACTIVE, ""
            self._followed_s = now_s
            self._turn_wheels((0, 0), now_s)

    def _drive_on(self, mode: int, sensors: Sensors, moved: bool, now_s: float) -> None:
        """Compare what an ACTIVE robot reports with what was sent to it."""
        if self.docking:
            if (sensors.chargers or 0) & 0b10:
                self._stand_down(now_s, "it has found its dock")
            elif mode != Mode.PASSIVE and now_s - self._sent_s > REPEAT_S:
                self._sent_s = now_s
                self._out.append(simple(Op.DOCK))
        elif mode != Mode.SAFE:
            self._fall(now_s)
        else:
            wheels = sensors.left_mm_s, sensors.right_mm_s
            unseen = None in wheels  # a stream at 19200 baud has no room for packet 42: repeated for ever
            confirmed = wheels == self._wheels
            if unseen or confirmed or moved:
                self._followed_s = now_s
            if not confirmed and now_s - self._sent_s > REPEAT_S:
                self._turn_wheels(self._wheels, now_s)

    def _watch(self, now_s: float) -> None:
        """Give up an ACTIVE robot whose sensors do not follow its set-points."""
        if now_s - self._followed_s > STUCK_S and not self.docking:
            self._fail(
                f"what it reports has not changed for {STUCK_S} s of other set-points: its sensors hang, or it does "
                "not receive them; restart the robot, then check the cable"
            )
            self._greet(now_s)
            self._hello(now_s)

    def _fall(self, now_s: float) -> None:
        """Follow a robot that left Safe mode by itself."""
        cause = self._senses.cause or given(f"the cause is unknown, it is in mode {self._mode}")
        self._stand_down(now_s, f"the robot stopped itself: {cause}", cause)
        self._falls = [each for each in self._falls if now_s - each < FALL_WINDOW_S] + [now_s]
        if len(self._falls) >= FALLS:
            self._latched = (
                f"it stopped itself {FALLS} times within {FALL_WINDOW_S:.0f} s, the last time: {cause}; "
                f"put it on safe ground, it is ready again after {CALM_S:.0f} s there"
            )
            self._calm_s = now_s
            self._fail(self._latched, cause)

    def _stand_down(self, now_s: float, why: str, cause: Reason = NONE) -> None:
        self.state = Lifecycle.READY
        self._bar(why, now_s, cause)
        self._forget()
        self._park(now_s)

    def _refuse(self, now_s: float) -> None:
        cause = self._senses.cause
        self._bar(f"not activated: {cause}; mend that first", now_s, cause)

    def _bar(self, why: str, now_s: float, cause: Reason = NONE) -> None:
        self.blocked, self._barred_s, self._cause = why, now_s, cause

    def _may_nudge(self) -> bool:
        chargers = self._newest.chargers if self._newest is not None else 0
        return not self._senses.cause and not chargers and self._activate_by_s is None

    def _publish(self, sensors: Sensors, now_s: float) -> None:
        self.reading = Reading(
            stamp_s=now_s,
            odometry=self._odometry.pose,
            odometry_breaks=self._odometry.breaks,
            twist=self._odometry.twist,
            hazards=self._senses.hazards,
            contacts=int(sensors.bump_left or sensors.bump_right),
            battery=sensors.battery,
            charging=charges(sensors),
        )

    def _turn_wheels(self, wheels: tuple[int, int], now_s: float) -> None:
        self._wheels, self._sent_s = wheels, now_s
        self._out.append(drive_direct(*wheels))

    def _park(self, now_s: float) -> None:
        self._wheels, self._sent_s = (0, 0), now_s
        self._out.append(PARK)

    def _forget(self) -> None:
        """Drop an activation under way, a search for the dock and the set-point."""
        self._activate_by_s, self._safe_sent, self._wheels, self.docking = None, False, (0, 0), False
        self._panel.reset()

    def _fail(self, reason: str, cause: Reason = NONE) -> None:
        self.state, self.fault, self._fault_cause = Lifecycle.FAULT, self._about(reason), cause

    def _about(self, reason: str) -> str:
        return f"{self._settings.path}: {reason}"
