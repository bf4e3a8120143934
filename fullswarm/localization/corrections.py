"""Brings RTK corrections to a GNSS receiver: from an NTRIP caster, or as a plain RTCM stream over TCP.

A link of its own (`links.py`) reads them, so that neither a caster that hangs nor the search for its address delays
positions. Only well-formed RTCM 3 frames get into the outbox of the receiver's port, and a stated number of bytes per
second is looked at: the rest waits in the system's buffers and slows the sender.
"""

from __future__ import annotations

import math
import re
import socket
import ssl
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar
from urllib.parse import unquote

import structlog

from fullswarm.clock import Clock
from fullswarm.errors import ConfigError, DriverError, LinkLost
from fullswarm.identity.private import check_private
from fullswarm.localization.links import CONNECT_S, RETRY_S, Connection, HasFileno, Link
from fullswarm.localization.ntrip import MOUNT, Answer, Login, Place, request
from fullswarm.localization.rtcm import SLOW_S, FrameFilter, Outbox
from fullswarm.localization.source import Content

log = structlog.get_logger()

T = TypeVar("T")

PORTS = {"ntrip": 2101, "ntrips": 0, "tcp": 0}
"""Usual ports by scheme; 0: there is none, it must be stated."""
EXAMPLE = "rtcm=ntrip://caster.example:2101/MOUNTPOINT or rtcm=tcp://192.168.1.9:5015"
GGA_S = 10.0
SILENT_S = 10.0
NO_FRAMES_S = 30.0
"""What sends bytes without one RTCM 3 frame for so long sends something else."""
LATE_S = 10.0
"""So long no corrections are no trouble."""
CLOSE_S = 0.5
LONGEST_RETRY_S, REFUSED_RETRY_S = 60.0, 30.0
PIECE = 16_384
"""Bytes read at once: a whole TLS record, since `select` does not see the rest of one."""
WORK_PER_S = 65_536.0
"""Bytes checked per second: ten times what a network of reference stations sends, 10 ms of a small computer."""
STEPS = (10.0, 30.0, 60.0, 300.0, 600.0, 1800.0, 3600.0, 21_600.0, 86_400.0)
"""Ages (s) at which the report of missing corrections is renewed."""
LONGEST_LOGIN = 500
_LABEL = r"[A-Za-z0-9_-]{1,63}"
_HOST = re.compile(rf"(?=.{{1,253}}\Z){_LABEL}(\.{_LABEL})*\.?|\[[0-9A-Fa-f:.]{{2,60}}\]")


@dataclass(frozen=True, slots=True)
class Corrections:
    """Where corrections come from.

    Parameters
    ----------
    scheme : one of `PORTS`
    mount : the mountpoint; empty: a plain stream
    login : as the URL states it
    login_file : what contains ``USER:PASSWORD``; read at each attempt, so that it may be replaced
    """

    scheme: str
    host: str
    port: int
    mount: str = ""
    login: Login | None = field(default=None, repr=False)
    login_file: Path | None = None

    @property
    def address(self) -> str:
        """The URL without a login, for messages."""
        return f"{self.scheme}://{self.host}:{self.port}{f'/{self.mount}' if self.mount else ''}"

    def find_login(self) -> Login | None:
        """Return user and password; raises `DriverError` where the file does not contain them."""
        if self.login_file is None:
            return self.login
        where = str(self.login_file)
        try:
            check_private(self.login_file)
            with self.login_file.open(encoding="utf-8") as file:
                user, colon, password = file.readline(LONGEST_LOGIN).strip().partition(":")
        except ConfigError as error:
            raise DriverError(error.what, where=error.where, hint=error.hint) from None
        except (OSError, UnicodeDecodeError) as error:
            why = error.strerror if isinstance(error, OSError) else "not text"
            hint = "one line USER:PASSWORD, readable by the user of this process only"
            raise DriverError(f"the login cannot be read: {why}", where=where, hint=hint) from None
        if not colon or not user:
            raise DriverError("this is no login", where=where, hint="one line USER:PASSWORD")
        return Login(user, password)


# ---------------------------------------------------------------- the options of a URL
def options_of(url: str) -> dict[str, str]:
    """Return the options of a URL as they are written; a ``#`` is a character like others."""
    pairs = (part.partition("=") for part in url.partition("?")[2].split("&"))
    return {key: value for key, _, value in pairs if key}


def take_corrections(options: dict[str, str], where: str) -> Corrections | None:
    """Return what the options ``rtcm`` and ``login`` say, which are removed; None: no corrections.

    No message repeats what may be a part of a password.

    Raises
    ------
    ConfigError
        They are wrong.
    """
    target, file = options.pop("rtcm", ""), options.pop("login", "")
    if any("@" in text for option in options.items() for text in option):
        hint = "in a user and a password write %26 for & and %25 for %, or use login=FILE"
        raise ConfigError("'@' in an option that has none", where=where, hint=hint)
    if file and not file.startswith("/"):
        raise ConfigError("login is no absolute path", where=where, hint="like login=/etc/fullswarm/ntrip")
    if not target:
        if file:
            raise ConfigError("login without rtcm", where=where, hint=EXAMPLE)
        return None
    found = _parse(target, where)
    if not file:
        return found
    if found.login is not None or found.scheme == "tcp":
        what = "two logins: in rtcm and in login" if found.login else "a plain stream takes no login"
        raise ConfigError(what, where=where, hint="remove one" if found.login else EXAMPLE)
    return replace(found, login_file=Path(unquote(file)))


def _parse(target: str, where: str) -> Corrections:
    userinfo, at, rest = target.rpartition("@")
    scheme, separator, first = (userinfo if at else rest).partition("://")
    if not separator or scheme not in PORTS:
        raise ConfigError("rtcm is no URL of corrections", where=where, hint=EXAMPLE)
    address, _, mount = (rest if at else first).partition("/")
    found = re.fullmatch(r"(.*?)(?::(\d{1,5}))?", address)
    host, port = (found[1], int(found[2] or PORTS[scheme])) if found else ("", 0)
    if not _HOST.fullmatch(host):
        raise ConfigError("rtcm names no host", where=where, hint=EXAMPLE)
    if not 0 < port <= 65_535:
        raise ConfigError("rtcm names no port", where=where, hint=EXAMPLE)
    mount = unquote(mount)
    if scheme == "tcp" and (mount or at):
        raise ConfigError("a plain stream has no mountpoint and no login", where=where, hint=EXAMPLE)
    if scheme != "tcp" and not MOUNT.fullmatch(mount):
        raise ConfigError("rtcm names no mountpoint", where=where, hint=EXAMPLE)
    return Corrections(scheme, host, port, mount, _login(first, where) if at else None)


def _login(userinfo: str, where: str) -> Login:
    user, colon, password = userinfo.partition(":")
    if not user or not colon:
        raise ConfigError("rtcm has a user without a password", where=where, hint="USER:PASSWORD@, or login=FILE")
    return Login(unquote(user), unquote(password))


# ---------------------------------------------------------------- the connection
class CorrectionStream(Connection):
    """One connection to a caster, or to what sends a plain stream.

    Parameters
    ----------
    peer : connected
    answer : reads what a caster answers; None: a plain stream
    ask : what is sent first
    take : gets each frame and when it came
    gga : the receiver's position as a sentence; empty: it has none yet
    """

    def __init__(
        self,
        peer: socket.socket,
        answer: Answer | None,
        ask: bytes,
        take: Callable[[bytes, float], None],
        gga: Callable[[], bytes],
    ) -> None:
        peer.setblocking(False)
        self._socket, self._answer, self._take, self._gga = peer, answer, take, gga
        self._unsent, self._filter = ask, FrameFilter()
        self._began_s: float | None = None
        self._heard_s = self._framed_s = self._worked_s = 0.0
        self._work, self._next_gga_s, self._placed = WORK_PER_S, 0.0, False

    def waits_on(self) -> Sequence[HasFileno]:
        """Return the socket, unless there is enough to look at."""
        return () if self._filter.behind else (self._socket,)

    def read(self, ready: HasFileno, now_s: float) -> Iterable[tuple[str, bytes]]:
        """Take in what has arrived; frames are delivered at the next turn."""
        del ready
        data = _unblocked(lambda: self._socket.recv(PIECE))
        if data is None:
            return ()
        if not data:
            if self._answer is not None:
                self._answer.end()
            raise ConnectionResetError("the other side has closed the connection")
        self._heard_s = now_s
        self._filter.add(data if self._answer is None else self._answer.feed(data))
        return ()

    def turn(self, now_s: float) -> None:
        """Deliver frames, send the position, notice silence."""
        if self._began_s is None:
            self._began_s = self._heard_s = self._framed_s = self._worked_s = now_s
        self._work = min(WORK_PER_S, self._work + WORK_PER_S * (now_s - self._worked_s))
        self._worked_s = now_s
        frames, done = self._filter.take(self._work)
        self._work -= done
        if self._filter.behind:
            self._heard_s = now_s  # it is not read meanwhile
        for frame in frames:
            self._framed_s = now_s
            self._take(frame, now_s)
        if self._answer is not None and self._answer.streams and now_s >= self._next_gga_s:
            self._send_position(now_s)
        if self._unsent:
            self._unsent = self._unsent[_unblocked(lambda: self._socket.send(self._unsent)) or 0 :]
        self._check(now_s)

    def _send_position(self, now_s: float) -> None:
        sentence = self._gga()
        if sentence and len(self._unsent) < PIECE:
            self._unsent += sentence
            self._next_gga_s, self._placed = now_s + GGA_S, True

    def _check(self, now_s: float) -> None:
        """Raise `LinkLost` where nothing arrives, or nothing of use."""
        if now_s - self._heard_s > SILENT_S:
            waits = self._answer is not None and self._answer.streams and not self._placed
            hint = "a network (VRS) mountpoint sends nothing before the receiver has a position" if waits else ""
            raise LinkLost(f"nothing arrives for {SILENT_S:g} s", hint=hint)
        streams = self._answer is None or self._answer.streams
        if streams and now_s - self._framed_s > NO_FRAMES_S:
            raise LinkLost("what arrives is not RTCM 3", hint="is this mountpoint or port that of a base?")

    def close(self) -> None:
        """Release it."""
        self._socket.close()


def _unblocked(call: Callable[[], T]) -> T | None:
    """Return what a call on a socket returns; None: not now."""
    try:
        return call()
    except (BlockingIOError, ssl.SSLWantReadError, ssl.SSLWantWriteError):
        return None


class CorrectionFeed:
    """Keeps corrections coming into the outbox of a receiver's port, and states why there are none.

    Parameters
    ----------
    place : where the receiver is; None: it does not know
    """

    def __init__(self, source: Corrections, outbox: Outbox, place: Callable[[], Place | None], clock: Clock) -> None:
        self._source, self._outbox, self._place, self._clock = source, outbox, place, clock
        self._began_s, self._frame_s = clock.now_s(), -math.inf
        self._answer: Answer | None = None
        self._version, self._wait_s = 2, 0.0
        self._flowing = self._firm = False
        self._reason = ""
        self._link = Link(self._connect, source.address, clock, lost="", retry_s=self._retry_s)

    def start(self) -> None:
        """Bring corrections from now on."""
        self._began_s = self._clock.now_s()
        self._link.start(self)

    def close(self) -> None:
        """Bring no more."""
        self._link.close(CLOSE_S)

    def trouble(self, now_s: float) -> str:
        """Return why the receiver lacks corrections, in words that change a few times only; empty: it has them."""
        if now_s - self._outbox.dropped_s < SLOW_S:
            return "corrections are dropped: the receiver's port takes less than arrives; is its baud rate too low?"
        late_s = now_s - max(self._began_s, self._frame_s)
        step_s = max((each for each in STEPS if each <= late_s), default=0.0)
        why = f": {self._reason}" if self._reason else ""
        if step_s < LATE_S:
            return f"no corrections yet{why}" if why and self._frame_s < self._began_s else ""
        return f"no corrections for {_duration(step_s)}{why}"

    # ------------------------------------------------------------------ on the link's thread
    def arrive(self, arrival_s: float, sender: str, content: Content) -> None:
        """Take nothing: frames go into the outbox."""

    def report(self, trouble: str) -> None:
        """Take why the connection is down. What the caster said of the request counts more than how it ended."""
        answer = self._answer
        if not trouble or (self._firm and answer is not None and answer.outdated and self._version == 2):
            return
        if self._version == 1 and self._reason and answer is not None and not answer.refused:
            return
        self._reason = trouble
        self._firm = self._version == 1 and answer is not None and answer.refused

    def _connect(self) -> Connection:
        self._answer, self._flowing = None, False
        source = self._source
        login = source.find_login()
        peer = socket.create_connection((source.host.strip("[]"), source.port), CONNECT_S)
        try:
            if source.scheme == "ntrips":
                context = ssl.create_default_context()
                peer = context.wrap_socket(peer, server_hostname=source.host.strip("[]"))
        except OSError:
            peer.close()
            raise
        if source.scheme == "tcp":
            return CorrectionStream(peer, None, b"", self._take, self._gga)
        self._answer = Answer(source.mount, login)
        ask = request(f"{source.host}:{source.port}", source.mount, login, self._version, self._gga())
        return CorrectionStream(peer, self._answer, ask, self._take, self._gga)

    def _gga(self) -> bytes:
        place = self._place()
        return b"" if place is None else place.gga()

    def _take(self, frame: bytes, now_s: float) -> None:
        if not self._flowing:
            log.info("corrections arrive", source=self._source.address)
        self._flowing, self._frame_s, self._reason = True, now_s, ""
        self._outbox.put(frame, now_s)

    def _retry_s(self) -> float:
        """Return the time until the next attempt: casters block who asks often in vain."""
        answer = self._answer
        if self._flowing:
            self._wait_s = RETRY_S
        elif answer is not None and answer.outdated and self._version == 2:
            self._version = 1
            return RETRY_S
        else:
            least_s = REFUSED_RETRY_S if answer is not None and answer.refused else RETRY_S
            self._version, self._wait_s = 2, min(LONGEST_RETRY_S, max(least_s, 2.0 * self._wait_s))
        return self._wait_s


def _duration(seconds: float) -> str:
    """Return a time of `STEPS` in words."""
    for unit_s, name in ((86_400.0, "d"), (3600.0, "h"), (60.0, "min")):
        if seconds >= unit_s:
            return f"{seconds / unit_s:g} {name}"
    return f"{seconds:g} s"
