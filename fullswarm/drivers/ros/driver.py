"""Drives a ROS robot that takes ``cmd_vel`` and gives ``odom``. URL: :mod:`.settings`.

The transports differ in their port alone: a relay process that holds the zenoh session, or a TCP connection to
rosbridge. Frames are those of REP 105: the odometry is the robot's own, since `open()`; a pose in the world comes from
elsewhere (motion capture, a camera).
"""

from __future__ import annotations

from collections.abc import Callable

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.guardian import Attempts
from fullswarm.drivers.linked import LinkedDriver
from fullswarm.drivers.ports import Port, TcpPort
from fullswarm.drivers.ros.relay import RelayPort
from fullswarm.drivers.ros.rosbridge_wire import RosbridgeWire
from fullswarm.drivers.ros.session import Session
from fullswarm.drivers.ros.settings import Settings, parse_url
from fullswarm.drivers.ros.zenoh_wire import ZenohWire, relay_task

UNSTOPPED = (
    "this base keeps its last velocity when the link is cut: nothing on the robot stops it (watchdog= in the URL)"
)


class RosDriver(LinkedDriver[bytes]):
    """A :class:`~fullswarm.drivers.base.Driver` for TurtleBots, Create 3, ROSbots and other ROS bases.

    `open` raises ``MissingExtra`` for rosbridge without the package websockets.

    Raises
    ------
    ConfigError
        The URL is wrong, or of a robot that nothing would stop.
    """

    def __init__(self, url: str, clock: Clock | None = None) -> None:
        settings, clock = parse_url(url), clock or MonotonicClock()
        super().__init__(
            url,
            settings.description,
            session=lambda _: begin(settings),
            port=open_port(settings, clock),
            guardian=settings.guardian,
            warning=UNSTOPPED if settings.description.watchdog_s is None else "",
            clock=clock,
        )


def begin(settings: Settings) -> Session:
    """Return a new session over the URL's transport."""
    estop = bool(settings.topics.estop)
    if settings.transport == "rosbridge":
        wire = RosbridgeWire(settings)
        return Session(
            settings.description, wire, stamped=settings.stamped, estop=estop, plan=wire.stop_plan,
            scan_at=settings.scan_at,
        )  # fmt: skip
    return Session(
        settings.description, ZenohWire(settings), stamped=settings.stamped, estop=estop, scan_at=settings.scan_at
    )


def open_port(settings: Settings, clock: Clock) -> Callable[[], Port[bytes]]:
    """Return what opens the URL's port; relay processes that fail are spaced out."""
    attempts = Attempts(clock)
    if settings.transport == "rosbridge":
        return lambda: TcpPort(settings.host, settings.port, clock=clock)
    return lambda: RelayPort(settings.host, settings.port, relay_task(settings), clock, attempts)
