"""The driver of a CAN base: owns the bus and the thread that talks on it."""

from __future__ import annotations

import atexit
import threading

import structlog

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import Lifecycle, Reading, Twist
from fullswarm.drivers.can.machine import BaseMachine
from fullswarm.drivers.can.port import CanPort
from fullswarm.drivers.can.protocol import Frame
from fullswarm.drivers.can.settings import parse
from fullswarm.drivers.guardian import Guardian, StopPlan
from fullswarm.errors import DriverError, FullswarmError, LinkLost, MissingExtra

PERIOD_S = 0.02  # of the set-points
SLICE_S = 0.005  # a stop waits no longer than that for the thread to look up from listening
REOPEN_S = 0.25
MOUTHFUL = 64  # frames at most between two looks at what is due
CLOSING_S = 1.0  # at most for rolling out and letting go
JOIN_S = 2.0  # at most for the adapter to let go of the link thread

_log = structlog.get_logger("fullswarm.drivers.can")


class CanBaseDriver:
    """A :class:`~fullswarm.drivers.base.Driver` for two wheels with an ODrive axis or a VESC each.

    ``can+odrive://vcan0?left=1&right=2&wheel_radius=0.05&base=0.3`` or ``can+vesc://…&pole_pairs=7``; further
    options are in :mod:`fullswarm.drivers.can.settings`. Set-points go out at 50 Hz while they are fresh; without
    `command` for 0.3 s they are zero. Should this process die, its guardian brakes (see :meth:`guard`). Should the
    computer die or the cable come off, only the controllers' own watchdogs stop the robot: a VESC's is on (1 s, it then
    coasts), an ODrive's must be switched on once over USB (see
    :class:`~fullswarm.drivers.can.odrive_axis.OdriveCodec`) and declared with ``watchdog=0.5``. Neither protocol can
    do that over CAN.

    Parameters
    ----------
    url
        What to drive and how to reach it; ``ConfigError`` names all that is wrong with it.
    clock
        Monotonic; only the link thread and the calls below read it.
    """

    def __init__(self, url: str, clock: Clock | None = None) -> None:
        self.url = url
        self._settings = parse(url)
        self.description = self._settings.description()
        self._codecs = self._settings.codecs()
        self._clock = clock or MonotonicClock()
        base = self._settings.base
        self._machine = BaseMachine(self._codecs, base.base, self._settings.wheel_limit_m_s, base.volts)
        self._lock = threading.Lock()  # guards the machine; held for microseconds
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._port: CanPort | None = None  # used by the link thread only once that runs
        self._dropped = 0
        self.guarded = self._settings.bus.guardian == "1"
        self._guardian: Guardian | None = None  # used by the link thread only, once that runs
        self._stop_plan: StopPlan[bytes] | None = None  # for the port that is open

    @property
    def state(self) -> Lifecycle:
        """Where the driver stands."""
        return self._machine.state

    @property
    def fault(self) -> str:
        """Why it is in FAULT and what to do; empty otherwise."""
        return self._machine.fault

    @property
    def firmware(self) -> str:
        """What the controllers say they run (only ODrive 0.6 does), or else what the URL says they are."""
        return self._machine.firmware

    @property
    def warning(self) -> str:
        """What an operator must know before this base drives; empty: nothing. Logged by `open` as well."""
        return self._settings.warning

    @property
    def malformed(self) -> int:
        """How many frames could not be understood or sent since construction."""
        return self._dropped + sum(codec.malformed for codec in self._codecs)

    def guard(self) -> None:
        """Have a guardian from the next `open` on, unless the URL says ``guardian=0``."""
        self.guarded = self._settings.bus.guardian != "0"

    def open(self) -> None:
        """Open the bus and start to listen; ``DriverError`` or ``MissingExtra`` say why not."""
        if self._thread is not None:
            return
        self._port = CanPort(self._settings)
        self._guardian = Guardian(self._clock) if self.guarded and self._port.descriptor is not None else None
        if self.warning:
            _log.warning("no device watchdog", url=self.url, why=self.warning)
        self._closing.clear()
        with self._lock:
            self._machine.opened(self._clock.now_s())
        # A daemon, because a forgotten driver must not keep a dying process alive; close() at exit stops the robot.
        self._thread = threading.Thread(target=self._run, name=f"can {self.url}", daemon=True)
        self._thread.start()
        atexit.register(self.close)

    def activate(self) -> None:
        """Ask both wheels into closed loop; ACTIVE as soon as both confirm, FAULT if one does not in 0.5 s."""
        with self._lock:
            self._machine.activate(self._clock.now_s())

    def deactivate(self) -> None:
        """ACTIVE → READY: wheels to zero, and let go when they stand (after 0.5 s at the latest)."""
        with self._lock:
            self._machine.deactivate(self._clock.now_s())

    def read(self) -> Reading | None:
        """Return the newest reading."""
        return self._machine.reading

    def command(self, twist: Twist) -> Twist:
        """Take a set-point; return what the wheels make of it."""
        with self._lock:
            return self._machine.command(twist, self._clock.now_s())

    def close(self) -> None:
        """Zero, let go, close the bus; takes up to a second when the robot was driving."""
        thread = self._thread
        if thread is None:
            return
        self._closing.set()
        thread.join(CLOSING_S + JOIN_S)
        self._thread = None
        if thread.is_alive():  # an adapter that blocks; its watchdog has to stop the wheels
            with self._lock:
                self._machine.closed(self._clock.now_s())
        atexit.unregister(self.close)

    # ------------------------------------------------------------ the link thread
    def _run(self) -> None:
        try:
            while not self._closing.is_set():
                try:
                    self._serve()
                except Exception as error:  # whatever it was: let go, say so, begin anew
                    known = isinstance(error, FullswarmError)
                    self._lost(str(error) if known else f"unexpected {type(error).__name__}: {error}")
                    self._reopen()
            self._say_goodbye()
        finally:
            with self._lock:
                frames = self._machine.closed(self._clock.now_s())
            self._let_go(frames)

    def _serve(self) -> None:
        """Listen and speak until closing."""
        self._watch()
        next_s = self._clock.now_s()
        while not self._closing.is_set():
            next_s = self._step(next_s)

    def _watch(self) -> None:
        """Have the guardian watch over the port that has been opened."""
        port, guardian = self._port, self._guardian
        if guardian is None or port is None or port.descriptor is None:
            return
        guardian.watch(port.descriptor)
        brakes, lets_go = self._machine.stop_frames()
        self._stop_plan = StopPlan(
            tuple((after_s, port.packed(frame)) for after_s, frame in brakes),
            tuple((after_s, port.packed(frame)) for after_s, frame in lets_go),
        )

    def _beat(self) -> None:
        """Tell the guardian that this thread lives, and whether there is something to stop."""
        guardian = self._guardian
        if guardian is None:
            return
        guardian.beat()
        with self._lock:
            self._machine.unguarded, drives = guardian.trouble, self._machine.drives
        guardian.stop_with(self._stop_plan if drives else None, self._port.destination if self._port else None)

    def _step(self, next_s: float) -> float:
        """Take in what is there or a moment's silence, then speak if it is time; return when it is time next."""
        port = self._port
        if port is None:
            raise LinkLost("the bus is closed", where=self.url)
        heard: list[Frame] = []
        frame = port.receive(min(SLICE_S, next_s - self._clock.now_s()))
        # All of it: after a pause a tick must not find a wheel silent whose words wait in the port.
        while frame is not None and len(heard) < MOUTHFUL:
            heard.append(frame)
            frame = port.receive(0.0)
        now_s = self._clock.now_s()
        frames: list[Frame] = []
        with self._lock:
            for each in heard:
                self._machine.receive(each, now_s)
            if now_s >= next_s or self._machine.urgent:
                frames = self._machine.tick(now_s)
        self._beat()  # before the first set-point leaves
        for each in frames:
            port.send(each)
        if now_s < next_s:
            return next_s
        # Missed periods are skipped: old set-points are worth nothing.
        return max(next_s + PERIOD_S, now_s)

    def _say_goodbye(self) -> None:
        """Roll out and let go, as long as the bus allows it and for a second at most."""
        if self._port is None:
            return
        next_s = now_s = self._clock.now_s()
        end_s = now_s + CLOSING_S
        with self._lock:
            self._machine.leave(now_s)
        try:
            while now_s < end_s:
                next_s = self._step(next_s)
                now_s = self._clock.now_s()
                with self._lock:
                    if self._machine.at_rest and not self._machine.urgent:
                        return
        except LinkLost:
            self._dropped += 1

    def _let_go(self, frames: tuple[Frame, ...]) -> None:
        """Send the last frames if there is a bus to send them on, and close it."""
        port = self._port
        if port is None:
            return
        try:
            for each in frames:
                port.send(each)
        except LinkLost:
            self._dropped += 1
        finally:
            self._close_port()

    def _close_port(self) -> None:
        port, self._port = self._port, None
        if self._guardian is not None:
            self._guardian.release()
        if port is not None:
            port.close()
            self._dropped += port.dropped

    def _lost(self, why: str) -> None:
        self._close_port()
        with self._lock:
            self._machine.bus_lost(why, self._clock.now_s())

    def _reopen(self) -> None:
        """Try until the bus is there again or closing comes first."""
        while not self._closing.wait(REOPEN_S):
            try:
                self._port = CanPort(self._settings)
            except (DriverError, MissingExtra) as error:
                with self._lock:
                    self._machine.bus_lost(str(error), self._clock.now_s())
                continue
            with self._lock:
                self._machine.bus_back(self._clock.now_s())
            return
