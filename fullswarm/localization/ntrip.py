"""Speaks NTRIP 2 and 1 with a caster: request, answer, source table, the receiver's position. No I/O.

`pygnssutils` has a client, but not one for a robot: it brings ten packages, ends after five lost connections, waits in
calls that cannot be stopped, reads answers and queues without a limit, and logs them. NTRIP is an HTTP request whose
answer does not end (RTCM 10410.1), so this file is smaller than what it would take to contain that one.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import time
from http import HTTPStatus

from fullswarm import __version__
from fullswarm.errors import DriverError, did_you_mean, nearest

LONGEST_HEAD, LONGEST_LINE = 8192, 1024
LARGEST_TABLE = 2 << 20
"""Bytes of a source table that are read; those of the largest casters have some 100 kB."""
MOST_NAMES, SHOWN_NAMES = 5000, 10
MOUNT = re.compile(r"[A-Za-z0-9._+~/-]{1,100}")
_STATUS = re.compile(rb"HTTP/1\.[01] (\d{3})\b")
_SIZE = re.compile(rb"[0-9A-Fa-f]{1,8}")
OLD_CASTER = (400, 404, 405, 406, 426, 501, 505)
"""Answers to version 2 after which version 1 is tried: it may be all the caster knows, and its answer to a mountpoint
that it does not have is the table of those it has."""


@dataclass(frozen=True, slots=True)
class Login:
    """Name and password at a caster."""

    user: str
    password: str = field(repr=False)

    @property
    def header(self) -> str:
        """The line of the request (Basic authorisation, RFC 7617)."""
        return f"Authorization: Basic {self._encoded}\r\n"

    @property
    def _encoded(self) -> str:
        return base64.b64encode(f"{self.user}:{self.password}".encode()).decode()

    def is_in(self, text: str) -> bool:
        """Tell whether a text contains the password, plain or as it is sent."""
        return bool(self.password) and (self.password in text or self._encoded.rstrip("=") in text)


@dataclass(frozen=True, slots=True)
class Place:
    """Where a receiver is, as it reports.

    Parameters
    ----------
    day_s : time of the measurement, seconds of the day, UTC
    height_m, separation_m : above the geoid; of the geoid above the ellipsoid
    quality : as in GGA
    """

    day_s: float
    latitude_deg: float
    longitude_deg: float
    height_m: float
    separation_m: float
    quality: int
    satellites: int
    hdop: float

    def gga(self) -> bytes:
        """Return the place as a sentence GGA, with its line end."""
        from pynmeagps import GET, NMEAMessage

        centiseconds = int(100.0 * self.day_s) % 8_640_000
        hour, minute, second = centiseconds // 360_000, centiseconds // 6000 % 60, centiseconds // 100 % 60
        sentence = NMEAMessage(
            "GP", "GGA", GET,
            time=time(hour, minute, second, 10_000 * (centiseconds % 100)), lat=self.latitude_deg,
            lon=self.longitude_deg, quality=self.quality, numSV=self.satellites, HDOP=round(self.hdop, 2),
            alt=round(self.height_m, 2), altUnit="M", sep=round(self.separation_m, 2), sepUnit="M", diffAge="",
            diffStation="",
        )  # fmt: skip
        return bytes(sentence.serialize())


def request(host: str, mount: str, login: Login | None, version: int, gga: bytes) -> bytes:
    """Return the request for a mountpoint; `host` with its port, `gga` empty where no position is known."""
    lines = f"GET /{mount} HTTP/1.{version - 1}\r\nHost: {host}\r\nUser-Agent: NTRIP fullswarm/{__version__}\r\n"
    if version == 2:
        lines += "Ntrip-Version: Ntrip/2.0\r\nAccept: */*\r\n"
        lines += f"Ntrip-GGA: {gga.decode().strip()}\r\n" if gga else ""
    lines += login.header if login is not None else ""
    return f"{lines}Connection: close\r\n\r\n".encode()


class Chunks:
    """Decodes the body of an HTTP answer that comes in chunks (RFC 9112, section 7.1)."""

    def __init__(self) -> None:
        self._line, self._left, self._ends = bytearray(), 0, False

    def feed(self, data: bytes) -> bytes:
        """Return what the chunks contain.

        Raises
        ------
        ConnectionResetError
            The last chunk.
        DriverError
            Not chunks.
        """
        found, at = bytearray(), 0
        while at < len(data):
            if self._left:
                piece = data[at : at + self._left]
                found += piece
                at += len(piece)
                self._left -= len(piece)
                self._ends = self._left == 0
                continue
            end = data.find(b"\n", at)
            self._line += data[at : end + 1 if end >= 0 else len(data)]
            if len(self._line) > LONGEST_LINE:
                raise DriverError("the caster's answer is damaged: a chunk without a size")
            if end < 0:
                break
            at = end + 1
            self._start(bytes(self._line).strip())
            self._line.clear()
        return bytes(found)

    def _start(self, line: bytes) -> None:
        if self._ends and not line:  # what ends the chunk before
            self._ends = False
            return
        size = line.partition(b";")[0].strip()
        if not _SIZE.fullmatch(size):
            raise DriverError("the caster's answer is damaged: a chunk without a size")
        self._left = int(size, 16)
        if self._left == 0:
            raise ConnectionResetError("the caster has ended the stream")


class Answer:
    """Reads what a caster answers to a request.

    Text of the caster is in no message, except names of mountpoints: an answer may repeat what was asked, and with it
    the password.

    Attributes
    ----------
    refused : it makes no sense to ask again soon
    outdated : the caster may know version 1 only
    streams : corrections follow
    """

    def __init__(self, mount: str, login: Login | None) -> None:
        self._mount, self._login = mount, login
        self._head = bytearray()
        self._chunks: Chunks | None = None
        self._table: SourceTable | None = None
        self.refused = self.streams = False
        self.outdated = True  # until it answers: one that does not may not understand the request

    def feed(self, data: bytes) -> bytes:
        """Return the corrections in these bytes.

        Raises
        ------
        DriverError
            The caster refuses, or it is none.
        ConnectionResetError
            The stream has ended.
        """
        if not self.streams and self._table is None:
            self._head += data
            data = self._read_head()
        if self._table is None and not self.streams:
            return b""
        body = data if self._chunks is None else self._chunks.feed(data)
        if self._table is None:
            return body
        if self._table.feed(body):
            raise self._unknown_mount()
        return b""

    def end(self) -> None:
        """Note that the caster has closed the connection; raises as :meth:`feed`."""
        if self._table is not None:
            raise self._unknown_mount()
        if not self.streams:
            raise ConnectionResetError("the caster has closed the connection without an answer")
        raise ConnectionResetError("the caster has closed the connection")

    def _read_head(self) -> bytes:
        """Return what follows the head, once that is complete."""
        line, end, rest = bytes(self._head).partition(b"\n")
        if end and line.startswith(b"ICY 200"):
            self.streams, self.outdated = True, False
            return rest  # what else there is of the head, the filter skips
        if end and line.startswith(b"SOURCETABLE 200"):
            self._table = SourceTable()
            return rest
        if end and line.startswith(b"ERROR"):
            raise self._old_error(line.lower())
        if end and not line.startswith(b"HTTP/1."):
            raise DriverError("this is not the answer of an NTRIP caster", hint="are host and port right?")
        head, end, rest = bytes(self._head).partition(b"\r\n\r\n")
        if not end:
            if len(self._head) > LONGEST_HEAD:
                raise DriverError("the caster's answer has no end", hint="are host and port right?")
            return b""
        self._read_http(head)
        return rest

    def _read_http(self, head: bytes) -> None:
        status = _STATUS.match(head)
        code = int(status[1]) if status else 0
        self.outdated = code in OLD_CASTER
        if code != 200:
            raise self._status_error(code)
        headers = dict(_header(line) for line in head.split(b"\r\n")[1:])
        if b"chunked" in headers.get(b"transfer-encoding", b""):
            self._chunks = Chunks()
        kind = headers.get(b"content-type", b"")
        if kind.startswith((b"gnss/sourcetable", b"text/plain")):
            self._table = SourceTable()
        elif kind.startswith(b"text/"):
            self.refused = True
            raise DriverError("it answers with a web page, not with corrections", hint="are host and port right?")
        else:
            self.streams = True

    # ------------------------------------------------------------------ errors
    def _status_error(self, code: int) -> DriverError:
        self.refused = True
        if code in (401, 403):
            return self._login_error(f" ({code})")
        if code == 404:
            return DriverError(f"the caster has no mountpoint '{self._mount}' (404)", hint="upper and lower case count")
        try:
            phrase = f"{code} {HTTPStatus(code).phrase}"
        except ValueError:
            phrase = "nothing that can be read" if code == 0 else str(code)
        return DriverError(f"the caster answers {phrase}")

    def _login_error(self, code: str) -> DriverError:
        self.refused = True
        if self._login is None:
            hint = "it wants a login: add login=FILE to the URL, a file with USER:PASSWORD"
            return DriverError(f"the caster refuses access without a login{code}", hint=hint)
        hint = "are user and password right, and is the account allowed this mountpoint?"
        return DriverError(f"the caster refuses the login{code}", hint=hint)

    def _old_error(self, line: bytes) -> DriverError:
        self.outdated = False
        if any(word in line for word in (b"pass", b"auth", b"user", b"login")):
            return self._login_error("")
        self.refused = True
        return DriverError(
            f"the caster refuses mountpoint '{self._mount}'", hint="it may be in use, or not be sent now"
        )

    def _unknown_mount(self) -> DriverError:
        self.refused, self.outdated = True, False
        names = self._table.names if self._table is not None else ()
        known = [name for name in names if self._login is None or not self._login.is_in(name)]
        if self._mount in known:
            what = f"the caster lists mountpoint '{self._mount}', but does not send it now"
            return DriverError(what, hint="is its base on?")
        return DriverError(f"the caster has no mountpoint '{self._mount}'", hint=_near(self._mount, known))


class SourceTable:
    """Collects the names of mountpoints from a caster's source table."""

    def __init__(self) -> None:
        self._line = bytearray()
        self._read = 0
        self.names: list[str] = []

    def feed(self, data: bytes) -> bool:
        """Take bytes in; return whether the table has ended, or is too long to go on."""
        self._read += len(data)
        *lines, rest = (bytes(self._line) + data).split(b"\n")
        self._line = bytearray(rest[:LONGEST_LINE])
        for line in lines:
            if line.startswith(b"ENDSOURCETABLE"):
                return True
            kind, _, fields = line.partition(b";")
            name = fields.partition(b";")[0].decode("latin-1").strip()
            if kind == b"STR" and MOUNT.fullmatch(name) and len(self.names) < MOST_NAMES:
                self.names.append(name)
        return self._read > LARGEST_TABLE


def _header(line: bytes) -> tuple[bytes, bytes]:
    name, _, value = line.partition(b":")
    return name.strip().lower(), value.strip().lower()


def _near(mount: str, names: Iterable[str]) -> str:
    """Return which mountpoint may be meant, in whatever case; the whole choice where it is short."""
    by_upper = {name.upper(): name for name in names}
    near = nearest(mount.upper(), by_upper)
    if near:
        return did_you_mean(by_upper[near], [by_upper[near]])
    if len(by_upper) <= SHOWN_NAMES:
        return did_you_mean(mount, by_upper.values())
    return f"it has {len(by_upper)} others"
