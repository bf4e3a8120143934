"""Drives an Acme Scout: ``acme://192.168.7.20:7700``. It adds only the URL and the session to `LinkedDriver`."""

from fullswarm.clock import Clock
from fullswarm.drivers.base import Description
from fullswarm.drivers.linked import LinkedDriver
from fullswarm.drivers.ports import TcpPort, parse_address

from fullswarm_acme.protocol import WATCHDOG_S
from fullswarm_acme.session import LIMITS, Session


class AcmeDriver(LinkedDriver[bytes]):
    """A :class:`~fullswarm.drivers.base.Driver` for an Acme Scout; ``ConfigError`` if the URL is not that of a Scout."""

    def __init__(self, url: str, clock: Clock | None = None) -> None:
        host, port = parse_address(url.removeprefix("acme://"), where=url)
        super().__init__(
            url,
            Description("Acme", "Scout", radius_m=0.2, limits=LIMITS, senses_bumps=True, watchdog_s=WATCHDOG_S),
            session=lambda _: Session(),
            port=lambda: TcpPort(host, port, clock=clock),
            guardian=None,
            clock=clock,
        )
