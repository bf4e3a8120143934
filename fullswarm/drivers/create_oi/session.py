"""The conversation with one Create as a state machine: bytes and time in, bytes and state out. No port, no thread.

::

    linked() -> OPEN: 145 0 0, 128, 148 -> first good frame that says Passive -> READY (wheels cannot move)
    READY -> activate(): 131 -> packet 35 says Safe -> 145 0 0 -> ACTIVE
    ACTIVE -> the robot falls to Passive by itself (cliff, wheel drop, charger) -> READY, third time in 10 s -> FAULT
    READY, ACTIVE -> no good frame for 0.5 s -> FAULT, hello again each 0.5 s -> READY

Safe mode, never Full: the robot's own reflexes stay on. It has no command timeout, so :meth:`Session.tick` sends
zero when no command came for 0.3 s, and repeats a set-point until packets 41 and 42 confirm it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Reading, Twist
from fullswarm.drivers.create_oi.odometry import Odometry
from fullswarm.drivers.create_oi.protocol import (
    TOP_MM_S,
    Generation,
    Mode,
    Op,
    Sensors,
    StreamParser,
    drive_direct,
    frame_size,
    simple,
    stream,
)

COMMAND_TTL_S = 0.3
SILENT_S = 0.5
HELLO_PERIOD_S, HELLO_GAP_S, HELLOS = 0.5, 0.05, 10
CONFIRM_S = 0.5
"""For the mode asked for to show up in packet 35."""
REPEAT_S = 0.06
"""Between two repeats of a set-point or a mode that the robot does not confirm."""
HOLD_S = 0.2
"""A hazard is reported at least this long: a reader at 10 Hz must not miss a blip of one frame."""
FALLS, FALL_WINDOW_S = 3, 10.0
LOW_BATTERY = 0.1

PARK = drive_direct(0, 0) + simple(Op.START)
"""Stops the wheels and takes the drive away. Begins with zero: mode changes alone do not stop every firmware."""

_WANTED_IDS = (35, 7, 9, 10, 11, 12, 14, 34, 41, 42, 25, 26)


def stream_ids(generation: Generation, baud: int) -> tuple[int, ...]:
    """Choose what to stream: odometry and safety always, the rest while it fits into 15 ms at this rate."""
    ids = [43, 44] if generation.m_per_count is not None else [19, 20]
    for number in _WANTED_IDS:
        if frame_size([*ids, number]) <= generation.budget(baud):
            ids.append(number)
    return tuple(ids)


def wheel_speeds(twist: Twist, wheel_base_m: float) -> tuple[int, int]:
    """Return left and right wheel in whole mm/s, both scaled alike to ±500 so that the curvature stays.

    Raises
    ------
    ValueError
        The twist is not finite.
    """
    if not (math.isfinite(twist.linear_m_s) and math.isfinite(twist.angular_rad_s)):
        raise ValueError(f"not a velocity: {twist.linear_m_s} m/s, {twist.angular_rad_s} rad/s")
    # Half speeds: the sum of two huge but finite numbers must not overflow.
    forward, turn = twist.linear_m_s / 2.0, twist.angular_rad_s * wheel_base_m / 4.0
    left, right = forward - turn, forward + turn
    per_half_m_s = min(2000.0, TOP_MM_S / max(abs(left), abs(right), 1e-3))
    return round(left * per_half_m_s), round(right * per_half_m_s)


def _nowhere(_data: bytes) -> None:
    """Drop what is said before there is a port."""


class Session:
    """One robot, from its port's opening to its closing. Not thread-safe."""

    def __init__(self, generation: Generation, baud: int, where: str, *, mode_offset: int = 0) -> None:
        self.send: Callable[[bytes], None] = _nowhere  # to the robot; must not block
        self.state = Lifecycle.CLOSED
        self.fault = ""
        self.blocked = ""  # why the robot left ACTIVE or does not become it
        self.reading: Reading | None = None
        self._generation, self._where, self._mode_offset = generation, where, mode_offset
        self._ids = stream_ids(generation, baud)
        self._parser = StreamParser(self._ids, both_checksums=generation.both_checksums)
        self._odometry = Odometry(generation)
        self._latched = ""  # a fault that only close() and open() clear
        self._hello_s: float | None = None  # when to say hello next; None: connected
        self._hellos = 0
        self._list_s: float | None = None
        self._heard = self._mode = -1  # bytes since the first hello; newest mode
        self._frame_s = self._command_s = self._sent_s = -math.inf
        self._activate_by_s: float | None = None  # activation asked for, not confirmed
        self._safe_sent = False
        self._wheels = (0, 0)
        self._falls: list[float] = []
        self._seen: dict[Hazard, float] = {}
        self._on_charger = False

    # ------------------------------------------------------------ link events
    def linked(self, now_s: float) -> None:
        """Greet the robot: its port has just been opened."""
        self.state, self.fault = Lifecycle.OPEN, ""
        self._greet(now_s)

    def lost(self, reason: str) -> None:
        """Mark the port as gone."""
        self.state, self.fault = Lifecycle.FAULT, self._about(reason)
        self._hello_s = None
        self._forget()

    def closed(self) -> None:
        """Mark the port as closed on purpose."""
        self.state, self.fault, self.blocked = Lifecycle.CLOSED, "", ""
        self._forget()

    def received(self, data: bytes, now_s: float) -> None:
        """Take bytes from the robot."""
        self._heard += len(data)
        for frame in self._parser.feed(data):
            self._take(frame.sensors, now_s)

    def tick(self, now_s: float) -> None:
        """Do what is due; to be called at least each 20 ms while the port is open."""
        if self._hello_s is not None:
            self._hello(now_s)
        elif now_s - self._frame_s > SILENT_S:
            self._fail(f"silent for {SILENT_S} s: check its power and the cable; the driver keeps calling")
            self._greet(now_s)
            self._hello(now_s)
        elif self.state is Lifecycle.ACTIVE:
            if self._wheels != (0, 0) and now_s - self._command_s > COMMAND_TTL_S:
                self._turn_wheels((0, 0), now_s)
        elif self._activate_by_s is not None and now_s > self._activate_by_s:
            self._forget()
            self._park(now_s)
            self.blocked = f"the robot did not go into Safe mode within {CONFIRM_S} s; take it off its charger"

    # ------------------------------------------------------------ what the agent asks
    def activate(self, now_s: float) -> None:
        """Ask for Safe mode; refused while a cause to fall out of it lasts."""
        if self.state is not Lifecycle.READY or self._activate_by_s is not None:
            return
        cause = self._cause()
        self.blocked = f"not activated: {cause}" if cause else ""
        if not cause:
            self._activate_by_s, self._safe_sent = now_s + CONFIRM_S, False

    def deactivate(self, now_s: float) -> None:
        """Stop the wheels and take the drive away."""
        self._forget()
        if self.state is Lifecycle.ACTIVE:
            self.state = Lifecycle.READY
            self._park(now_s)

    def command(self, twist: Twist, now_s: float) -> Twist:
        """Turn the wheels if ACTIVE; return what they were told. Raises ``ValueError`` if not finite, and stops."""
        base_m = self._generation.wheel_base_m
        try:
            wheels = wheel_speeds(twist, base_m)
        except ValueError:
            if self.state is Lifecycle.ACTIVE:
                self._turn_wheels((0, 0), now_s)
            raise
        if self.state is not Lifecycle.ACTIVE:
            return STAND
        self._command_s = now_s
        if wheels != self._wheels:
            self._turn_wheels(wheels, now_s)
        left, right = wheels
        return Twist((left + right) / 2000.0, (right - left) / 1000.0 / base_m)

    # ------------------------------------------------------------ within
    def _greet(self, now_s: float) -> None:
        self._parser.reset()
        self._odometry.rebase()
        self._hello_s, self._hellos, self._list_s, self._heard, self._mode = now_s, 0, None, 0, -1
        self._forget()

    def _hello(self, now_s: float) -> None:
        if self._list_s is not None and now_s >= self._list_s:
            self._list_s = None
            self.send(stream(self._ids))
        if self._hello_s is None or now_s < self._hello_s:
            return
        if self._hellos >= HELLOS and self.state is Lifecycle.OPEN:
            self._fail(self._no_answer())
        self._hellos += 1
        # A robot whose last master died may still be driving: zero first, then the greeting.
        self._park(now_s)
        self._list_s, self._hello_s = now_s + HELLO_GAP_S, now_s + HELLO_PERIOD_S

    def _no_answer(self) -> str:
        if self._mode >= 0:
            return f"it answers, but stays in mode {self._mode} instead of Passive; some need '?mode_offset=1'"
        if self._heard > 0:
            return "it sends bytes, but none that make a frame: wrong model or baud rate in its URL?"
        return "no answer: press its power button, check the cable, and 'model' and 'baud' in its URL"

    def _take(self, sensors: Sensors, now_s: float) -> None:
        self._frame_s = now_s
        self._odometry.update(sensors, now_s)
        self._note(sensors, now_s)
        self._mode = mode = (sensors.mode or 0) - self._mode_offset
        if self._hello_s is not None:
            if mode == Mode.PASSIVE:
                self._settle()
        elif self.state is Lifecycle.ACTIVE:
            if mode != Mode.SAFE:
                self._fall(now_s)
            elif sensors.left_mm_s is not None and (sensors.left_mm_s, sensors.right_mm_s) != self._wheels:
                self._repeat_wheels(now_s)
        elif self._activate_by_s is not None:
            self._go_on_activating(mode, now_s)
        elif mode != Mode.PASSIVE and now_s - self._sent_s > REPEAT_S:
            self._park(now_s)
        self._publish(sensors, now_s)

    def _settle(self) -> None:
        """End the greeting: the robot is there and its wheels cannot move."""
        self._hello_s = self._list_s = None
        self.state, self.fault = Lifecycle.READY, ""
        if self._latched:
            self._fail(self._latched)

    def _go_on_activating(self, mode: int, now_s: float) -> None:
        if self._cause():
            self.blocked = f"not activated: {self._cause()}"
            self._forget()
            self._park(now_s)
        elif not self._safe_sent:
            # Only after Passive was seen: a late frame from an earlier ACTIVE must not confirm this one.
            if mode == Mode.PASSIVE:
                self._safe_sent = True
                self.send(simple(Op.SAFE))
        elif mode == Mode.SAFE:
            self._forget()
            self.state, self.blocked, self._command_s = Lifecycle.ACTIVE, "", now_s
            self._turn_wheels((0, 0), now_s)

    def _fall(self, now_s: float) -> None:
        """Follow a robot that left Safe mode by itself."""
        cause = self._cause() or f"it is in mode {self._mode}"
        self.blocked = f"the robot stopped itself: {cause}"
        self.state = Lifecycle.READY
        self._forget()
        self._park(now_s)
        self._falls = [each for each in self._falls if now_s - each < FALL_WINDOW_S] + [now_s]
        if len(self._falls) >= FALLS:
            self._latched = (
                f"it stopped itself {FALLS} times within {FALL_WINDOW_S:.0f} s, last because {cause}; "
                "put it on safe ground, then close and open its driver"
            )
            self._fail(self._latched)

    def _note(self, sensors: Sensors, now_s: float) -> None:
        checks = (
            (Hazard.BUMP, sensors.bump_left or sensors.bump_right),
            (Hazard.CLIFF, sensors.cliff),
            (Hazard.WHEEL_DROP, sensors.wheel_drop),
            (Hazard.OVERCURRENT, sensors.wheel_overcurrent),
            (Hazard.BATTERY_LOW, sensors.battery is not None and sensors.battery < LOW_BATTERY),
        )
        self._seen.update({hazard: now_s for hazard, present in checks if present})
        self._on_charger = bool((sensors.chargers or 0) & 1)

    def _hazards(self) -> Hazard:
        hazards = Hazard.NONE
        for hazard, seen_s in self._seen.items():
            if self._frame_s - seen_s <= HOLD_S:
                hazards |= hazard
        return hazards

    def _cause(self) -> str:
        """Say what would make the robot leave Safe mode at once; empty when nothing would."""
        hazards = self._hazards()
        if Hazard.WHEEL_DROP in hazards:
            return "a wheel hangs"
        if Hazard.CLIFF in hazards:
            return "a cliff sensor sees no floor"
        return "the charger is plugged in" if self._on_charger else ""

    def _publish(self, sensors: Sensors, now_s: float) -> None:
        self.reading = Reading(
            stamp_s=now_s,
            odometry=self._odometry.pose,
            twist=self._odometry.twist,
            hazards=self._hazards(),
            contacts=int(sensors.bump_left or sensors.bump_right),
            battery=sensors.battery,
        )

    def _turn_wheels(self, wheels: tuple[int, int], now_s: float) -> None:
        self._wheels, self._sent_s = wheels, now_s
        self.send(drive_direct(*wheels))

    def _repeat_wheels(self, now_s: float) -> None:
        if now_s - self._sent_s > REPEAT_S:
            self._turn_wheels(self._wheels, now_s)

    def _park(self, now_s: float) -> None:
        self._wheels, self._sent_s = (0, 0), now_s
        self.send(PARK)

    def _forget(self) -> None:
        """Drop an activation under way and the set-point."""
        self._activate_by_s, self._safe_sent, self._wheels = None, False, (0, 0)

    def _fail(self, reason: str) -> None:
        self.state, self.fault = Lifecycle.FAULT, self._about(reason)

    def _about(self, reason: str) -> str:
        return f"{self._where}: {reason}"
