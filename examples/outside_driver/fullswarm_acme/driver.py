"""Drives an Acme Scout: ``acme://192.168.7.20:7700``. It adds only the URL and the session to `LinkedDriver`."""

from __future__ import annotations

from urllib.parse import urlsplit

from fullswarm.clock import Clock
from fullswarm.drivers.base import Description
from fullswarm.drivers.linked import LinkedDriver
from fullswarm.drivers.ports import TcpPort
from fullswarm.errors import ConfigError

from fullswarm_acme.protocol import WATCHDOG_S
from fullswarm_acme.session import LIMITS, Session

PORT = 7700
SILENCE_S = 2.0
"""A connection without a byte for so long is opened anew: TCP itself would not notice for minutes."""


class AcmeDriver(LinkedDriver[bytes]):
    """A :class:`~fullswarm.drivers.base.Driver` for an Acme Scout; ``ConfigError`` if the URL is not that of a Scout."""

    def __init__(self, url: str, clock: Clock | None = None) -> None:
        host, port = _address(url)
        super().__init__(
            url,
            Description("Acme", "Scout", radius_m=0.2, limits=LIMITS, senses_bumps=True, watchdog_s=WATCHDOG_S),
            session=lambda _: Session(f"{host}:{port}"),
            port=lambda: TcpPort(host, port, silence_s=SILENCE_S, clock=clock),
            guardian=None,
            clock=clock,
        )


def _address(url: str) -> tuple[str, int]:
    try:
        parts = urlsplit(url)
        port = parts.port or PORT
    except ValueError as error:
        raise ConfigError(f"not a URL: {error}", where=url) from error
    if parts.scheme != "acme" or not parts.hostname or parts.path or parts.query:
        raise ConfigError("not the URL of an Acme robot", where=url, hint=f"write acme://192.168.7.20:{PORT}")
    return parts.hostname, port
