"""The driver of one simulated robot, over UDP to the world's process."""

from __future__ import annotations

import math
import secrets
import select
import socket
import threading
from dataclasses import replace

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Pose, Reading, Twist
from fullswarm.drivers.sim import protocol
from fullswarm.drivers.sim.settings import parse_url
from fullswarm.errors import DriverError, LinkLost, MessageError

SILENCE_S = 0.5
COMMAND_TTL_S = 0.3
POLL_S = 0.05
PAUSED_S = 0.2
"""When the link's thread has not run for so long, this process stood still: the world was not silent meanwhile."""


class SimDriver:
    """A :class:`~fullswarm.drivers.base.Driver` for ``sim://r1`` or ``sim://127.0.0.1:7450/r1``.

    A world that restarts is found again by itself; the driver is then READY, never ACTIVE.
    """

    def __init__(self, url: str, clock: Clock | None = None) -> None:
        parsed = parse_url(url)
        self.url, self.description = url, parsed.description
        self._robot, self._address, self._sensing_m = parsed.robot, (parsed.host, parsed.port), parsed.sensing_m
        self._where = f"{parsed.host}:{parsed.port}"
        self._clock = clock or MonotonicClock()
        limits = parsed.description.limits
        self._top = limits.speed_m_s, limits.turn_rad_s
        self._lock = threading.Lock()
        self._outgoing = threading.Lock()  # guards the newest set-point and its number
        self._socket: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()
        self._session = ""
        self._sequence = 0
        self._driven, self._driven_s = STAND, -math.inf
        self._reset()

    def _reset(self) -> None:
        self._state, self._fault, self._firmware, self._world = Lifecycle.CLOSED, "", "", ""
        self._reading: Reading | None = None
        self._unread = False
        self._origin: Pose | None = None
        self._time_s = -math.inf
        self._heard_s = self._looked_s = -math.inf

    @property
    def state(self) -> Lifecycle:
        """Where the driver stands."""
        return self._state

    @property
    def fault(self) -> str:
        """Why it is in FAULT."""
        return self._fault

    @property
    def firmware(self) -> str:
        """The world's engine and version."""
        return self._firmware

    def open(self) -> None:
        """Say hello to the world, again and again until it answers. Opening twice is fine."""
        if self._socket is not None:
            return
        link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            link.connect(self._address)
        except OSError as error:
            link.close()
            raise DriverError(
                f"cannot reach the world: {error.strerror}", where=self._where, hint="check host and port"
            ) from error
        link.setblocking(False)
        self._reset()
        self._session = secrets.token_hex(8)
        self._socket, self._state = link, Lifecycle.OPEN
        self._heard_s = self._looked_s = self._clock.now_s()
        self._closing.clear()
        self._thread = threading.Thread(target=self._serve, args=(link,), name=f"sim-{self._robot}", daemon=True)
        self._thread.start()

    # ------------------------------------------------------------ the link's thread
    def _serve(self, link: socket.socket) -> None:
        hello_s = -math.inf
        while not self._closing.is_set():
            now_s = self._clock.now_s()
            if now_s - hello_s >= protocol.HELLO_PERIOD_S:
                hello_s = now_s
                self._send(protocol.Hello(robot=self._robot, session=self._session, sensing_m=self._sensing_m))
            self._judge(now_s)
            self._expire(now_s)
            if not select.select([link], [], [], POLL_S)[0]:
                continue
            try:
                datagram = protocol.decode(link.recv(protocol.MAX_BYTES))
                self._take(datagram, self._clock.now_s())
            except (OSError, MessageError):
                continue  # nobody listens there yet, or not our bytes: the silence is what counts

    def _judge(self, now_s: float) -> None:
        """Go to FAULT once the world has been silent for too long.

        A pause of this process is no silence of the world: it ends the motion (`_expire`, and the world's own
        watchdog), not what the robot was asked for.
        """
        paused_s, self._looked_s = now_s - self._looked_s, now_s
        if paused_s > PAUSED_S:
            self._heard_s += paused_s
        if now_s - self._heard_s <= SILENCE_S:
            return
        with self._lock:
            self._state = Lifecycle.FAULT
            self._fault = str(
                LinkLost(
                    f"no reading for {SILENCE_S} s",
                    where=self._where,
                    hint="is the world running there, with this robot in it?",
                )
            )

    def _take(self, datagram: protocol.Datagram, now_s: float) -> None:
        if datagram.robot != self._robot or datagram.session != self._session:
            return
        if isinstance(datagram, protocol.Refusal):
            with self._lock:
                self._heard_s = now_s
                self._state = Lifecycle.FAULT
                self._fault = str(DriverError(datagram.reason, where=self._where, hint=datagram.hint))
        elif isinstance(datagram, protocol.Welcome):
            self._welcome(datagram)
        elif isinstance(datagram, protocol.BodyReading) and datagram.time_s > self._time_s:
            self._judge(now_s)  # a silence that nobody looked at must not leave the robot ACTIVE
            reading = self._convert(datagram, now_s)
            with self._lock:
                if self._unread and self._reading is not None:  # a contact must not be over before anybody has read it
                    reading = replace(
                        reading,
                        contacts=max(reading.contacts, self._reading.contacts),
                        hazards=reading.hazards | self._reading.hazards,
                    )
                self._time_s, self._heard_s, self._reading = datagram.time_s, now_s, reading
                self._unread = True
                if self._state in (Lifecycle.OPEN, Lifecycle.FAULT) and self._world:
                    self._state, self._fault = Lifecycle.READY, ""

    def _welcome(self, welcome: protocol.Welcome) -> None:
        with self._lock:
            self._firmware, self._top = welcome.firmware, self._within(*welcome.limits[:2])
            if welcome.world != self._world:
                # Another run of the world: its clock and its odometry start anew, and nothing drives on.
                self._world, self._time_s, self._origin = welcome.world, -math.inf, None
                if self._state is Lifecycle.ACTIVE:
                    self._state = Lifecycle.READY

    def _within(self, speed_m_s: float, turn_rad_s: float) -> tuple[float, float]:
        """Return the world's limits for this body, held within what the URL promises of it."""
        promised = self.description.limits
        return min(speed_m_s, promised.speed_m_s), min(turn_rad_s, promised.turn_rad_s)

    def _convert(self, body: protocol.BodyReading, now_s: float) -> Reading:
        if self._origin is None:
            self._origin = Pose(*body.odometry)
        return Reading(
            stamp_s=now_s,
            odometry=_relative(Pose(*body.odometry), self._origin),
            twist=Twist(*body.twist),
            pose=Pose(*body.pose),
            hazards=Hazard(body.hazards),
            contacts=body.contacts,
            obstacles=protocol.unpack_obstacles(body.obstacles),
        )

    # ------------------------------------------------------------ the agent's thread
    def activate(self) -> None:
        """READY → ACTIVE."""
        with self._lock:
            if self._state is Lifecycle.READY:
                self._state = Lifecycle.ACTIVE

    def deactivate(self) -> None:
        """ACTIVE → READY with the wheels at zero."""
        with self._lock:
            if self._state is Lifecycle.ACTIVE:
                self._state = Lifecycle.READY
        self._drive(STAND)

    def read(self) -> Reading | None:
        """Return the newest reading; its contacts and hazards are those since the last call."""
        with self._lock:
            self._unread = False
            return self._reading

    def command(self, twist: Twist) -> Twist:
        """Send a set-point in one datagram; return it clipped to the limits, or zero unless ACTIVE."""
        if not (math.isfinite(twist.linear_m_s) and math.isfinite(twist.angular_rad_s)):
            self._drive(STAND)
            raise ValueError(f"a twist must be finite, not {twist}")
        applied = STAND
        if self._state is Lifecycle.ACTIVE:
            speed, turn = self._top
            applied = Twist(max(-speed, min(speed, twist.linear_m_s)), max(-turn, min(turn, twist.angular_rad_s)))
        self._drive(applied)
        return applied

    def _drive(self, twist: Twist) -> None:
        with self._outgoing:
            self._say(twist)

    def _expire(self, now_s: float) -> None:
        """Stand when no command has come for too long, however patient the world is."""
        with self._outgoing:
            if self._driven != STAND and now_s - self._driven_s > COMMAND_TTL_S:
                self._say(STAND)

    def _say(self, twist: Twist) -> None:
        self._sequence += 1
        self._driven, self._driven_s = twist, self._clock.now_s()
        self._send(
            protocol.Drive(
                robot=self._robot,
                session=self._session,
                sequence=self._sequence,
                linear_m_s=twist.linear_m_s,
                angular_rad_s=twist.angular_rad_s,
                active=self._state is Lifecycle.ACTIVE,
            )
        )

    def _send(self, datagram: protocol.Datagram) -> None:
        link = self._socket
        if link is None:
            return
        try:
            link.send(protocol.encode(datagram))
        except OSError:
            return  # nobody listens there now, or the buffer is full; _judge reports the silence

    def close(self) -> None:
        """Stop the body, give the robot back and end the thread."""
        link, thread = self._socket, self._thread
        if link is None or thread is None:
            return
        self._drive(STAND)
        self._closing.set()
        thread.join()
        self._send(protocol.Bye(robot=self._robot, session=self._session))
        self._socket = self._thread = None
        link.close()
        self._state, self._fault = Lifecycle.CLOSED, ""


def _relative(pose: Pose, origin: Pose) -> Pose:
    """Return `pose` as seen from `origin`."""
    dx, dy = pose.x_m - origin.x_m, pose.y_m - origin.y_m
    c, s = math.cos(origin.heading_rad), math.sin(origin.heading_rad)
    turned = math.remainder(pose.heading_rad - origin.heading_rad, 2 * math.pi)
    return Pose(c * dx + s * dy, c * dy - s * dx, turned)
