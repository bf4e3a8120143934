"""Controls access: Host, Origin and token, how often, and what every answer carries along.

A page of any other origin can make a browser send requests here, and open WebSockets. Three things keep it out: it
does not know the token, its Origin is not this server's, and a name that it had pointed at this address is not ours.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
from collections.abc import Iterable
from dataclasses import dataclass, field

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from fullswarm.bus.endpoint import is_loopback

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
_HOST = re.compile(r"(?P<name>\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(?::(?P<port>[0-9]{1,5}))?\Z")


@dataclass(frozen=True, slots=True)
class Names:
    """The names by which this server may be called.

    Parameters
    ----------
    bound
        Address that it listens on.
    port
        Its port.
    also
        Names that the user allows; a port of their own, or any: a proxy in front may have its own.
    """

    bound: str
    port: int
    also: frozenset[str] = frozenset()

    def host(self, value: str) -> bool:
        """Tell whether a Host header names this server."""
        match = _HOST.match(value)
        if match is None:
            return False
        name, port = match["name"].strip("[]").lower(), match["port"]
        if name in self.also or value.lower() in self.also:
            return True
        if int(port or 80) != self.port:
            return False
        if name == self.bound.lower():
            return True
        if is_loopback(self.bound) or not _is_any(self.bound):
            return is_loopback(self.bound) and is_loopback(name)
        # Bound to all addresses: any plain address is one of ours. A name could be anybody's.
        return name == "localhost" or _is_address(name)

    def origin(self, value: str, host: str) -> bool:
        """Tell whether an Origin header is this server, called as the Host header says."""
        scheme, _, origin_host = value.partition("://")
        if origin_host.lower() != host.lower():
            return False
        name = host.rpartition(":")[0] or host
        return scheme == "http" or (scheme == "https" and {host.lower(), name.lower()} & self.also != set())


def _is_any(address: str) -> bool:
    return address in ("0.0.0.0", "::")  # noqa: S104  (compared, not bound)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def same_token(given: str, wanted: str) -> bool:
    """Compare two tokens in a time that does not tell where they differ."""
    return hmac.compare_digest(given.encode(), wanted.encode())


class Guard:
    """Lets only requests by this server's own name and from its own page through; adds the security headers."""

    def __init__(self, app: ASGIApp, names: Names) -> None:
        self._app, self._names = app, names

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        reason = self._refuses(Headers(scope=scope), needs_origin=scope["type"] == "websocket")

        async def send_with_headers(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers[name] = value
                headers.setdefault("Cache-Control", "no-store")
            await send(message)

        if not reason:
            await self._app(scope, receive, send_with_headers)
            return
        if scope["type"] == "websocket":
            await receive()  # the opening, which must be taken before it may be refused
        await PlainTextResponse(reason, 403)(scope, receive, send_with_headers)

    def _refuses(self, headers: Headers, *, needs_origin: bool) -> str:
        hosts, origins = headers.getlist("host"), headers.getlist("origin")
        if len(hosts) != 1 or not self._names.host(hosts[0]):
            return "this is not the name of this console; allow it with --allow-host"
        if len(origins) > 1 or (needs_origin and not origins):
            return "a WebSocket must come from this console's own page"
        if origins and not self._names.origin(origins[0], hosts[0]):
            return "a page of another origin has no business here"
        return ""


@dataclass(slots=True)
class Bucket:
    """How many frames a page may send: `rate_hz` for long, `burst` at once."""

    rate_hz: float
    burst: float
    _left: float = field(init=False)
    _at_s: float | None = None

    def __post_init__(self) -> None:
        self._left = self.burst

    def take(self, now_s: float) -> bool:
        """Book one frame; False when it is too many."""
        if self._at_s is not None:
            self._left = min(self.burst, self._left + (now_s - self._at_s) * self.rate_hz)
        self._at_s = now_s
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


def lower(names: Iterable[str]) -> frozenset[str]:
    """Return names as they are compared."""
    return frozenset(name.strip().lower() for name in names if name.strip())
