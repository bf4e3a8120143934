"""OptiTrack Motive's NatNet stream, versions 2.6 to 4.x, as a source: where rigid bodies are.

Layouts after OptiTrack's NatNet SDK (PacketClient.cpp, PythonClient/NatNetClient.py) and its documentation
(docs.optitrack.com, "NatNet: Data Streaming"). Little-endian. Only what robots need is read: the names of rigid bodies,
their poses, and the time of the exposure. The `natnet` package is not used: it stops at the first packet that it cannot
read and does not know the precision time stamp of NatNet 4.1.
"""

from __future__ import annotations

import contextlib
import socket
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from urllib.parse import parse_qs, urlsplit

from fullswarm.clock import Clock
from fullswarm.errors import ConfigError
from fullswarm.localization.links import MAX_DATAGRAM, Connection, FrameSource, HasFileno
from fullswarm.localization.sighting import Body, Frame, Refused

CONNECT, SERVER_INFO, REQUEST_MODELS, MODELS, FRAME, KEEP_ALIVE = 0, 1, 4, 5, 7, 10
HINT = "is streaming on in Motive (Data Streaming pane), are rigid bodies streamed, is a firewall in between?"
PORT = 1510
ASK_S = 1.0
"""Time between two questions that have no answer, and between two signs of life."""
MODELS_S = 10.0
"""The names of bodies are asked for again after so long."""
ANSWER_S = 2.0
MARKER_SET, RIGID_BODY, SKELETON = 0, 1, 2
TRACKED, MODELS_CHANGED = 1, 2
Version = tuple[int, int]
OLDEST: Version = (2, 6)
"""Earlier ones do not say whether a body is seen now: a lost one would keep its last pose."""


class Cursor:
    """Reads the fields of a packet one after the other; `Refused` beyond its end."""

    def __init__(self, data: bytes, at: int = 0) -> None:
        self._data, self.at = data, at

    @property
    def left(self) -> int:
        """Bytes that are left."""
        return len(self._data) - self.at

    def take(self, layout: str) -> tuple[float, ...]:
        """Return the next fields as `struct` describes them."""
        size = struct.calcsize("<" + layout)
        if size > self.left:
            raise Refused("a packet that ends too early")
        values = struct.unpack_from("<" + layout, self._data, self.at)
        self.at += size
        return values

    def number(self) -> int:
        """Return the next integer of 4 bytes."""
        return int(self.take("i")[0])

    def text(self) -> str:
        """Return the next text that ends with a zero byte."""
        end = self._data.find(b"\0", self.at)
        if end < 0:
            raise Refused("a packet that ends too early")
        text = self._data[self.at : end].decode(errors="replace")
        self.at = end + 1
        return text

    def skip(self, count: int, size: int = 1) -> None:
        """Skip `count` things of a size."""
        if not 0 <= count * size <= self.left:
            raise Refused("a packet that ends too early")
        self.at += count * size

    def count(self) -> int:
        """Return how many things follow, each at least one byte long."""
        count = self.number()
        if not 0 <= count <= self.left:
            raise Refused("a packet with an impossible count")
        return count


@dataclass(frozen=True, slots=True)
class Server:
    """What a server says of itself."""

    version: Version
    clock_hz: int = 0
    data_port: int = 1511
    group: str = ""
    """Multicast group of the frames; empty: they come to the socket that asks."""


def parse_server(payload: bytes) -> Server:
    """Read an answer to a connection request; `Refused`: it is none."""
    cursor = Cursor(payload, 256)  # the server's name
    cursor.take("4B")  # version of the program
    major, minor, _, _ = (int(each) for each in cursor.take("4B"))
    if not OLDEST <= (major, minor) < (10, 0):
        raise Refused("a NatNet version that cannot be used", f"{major}.{minor}: update Motive")
    if cursor.left < 15:
        return Server((major, minor), group="239.255.42.99")
    (clock_hz, port, multicast), group = cursor.take("QH?"), cursor.take("4B")
    name = ".".join(str(int(each)) for each in group)
    return Server((major, minor), int(clock_hz), int(port), name if multicast else "")


def parse_models(payload: bytes, version: Version) -> dict[int, str]:
    """Return the names of rigid bodies by their number; `Refused`: the packet is invalid."""
    cursor, names = Cursor(payload), dict[int, str]()
    for _ in range(cursor.count()):
        kind = cursor.number()
        if version >= (4, 1):
            size = cursor.number()
            following = Cursor(payload, cursor.at)
            cursor.skip(size)
            if kind == RIGID_BODY:
                name, number = _model(following, version)
                names[number] = name
        elif kind == MARKER_SET:
            cursor.text()
            for _ in range(cursor.count()):
                cursor.text()
        elif kind == RIGID_BODY:
            name, number = _model(cursor, version)
            names[number] = name
        elif kind == SKELETON:
            cursor.text()
            cursor.number()
            for _ in range(cursor.count()):
                _model(cursor, version)
        else:
            break  # force plates, devices and cameras come after all bodies
    return names


def _model(cursor: Cursor, version: Version) -> tuple[str, int]:
    name, number = cursor.text(), cursor.number()
    cursor.skip(16)  # parent, offset
    if version >= (4, 2):
        cursor.skip(16)  # offset of the orientation
    if version >= (3, 0):
        markers = cursor.count()
        cursor.skip(markers, 16)
        if version >= (4, 0):
            for _ in range(markers):
                cursor.text()
    return name, number


@dataclass(frozen=True, slots=True)
class RawBody:
    """A rigid body in a frame."""

    number: int
    place: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    error: float
    tracked: bool


@dataclass(frozen=True, slots=True)
class RawFrame:
    """A frame; `ticks` is the time of the exposure on the server's fast clock, 0: not stated."""

    bodies: tuple[RawBody, ...]
    ticks: int
    models_changed: bool


def parse_frame(payload: bytes, version: Version) -> RawFrame:
    """Read a frame; `Refused`: the packet is invalid."""
    cursor = Cursor(payload)
    cursor.number()  # number of the frame
    count = _section(cursor, version)
    for _ in range(count):  # marker sets
        cursor.text()
        cursor.skip(cursor.count(), 12)
    cursor.skip(_section(cursor, version), 12)  # markers without a set
    bodies = tuple(_body(cursor, version) for _ in range(_section(cursor, version)))
    if version < (3, 0):
        return RawFrame(bodies, 0, models_changed=False)
    _skip_rest(cursor, version)
    ticks, flags = _suffix(cursor, version)
    return RawFrame(bodies, ticks, bool(flags & MODELS_CHANGED))


def _section(cursor: Cursor, version: Version) -> int:
    count = cursor.count()
    if version >= (4, 1):
        cursor.number()  # its size in bytes
    return count


def _body(cursor: Cursor, version: Version) -> RawBody:
    number = cursor.number()
    x, y, z, qx, qy, qz, qw = cursor.take("7f")
    if version < (3, 0):
        cursor.skip(cursor.count(), 20)  # markers: place, number, size
    error, flags = cursor.take("fh")
    return RawBody(number, (x, y, z), (qx, qy, qz, qw), error, bool(int(flags) & TRACKED))


def _skip_rest(cursor: Cursor, version: Version) -> None:
    """Skip what stands between the bodies and the times: skeletons, assets, markers, force plates, devices."""
    if version >= (4, 1):
        for _ in range(5):
            cursor.number()
            cursor.skip(cursor.number())  # its size in bytes
        return
    for _ in range(cursor.count()):  # skeletons
        cursor.number()
        for _ in range(cursor.count()):
            _body(cursor, version)
    cursor.skip(cursor.count(), 26)  # markers with a label
    for _ in range(2):  # force plates, devices
        for _ in range(cursor.count()):
            cursor.number()
            for _ in range(cursor.count()):
                cursor.skip(cursor.count(), 4)


def _suffix(cursor: Cursor, version: Version) -> tuple[int, int]:
    """Return the exposure's time and the flags."""
    cursor.take("iid")  # time code, time of the take
    ticks, _, _ = cursor.take("3Q")
    if version >= (4, 1):
        cursor.skip(8)  # the precision time stamp
    return int(ticks), int(cursor.take("h")[0])


@dataclass(slots=True)
class Session:
    """One conversation with a server, without I/O.

    Attributes
    ----------
    outbox : packets to be sent to the server
    """

    server: Server | None = None
    names: dict[int, str] = field(default_factory=dict)
    outbox: list[bytes] = field(default_factory=list)
    _asked_s: float = -1.0e9
    _models_s: float = -1.0e9

    def turn(self, now_s: float) -> None:
        """Ask for what is not known; show a sign of life."""
        if now_s - self._asked_s < ASK_S:
            return
        self._asked_s = now_s
        if self.server is None:
            self.outbox.append(packet(CONNECT, b"Ping\0"))
            return
        self.outbox.append(packet(KEEP_ALIVE, b"\0"))
        if not self.names or now_s - self._models_s > MODELS_S:
            self._models_s = now_s
            self.outbox.append(packet(REQUEST_MODELS, b"\0"))

    def receive(self, data: bytes) -> Frame | Refused | None:
        """Read one packet; return a frame if it has one."""
        try:
            return self._receive(data)
        except Refused as refused:
            return refused

    def _receive(self, data: bytes) -> Frame | None:
        if len(data) < 4:
            raise Refused("a packet that ends too early")
        kind, size = struct.unpack_from("<HH", data)
        payload = data[4 : 4 + size]
        if kind == SERVER_INFO:
            self.server, self._asked_s = parse_server(payload), -1.0e9
        elif self.server is None:
            return None
        elif kind == MODELS:
            self.names = parse_models(payload, self.server.version)
        elif kind == FRAME:
            return self._frame(parse_frame(payload, self.server.version), self.server)
        return None

    def _frame(self, raw: RawFrame, server: Server) -> Frame | None:
        if raw.models_changed:
            self._models_s, self._asked_s = -1.0e9, -1.0e9
        bodies = tuple(
            Body(self.names[each.number], *each.place, each.quaternion, each.tracked, each.error)
            for each in raw.bodies
            if each.number in self.names  # a frame may come before its names do
        )
        time_s = raw.ticks / server.clock_hz if raw.ticks and server.clock_hz else None
        return Frame(bodies, time_s)


def packet(kind: int, payload: bytes) -> bytes:
    """Return a packet for the server."""
    return struct.pack("<HH", kind, len(payload)) + payload


class NatNetConnection(Connection):
    """The sockets of one conversation: one that asks, and one for a multicast group."""

    def __init__(self, server: tuple[str, int], local: str, clock: Clock) -> None:
        self._session = Session()
        self._address = (socket.gethostbyname(server[0]), server[1])
        self._local, self._clock = local, clock
        self._frames: socket.socket | None = None
        self._heard_s = clock.now_s()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        self._socket.bind((local, 0))
        self._socket.setblocking(False)

    def waits_on(self) -> Sequence[HasFileno]:
        """Return the sockets."""
        return (self._socket,) if self._frames is None else (self._socket, self._frames)

    def turn(self, now_s: float) -> None:
        """Send what the conversation needs; `TimeoutError`: no answer."""
        if now_s - self._heard_s > ANSWER_S:
            raise TimeoutError("" if self._session.server is None else "nothing comes from it any more")
        self._session.turn(now_s)
        while self._session.outbox:
            self._socket.sendto(self._session.outbox.pop(0), self._address)

    def read(self, ready: HasFileno, now_s: float) -> Iterable[tuple[str, Frame | Refused]]:
        """Read one packet."""
        own = self._frames if self._frames is not None and ready is self._frames else self._socket
        data, sender = own.recvfrom(MAX_DATAGRAM)
        if sender[0] != self._address[0]:
            return ((sender[0], Refused("a packet of another computer", sender[0])),)
        self._heard_s = now_s
        before = self._session.server
        found = self._session.receive(data)
        server = self._session.server
        if server is not before and server is not None and server.group and self._frames is None:
            self._frames = self._join(server)
        return () if found is None else ((sender[0], found),)

    def _join(self, server: Server) -> socket.socket:
        frames = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        with contextlib.ExitStack() as undo:
            undo.callback(frames.close)
            frames.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            frames.bind((server.group, server.data_port))
            member = socket.inet_aton(server.group) + socket.inet_aton(self._local or "0.0.0.0")  # noqa: S104
            frames.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
            frames.setblocking(False)
            undo.pop_all()
        return frames

    def close(self) -> None:
        """Release them."""
        self._socket.close()
        if self._frames is not None:
            self._frames.close()


def open_source(url: str, clock: Clock) -> FrameSource:
    """Return ``natnet://HOST[:1510][?local=ADDRESS]``; `local` is this machine's address in the cameras' network.

    Raises
    ------
    ConfigError
        An option is unknown.
    """
    parts = urlsplit(url)
    options = parse_qs(parts.query, strict_parsing=bool(parts.query))
    if unknown := sorted(set(options) - {"local"}):
        raise ConfigError(f"unknown option '{unknown[0]}'", where=url, hint="natnet knows local=ADDRESS")
    server = (parts.hostname or "", parts.port or PORT)
    local = options.get("local", [""])[0]
    return FrameSource("mocap natnet", HINT, url, lambda: NatNetConnection(server, local, clock), clock)
