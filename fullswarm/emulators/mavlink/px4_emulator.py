"""An emulated PX4 rover behind a real port; addresses as in ``emulator.py``."""

from __future__ import annotations

import select
import threading
from typing import Self

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.mavlink.codec import StreamParser
from fullswarm.drivers.mavlink.maps import Degrees, SphereMap
from fullswarm.drivers.mavlink.signing import Signing
from fullswarm.earth import SITL_ORIGIN_DEG
from fullswarm.emulators.faults import BadLink, LinkFaults
from fullswarm.emulators.mavlink.px4_firmware import Px4Firmware, Px4Setpoint
from fullswarm.emulators.mavlink.rover.chart import Chart
from fullswarm.emulators.mavlink.rover.ports import Port, open_port, reopen
from fullswarm.simulation.bodies import Body, FreeBody

LOOP_WAIT_MS = 5


class Px4Emulator:
    """A PX4 rover that runs from :meth:`start` to :meth:`close`, or as a context manager.

    Parameters
    ----------
    address
        As of the emulated ArduPilot rover, or an open port.
    body
        What it drives; default: one alone on an endless floor.
    signing
        Signs what it says, and it hears only who signs alike; None: unsigned.
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
        self._port = open_port(address) if isinstance(address, str) else address
        self.url = self._port.url
        self.body: Body = body or FreeBody()
        self.faults = LinkFaults()
        self._signing = signing
        signer = None if signing is None else signing.signer()
        chart = Chart(origin, SphereMap())
        self.firmware = Px4Firmware(self.body, system=system, boot_s=boot_s, signer=signer, chart=chart)
        self._clock = clock or MonotonicClock()
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._muted = self._unplugged = False
        self._heard, self._said = BadLink(self.faults, 1), BadLink(self.faults, 2)
        self._thread: threading.Thread | None = None

    def start(self) -> Self:
        """Power on."""
        self._stopping.clear()
        self.firmware.power_on(self._clock.now_s())
        self._thread = threading.Thread(target=self._run, name=f"px4 emulator {self.url}", daemon=True)
        self._thread.start()
        return self

    def close(self) -> None:
        """Power off and let go of the port; closing twice is fine."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
            self.body.drive(0.0, 0.0)
        self._port.close()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def setpoints(self) -> list[Px4Setpoint]:
        """A copy of the set-points that arrived since the start (the newest 20 000)."""
        with self._lock:
            return list(self.firmware.setpoints)

    def pilot_mode(self, mode: int) -> None:
        """Turn the pilot's mode switch."""
        with self._lock:
            self.firmware.pilot_mode(mode)

    def reboot(self) -> None:
        """Restart the autopilot; the connection drops."""
        with self._lock:
            self._port.drop()
            self.firmware.power_on(self._clock.now_s())

    def mute(self, on: bool = True) -> None:
        """Hear, say nothing."""
        self._muted = on

    def unplug(self) -> None:
        """Pull the cable: the port is gone. The rover goes on as it thinks fit."""
        with self._lock:
            self._unplugged = True
            self._port.close()
            self._heard.clear()
            self._said.clear()

    def replug(self) -> None:
        """Put the cable back; the port has its old address.

        Raises
        ------
        DriverError
            Somebody else has taken the port meanwhile.
        """
        with self._lock:
            if self._unplugged:
                reopen(self._port, self.url)
                self._unplugged = False

    def set_battery(self, fraction: float) -> None:
        """Set the charge, 0 to 1."""
        self.firmware.battery = fraction

    def stick_sensors(self, on: bool = True) -> None:
        """Repeat the present measurements with new time stamps, or stop that."""
        with self._lock:
            self.firmware.stick_sensors(on)

    def _run(self) -> None:
        parser = StreamParser(believe=None if self._signing is None else self._signing.accept)
        while not self._stopping.is_set():
            poll = select.poll()
            if self._port.fileno() >= 0:
                poll.register(self._port.fileno(), select.POLLIN)
            poll.poll(LOOP_WAIT_MS)
            with self._lock:
                self._turn(parser, self._clock.now_s())

    def _turn(self, parser: StreamParser, now_s: float) -> None:
        self._heard.put(b"" if self._unplugged else self._port.receive(), now_s)
        for chunk in self._heard.due(now_s):
            for message in parser.feed(chunk):
                self.firmware.receive(message, now_s)
        for frame in self.firmware.tick(now_s):
            if not (self._muted or self._unplugged):
                self._said.put(frame, now_s)
        for frame in self._said.due(now_s):
            self._port.send(frame)
