"""Plays a Vicon DataStream server: one subject of one segment per body.

Written from Vicon's own description of the stream, the DataStream SDK's sources under the MIT licence (folder
ViconCGStream: Enum.h and one header per object; StreamCommon/BufferDetail.h). Little-endian; lengths and counts are 4
bytes. Millimetres, z up.
"""

from __future__ import annotations

import socket
from collections.abc import Iterable, Sequence
from struct import iter_unpack, pack, unpack_from

from fullswarm.emulators.mocap.server import Shown, StreamServer

OBJECTS, OBJECT_ENUMS, CONTENTS = 0x1A2B0001, 100_001, 100_004
STREAM_INFO, SUBJECT_INFO, FRAME_INFO, GLOBAL_SEGMENTS = 1, 2, 5, 9
OFFERED = (STREAM_INFO, SUBJECT_INFO, FRAME_INFO, GLOBAL_SEGMENTS)


class ViconServer(StreamServer):
    """A server of the DataStream."""

    def __init__(self, names: Sequence[str], host: str = "127.0.0.1", port: int = 801) -> None:
        super().__init__(names, host, port)
        self._wanted: dict[socket.socket, frozenset[int]] = {}
        self._said: dict[socket.socket, bytes] = {}
        self._number = 0

    def greet(self, client: socket.socket) -> None:
        """Say which objects there are."""
        client.sendall(_block(OBJECTS, _block(OBJECT_ENUMS, pack(f"<I{len(OFFERED)}i", len(OFFERED), *OFFERED))))

    def hear(self, client: socket.socket, data: bytes) -> None:
        """Note which objects the client wants: it says so more than once, and packets arrive joined or in parts."""
        packets, self._said[client] = _blocks(self._said.get(client, b"") + data)
        for kind, packet in packets:
            for part, content in _blocks(packet)[0] if kind == OBJECTS else ():
                if part == OBJECT_ENUMS:
                    numbers = iter_unpack("<i", content[4 : len(content) // 4 * 4])  # the count stands before them
                    self._wanted[client] = frozenset(number for (number,) in numbers)

    def drop(self, gone: socket.socket) -> None:
        """Forget a client."""
        self._wanted.pop(gone, None)
        self._said.pop(gone, None)
        super().drop(gone)

    def send(self, bodies: Sequence[Shown], time_s: float) -> None:
        """Send a frame; a subject that is not seen has no segment in it."""
        del time_s
        self._number += 1
        self.send_all(lambda client: self._frame(bodies, self._wanted.get(client)))

    def _frame(self, bodies: Sequence[Shown], wanted: frozenset[int] | None) -> bytes:
        if wanted is None:
            return b""
        objects = [(FRAME_INFO, pack("<I", self._number))]
        objects += [(SUBJECT_INFO, _subject(number, name)) for number, name in enumerate(self.names, 1)]
        objects += [(GLOBAL_SEGMENTS, _segments(self.names.index(each.name) + 1, each)) for each in bodies]
        return _block(OBJECTS, b"".join(_block(kind, content) for kind, content in objects if kind in wanted))


def _subject(number: int, name: str) -> bytes:
    segment = pack("<II6f", 0, 1, *6 * (0.0,)) + _text(name)
    marker = pack("<I", 1) + _text("front")
    return pack("<I", number) + _text(name) + _vector([segment]) + _vector([marker]) + _vector([pack("<II", 1, 1)])


def _segments(number: int, shown: Shown) -> bytes:
    x, y, z, w = shown.quaternion
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    segment = pack("<I3d9d", 1, *shown.position, *rows)
    return pack("<I", number) + _vector([segment] if shown.seen else [])


def _text(text: str) -> bytes:
    return pack("<I", len(text.encode())) + text.encode()


def _vector(items: Iterable[bytes]) -> bytes:
    things = list(items)
    return pack("<I", len(things)) + b"".join(things)


def _block(kind: int, content: bytes) -> bytes:
    return pack("<iI", kind, len(content)) + content


def _blocks(data: bytes) -> tuple[list[tuple[int, bytes]], bytes]:
    """Return the whole blocks in `data`, as kind and content, and the rest."""
    found = []
    while len(data) >= 8:
        kind, size = unpack_from("<iI", data)
        if len(data) < 8 + size:
            break
        found.append((kind, data[8 : 8 + size]))
        data = data[8 + size :]
    return found, data
