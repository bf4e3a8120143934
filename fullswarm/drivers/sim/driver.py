"""Drives one simulated robot over UDP to the world's process."""

from __future__ import annotations

from fullswarm.clock import Clock
from fullswarm.drivers.linked import LinkedDriver
from fullswarm.drivers.ports import UdpPort
from fullswarm.drivers.sim.session import Session
from fullswarm.drivers.sim.settings import parse_url


class SimDriver(LinkedDriver[bytes]):
    """A :class:`~fullswarm.drivers.base.Driver` for ``sim://r1`` or ``sim://127.0.0.1:7450/r1``."""

    def __init__(self, url: str, clock: Clock | None = None) -> None:
        parsed = parse_url(url)
        super().__init__(
            url,
            parsed.description,
            session=lambda now_s: Session(parsed, now_s),
            port=lambda: UdpPort(parsed.host, parsed.port),
            clock=clock,
        )
