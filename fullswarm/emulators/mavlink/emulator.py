"""An emulated ArduPilot rover behind real ports: the driver cannot tell it from the firmware's own simulator.

Addresses::

    udp://127.0.0.1:14550      sends to a station that listens there (driver: mavlink+udp)
    udpin://127.0.0.1:14551    listens for a station (driver: mavlink+udpout)
    tcp://127.0.0.1:5760       serves one station at a time (driver: mavlink+tcp)
    pty: or pty:/tmp/rover     a serial device (driver: mavlink+serial)

Port 0 lets the system choose; `url` then names the driver's end.
"""

from __future__ import annotations

import select
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Self

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.mavlink.codec import StreamParser
from fullswarm.earth import SITL_ORIGIN_DEG
from fullswarm.emulators.faults import BadLink, LinkFaults
from fullswarm.emulators.mavlink.firmware import Firmware
from fullswarm.emulators.mavlink.rover.chart import Chart
from fullswarm.emulators.mavlink.rover.inbox import SetpointRecord
from fullswarm.emulators.mavlink.rover.ports import Port, open_port, reopen
from fullswarm.simulation.bodies import Body, FreeBody

__all__ = ["Port", "RoverEmulator", "open_port"]

BURST = 64  # chunks taken from a port before the main loop has its turn


@dataclass(slots=True)
class _Link:
    """A port with its two directions, which may be bad."""

    port: Port
    heard: BadLink
    said: BadLink
    parser: StreamParser = field(default_factory=StreamParser)

    def clear(self) -> None:
        self.heard.clear()
        self.said.clear()
        self.parser = StreamParser()


class RoverEmulator:
    """A rover that runs from :meth:`start` to :meth:`close`, or as a context manager.

    Parameters
    ----------
    address, more
        Its ports, see the module's docstring; the first one believes unsigned frames even when signing is set up.
    body
        What it drives, and where it starts; default: alone on an endless floor.
    system
        Its system id.
    boot_s
        Power-on to armable (real: 42.4 s).
    seed
        Of its position filter's noise.
    traps_floats
        Die of NaN in a set-point, as the firmware's own simulator does.
    origin
        Latitude and longitude of the body's (0, 0).

    Attributes
    ----------
    url : what a driver is opened with (`urls`: of all ports)
    faults : how bad the links are, both directions; may be changed at any time
    firmware, body : for tests; use them under no lock for single reads only

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
        origin: tuple[float, float] = SITL_ORIGIN_DEG,
        clock: Clock | None = None,
    ) -> None:
        self.faults = faults or LinkFaults()
        self._clock = clock or MonotonicClock()
        self.body: Body = body or FreeBody(clock=self._clock)
        self.firmware = Firmware(
            self.body,
            system=system,
            boot_s=boot_s,
            ports=1 + len(more),
            traps_floats=traps_floats,
            seed=seed,
            chart=Chart(origin),
        )
        self._links: list[_Link] = []
        try:
            for number, each in enumerate((address, *more)):
                heard, said = (BadLink(self.faults, seed=2 * number + way) for way in (0, 1))
                self._links.append(_Link(open_port(each), heard, said))
        except BaseException:
            self._close_ports()
            raise
        self.urls = tuple(link.port.url for link in self._links)
        self.url = self.urls[0]
        self._lock = threading.Lock()
        self._waiting = threading.Lock()  # held while the thread waits on the ports: nobody may close one then
        self._stopping = threading.Event()
        self._muted = self._unplugged = False
        self._thread: threading.Thread | None = None

    def start(self) -> Self:
        """Power on."""
        self._stopping.clear()
        self.firmware.power_on(self._clock.now_s())
        self._thread = threading.Thread(target=self._run, name=f"rover emulator {self.url}", daemon=True)
        self._thread.start()
        return self

    def close(self) -> None:
        """Power off and let go of the ports; closing twice is fine."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
            self.body.drive(0.0, 0.0)
        self._close_ports()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def setpoints(self) -> list[SetpointRecord]:
        """A copy of the set-points that arrived since the start (the newest 20 000)."""
        with self._lock:
            return list(self.firmware.setpoints)

    # ------------------------------------------------------------ what may happen to a rover
    def pilot_mode(self, mode: int) -> None:
        """Turn the pilot's mode switch."""
        with self._lock:
            self.firmware.pilot_mode(mode, self._clock.now_s())

    def reboot(self) -> None:
        """Restart the autopilot (revives one that died, too); connections drop, the ports stay."""
        with self._waiting, self._lock:
            self._drop()
            self.firmware.power_on(self._clock.now_s(), again=True)

    def unplug(self) -> None:
        """Pull the cables: the ports are gone. The rover goes on as it thinks fit."""
        with self._waiting, self._lock:
            self._unplugged = True
            self._close_ports()

    def replug(self) -> None:
        """Put the cables back; each port has its old address.

        Raises
        ------
        DriverError
            Somebody else has taken a port meanwhile.
        """
        with self._waiting, self._lock:
            if self._unplugged:
                for link in self._links:
                    reopen(link.port, link.port.url)
                self._unplugged = False

    def mute(self, on: bool = True) -> None:
        """Let the rover hear, but say nothing."""
        self._muted = on

    def set_battery(self, fraction: float) -> None:
        """Charge the battery to this part, 0 to 1."""
        with self._lock:
            self.firmware.charge = fraction

    def press_estop(self, on: bool = True) -> None:
        """Press the motor safety switch, or release it: no power for the motors, whatever mode and arming say."""
        with self._lock:
            self.firmware.safety = on

    def stick_sensors(self, on: bool = True) -> None:
        """Repeat the present measurements with new time stamps, or stop that."""
        with self._lock:
            self.firmware.stick_sensors(on)

    def set_gps(self, on: bool) -> None:
        """Switch the GPS: 7 s without it the position is lost, 8.2 s without it the mode is HOLD."""
        with self._lock:
            self.firmware.set_gps(on)

    # ------------------------------------------------------------ the rover's thread
    def _run(self) -> None:
        while not self._stopping.is_set():
            with self._waiting:
                self._wait()
            with self._lock:
                self._turn(self._clock.now_s())

    def _wait(self) -> None:
        """Wait for something to read, at most until the main loop's next turn."""
        poll = select.poll()
        for link in self._links:
            if link.port.fileno() >= 0:
                poll.register(link.port.fileno(), select.POLLIN)
        left_s = self.firmware.next_step_s - self._clock.now_s()
        poll.poll(1000.0 * min(max(left_s, 0.001), 0.02))

    def _turn(self, now_s: float) -> None:
        firmware = self.firmware
        for number, link in enumerate(self._links):
            self._listen(link)
            for data in link.heard.due(now_s):
                for message in link.parser.feed(data):
                    firmware.receive(message, now_s, number)
        restart = now_s >= firmware.reboot_due_s
        if restart or firmware.aborted:
            self._drop()
        frames = firmware.tick(now_s)
        for number, link in enumerate(self._links):
            for frame in frames if number == 0 else firmware.channels[number].take():
                if not (self._muted or self._unplugged):
                    link.said.put(frame, now_s)
            for frame in link.said.due(now_s):
                link.port.send(frame)

    def _listen(self, link: _Link) -> None:
        for _ in range(BURST):
            data = b"" if self._unplugged else link.port.receive()
            if not data:
                return
            link.heard.put(data, self._clock.now_s())

    def _drop(self) -> None:
        for link in self._links:
            link.clear()
            link.port.drop()

    def _close_ports(self) -> None:
        for link in self._links:
            link.clear()
            link.port.close()
