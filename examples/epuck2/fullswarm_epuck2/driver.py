"""Drives an e-puck2: ``epuck2:///dev/rfcomm0`` (Bluetooth) or ``epuck2:///dev/ttyACM0`` (USB).

The robot drives on at its last speed for ever. With a guardian (agents and `robots test` have one) the port is held by
a process that stops the robot when this one is killed or frozen; ``guardian=0`` in the URL: none. Bluetooth that is out
of reach cannot be stopped by anyone: keep the speed low, or put the driver on a computer on the robot.
"""

from collections.abc import Callable
from urllib.parse import parse_qsl, unquote, urlsplit

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.guardian import Attempts, GuardedPort
from fullswarm.drivers.linked import LinkedDriver
from fullswarm.drivers.make import Claim, device_claim
from fullswarm.drivers.ports import Port, SerialPort
from fullswarm.errors import ConfigError

from fullswarm_epuck2.protocol import PARK
from fullswarm_epuck2.session import DESCRIPTION, Session

BAUD = 115200
UNSTOPPED = "an e-puck2 out of the radio's reach drives on at its last speed: nothing on the robot stops it"


class Epuck2Driver(LinkedDriver[bytes]):
    """A :class:`~fullswarm.drivers.base.Driver` for an e-puck2; ``ConfigError`` if the URL is not that of one."""

    def __init__(self, url: str, clock: Clock | None = None) -> None:
        path, guardian = parse_url(url)
        clock = clock or MonotonicClock()
        attempts = Attempts(clock)

        def port() -> Port[bytes]:
            if self.guarded:
                return GuardedPort(path, BAUD, PARK, clock, attempts)
            return SerialPort(path, BAUD, clock)

        super().__init__(
            url, DESCRIPTION, session=_new_session(), port=port, guardian=guardian, warning=UNSTOPPED, clock=clock
        )


def _new_session() -> Callable[[float], Session]:
    return lambda _: Session()


def parse_url(url: str) -> tuple[str, bool | None]:
    """Return the device and whether the URL wants a guardian; None: the opener of the driver decides."""
    parts = urlsplit(url)
    path, options = unquote(parts.path), dict(parse_qsl(parts.query, keep_blank_values=True))
    if parts.scheme != "epuck2" or parts.netloc or not path.startswith("/") or path == "/":
        raise ConfigError("this names no serial port", where=url, hint="write epuck2:///dev/rfcomm0")
    if options and (set(options) != {"guardian"} or options["guardian"] not in ("0", "1")):
        raise ConfigError("the only option is guardian=0 or 1", where=url)
    return path, options["guardian"] == "1" if options else None


def claims(url: str, elsewhere: bool) -> tuple[Claim, ...]:
    """Return what only one robot of a computer can have: its serial port."""
    return (device_claim(parse_url(url)[0], elsewhere=elsewhere),)
