"""pymavlink's generated dialect, and a parser that cuts a byte stream into its messages.

pymavlink is imported at the first use, never with the package, and with ``MAVLINK20=1``: without it a mavutil
that is imported later in the same process would fall back to MAVLink 1 and accept unsigned frames.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Callable
from typing import Any

from fullswarm.errors import MissingExtra

MARKER_V1, MARKER_V2 = 0xFE, 0xFD
HEADER_BYTES = {MARKER_V1: 6, MARKER_V2: 10}
_SIGNED, _SIGNATURE_BYTES, _CRC_BYTES = 0x01, 13, 2
_MARKERS = re.compile(b"[\xfd\xfe]")


@functools.cache
def dialect() -> Any:
    """Return pymavlink's ``ardupilotmega`` dialect (a superset of ``common``).

    Raises
    ------
    MissingExtra
        pymavlink is not installed; says how to install it.
    """
    os.environ["MAVLINK20"] = "1"
    try:
        from pymavlink.dialects.v20 import ardupilotmega
    except ImportError as error:
        raise MissingExtra(
            "MAVLink rovers need pymavlink, which is not installed", hint="pip install 'fullswarm[mavlink]'"
        ) from error
    return ardupilotmega


Believe = Callable[[bytearray, int, int], bool]
"""Tells whether a frame (its bytes, system, component) is to be believed: see :mod:`.signing`."""


class StreamParser:
    """Cuts a byte stream into MAVLink messages; console text, noise and torn frames are skipped, never raised.

    pymavlink's own parser drops a whole frame's length after a stray marker byte, real frames inside included.
    This one moves on by one byte, so a good frame is never lost to the noise before it.

    Parameters
    ----------
    wanted
        Ids of the messages to return; others are checked and passed over without being unpacked. None: all.
    believe
        Asked for each whole frame; one that is not believed is dropped.
    """

    def __init__(self, wanted: frozenset[int] | None = None, believe: Believe | None = None) -> None:
        self._dialect = dialect()
        self._mav = self._dialect.MAVLink(None)
        self._kinds = self._dialect.mavlink_map
        self._wanted, self._believe = wanted, believe
        self._buffer = bytearray()
        self.skipped_bytes = 0
        self.bad_checksums = 0
        self.disbelieved = 0

    def feed(self, data: bytes) -> list[Any]:
        """Return the dialect's messages that `data` completes."""
        self._buffer += data
        buffer, messages, at = self._buffer, [], 0
        while at < len(buffer):
            marker = _MARKERS.search(buffer, at)
            if marker is None:
                self.skipped_bytes += len(buffer) - at
                at = len(buffer)
                break
            self.skipped_bytes += marker.start() - at
            at = marker.start()
            length = self._frame_length(buffer, at)
            if length is None or at + length > len(buffer):
                break
            frame = buffer[at : at + length]
            if not length or not self._intact(frame):
                at += 1
                self.skipped_bytes += 1
                continue
            at += length
            message = self._message(frame)
            if message is not None:
                messages.append(message)
        del buffer[:at]
        return messages

    def reset(self) -> None:
        """Forget a frame that has begun: the stream was torn (datagram boundary, reconnect)."""
        self.skipped_bytes += len(self._buffer)
        self._buffer.clear()

    def _frame_length(self, buffer: bytearray, at: int) -> int | None:
        """Return the length of the frame that begins at `at`; 0 if none can, None if more bytes must come first.

        The header alone rules out most noise, so that a stray marker seldom holds up what follows. A message that
        the dialect does not know is searched through like noise: its checksum cannot be verified.
        """
        marker = buffer[at]
        if len(buffer) - at < HEADER_BYTES[marker]:
            return None
        payload, flags = buffer[at + 1], buffer[at + 2]
        if marker == MARKER_V1:
            kind = self._kinds.get(buffer[at + 5])
            fits = kind is not None and payload <= kind.unpacker.size  # version 1 has no extensions
            return HEADER_BYTES[marker] + payload + _CRC_BYTES if fits else 0
        if flags & ~_SIGNED or _message_id(buffer, at) not in self._kinds:
            return 0
        signature = _SIGNATURE_BYTES if flags & _SIGNED else 0
        return HEADER_BYTES[marker] + payload + _CRC_BYTES + signature

    def _intact(self, frame: bytearray) -> bool:
        """Tell whether the checksum is right; 16 bits, so one in 65 536 of what is no frame passes."""
        end = HEADER_BYTES[frame[0]] + frame[1]
        checksum = self._dialect.x25crc(frame[1:end] + bytes((self._kinds[_message_id(frame)].crc_extra,))).crc
        good: bool = checksum == frame[end] | frame[end + 1] << 8
        self.bad_checksums += not good
        return good

    def _message(self, frame: bytearray) -> Any | None:
        if self._wanted is not None and _message_id(frame) not in self._wanted:
            return None
        first = 3 if frame[0] == MARKER_V1 else 5
        if self._believe is not None and not self._believe(frame, frame[first], frame[first + 1]):
            self.disbelieved += 1
            return None
        try:
            return self._mav.decode(frame)
        except self._dialect.MAVError:
            return None


def _message_id(buffer: bytearray, at: int = 0) -> int:
    return buffer[at + 5] if buffer[at] == MARKER_V1 else int.from_bytes(buffer[at + 7 : at + 10], "little")
