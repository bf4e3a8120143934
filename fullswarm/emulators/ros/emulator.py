"""Emulated ROS bases: a TurtleBot, Create 3 or ROSbot as its topics show it, behind zenoh or rosbridge."""

from __future__ import annotations

from urllib.parse import parse_qsl, urlsplit

from fullswarm.clock import Clock
from fullswarm.drivers.ros.settings import parse_url
from fullswarm.emulators.base import Emulator, body_and_clock
from fullswarm.emulators.ports import Port, TcpPort
from fullswarm.emulators.ros.firmware import CLIFF, STALL, WHEEL_DROP, Base, BaseOptions, Topics
from fullswarm.simulation.bodies import Body


class RosEmulator(Emulator):
    """The base at the other end of a driver's URL; it stops by itself as the URL's ``watchdog`` says.

    Parameters
    ----------
    hashes
        Whether its ROS has type hashes (rmw_zenoh; Humble has none).

    Raises
    ------
    ConfigError
        The URL is wrong.
    MissingExtra
        A library is not installed.
    """

    def __init__(self, url: str, body: Body | None = None, clock: Clock | None = None, *, hashes: bool = True) -> None:
        body, clock = body_and_clock(body, clock)
        settings = parse_url(url)
        self.base = Base(_options(url), body)
        self.url = url
        if settings.transport == "rosbridge":
            from fullswarm.emulators.ros.rosbridge import Rosbridge

            port: Port = TcpPort(settings.host, settings.port)
            super().__init__(Rosbridge(self.base), [port], body, clock, seeds=(1, 2))
            return
        from fullswarm.emulators.ros.zenoh_port import ZenohPort

        port = ZenohPort(
            settings.host, settings.port, self.base.options, kind=settings.transport, domain=settings.domain,
            hashes=hashes,
        )  # fmt: skip
        super().__init__(Topics(self.base), [port], body, clock, seeds=(1, 2))

    @property
    def motors_on(self) -> None:
        """None: a base of ROS obeys whoever publishes on its topic, and no message switches its motors off."""
        return

    def reboot(self) -> None:
        """Restart its computer: odometry at zero, connections gone."""

        def restart() -> None:
            self.base.reboot()
            self.drop()

        self.do(restart)

    def set_battery(self, fraction: float) -> None:
        """Fill its battery to this part."""
        self.base.battery = fraction

    def press_estop(self, on: bool) -> None:
        """Engage or release its emergency stop."""
        self.base.estop = on

    def set_distances(self, distances_m: list[float]) -> None:
        """Say what its lidar measures, 360 rays counter-clockwise; infinite: nothing."""
        self.base.distances_m = list(distances_m)

    def stick_sensors(self, on: bool) -> None:
        """Repeat the last odometry, with its old stamp."""
        self.base.stuck = on

    def set_cliff(self, front_left: bool = False, front_right: bool = False) -> None:
        """Take the floor away in front."""
        self._hazard(CLIFF, front_left or front_right)

    def set_wheel_drop(self, left: bool = False, right: bool = False) -> None:
        """Lift a wheel."""
        self._hazard(WHEEL_DROP, left or right)

    def set_overcurrent(self, left: bool = False, right: bool = False) -> None:
        """Block a wheel."""
        self._hazard(STALL, left or right)

    def _hazard(self, kind: int, on: bool) -> None:
        self.do(lambda: self.base.hazards.add(kind) if on else self.base.hazards.discard(kind))


def _options(url: str) -> BaseOptions:
    """Return the base that a driver's URL names."""
    settings = parse_url(url)
    topics, limits = settings.topics, settings.description.limits
    model = dict(parse_qsl(urlsplit(url).query)).get("model", "")
    return BaseOptions(
        topics.cmd, topics.odom, topics.battery, topics.hazards, topics.estop, topics.scan,
        # Its motors are faster than what is asked of them, and brake as their maker states.
        1.2 * limits.speed_m_s, 1.2 * limits.turn_rad_s, limits.accel_m_s2, limits.turn_accel_rad_s2,
        timeout_s=settings.description.watchdog_s, stamped=settings.stamped,
        checks_age=not model.startswith("turtlebot"), percent=model.startswith("turtlebot3"),
    )  # fmt: skip
