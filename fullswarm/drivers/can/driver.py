"""Drives a CAN base: a :class:`.session.Session` on a bus."""

from __future__ import annotations

from fullswarm.clock import Clock
from fullswarm.drivers.can.port import CanPort
from fullswarm.drivers.can.protocol import Frame
from fullswarm.drivers.can.session import Session
from fullswarm.drivers.can.settings import parse
from fullswarm.drivers.linked import LinkedDriver


class CanBaseDriver(LinkedDriver[Frame]):
    """A :class:`~fullswarm.drivers.base.Driver` for two wheels with an ODrive axis or a VESC each.

    ``can+odrive://vcan0?left=1&right=2&wheel_radius=0.05&base=0.3`` or ``can+vesc://…&pole_pairs=7``; further
    options are in :mod:`fullswarm.drivers.can.settings`. Set-points go out at 50 Hz. Should this process die, its
    guardian brakes. Should the computer die or the cable come off, only the controllers' own watchdogs stop the robot:
    a VESC's is on (1 s, it then coasts), an ODrive's must be switched on once over USB (see
    :class:`~fullswarm.drivers.can.odrive.OdriveCodec`) and declared with ``watchdog=0.5``. Neither protocol can do that
    over CAN.

    Raises
    ------
    ConfigError
        Names all that is wrong with the URL.
    """

    def __init__(self, url: str, clock: Clock | None = None) -> None:
        settings = parse(url)
        base, codecs = settings.base, settings.codecs()
        self._codecs = codecs
        super().__init__(
            url,
            settings.description(),
            session=lambda now_s: Session(codecs, base.base, settings.wheel_limit_m_s, base.volts, now_s),
            port=lambda: CanPort(settings),
            guardian=None if settings.bus.guardian is None else settings.bus.guardian == "1",
            warning=settings.warning,
            clock=clock,
        )

    @property
    def malformed(self) -> int:
        """How many frames could not be understood since construction."""
        return sum(codec.malformed for codec in self._codecs)
