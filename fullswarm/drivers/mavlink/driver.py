"""The HAL contract over MAVLink: one link thread owns the port, the agent's calls only touch memory.

URLs::

    mavlink+udp://127.0.0.1:14550          listen there for the vehicle
    mavlink+udpout://10.0.0.7:14550        send to it first
    mavlink+tcp://127.0.0.1:5760
    mavlink+serial:///dev/ttyACM0?baud=115200

Options: ``sysid=1`` the vehicle's system id; ``autopilot=ardupilot|px4`` what it must run (default: what its
heartbeat says; name it, for `description` is read before there is one); ``ekf=ignore`` do not wait for the position
filter's own approval; ``speed=``, ``turn=`` (m/s, rad/s) limits below the vehicle's own; ``radius=`` of the footprint
in metres; ``sign_key=`` the file with the key of MAVLink 2 signing, ``sign_state=`` the file with its timestamps,
``sign_link=0`` the link id; ``pose=external`` hand the fixes that :meth:`MavlinkDriver.locate` gets to the vehicle,
``origin=lat,lon,alt`` where its local frame begins then (see ``external.py`` for the parameters it needs);
``guardian=0`` or ``1`` whether a process of its own holds and disarms the rover when this one is paused or killed
(agents and `robots test` have one unless told 0); signed, its frames bear the link id ``sign_link`` + 128.

Opening writes one parameter, for good, so that a rover that loses us stops by itself: ``FS_GCS_ENABLE=1`` on
ArduPilot, once ``FS_ACTION`` is seen to be HOLD (2) or Terminate (5); ``COM_OBL_RC_ACT=5`` on PX4 (Hold).
"""

from __future__ import annotations

import atexit
import contextlib
import math
import threading
from collections.abc import Callable

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import STAND, Lifecycle, Pose, Reading, Twist
from fullswarm.drivers.guardian import Guardian
from fullswarm.drivers.mavlink.codec import StreamParser, decoded_ids, dialect
from fullswarm.drivers.mavlink.link import Address, Transport, Waker, open_transport, parse_url
from fullswarm.drivers.mavlink.session import Session
from fullswarm.drivers.mavlink.settings import describe, read_settings
from fullswarm.errors import DriverError, LinkLost

REOPEN_S = 0.5
RESIGN_S = 5.0
"""A vehicle believes a link that it has not heard before for a minute after the signature."""
LONGEST_WAIT_S = 0.05
CLOSE_S = 4.0


class MavlinkDriver:
    """An ArduPilot or PX4 rover. Nothing is touched before :meth:`open`, nothing moves before :meth:`activate`.

    `activate` starts an attempt and returns: ACTIVE follows once the vehicle's heartbeats show GUIDED (PX4: OFFBOARD)
    and armed. When it refuses, the state stays READY and `fault` holds the firmware's words. When a pilot changes the
    mode, the state goes to READY, the reading shows ESTOP_BUTTON, and the driver keeps off until the pilot hands it
    back, or until `activate` comes after a pause of a second.

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
        self._settings = read_settings(url, str(self._address), options)
        self.description = self._settings.description  # of an ArduPilot, until a heartbeat says PX4
        self._lock = threading.Lock()
        self._session: Session | None = None
        self._thread: threading.Thread | None = None
        self._waker: Waker | None = None
        self._closing = threading.Event()
        self.guarded = bool(self._settings.guardian)
        # These are used by the link thread only.
        self._guardian: Guardian | None = None
        self._stop_kind: tuple[tuple[str, bool], tuple[str, int] | None] | None = None
        self._resign_s = 0.0

    @property
    def state(self) -> Lifecycle:
        """Where the driver stands."""
        session = self._session
        return Lifecycle.CLOSED if session is None else session.lifecycle

    @property
    def fault(self) -> str:
        """Why it is in FAULT, why it is no longer or not yet ACTIVE, what a person must set, or what aid is lost."""
        session = self._session
        return "" if session is None else session.fault or session.unfit or session.unaided(self._clock.now_s())

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

    @property
    def texts(self) -> list[str]:
        """The vehicle's warnings of the last half minute, and what is odd about its settings."""
        with self._lock:
            return [] if self._session is None else self._session.texts(self._clock.now_s())

    def guard(self) -> None:
        """Have a guardian from the next `open` on, unless the URL says ``guardian=0``."""
        self.guarded = self._settings.guardian is not False

    def open(self) -> None:
        """Claim the port and start the link thread.

        Raises
        ------
        ConfigError
            The signing key cannot be used.
        DriverError
            The port cannot be had, or the driver is open already.
        MissingExtra
            pymavlink is not installed.
        """
        if self._thread is not None:
            raise DriverError("this driver is open already", where=self.url, hint="close it first")
        dialect()
        signing = self._settings.signing()
        session = Session(self._settings.options, self._clock.now_s(), signing)
        try:
            transport = _open(self._address, session)
        except DriverError:
            if signing is not None:  # each try would push the signing clock ahead by what it reserved
                with contextlib.suppress(DriverError):
                    signing.close()
            raise
        self._session, self._waker = session, Waker()
        self._closing.clear()
        # A daemon thread dies unheard when the interpreter exits, and the rover would stay armed.
        atexit.register(self.close)
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
        """Zero set-point, then HOLD, then disarm; READY once the vehicle shows it. Ends an attempt of `activate`."""
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

    def locate(self, pose: Pose, position_sigma_m: float, heading_sigma_rad: float) -> None:
        """Hand a pose measured from outside, ENU, with its standard deviations, to the vehicle's position filter.

        Without ``pose=external`` in the URL, while closed, or with a pose that is not finite, it does nothing.
        A heading with a deviation above 1 rad counts as not seen.
        """
        with self._lock:
            session = self._session
            used = session is not None and session.locate(
                pose, position_sigma_m, heading_sigma_rad, self._clock.now_s()
            )
        if used:
            self._wake()

    def close(self) -> None:
        """Stand down (at most 4 s), end the link thread and let go of the port."""
        thread, waker = self._thread, self._waker
        if thread is None or waker is None:
            return
        self._closing.set()
        waker.wake()
        thread.join()
        atexit.unregister(self.close)
        self._thread = self._waker = self._session = None
        waker.close()

    def _wake(self) -> None:
        waker = self._waker
        if waker is not None:
            waker.wake()

    # ------------------------------------------------------------ link thread
    def _run(self, session: Session, waker: Waker, transport: Transport | None) -> None:
        self._guardian = Guardian(self._clock) if self.guarded else None
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
            if session.signing is not None:
                with contextlib.suppress(DriverError):
                    session.signing.close()
            if transport is not None:
                self._let_go(transport)

    def _now(self) -> float:
        return self._clock.now_s()

    def _serve(
        self, session: Session, waker: Waker, transport: Transport | None, finished: Callable[[], bool]
    ) -> Transport | None:
        """Talk until `finished` or until the port is lost; return the port, or None when it is gone."""
        if transport is None:
            return None
        parser = StreamParser(decoded_ids(), None if session.signing is None else session.signing.accept)
        if self._guardian is not None and not self._guardian.watching:
            self._guardian.watch(transport.fileno())
            self._stop_kind = None
        try:
            while not finished():
                now_s = self._now()
                waker.wait(transport, min(session.next_due_s(now_s) - now_s, LONGEST_WAIT_S))
                data = transport.receive()
                # Between the two, wherever this process was paused: the guardian says that it stops the vehicle before
                # it does, so a heartbeat in HOLD is not taken for a pilot's change of mode.
                self._beat(session)
                messages = parser.feed(data)
                for message in messages:
                    with self._lock:  # one at a time: the agent's calls must not wait for a whole backlog
                        session.receive(message, self._now())
                with self._lock:
                    frames = session.tick(self._now())
                    alone = session.alone
                if alone:
                    transport.forget_peer()
                elif self.description.make != session.autopilot.make:
                    self.description = describe(self._settings, session.autopilot)
                self._leave_word(session, transport)  # before the first set-point leaves
                for frame in frames:
                    transport.send(frame)
        except LinkLost as error:
            self._let_go(transport)
            with self._lock:
                session.link_lost(error.what, self._now())
            return None
        return transport

    def _beat(self, session: Session) -> None:
        """Tell the guardian that this thread lives, and the session what the guardian has done."""
        guardian = self._guardian
        if guardian is None:
            return
        stopped = guardian.beat()
        with self._lock:
            session.unguarded = guardian.trouble
            if stopped:
                session.stopped_by_guardian(self._now())

    def _leave_word(self, session: Session, transport: Transport) -> None:
        """Leave with the guardian what stops the vehicle as it is driven now."""
        guardian, now_s = self._guardian, self._now()
        if guardian is None:
            return
        with self._lock:
            kind = session.stop_kind
            word = None if kind is None else (kind, transport.peer)
            stale = kind is not None and session.signing is not None and now_s >= self._resign_s
            if word == self._stop_kind and not stale:
                return
            plan = None if kind is None else session.stop_plan()
        self._stop_kind, self._resign_s = word, now_s + RESIGN_S
        guardian.stop_with(plan, transport.peer)

    def _let_go(self, transport: Transport) -> None:
        if self._guardian is not None:
            self._guardian.release()
        transport.close()

    def _reopen(self, session: Session, waker: Waker) -> Transport | None:
        while not self._closing.is_set():
            again_s = self._now() + REOPEN_S
            while self._now() < again_s and not self._closing.is_set():
                waker.wait(None, again_s - self._now())
            if self._closing.is_set():
                return None
            try:
                return _open(self._address, session)
            except DriverError:
                continue
        return None

    def _end(self, session: Session, waker: Waker, transport: Transport) -> None:
        """Bring the vehicle into its safe state before the port is let go."""
        with self._lock:
            deadline_s = self._now() + CLOSE_S
            session.deactivate(self._now())
        self._serve(session, waker, transport, lambda: not session.standing_down or self._now() > deadline_s)


def _open(address: Address, session: Session) -> Transport:
    ids, believe = decoded_ids(), None if session.signing is None else session.signing.authentic

    def is_vehicle(datagram: bytes) -> bool:
        return any(map(session.is_our_vehicle, StreamParser(ids, believe).feed(datagram)))

    return open_transport(address, is_vehicle)
