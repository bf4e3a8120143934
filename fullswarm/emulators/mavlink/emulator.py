"""Emulated ArduPilot and PX4 rovers: their firmware in the shell of all emulators, over UDP, TCP or a serial device.

The driver cannot tell them from the firmware's own simulators.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from fullswarm.clock import Clock
from fullswarm.drivers.mavlink.codec import StreamParser
from fullswarm.drivers.mavlink.maps import Degrees, SphereMap
from fullswarm.drivers.mavlink.signing import Signing
from fullswarm.earth import SITL_ORIGIN_DEG
from fullswarm.emulators.base import Emulator, LinkFaults, body_and_clock
from fullswarm.emulators.mavlink.firmware import Firmware
from fullswarm.emulators.mavlink.position import Chart
from fullswarm.emulators.mavlink.px4_firmware import Px4Firmware, Px4Setpoint
from fullswarm.emulators.mavlink.requests import SetpointRecord
from fullswarm.emulators.ports import Port, PtyPort, TcpPort, UdpPort, port_at
from fullswarm.simulation.bodies import Body

Believe = Callable[[bytes | bytearray, int, int], bool]


class _OnLinks:
    """An autopilot as chunks: one in is a piece of a stream of frames, one out is a frame."""

    def __init__(self, autopilot: Firmware | Px4Firmware, ports: int, believe: Believe | None = None) -> None:
        self.autopilot, self._believe = autopilot, believe
        self._parsers = [StreamParser(believe=believe) for _ in range(ports)]
        self._first: list[bytes] = []

    @property
    def next_due_s(self) -> float:
        return self.autopilot.next_due_s

    def receive(self, data: bytes, now_s: float, port: int) -> None:
        for message in self._parsers[port].feed(data):
            self.autopilot.receive(message, now_s, port)

    def step(self, now_s: float) -> bool:
        restarts = self.autopilot.restarts(now_s)
        self._first = self.autopilot.tick(now_s)
        return restarts

    def take(self, port: int) -> list[bytes]:
        return self._first if port == 0 else self.autopilot.take(port)

    def hung_up(self, port: int) -> None:
        self._parsers[port] = StreamParser(believe=self._believe)


class _MavlinkEmulator(Emulator):
    """What both autopilots have in common.

    Attributes
    ----------
    url : what a driver is opened with (`urls`: of all ports)
    firmware, body : for tests; outside of :meth:`do` for single reads only
    """

    firmware: Firmware | Px4Firmware

    def __init__(
        self,
        firmware: _OnLinks,
        addresses: Sequence[str | Port],
        body: Body,
        clock: Clock,
        *,
        faults: LinkFaults | None,
        seeds: tuple[int, int],
    ) -> None:
        ports = [each if not isinstance(each, str) else port_at(each) for each in addresses]
        super().__init__(firmware, ports, body, clock, faults=faults, seeds=seeds)
        self.urls = tuple(_url(port) for port in ports)
        self.url = self.urls[0]

    @property
    def motors_on(self) -> bool:
        """Whether it is armed."""
        return self.firmware.armed

    def pilot_mode(self, mode: int) -> None:
        """Turn the pilot's mode switch."""
        self.do(lambda: self.firmware.pilot_mode(mode))

    def reboot(self) -> None:
        """Restart the autopilot (also one that has ended); connections drop, the ports stay."""

        def restart() -> None:
            self.drop()
            self.firmware.power_on(self._clock.now_s(), again=True)

        self.do(restart)

    def set_battery(self, fraction: float) -> None:
        """Charge the battery to this part, 0 to 1."""
        self.firmware.charge = fraction

    def stick_sensors(self, on: bool = True) -> None:
        """Repeat the present measurements with new time stamps, or stop that."""
        self.do(lambda: self.firmware.stick_sensors(on))

    def _power_on(self, now_s: float) -> None:
        self.firmware.power_on(now_s)


class RoverEmulator(_MavlinkEmulator):
    """An ArduPilot rover.

    Parameters
    ----------
    address, more
        Its ports; the first one accepts unsigned frames even when signing is set up.
    body
        What it drives, and where it starts; alone on an endless floor by default.
    system
        Its system id.
    boot_s
        Power-on to armable (real: 42.4 s).
    seed
        Of its position filter's noise.
    traps_floats
        End by NaN in a set-point, as the firmware's own simulator does.
    origin
        Latitude and longitude of the body's (0, 0).

    Raises
    ------
    ConfigError
        The address is wrong.
    DriverError
        A port cannot be had.
    """

    def __init__(
        self,
        address: str,
        body: Body | None = None,
        *,
        more: Sequence[str] = (),
        system: int = 1,
        boot_s: float = 0.2,
        traps_floats: bool = False,
        seed: int = 0,
        faults: LinkFaults | None = None,
        origin: Degrees = SITL_ORIGIN_DEG,
        clock: Clock | None = None,
    ) -> None:
        body, clock = body_and_clock(body, clock)
        addresses = (address, *more)
        self.firmware: Firmware = Firmware(
            body,
            system=system,
            boot_s=boot_s,
            ports=len(addresses),
            traps_floats=traps_floats,
            seed=seed,
            chart=Chart(origin),
        )
        super().__init__(_OnLinks(self.firmware, len(addresses)), addresses, body, clock, faults=faults, seeds=(0, 1))

    @property
    def setpoints(self) -> list[SetpointRecord]:
        """A copy of the set-points that arrived since the start (the newest 20 000)."""
        return self.do(lambda: list(self.firmware.setpoints))

    def press_estop(self, on: bool = True) -> None:
        """Press the motor safety switch, or release it: no power for the motors, whatever mode and arming are."""
        self.firmware.safety = on

    def set_gps(self, on: bool) -> None:
        """Switch the GPS: 7 s without it the position is lost, 8.2 s without it the mode is HOLD."""
        self.firmware.set_gps(on)


class Px4Emulator(_MavlinkEmulator):
    """A PX4 rover.

    Parameters
    ----------
    address
        Its port.
    body
        What it drives; alone on an endless floor by default.
    signing
        Signs what it sends, and it accepts only frames that are signed alike; None: unsigned.
    origin
        Latitude and longitude of the body's (0, 0).
    """

    def __init__(
        self,
        address: str | Port,
        body: Body | None = None,
        *,
        system: int = 1,
        boot_s: float = 0.2,
        signing: Signing | None = None,
        origin: Degrees = SITL_ORIGIN_DEG,
        clock: Clock | None = None,
    ) -> None:
        body, clock = body_and_clock(body, clock)
        signer = None if signing is None else signing.signer()
        chart = Chart(origin, SphereMap())
        self.firmware: Px4Firmware = Px4Firmware(body, system=system, boot_s=boot_s, signer=signer, chart=chart)
        believe = None if signing is None else signing.accept
        super().__init__(_OnLinks(self.firmware, 1, believe), [address], body, clock, faults=None, seeds=(1, 2))

    @property
    def setpoints(self) -> list[Px4Setpoint]:
        """A copy of the set-points that arrived since the start (the newest 20 000)."""
        return self.do(lambda: list(self.firmware.setpoints))


def _url(port: Port) -> str:
    """Return the URL with which a driver opens the other end of a port."""
    if isinstance(port, PtyPort):
        return f"mavlink+serial://{port.address}"
    if isinstance(port, TcpPort):
        return f"mavlink+tcp://{port.address}"
    scheme = "udpout" if isinstance(port, UdpPort) and port.listens else "udp"
    return f"mavlink+{scheme}://{port.address}"
