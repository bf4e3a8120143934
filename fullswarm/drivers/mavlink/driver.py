"""The HAL contract over MAVLink: one link thread owns the port, the agent's calls only touch memory.

URLs::

    mavlink+udp://127.0.0.1:14550          listen there for the vehicle
    mavlink+udpout://10.0.0.7:14550        send to it first
    mavlink+tcp://127.0.0.1:5760
    mavlink+serial:///dev/ttyACM0?baud=115200

Options: ``sysid=1`` the vehicle's system id; ``ekf=ignore`` do not wait for the position filter's own approval;
``speed=``, ``turn=`` (m/s, rad/s) limits below the vehicle's own; ``radius=`` of the footprint in metres.

Opening sets ``FS_GCS_ENABLE=1`` in the vehicle, for good: a rover that loses us then goes to HOLD by itself.
"""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Callable

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import STAND, Description, Lifecycle, Limits, Reading, Twist
from fullswarm.drivers.mavlink.codec import StreamParser, dialect
from fullswarm.drivers.mavlink.link import Transport, Waker, open_transport, parse_url
from fullswarm.drivers.mavlink.session import Options, Session
from fullswarm.errors import ConfigError, DriverError, LinkLost, did_you_mean

REOPEN_S = 0.5
LONGEST_WAIT_S = 0.05
CLOSE_S = 4.0
GUIDED_TIMEOUT_S = 3.0
# ArduRover's defaults (ATC_ACCEL_MAX, ATC_STR_RAT_MAX, ATC_STR_ACC_MAX); the speed is our caution, not WP_SPEED.
LIMITS = Limits(speed_m_s=1.0, turn_rad_s=2.0, accel_m_s2=1.0, turn_accel_rad_s2=2.0)
RADIUS_M = 0.35


class MavlinkDriver:
    """An ArduPilot rover. Nothing is touched before :meth:`open`, nothing moves before :meth:`activate`.

    `activate` starts an attempt and returns: ACTIVE follows once the vehicle's heartbeats show GUIDED and armed.
    When it refuses, the state stays READY and `fault` holds the firmware's words. When a pilot changes the mode,
    the state goes to READY, the reading shows ESTOP_BUTTON, and the driver keeps off until he hands back GUIDED,
    until `deactivate`, or until `activate` comes after a pause of a second.

    Parameters
    ----------
    url
        See the module's docstring.
    clock
        Where time comes from; tests may bring their own.

    Raises
    ------
    ConfigError
        The URL is wrong.
    """

    def __init__(self, url: str, clock: Clock | None = None) -> None:
        self.url = url
        self._address, options = parse_url(url)
        self._clock = clock or MonotonicClock()
        self.description, self._options = _settings(url, str(self._address), options)
        self._lock = threading.Lock()
        self._session: Session | None = None
        self._thread: threading.Thread | None = None
        self._waker: Waker | None = None
        self._closing = threading.Event()

    @property
    def state(self) -> Lifecycle:
        """Where the driver stands."""
        session = self._session
        return Lifecycle.CLOSED if session is None else session.lifecycle

    @property
    def fault(self) -> str:
        """Why it is in FAULT, or why it is no longer or not yet ACTIVE; empty otherwise."""
        session = self._session
        return "" if session is None else session.fault

    @property
    def why(self) -> str:
        """What the driver waits for while it is OPEN; empty otherwise."""
        session = self._session
        return session.why if session is not None and session.lifecycle is Lifecycle.OPEN else ""

    @property
    def firmware(self) -> str:
        """What the vehicle says it runs; empty until known."""
        session = self._session
        return "" if session is None else session.firmware

    def open(self) -> None:
        """Claim the port and start the link thread.

        Raises
        ------
        DriverError
            The port cannot be had, or the driver is open already.
        MissingExtra
            pymavlink is not installed.
        """
        if self._thread is not None:
            raise DriverError("this driver is open already", where=self.url, hint="close it first")
        dialect()
        session = Session(self._options, self._clock.now_s())
        transport = open_transport(self._address, _vehicle_filter(session))
        self._session, self._waker = session, Waker()
        self._closing.clear()
        self._thread = threading.Thread(
            target=self._run, args=(session, self._waker, transport), name=f"mavlink {self._address}", daemon=True
        )
        self._thread.start()

    def activate(self) -> None:
        """Ask for ACTIVE (GUIDED, then armed); ignored unless READY."""
        with self._lock:
            if self._session is not None:
                self._session.activate(self._clock.now_s())
        self._wake()

    def deactivate(self) -> None:
        """Zero set-point, then HOLD, then disarm; READY once the vehicle shows it."""
        with self._lock:
            if self._session is not None:
                self._session.deactivate(self._clock.now_s())
        self._wake()

    def read(self) -> Reading | None:
        """Return the newest reading; None before the first."""
        with self._lock:
            return None if self._session is None else self._session.reading()

    def command(self, twist: Twist) -> Twist:
        """Take a set-point; return what the vehicle is told after limits. Zero unless ACTIVE.

        Raises
        ------
        ValueError
            Not finite; the rover is told to stand.
        """
        try:
            with self._lock:
                if self._session is not None:
                    return self._session.command(twist, self._clock.now_s())
            if not (math.isfinite(twist.linear_m_s) and math.isfinite(twist.angular_rad_s)):
                raise ValueError(f"a set-point must be finite, not {twist}")
            return STAND
        finally:
            if twist == STAND or not math.isfinite(twist.linear_m_s + twist.angular_rad_s):
                self._wake()  # a stop does not wait for the next set-point's turn

    def close(self) -> None:
        """Stand down (at most 4 s), end the link thread and let go of the port."""
        thread, waker = self._thread, self._waker
        if thread is None or waker is None:
            return
        self._closing.set()
        waker.wake()
        thread.join()
        self._thread = self._waker = self._session = None
        waker.close()

    def _wake(self) -> None:
        waker = self._waker
        if waker is not None:
            waker.wake()

    # ------------------------------------------------------------ link thread
    def _run(self, session: Session, waker: Waker, transport: Transport | None) -> None:
        try:
            while not self._closing.is_set():
                transport = self._serve(session, waker, transport, self._closing.is_set)
                if not self._closing.is_set():
                    transport = self._reopen(session, waker)
            if transport is not None:
                self._end(session, waker, transport)
        except Exception as error:
            # Whatever it is: stop the rover, and let the agent learn that nobody talks to it any more.
            with contextlib.suppress(Exception):
                for frame in session.emergency():
                    if transport is not None and frame:
                        transport.send(frame)
            with self._lock:
                session.link_lost(f"the link thread failed ({type(error).__name__}: {error}); reopen it", self._now())
        finally:
            if transport is not None:
                transport.close()

    def _now(self) -> float:
        return self._clock.now_s()

    def _serve(
        self, session: Session, waker: Waker, transport: Transport | None, finished: Callable[[], bool]
    ) -> Transport | None:
        """Talk until `finished` or until the port is lost; return the port, or None when it is gone."""
        if transport is None:
            return None
        parser = StreamParser()
        try:
            while not finished():
                waker.wait(transport, min(session.next_due_s() - self._now(), LONGEST_WAIT_S))
                messages = parser.feed(transport.receive())
                for message in messages:
                    with self._lock:  # one at a time: the agent's calls must not wait for a whole backlog
                        session.receive(message, self._now())
                with self._lock:
                    frames = session.tick(self._now())
                    alone = session.alone
                if alone:
                    transport.forget_peer()
                for frame in frames:
                    transport.send(frame)
        except LinkLost as error:
            transport.close()
            with self._lock:
                session.link_lost(error.what, self._now())
            return None
        return transport

    def _reopen(self, session: Session, waker: Waker) -> Transport | None:
        while not self._closing.is_set():
            again_s = self._now() + REOPEN_S
            while self._now() < again_s and not self._closing.is_set():
                waker.wait(None, again_s - self._now())
            if self._closing.is_set():
                return None
            try:
                return open_transport(self._address, _vehicle_filter(session))
            except DriverError:
                continue
        return None

    def _end(self, session: Session, waker: Waker, transport: Transport) -> None:
        """Bring the vehicle into its safe state before the port is let go."""
        with self._lock:
            deadline_s = self._now() + CLOSE_S
            session.deactivate(self._now())
        self._serve(session, waker, transport, lambda: not session.standing_down or self._now() > deadline_s)


def _vehicle_filter(session: Session) -> Callable[[bytes], bool]:
    def is_vehicle(datagram: bytes) -> bool:
        return any(map(session.is_our_vehicle, StreamParser().feed(datagram)))

    return is_vehicle


def _settings(url: str, where: str, options: dict[str, str]) -> tuple[Description, Options]:
    known = {"sysid", "ekf", "speed", "turn", "radius"}
    for name in options:
        if name not in known:
            raise ConfigError(f"unknown option '{name}'", where=url, hint=did_you_mean(name, known))
    sysid = options.get("sysid", "1")
    if not sysid.isdecimal() or not 1 <= int(sysid) <= 254:
        raise ConfigError(f"sysid is '{sysid}'", where=url, hint="a vehicle's system id is 1 to 254")
    ekf = options.get("ekf", "require")
    if ekf not in ("require", "ignore"):
        raise ConfigError(f"ekf is '{ekf}'", where=url, hint="ekf=ignore or ekf=require")
    limits = Limits(
        speed_m_s=_positive(url, "speed", options, LIMITS.speed_m_s),
        turn_rad_s=_positive(url, "turn", options, LIMITS.turn_rad_s),
        accel_m_s2=LIMITS.accel_m_s2,
        turn_accel_rad_s2=LIMITS.turn_accel_rad_s2,
    )
    description = Description(
        make="ArduPilot",
        model="Rover",
        radius_m=_positive(url, "radius", options, RADIUS_M),
        limits=limits,
        senses_pose=True,
        watchdog_s=GUIDED_TIMEOUT_S,
    )
    return description, Options(int(sysid), limits, where, ekf_ignored=ekf == "ignore")


def _positive(url: str, name: str, options: dict[str, str], default: float) -> float:
    text = options.get(name)
    if text is None:
        return default
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise ConfigError(f"{name} is '{text}'", where=url, hint=f"a number above 0, e.g. {name}={default:g}")
    return value
