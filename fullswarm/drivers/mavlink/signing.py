"""MAVLink 2 signing: our key, its timestamps over restarts, and which frames to accept.

A signature is the link id (1 byte), a timestamp (6 bytes, 10 µs since 2015) and 6 bytes of
``sha256(key + frame + link id + timestamp)``. Own code checks it, not pymavlink's: that one notes a frame's timestamp
before it has verified the frame, so that one forged frame would silence the real sender for good.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import stat
from collections.abc import Callable
from pathlib import Path

from fullswarm.clock import wall_time_s
from fullswarm.drivers.mavlink.codec import FrameSigner
from fullswarm.errors import ConfigError, DriverError
from fullswarm.files import replace_file

KEY_BYTES = 32
EPOCH_S = 1_420_070_400  # 2015-01-01
TICKS_S = 100_000
NEW_STREAM_S = 60  # how far behind us a sender may be that is new to us
RESERVE_S, SAVE_S = 10, 5

UNSIGNED = "its messages are not signed, and only signed ones are accepted"
OTHER_KEY = "it signs with another key than ours"
GUARDIAN_LINK = 128
"""Added to the link id: each link has timestamps of its own, and a guardian's frames are signed long before."""
STALE = "its signatures are older than what we have seen: its clock was set back, or its messages are being replayed"


def read_key(path: Path) -> bytes:
    """Return the 32 bytes of a key file: raw, or as 64 hexadecimal digits.

    Raises
    ------
    ConfigError
        No such file, readable for others, or not a key.
    """
    try:
        mode, data = path.stat().st_mode, path.read_bytes()
    except OSError as error:
        raise ConfigError(f"cannot read the signing key: {error.strerror}", where=str(path)) from error
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ConfigError("others may read the signing key", where=str(path), hint=f"chmod 600 {path}")
    if len(data) == KEY_BYTES:
        return data
    with contextlib.suppress(ValueError):
        key = bytes.fromhex(data.decode("ascii"))
        if len(key) == KEY_BYTES:
            return key
    raise ConfigError(
        "not a signing key", where=str(path), hint="32 bytes, or 64 hexadecimal digits: openssl rand -hex 32"
    )


def state_path(key: bytes, system: int) -> Path:
    """Return where the timestamps of this key towards one vehicle are kept unless the URL names another file."""
    import platformdirs  # here, because only signing needs it

    name = f"signing-{hashlib.sha256(b'fullswarm' + key).hexdigest()[:12]}-{system}"
    return platformdirs.user_state_path("fullswarm") / "mavlink" / name


class Timestamps:
    """Outgoing timestamps that only grow, over restarts and a clock set back as well.

    The file runs ahead of what was used, so that it need not be written for each frame; what a crash leaves unused
    is a few seconds, which the clock catches up with.

    Parameters
    ----------
    path
        The file; None: not kept.
    wall
        Seconds since 1970.
    """

    def __init__(self, path: Path | None, wall: Callable[[], float] = wall_time_s) -> None:
        self._path, self._wall = path, wall
        self._newest = max(self._stored(), self._now())
        self._saved = -1
        self.save()

    def _now(self) -> int:
        return max(0, int((self._wall() - EPOCH_S) * TICKS_S))

    def _stored(self) -> int:
        if self._path is None:
            return 0
        try:
            return int(self._path.read_text())
        except FileNotFoundError:
            return 0
        except (OSError, ValueError) as error:
            # Beginning anew could repeat timestamps, which the vehicle takes for a replay: a person has to look.
            raise DriverError(
                "cannot read the signing timestamps", where=str(self._path), hint="mend its mode or delete it"
            ) from error

    @property
    def newest(self) -> int:
        """The newest that was used or received."""
        return self._newest

    def next(self) -> int:
        """Return one that was never used before."""
        self._newest = max(self._newest + 1, self._now())
        if self._newest >= self._saved - (RESERVE_S - SAVE_S) * TICKS_S:
            with contextlib.suppress(DriverError):  # a full disk must not keep us from stopping a rover
                self.save()
        return self._newest

    def received(self, timestamp: int) -> None:
        """Keep up with a vehicle whose clock is ahead: it takes ours for a replay otherwise."""
        self._newest = max(self._newest, timestamp)

    def save(self, reserve_s: float = RESERVE_S) -> None:
        """Write down where a later run may begin; exactly, with no reserve, when this one ends.

        Raises
        ------
        DriverError
            The file cannot be written.
        """
        self._saved = self._newest + int(reserve_s * TICKS_S)
        if self._path is None:
            return
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            replace_file(self._path, f"{self._saved}\n")
        except OSError as error:
            raise DriverError(
                f"cannot keep the signing timestamps: {error.strerror}",
                where=str(self._path),
                hint="name a file with ?sign_state=",
            ) from error


class Signing:
    """One key on one link: signs what goes out, accepts only what is signed with it and new."""

    def __init__(self, key: bytes, stamps: Timestamps, link_id: int = 0) -> None:
        self._key, self._stamps, self._link_id = key, stamps, link_id
        self._streams: dict[tuple[int, int, int], int] = {}
        self._doubts: dict[int, str] = {}

    def signer(self, *, guardian: bool = False) -> FrameSigner:
        """Return what an encoder needs: key, link id and a fresh timestamp for each frame."""
        link_id = (self._link_id + GUARDIAN_LINK) % 256 if guardian else self._link_id
        return FrameSigner(self._key, link_id, self._stamps.next)

    def doubt(self, system: int) -> str:
        """Return why the newest frame of a system was not accepted; empty if it was, or if none came."""
        return self._doubts.get(system, "")

    def accept(self, frame: bytes | bytearray, system: int, component: int) -> bool:
        """Return whether a frame is authentic and new, and remember its timestamp."""
        if not self.authentic(frame, system, component):
            return False
        stream, timestamp = (frame[-13], system, component), int.from_bytes(frame[-12:-6], "little")
        last = self._streams.get(stream, self._stamps.newest - NEW_STREAM_S * TICKS_S - 1)
        if timestamp <= last:
            self._doubts[system] = STALE
            return False
        self._streams[stream] = timestamp
        self._stamps.received(timestamp)
        self._doubts.pop(system, None)
        return True

    def authentic(self, frame: bytes | bytearray, system: int, component: int) -> bool:
        """Tell whether a frame bears our key's signature, be it new or repeated."""
        del component
        if not signed(frame):
            self._doubts[system] = UNSIGNED
            return False
        if not hmac.compare_digest(hashlib.sha256(self._key + bytes(frame[:-6])).digest()[:6], bytes(frame[-6:])):
            self._doubts[system] = OTHER_KEY
            return False
        return True

    def close(self) -> None:
        """Write down the timestamps."""
        self._stamps.save(0.0)


def signed(frame: bytes | bytearray) -> bool:
    """Tell whether a frame bears a signature at all."""
    return frame[0] == 0xFD and bool(frame[2] & 1)
