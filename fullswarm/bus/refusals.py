"""Logs what a secured hub refuses: which certificate, what it tried, on which key, how often.

Zenoh drops what its access list denies without notice, and names it only in its own trace log on stdout. So the hub's
process reads that log through a pipe. The reading thread only counts, and a timer of the process logs the counts: a
terminal that blocks stops no message, and a flood becomes a few lines per certificate each 10 s.

A key may contain any text, line breaks included. So a refusal has the name that belongs to the id of the session in
zenoh's line, which other clients do not know, and never a name that the line states.
"""

from __future__ import annotations

import os
import re
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import structlog
import zenoh

from fullswarm.bus.codec import LARGEST_BYTES
from fullswarm.recent import Recent

log = structlog.get_logger("fullswarm.hub")

AGAIN_S = 10.0
"""A refusal that goes on is logged this often, with its count."""
REPORT_S = 0.5
"""How often the process looks whether there is something to log."""
KEYS, KINDS, SESSIONS = 16, 1024, 4096
"""Keys of one certificate that are counted apart; all kinds of refusals; sessions whose certificate is known."""
CHUNK, CARRY = 1 << 18, 1 << 14
"""Bytes that are read at once; bytes that are kept of what was read before: the line in front names the refusal."""
PIPE_BYTES = 1 << 20
"""Of zenoh's log that wait to be read: zenoh, and with it the hub, waits when the pipe is full."""
PARSED = 200
"""Refusals of one chunk that are looked at; those beyond are counted under the last of them."""
LONGEST_KEY = 128
RUST_LOG = "RUST_LOG"
"""Whoever sets it wants zenoh's log on stdout: then nothing is read."""
FILTER = "off,zenoh::net::routing::interceptor=trace,zenoh_link_tls=trace"
"""What zenoh is to log: what its access list and its limit of the size refuse, failed handshakes, links that end."""

_REFUSED = b"Msg intercepted!"
_LINKED = re.compile(
    rb"zid: ([0-9a-f]{1,32}),[^\n]*? dst: tls/([^,\s]+),[^\n]*? auth_identifier: Tls\(Some\(\"([^\"\n]*)\"\)\)"
)
_UNLISTED = re.compile(rb"([0-9a-f]{1,32}) did not match any configured ACL subject")
_THREAD = re.compile(rb"ThreadId\(\d+\)")
_DECISION = re.compile(
    rb"([0-9a-f]{1,32})(?: on [^\n]+?)? is (un)?authorized to ([A-Z][A-Za-z/ ]*) \((ingress|egress)\) on ([^\n]*)"
)
_ENDED = re.compile(rb"(?:Closing|Read error on) TLS link:? \S+ => (\S+?):?\s")
_HANDSHAKE = re.compile(rb"WARN[^\n]*? [^ ]*zenoh_link_tls::unicast[^ ]* ([^\n]*)\n")
_DETAIL = re.compile(r"(\.? Hint: |: verification time ).*")
_TRIED = {"Put": "publish", "Delete": "delete", "Query": "query", "Reply": "reply"}
_TOO_LARGE = f"publish more than {LARGEST_BYTES} bytes"
_SOMETHING = "something, with a certificate that cannot be told"
_NOT_LISTED = "connect, and it is not in the list of valid certificates"


class Refusal(NamedTuple):
    """The certificate's common name, what was refused, and the key or the address; empty: not known, or many."""

    certificate: str
    tried: str
    where: str = ""


@dataclass(slots=True)
class Count:
    """How often something was refused since it was last logged."""

    number: int = 0
    logged_s: float | None = None


class RefusalLog:
    """Counts refusals in zenoh's log, and logs them.

    Parameters
    ----------
    now_s
        Returns the monotonic time.
    """

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s, self._lock = now_s, threading.Lock()
        self._counts: Recent[Refusal, Count] = Recent(KINDS)
        self._names: Recent[bytes, str] = Recent(SESSIONS)
        self._unlisted: Recent[bytes, None] = Recent(SESSIONS)  # sessions that no entry of the list matches
        self._strangers: Recent[str, None] = Recent(SESSIONS)  # addresses of those that are linked
        self._text, self._done = b"", 0
        self._stdout: int | None = None

    # ------------------------------------------------------------------ the pipe
    def start(self) -> None:
        """Read what zenoh logs from now on: stdout is zenoh's until :meth:`close`. Once per process."""
        if os.environ.get(RUST_LOG):
            log.warning("refusals are not logged: with RUST_LOG set, zenoh's own log is on stdout")
            return
        sys.stdout.flush()
        reading, writing = os.pipe()
        if sys.platform == "linux":
            import fcntl

            with suppress(OSError):  # the system allows this user less
                fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        self._stdout = os.dup(1)
        os.dup2(writing, 1)
        os.close(writing)
        zenoh.init_log_from_env_or(FILTER)
        threading.Thread(target=self._read, args=(reading,), name="fullswarm-refusals", daemon=True).start()

    def close(self) -> None:
        """Read no more, and log what was counted last. Zenoh's log is lost from then on."""
        stdout, self._stdout = self._stdout, None
        if stdout is not None:
            silence = os.open(os.devnull, os.O_WRONLY)
            os.dup2(silence, 1)  # no writing end of the pipe is left, so the reader ends
            os.close(silence)
            os.close(stdout)
        self.report()

    def _read(self, reading: int) -> None:
        while chunk := os.read(reading, CHUNK):
            try:
                self.feed(chunk)
            except Exception as error:  # any: a pipe that is not read blocks the hub
                self._text, self._done = b"", 0
                log.error("a piece of zenoh's log cannot be read", error=f"{type(error).__name__}: {error}")
        os.close(reading)

    # ------------------------------------------------------------------ counting
    def feed(self, chunk: bytes) -> None:
        """Count the refusals in a piece of zenoh's log, which may begin and end anywhere."""
        text = self._text + chunk
        end = text.rfind(b"\n") + 1
        if end > self._done:
            with self._lock:
                self._take(text, self._done, end)
            self._done = end
        cut = max(0, min(self._done, len(text)) - CARRY)
        self._text, self._done = text[cut:][-(CARRY + CHUNK) :], self._done - cut

    def _take(self, text: bytes, begin: int, end: int) -> None:
        for found in _UNLISTED.finditer(text, begin, end):
            self._unlisted[found[1]] = None
        for found in _LINKED.finditer(text, begin, end):
            session, address, name = found[1], _plain(found[2]), _plain(found[3])
            self._names[session] = name
            if session in self._unlisted:
                self._strangers[address] = None
                self._count(Refusal(name, _NOT_LISTED, address))
        for found in _ENDED.finditer(text, begin, end):
            self._strangers.pop(_plain(found[1]), None)
        for found in _HANDSHAKE.finditer(text, begin, end):
            self._count(Refusal("", f"connect: {_DETAIL.sub('', _plain(found[1]))}"))
        place, refusal = begin, None
        for _ in range(PARSED):
            place = text.find(_REFUSED, place, end)
            if place < 0:
                return
            refusal = self._named(text, place)
            self._count(refusal)
            place += len(_REFUSED)
        more = text.count(_REFUSED, place, end)
        if refusal is not None and more:
            self._count(refusal, more)

    def _named(self, text: bytes, place: int) -> Refusal:
        """Return what was refused at `place`: the line in front of it, of the same thread, is about it."""
        line = text.rfind(b"\n", 0, place) + 1
        thread = _THREAD.search(text, line, place)
        before = -1 if thread is None else text.rfind(thread[0], 0, line)
        found = None if before < 0 else _DECISION.search(text, before, line)
        name = None if found is None else self._names.get(found[1])
        if found is None or name is None or found[4] == b"egress":
            return Refusal("", _SOMETHING)
        if found[2]:
            action = _plain(found[3])
            tried = _TRIED.get(action, "receive" if "Subscriber" in action else action)
            return Refusal(name, tried, _plain(found[5]))
        if self._strangers:  # of theirs zenoh logs no decision: the one in front is another session's
            return Refusal("", _SOMETHING)
        return Refusal(name, _TOO_LARGE, _plain(found[5]))

    def _count(self, refusal: Refusal, number: int = 1) -> None:
        count = self._counts.get(refusal)
        if count is None:
            kind = refusal[:2]
            if sum(each[:2] == kind for each in self._counts) >= KEYS:
                refusal = Refusal(*kind)
            count = self._counts.setdefault(refusal, Count())
        count.number += number

    # ------------------------------------------------------------------ logging
    def report(self) -> None:
        """Log what is new, or was last logged more than `AGAIN_S` ago and has occurred since."""
        now_s, due = self._now_s(), []
        with self._lock:
            for refusal, count in list(self._counts.items()):
                if count.logged_s is not None and now_s - count.logged_s < AGAIN_S:
                    continue
                if not count.number:
                    del self._counts[refusal]
                    continue
                due.append((refusal, count.number))
                count.number, count.logged_s = 0, now_s
        for (certificate, tried, where), number in due:
            facts = {"certificate": certificate, "where": where}
            stated = {name: value for name, value in facts.items() if value}
            log.warning("the hub refused", tried=tried, **stated, times=number)


def _plain(text: bytes) -> str:
    """Return text of a line for people: without colours and line breaks, and not too long."""
    line = text.decode(errors="replace").removesuffix("\n").removesuffix("\x1b[0m")
    return "".join(each if each.isprintable() else "?" for each in line[:LONGEST_KEY])
