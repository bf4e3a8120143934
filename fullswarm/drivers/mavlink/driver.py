"""Drives a MAVLink rover: a :class:`.session.Session` on UDP, TCP or a serial port. URL: :mod:`.settings`.

Opening writes one parameter, for good, so that a rover whose link is lost stops by itself: ``FS_GCS_ENABLE=1`` on
ArduPilot, once ``FS_ACTION`` is seen to be HOLD (2) or Terminate (5); ``COM_OBL_RC_ACT=5`` on PX4 (Hold).
"""

from __future__ import annotations

from functools import partial

from fullswarm.clock import Clock
from fullswarm.drivers.base import Lifecycle, Pose
from fullswarm.drivers.linked import LinkedDriver
from fullswarm.drivers.mavlink.codec import dialect
from fullswarm.drivers.mavlink.session import Session
from fullswarm.drivers.mavlink.settings import describe, parse_url, read_settings


class MavlinkDriver(LinkedDriver[bytes]):
    """An ArduPilot or PX4 rover. Nothing is touched before :meth:`open`, nothing moves before :meth:`activate`.

    `activate` starts an attempt and returns: ACTIVE follows once the vehicle's heartbeats show GUIDED (PX4: OFFBOARD)
    and armed. When it refuses, the state stays READY and `fault` holds the firmware's words. When a pilot changes the
    mode, the state goes to READY, the reading shows ESTOP_BUTTON, and the driver keeps off until the pilot hands it
    back, or until `activate` comes after a pause of a second.

    `open` raises ``ConfigError`` for a signing key that cannot be used, and ``MissingExtra`` without pymavlink.

    Raises
    ------
    ConfigError
        The URL is wrong.
    """

    def __init__(self, url: str, clock: Clock | None = None) -> None:
        address, options = parse_url(url)
        self._settings = read_settings(url, str(address), options)
        self._own_session: Session | None = None
        super().__init__(
            url,
            self._settings.description,  # of an ArduPilot, until a heartbeat reports PX4
            session=self._begin,
            port=lambda: address.open(
                lambda datagram: self._own_session is not None and self._own_session.accepts(datagram)
            ),
            guardian=self._settings.guardian,
            clock=clock,
        )

    def _begin(self, now_s: float) -> Session:
        dialect()
        settings = self._settings
        self._own_session = Session(settings.options, now_s, settings.signing(), partial(describe, settings))
        return self._own_session

    @property
    def why(self) -> str:
        """What the driver waits for while it is OPEN; empty otherwise."""
        return self._own_session.why if self._own_session is not None and self.state is Lifecycle.OPEN else ""

    @property
    def texts(self) -> list[str]:
        """The vehicle's warnings of the last half minute, and what is odd about its settings."""
        session = self._own_session
        return [] if session is None else self.do(session.texts)

    def locate(self, pose: Pose, position_sigma_m: float, heading_sigma_rad: float) -> None:
        """Hand a pose measured from outside, ENU, with its standard deviations, to the vehicle's position filter.

        Without ``pose=external`` in the URL, while closed, or with a pose that is not finite, it does nothing.
        A heading with a deviation above 1 rad counts as not seen.
        """
        session = self._own_session
        if session is not None and self._settings.options.external:
            self.do(lambda now_s: session.locate(pose, position_sigma_m, heading_sigma_rad, now_s))
