"""A Create on a pseudo-terminal: :class:`.firmware.Firmware` behind a real port, over a body.

The emulator reads the rate that the other side has set: at a wrong one it hears nothing and sends garbage. Bytes take
as long as they would on the wire; a reader who is late loses what follows.
"""

from __future__ import annotations

import os
import select
import threading
from types import TracebackType
from typing import Self

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.create_oi.protocol import CREATE2, PERIOD_S, Generation, Mode
from fullswarm.emulators.create_oi.firmware import Firmware, Quirks
from fullswarm.emulators.create_oi.pty_port import PtyPort, Wire
from fullswarm.emulators.create_oi.surroundings import MAX_LIGHT, MAX_WALL
from fullswarm.emulators.faults import LinkFaults
from fullswarm.simulation.bodies import Body, FreeBody

__all__ = ["CreateEmulator", "FreeBody", "Quirks"]

_NAMES = ("clean", "spot", "dock", "minute", "hour", "day", "schedule", "clock")
BUTTONS = {**{name: 1 << bit for bit, name in enumerate(_NAMES)}, "play": 0b001, "advance": 0b100}
"""Bits of packet 18."""
_NOISE = bytes((each * 149 + 71) & 0xFF for each in range(256))


class CreateEmulator:
    """A robot to plug a driver into. A context manager; `url` opens it.

    Parameters
    ----------
    generation, body
        Which robot, and what it stands on; a :class:`~fullswarm.simulation.bodies.FreeBody` by default.
    port
        Path of the port to make, a link; by default one in a folder of its own. Raises ``DriverError`` if taken.
    quirks, encoders
        See :class:`~.firmware.Firmware`.
    seed
        Of the link's faults.

    Attributes
    ----------
    faults : how bad the link is, both directions; a chunk is one frame or answer
    """

    def __init__(
        self,
        generation: Generation = CREATE2,
        body: Body | None = None,
        *,
        port: str | None = None,
        quirks: Quirks | None = None,
        encoders: tuple[int, int] = (0, 0),
        seed: int = 0,
        clock: Clock | None = None,
    ) -> None:
        self.generation = generation
        self.faults = LinkFaults()
        self._clock = clock or MonotonicClock()
        self.body: Body = body or FreeBody(clock=self._clock)
        self._firmware = Firmware(generation, self.body, quirks=quirks, encoders=encoders)
        self._ear, self._mouth = Wire(self.faults, seed), Wire(self.faults, seed + 1)
        self._port = PtyPort(port)
        self._lock = threading.Lock()  # guards the firmware, the port and the switches
        self._mute = self._closed = self._cut = self._low = False
        self._wake_r = self._wake_w = -1
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def start(self) -> Self:
        """Plug in and switch on. Starting twice is fine."""
        if self._thread is None and not self._closed:
            self._wake_r, self._wake_w = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
            self.replug()
            self._thread = threading.Thread(target=self._run, name=f"emulator {self.port}", daemon=True)
            self._thread.start()
        return self

    def close(self) -> None:
        """Switch the robot off and remove its port. Closing twice is fine."""
        if self._closed:
            return
        self._closed = True
        if self._thread is not None:
            self._wake()
            self._thread.join()
            os.close(self._wake_r)
            os.close(self._wake_w)
        self._port.close()
        self.body.drive(0.0, 0.0)

    @property
    def port(self) -> str:
        """Path of the port."""
        return self._port.path

    @property
    def url(self) -> str:
        """What the driver is opened with."""
        return f"create://{self.port}?model={self.generation.name}"

    @property
    def firmware(self) -> Firmware:
        """The robot itself, to look at; touch it only while the emulator is not started."""
        return self._firmware

    @property
    def mode(self) -> Mode:
        """The mode that the robot is in."""
        with self._lock:
            return self._firmware.mode

    # ------------------------------------------------------------ the robot's surroundings
    def set_cliff(
        self, left: bool = False, front_left: bool = False, front_right: bool = False, right: bool = False
    ) -> None:
        """Take the floor away under these sensors, give it back to the others."""
        with self._lock:
            self._firmware.cliffs = [left, front_left, front_right, right]

    def set_wheel_drop(self, left: bool = False, right: bool = False) -> None:
        """Let wheels hang."""
        with self._lock:
            self._firmware.drops = [left, right]

    def set_charger(self, plugged: bool) -> None:
        """Plug the charger in or out."""
        with self._lock:
            self._firmware.charger = plugged

    def set_dock(self, docked: bool) -> None:
        """Put the robot onto its home base or take it off."""
        with self._lock:
            self._firmware.dock = docked

    def set_overcurrent(self, left: bool = False, right: bool = False) -> None:
        """Let wheel motors draw too much."""
        with self._lock:
            self._firmware.overcurrents = right << 3 | left << 4

    def press_buttons(self, *names: str) -> None:
        """Hold these buttons down, let go of the others: clean, spot, dock, minute, hour, day, schedule, clock.

        A Create 1 has play (clean) and advance (dock). Raises ``KeyError`` for a name that there is not.
        """
        with self._lock:
            self._firmware.panel.held = sum({BUTTONS[name] for name in names})

    def set_wall(self, signal: int) -> None:
        """Bring a wall to its right-hand side: signal 0 (none) to 1023."""
        with self._lock:
            self._firmware.surroundings.wall_signal = max(0, min(MAX_WALL, signal))

    def set_light_bumper(
        self, left: int = 0, front_left: int = 0, centre_left: int = 0, centre_right: int = 0, front_right: int = 0,
        right: int = 0,
    ) -> None:  # fmt: skip
        """Bring things before the light bumper: signals 0 (nothing) to 4095, grow as they come nearer."""
        signals = (left, front_left, centre_left, centre_right, front_right, right)
        a, b, c, d, e, f = (max(0, min(MAX_LIGHT, each)) for each in signals)
        with self._lock:
            self._firmware.surroundings.light_signals = a, b, c, d, e, f

    def set_infrared(self, omni: int | None = None, left: int = 0, right: int = 0) -> None:
        """Let its receivers get these bytes; None: nothing sends."""
        with self._lock:
            self._firmware.surroundings.infrared = None if omni is None else (omni & 0xFF, left & 0xFF, right & 0xFF)

    def set_virtual_wall(self, on: bool) -> None:
        """Switch a virtual wall in front of it on or off."""
        with self._lock:
            self._firmware.surroundings.virtual_wall = on

    def set_battery(self, fraction: float) -> None:
        """Fill the battery to this part of its capacity."""
        with self._lock:
            battery = self._firmware.battery
            battery.charge_mah = fraction * battery.capacity_mah

    def brc(self, low: bool) -> None:
        """Pull the BRC pin low or let it go: keeps the robot awake, or wakes it. Goes beside the port."""
        with self._lock:
            if low and not self._low:
                self._firmware.brc(self._clock.now_s())
            self._low = low

    # ------------------------------------------------------------ what can go wrong
    def unplug(self) -> None:
        """Pull the cable. The robot keeps its power, its mode and its speed, as a real one does."""
        with self._lock:
            self._port.pull()
            self._ear.clear()
            self._mouth.clear()

    def replug(self) -> None:
        """Put the cable back; the port has its old path."""
        with self._lock:
            self._port.plug()
        self._wake()

    def reboot(self) -> None:
        """Take the battery out and put it back: off, everything forgotten, back after a second."""
        with self._lock:
            self._firmware.reboot(self._clock.now_s())

    def mute(self, on: bool = True) -> None:
        """Let the robot hear, but say nothing; it goes on driving."""
        with self._lock:
            self._mute = on

    def stick_sensors(self, on: bool = True) -> None:
        """Let the robot tell its present sensor values for ever."""
        with self._lock:
            self._firmware.stick(on, self._clock.now_s())

    def garbage(self, data: bytes) -> None:
        """Bring bytes to the reader that nobody sent."""
        with self._lock:
            self._port.say(data)

    def cut(self) -> None:
        """Lose the second half of the next thing that the robot says."""
        with self._lock:
            self._cut = True

    # ------------------------------------------------------------ the robot's thread
    def _run(self) -> None:
        pause_s = 0.0
        while not self._closed:
            poll = select.poll()
            poll.register(self._wake_r, select.POLLIN)
            master = self._port.master
            if master is not None:
                poll.register(master, select.POLLIN)
            if any(descriptor == self._wake_r for descriptor, _ in poll.poll(pause_s * 1000.0)):
                os.read(self._wake_r, 4096)
            with self._lock:
                pause_s = self._turn()

    def _turn(self) -> float:
        """Do what is due; return how long nothing will be, unless something is heard."""
        now_s, firmware, baud = self._clock.now_s(), self._firmware, self._port.baud
        heard = self._port.hear()
        if heard and baud:
            self._ear.put(heard, now_s, baud)
        told = self._ear.take(now_s)
        if baud in (None, firmware.baud):
            said = firmware.receive(told, now_s) + firmware.step(now_s, self.generation.budget(firmware.baud))
        else:  # bits of another length: each side hears noise, which a robot ignores
            said = (told + firmware.step(now_s)).translate(_NOISE)
        if said and self._cut:
            said, self._cut = said[: len(said) // 2], False
        if not self._mute and baud is not None:
            self._mouth.put(said, now_s, firmware.baud)
        self._port.say(self._mouth.take(now_s))
        due_s = min(each for each in (self._ear.due_s, self._mouth.due_s, firmware.due_s) if each is not None)
        return max(0.001, min(due_s - now_s, PERIOD_S))

    def _wake(self) -> None:
        if self._wake_w < 0:
            return
        try:
            os.write(self._wake_w, b"\0")
        except BlockingIOError:
            return
