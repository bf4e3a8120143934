"""An emulated Create on a pseudo terminal: :class:`.firmware.Firmware` in the shell of all emulators.

The robot reads the rate that the other side has set: at a wrong one it takes in nothing and sends noise. Bytes take as
long as they would on the wire; a reader that is late loses what follows.
"""

from __future__ import annotations

from collections.abc import Sequence

from fullswarm.clock import Clock
from fullswarm.drivers.base import Pose
from fullswarm.drivers.create_oi.protocol import CREATE2, PERIOD_S, Generation, Mode
from fullswarm.emulators.base import Emulator, body_and_clock
from fullswarm.emulators.create_oi.firmware import Firmware, Quirks
from fullswarm.emulators.create_oi.hardware import MAX_LIGHT, MAX_WALL
from fullswarm.emulators.ports import PtyPort
from fullswarm.simulation.bodies import Body

_NAMES = ("clean", "spot", "dock", "minute", "hour", "day", "schedule", "clock")
BUTTONS = {**{name: 1 << bit for bit, name in enumerate(_NAMES)}, "play": 0b001, "advance": 0b100}
"""Bits of packet 18."""
_NOISE = bytes((each * 149 + 71) & 0xFF for each in range(256))


class SerialPort(PtyPort):
    """A serial port on which bytes take time; the robot's side has a rate of its own, `robot_baud`."""

    robot_baud = 0

    @property
    def rates(self) -> tuple[int, int]:
        """Bits per second of what arrives and of what is sent."""
        return self.baud or 0, self.robot_baud

    def receive(self) -> list[bytes] | None:
        """Return bytes; at a rate that no robot has they are lost."""
        chunks = super().receive()
        return chunks if self.baud else []


class _OnLine:
    """The firmware at the end of a serial line."""

    def __init__(self, firmware: Firmware, port: SerialPort) -> None:
        self._firmware, self._port = firmware, port
        self._arrived = self._out = b""
        self._look_s = 0.0

    @property
    def next_due_s(self) -> float:
        return min(self._firmware.due_s, self._look_s)

    def receive(self, data: bytes, _now_s: float, _port: int) -> None:
        self._arrived += data

    def step(self, now_s: float) -> bool:
        firmware, arrived = self._firmware, self._arrived
        if self._port.baud in (None, firmware.baud):
            out = firmware.receive(arrived, now_s)
            out += firmware.step(now_s, firmware.generation.budget(firmware.baud))
        else:  # bits of another length: each side receives noise, which a robot ignores
            out = (arrived + firmware.step(now_s)).translate(_NOISE)
        self._arrived, self._out, self._look_s = b"", out, now_s + PERIOD_S
        self._port.robot_baud = firmware.baud
        return False

    def take(self, _port: int) -> list[bytes]:
        out, self._out = self._out, b""
        return [out] if out else []

    def hung_up(self, _port: int) -> None:
        self._arrived = b""


class CreateEmulator(Emulator):
    """A Create or Roomba to plug a driver into.

    Parameters
    ----------
    generation, body
        Which robot, and what it drives; alone on an endless floor by default.
    port
        Path of the port to make, a link; by default one in a folder of its own.
    quirks, encoders
        See :class:`~.firmware.Firmware`.
    seed
        Of the link's faults; a chunk is one frame or answer.

    Attributes
    ----------
    firmware : the robot itself; change it only by :meth:`do`, or while the emulator is not started

    Raises
    ------
    DriverError
        The path is taken.
    """

    def __init__(
        self,
        generation: Generation = CREATE2,
        body: Body | None = None,
        *,
        port: str = "",
        quirks: Quirks | None = None,
        encoders: tuple[int, int] = (0, 0),
        seed: int = 0,
        clock: Clock | None = None,
    ) -> None:
        body, clock = body_and_clock(body, clock)
        self.generation = generation
        self.firmware = Firmware(generation, body, quirks=quirks, encoders=encoders)
        self._low = False
        line = SerialPort(port)
        self.port = line.address
        self.url = f"create://{self.port}?model={generation.name}"
        super().__init__(_OnLine(self.firmware, line), [line], body, clock, seeds=(seed, seed + 1))

    @property
    def motors_on(self) -> bool:
        """Whether it is in Safe or Full mode."""
        return self.mode in (Mode.SAFE, Mode.FULL)

    @property
    def mode(self) -> Mode:
        """The mode that the robot is in."""
        return self.firmware.mode

    # ------------------------------------------------------------ the robot's surroundings
    def set_cliff(
        self, left: bool = False, front_left: bool = False, front_right: bool = False, right: bool = False
    ) -> None:
        """Take the floor away under these sensors, give it back to the others."""
        self.firmware.cliffs = [left, front_left, front_right, right]

    def set_wheel_drop(self, left: bool = False, right: bool = False) -> None:
        """Let wheels hang."""
        self.firmware.drops = [left, right]

    def set_charger(self, plugged: bool) -> None:
        """Plug the charger in or out."""
        self.firmware.charger = plugged

    def set_dock(self, docked: bool) -> None:
        """Put the robot onto its home base or take it off."""
        self.firmware.dock = docked

    def set_bases(self, bases: Sequence[Pose]) -> None:
        """Put Home Bases around the robot, each given by the pose of a robot that stands on it."""
        self.firmware.bases = tuple(bases)

    def set_overcurrent(self, left: bool = False, right: bool = False) -> None:
        """Let wheel motors draw too much."""
        self.firmware.overcurrents = right << 3 | left << 4

    def press_buttons(self, *names: str) -> None:
        """Hold these buttons down, release the others: clean, spot, dock, minute, hour, day, schedule, clock.

        A Create 1 has play (clean) and advance (dock). Raises ``KeyError`` for an unknown name.
        """
        self.firmware.panel.held = sum({BUTTONS[name] for name in names})

    def set_wall(self, signal: int) -> None:
        """Bring a wall to its right-hand side: signal 0 (none) to 1023."""
        self.firmware.surroundings.wall_signal = max(0, min(MAX_WALL, signal))

    def set_light_bumper(
        self, left: int = 0, front_left: int = 0, centre_left: int = 0, centre_right: int = 0, front_right: int = 0,
        right: int = 0,
    ) -> None:  # fmt: skip
        """Bring things before the light bumper: signals 0 (nothing) to 4095, grow as they come nearer."""
        signals = (left, front_left, centre_left, centre_right, front_right, right)
        a, b, c, d, e, f = (max(0, min(MAX_LIGHT, each)) for each in signals)
        self.firmware.surroundings.light_signals = a, b, c, d, e, f

    def set_infrared(self, omni: int | None = None, left: int = 0, right: int = 0) -> None:
        """Let its receivers get these bytes; None: nothing sends."""
        self.firmware.surroundings.infrared = None if omni is None else (omni & 0xFF, left & 0xFF, right & 0xFF)

    def set_virtual_wall(self, on: bool) -> None:
        """Switch a virtual wall in front of it on or off."""
        self.firmware.surroundings.virtual_wall = on

    def set_battery(self, fraction: float) -> None:
        """Fill the battery to this part of its capacity."""

        def fill() -> None:
            self.firmware.battery.charge_mah = fraction * self.firmware.battery.capacity_mah

        self.do(fill)

    def brc(self, low: bool) -> None:
        """Pull the BRC pin low or release it: keeps the robot awake, or wakes it. Goes beside the port."""
        if low and not self._low:
            self.do(lambda: self.firmware.brc(self._clock.now_s()))
        self._low = low

    def reboot(self) -> None:
        """Take the battery out and put it back: off, everything forgotten, back after a second."""
        self.do(lambda: self.firmware.reboot(self._clock.now_s()))

    def stick_sensors(self, on: bool = True) -> None:
        """Repeat the present sensor values, or stop that."""
        self.do(lambda: self.firmware.stick(on, self._clock.now_s()))
