"""One of the rover's ports: frames out, its streams, and whom it believes once signing is set up.

pymavlink's own signing does the work: the driver's is our own code, so that each is tested against another's.
"""

from __future__ import annotations

from typing import Any

from fullswarm.drivers.mavlink.codec import dialect
from fullswarm.emulators.mavlink.rover.streams import Streams

TICKS_S = 100_000  # of a signature's timestamp: 10 µs
SIGNED = 0x01
TRUSTED = 0  # the first port (USB) believes unsigned frames too


class KeyRing:
    """The signing key, which all ports and restarts share."""

    def __init__(self) -> None:
        self._verifier = dialect().MAVLink(None)
        self._moved_s = 0.0

    @property
    def key(self) -> bytes | None:
        """The key; None: signing is off."""
        key: bytes | None = self._verifier.signing.secret_key
        return key

    def set_up(self, key: bytes, timestamp: int, now_s: float) -> None:
        """Take SETUP_SIGNING: a zero key with timestamp 0 ends signing."""
        self._verifier = dialect().MAVLink(None)
        self._verifier.signing.secret_key = key if any(key) or timestamp else None
        self._verifier.signing.timestamp, self._moved_s = timestamp, now_s

    def next_timestamp(self, now_s: float) -> int:
        """Return the timestamp of an outgoing frame; it goes on with the clock, and jumps ahead with others' frames."""
        signing = self._verifier.signing
        passed_s, self._moved_s = max(0.0, now_s - self._moved_s), now_s
        signing.timestamp += 1 + int(passed_s * TICKS_S)
        return int(signing.timestamp)

    def believes(self, message: Any, now_s: float) -> bool:
        """Whether a frame bears a right signature that is not older than what was heard."""
        frame = message.get_msgbuf()
        if frame[0] != 0xFD or not frame[2] & SIGNED:
            return False
        self.next_timestamp(now_s)
        return bool(self._verifier.check_signature(frame, message.get_srcSystem(), message.get_srcComponent()))


class Channel:
    """One port. `number` is its MAVLink channel, and its link id in signatures."""

    def __init__(self, number: int, system: int, keys: KeyRing) -> None:
        self.number = number
        self.streams: Streams | None = None  # none before power-on
        self._keys = keys
        self._mav = dialect().MAVLink(None, srcSystem=system, srcComponent=1)
        self._mav.signing.link_id = number
        self._out: list[bytes] = []

    def send(self, message: Any, now_s: float) -> None:
        """Pack a message of the dialect, signed if there is a key."""
        signing = self._mav.signing
        signing.secret_key = self._keys.key
        signing.sign_outgoing = signing.secret_key is not None
        if signing.sign_outgoing:
            signing.timestamp = self._keys.next_timestamp(now_s)
        self._out.append(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256

    def print(self, text: bytes) -> None:
        """Put console text between the frames."""
        self._out.append(text)

    def believes(self, message: Any, now_s: float) -> bool:
        """Whether what arrived here is acted upon."""
        if self._keys.key is None:
            return True
        return self._keys.believes(message, now_s) or self.number == TRUSTED

    def take(self) -> list[bytes]:
        """Return what goes out, and forget it."""
        out, self._out = self._out, []
        return out

    def clear(self) -> None:
        """Drop what would have gone out."""
        self._out.clear()
