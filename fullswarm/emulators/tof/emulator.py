"""Emulated VL53L1X on an I2C bus: what the driver's URL names, on that URL's serial device or TCP port."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from fullswarm.clock import Clock
from fullswarm.drivers.base import Pose
from fullswarm.drivers.tof.settings import Placed, Settings, parse_url
from fullswarm.emulators.base import Emulator, body_and_clock
from fullswarm.emulators.lidar.emulator import room_wall_m
from fullswarm.emulators.ports import Port, PtyPort, TcpPort
from fullswarm.emulators.tof.firmware import I2cBridge, Vl53l1x
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.simulation.bodies import Body, BodyState

Surroundings = Callable[[Pose, float], float]
"""The distance (m) from a place on the robot in a direction (rad) of the robot's own; infinite: nothing."""
FIVE = "".join(
    f"{'&' if channel else '?'}sensor={channel}@{0.1 * math.cos(angle):.3f},{0.1 * math.sin(angle):.3f},{angle:.3f}"
    for channel, angle in enumerate((math.pi / 2, math.pi / 4, 0.0, -math.pi / 4, -math.pi / 2))
)
"""Options of five sensors on a circle of 0.1 m, from left to right."""


class TofEmulator(Emulator):
    """The sensors, and the multiplexer if there is a channel, that a driver's URL names.

    Parameters
    ----------
    url
        Its path is the serial device to create; port 0 of TCP lets the system choose one, see `url`.
    sees
        What is around the robot.
    body
        What carries them.
    """

    lacks = ("bump",)

    def __init__(self, url: str, sees: Surroundings, clock: Clock | None = None, body: Body | None = None) -> None:
        body, clock = body_and_clock(body, clock)
        self._settings = settings = parse_url(url)
        self.sees = sees
        self.sensors = {each.key: self._sensor(each) for each in settings.sensors}
        on_bus: dict[int | None, list[Vl53l1x]] = {}
        for each in settings.sensors:
            on_bus.setdefault(each.channel, []).append(self.sensors[each.key])
        port = _port(settings)
        super().__init__(I2cBridge(on_bus, settings.mux), [port], body, clock)
        self.url = url if settings.path else f"vl53l1x://{port.address}?{url.partition('?')[2]}"

    def _sensor(self, placed: Placed) -> Vl53l1x:
        made = Vl53l1x(lambda angle_rad: self.sees(placed.at, placed.at.heading_rad + angle_rad))
        if placed.channel is None:
            made.write(bytes([0, 1, placed.address]), 0.0)  # as the user's own program has set it
        return made

    @property
    def motors_on(self) -> None:
        """None: they have no wheels."""
        return

    def wire_sensor(self, key: str, on: bool) -> None:
        """Pull the cable of one sensor, named as in the URL, or put it back.

        Raises
        ------
        ConfigError
            There is no such sensor.
        """
        if key not in self.sensors:
            raise ConfigError(f"no sensor '{key}'", hint=did_you_mean(key, self.sensors))

        def wire() -> None:
            sensor = self.sensors[key]
            address = sensor.address
            sensor.power(on, self._clock.now_s())
            if address != sensor.address:
                sensor.write(bytes([0, 1, address]), 0.0)

        self.do(wire)

    def stick_sensors(self, on: bool = True) -> None:
        """Let all sensors keep their last measurement."""
        for each in self.sensors.values():
            each.stuck = on


class RoomTof(TofEmulator):
    """Sensors in the rectangular room of emulated lidars, whose middle is the origin of the body that carries them."""

    def __init__(self, url: str, body: Body) -> None:
        super().__init__(url, lambda place, angle_rad: from_place_m(body.state(), place, angle_rad), body=body)


def from_place_m(state: BodyState, place: Pose, angle_rad: float) -> float:
    """Return the distance (m) from a place on a body to the room's wall, in a direction of the body."""
    c, s = math.cos(state.heading_rad), math.sin(state.heading_rad)
    x_m, y_m = state.x_m + c * place.x_m - s * place.y_m, state.y_m + s * place.x_m + c * place.y_m
    return room_wall_m(replace(state, x_m=x_m, y_m=y_m), angle_rad)


def _port(settings: Settings) -> Port:
    return PtyPort(settings.path) if settings.path else TcpPort(settings.host, settings.port)
