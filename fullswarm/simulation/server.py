"""Serves a world over UDP to one driver per robot.

A thread receives and keeps the newest set-point of each robot; :meth:`WorldServer.tick`, called by a timer at the
world's rate, applies them, steps the world and sends every connected driver its reading.
"""

from __future__ import annotations

import contextlib
import ipaddress
import math
import secrets
import socket
import threading
from dataclasses import dataclass

import numpy as np

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.ports import parse_address
from fullswarm.drivers.sim import protocol
from fullswarm.errors import ConfigError, MessageError
from fullswarm.simulation.world import World

Address = tuple[str, int]


@dataclass(slots=True)
class _Peer:
    """The driver that has a robot."""

    session: str
    address: Address
    sensing_m: float
    received_s: float
    sequence: int = -1
    fresh: protocol.Drive | None = None  # not yet applied
    leaving: bool = False  # after its bye; removed by the next tick


class WorldServer:
    """Serves all robots of a world to one driver each.

    Parameters
    ----------
    world
        Stepped by this server from now on; its owner closes it.
    address
        ``host:port`` to bind; port 0 takes a free one. Default: the world's own.
    insecure_network
        Allow an address that other machines reach: any program there could drive the robots.
    clock
        Decides which drivers are alive.

    Raises
    ------
    ConfigError
        The address is taken, not ours, or not loopback.
    """

    def __init__(
        self,
        world: World,
        address: str | None = None,
        *,
        insecure_network: bool = False,
        clock: Clock | None = None,
    ) -> None:
        self.world = world
        self.dropped = 0  # datagrams that were not understood
        self._clock = clock or MonotonicClock()
        self._token = secrets.token_hex(8)
        self._peers: dict[str, _Peer] = {}
        self._lock = threading.Lock()
        self._closing = False
        self._scans: dict[int, protocol.Scan] = {}  # by row
        self._held_s = 0.0  # time for which the world was held still
        self._socket = _bind(address or world.config.address, insecure_network)
        self._thread = threading.Thread(target=self._receive, name="world-link", daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """Where the world listens, ``host:port``."""
        host, port = self._socket.getsockname()
        return f"{host}:{port}"

    @property
    def connected(self) -> tuple[str, ...]:
        """Robots that have a driver."""
        with self._lock:
            return tuple(self._peers)

    # ------------------------------------------------------------ the link's thread
    def _receive(self) -> None:
        while not self._closing:
            try:
                data, sender = self._socket.recvfrom(protocol.MAX_BYTES)
            except OSError:
                continue  # an earlier datagram of this server was refused; closing is seen above
            try:
                datagram = protocol.decode(data)
            except MessageError:
                self.dropped += 1
                continue
            answer = self._take(datagram, sender)
            if answer is not None:
                self._send(answer, sender)

    def _take(self, datagram: protocol.Datagram, sender: Address) -> protocol.Datagram | None:
        with self._lock:
            if isinstance(datagram, protocol.Hello):
                return self._greet(datagram, sender)
            peer = self._peers.get(datagram.robot)
            if peer is None or peer.session != datagram.session:
                return None
            peer.received_s = self._clock.now_s()
            if isinstance(datagram, protocol.Drive):
                if datagram.sequence > peer.sequence:
                    peer.sequence, peer.fresh = datagram.sequence, datagram
            elif isinstance(datagram, protocol.Bye):
                peer.leaving = True
            return None

    def _greet(self, hello: protocol.Hello, sender: Address) -> protocol.Datagram:
        robot, now_s = hello.robot, self._clock.now_s()
        try:
            row = self.world.row(robot)
        except ConfigError as error:
            return protocol.Refusal(robot=robot, session=hello.session, reason=error.what, hint=error.hint)
        peer = self._peers.get(robot)
        if peer is None or peer.session != hello.session:
            if peer is not None and not peer.leaving and now_s - peer.received_s <= protocol.ALIVE_S:
                return protocol.Refusal(
                    robot=robot,
                    session=hello.session,
                    reason=f"robot '{robot}' already has a driver, at {peer.address[0]}:{peer.address[1]}",
                    hint="stop the other program, or use another robot",
                )
            # A set-point that the last driver left behind (zero before its bye) is still applied.
            fresh = peer.fresh if peer is not None else None
            peer = self._peers[robot] = _Peer(hello.session, sender, hello.sensing_m, now_s, fresh=fresh)
        peer.received_s, peer.address, peer.sensing_m = now_s, sender, hello.sensing_m
        for name, value in hello.actuators.items():
            with contextlib.suppress(ValueError):  # of a driver of another version
                self.world.actuate(row, name, value)
        v, w, a, b = self.world.limits[row].tolist()
        return protocol.Welcome(
            robot=robot,
            session=hello.session,
            world=self._token,
            firmware=self.world.firmware,
            limits=(v, w, a, b),
        )

    def _send(self, datagram: protocol.Datagram, to: Address) -> None:
        try:
            self._socket.sendto(protocol.encode(datagram), socket.MSG_DONTWAIT, to)
        except OSError:
            self.dropped += 1  # a full buffer or a vanished interface: the next reading replaces this one

    # ------------------------------------------------------------ the runtime's thread
    def tick(self, *, held: bool = False) -> None:
        """Apply the newest set-points, step the world, send the readings; if it is `held`, nothing moves meanwhile."""
        with self._lock:
            now_s = self._clock.now_s()
            for robot, peer in list(self._peers.items()):
                self._apply(robot, peer)
                if peer.leaving or now_s - peer.received_s > protocol.ALIVE_S:
                    del self._peers[robot]
            peers = list(self._peers.items())
        if held:
            self._held_s += self.world.dt_s
        else:
            self.world.step()
        for robot, peer in peers:
            self._send(self._reading(robot, peer, held), peer.address)

    def _apply(self, robot: str, peer: _Peer) -> None:
        drive, peer.fresh = peer.fresh, None
        if drive is None:
            return
        twist = np.array([drive.linear_m_s, drive.angular_rad_s])
        if not drive.active or not np.isfinite(twist).all():
            twist[:] = 0.0
        self.world.set_twists(twist, self.world.rows[robot])

    def _reading(self, robot: str, peer: _Peer, held: bool) -> protocol.BodyReading:
        world, row = self.world, self.world.rows[robot]
        x, y, heading = (world.sensed_pose if world.config.sight.pose else world.pose)[row].tolist()
        odometry_x, odometry_y, odometry_heading = world.odometry[row].tolist()
        v, w = (0.0, 0.0) if held else world.twist[row].tolist()
        seen, batteries = world.seen_bodies(row, peer.sensing_m), world.batteries
        return protocol.BodyReading(
            robot=robot,
            session=peer.session,
            time_s=world.time_s + self._held_s,  # drivers take what is newer only
            pose=(x, y, heading),
            odometry=(odometry_x, odometry_y, odometry_heading),
            twist=(v, w),
            contacts=int(world.contacts[row]),
            hazards=int(world.hazards[row]),
            obstacles=protocol.pack_rows(world.sensed_obstacles(row, peer.sensing_m)),
            bodies=None if seen is None else protocol.pack_rows(seen),
            scan=self._scan(row),
            senses_pose=world.config.sight.pose,
            battery=None if batteries is None else float(batteries.charge[row]),
            charging=None if batteries is None else bool(batteries.charging[row]),
        )

    def _scan(self, row: int) -> protocol.Scan | None:
        """Return the newest scan of a body, a new one if it is due."""
        world, sensor = self.world, self.world.sensors[row]
        if sensor is None:
            return None
        settings, scan = sensor.settings, self._scans.get(row)
        number = math.floor((world.time_s + self._held_s) * settings.rate_hz + 1e-6)
        if scan is None or number > scan.number:
            distances_m, angles_rad = world.scan(row), sensor.angles_rad
            if distances_m is None:
                return None
            step_rad = float(angles_rad[1] - angles_rad[0]) if len(angles_rad) > 1 else 0.0
            scan = self._scans[row] = protocol.Scan(
                number, protocol.pack_rows(distances_m), float(angles_rad[0]), step_rad, settings.max_m,
                (settings.x_m, settings.y_m, settings.yaw_rad), settings.sigma_m, settings.cone_rad,
            )  # fmt: skip
        return scan

    def close(self) -> None:
        """Release the port and end the thread. Closing twice is fine."""
        if self._closing:
            return
        self._closing = True
        host, port = self._socket.getsockname()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as waker:
            waker.sendto(b"", ("127.0.0.1" if host == "0.0.0.0" else host, port))  # noqa: S104  (compared, not bound)
        self._thread.join()
        self._socket.close()


def _bind(address: str, insecure_network: bool) -> socket.socket:
    host, port = parse_address(address, where="world.address")
    try:
        number = socket.gethostbyname(host)
    except OSError as error:
        raise ConfigError(f"no such host '{host}'", where="world.address") from error
    if not ipaddress.ip_address(number).is_loopback and not insecure_network:
        raise ConfigError(
            f"{address} can be reached from the network, and any program there could drive the robots",
            where="world.address",
            hint="use 127.0.0.1, or allow it with --insecure-network",
        )
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        link.bind((number, port))
    except OSError as error:
        link.close()
        raise ConfigError(
            f"cannot listen on {address}: {error.strerror}",
            where="world.address",
            hint="another world may be running there; choose another port",
        ) from error
    return link
