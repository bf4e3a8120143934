"""Emulates an e-puck2: its firmware behind a pseudo terminal, after ``Asercom2.c``. `fullswarm emulate epuck2` runs one.

The firmware is written like the original: one program that waits for the next byte. It shares no code with the driver's
protocol, so an error in one shows.
"""

from collections.abc import Generator
from urllib.parse import urlsplit

from fullswarm.clock import Clock
from fullswarm.emulators.base import Emulator, body_and_clock
from fullswarm.emulators.ports import PtyPort, make_folder
from fullswarm.simulation.bodies import Body, drive_wheels, wheels_rolled

MM_PER_STEP = 3.14159265358979 * 41.0 / 1000.0
WHEELS_APART_MM = 53.0
LIMIT = 1100
WELCOME = b'\x0c\x07WELCOME to the SerCom protocol on e-Puck\r\nthe EPFL education robot type "H" for help\r\n'

Program = Generator[None, int, None]


class Firmware:
    """The e-puck2's main processor: bytes in, bytes out, motors."""

    next_due_s = float("inf")  # it does nothing by itself: the motors keep their speed for ever

    def __init__(self, body: Body) -> None:
        self._body = body
        self.battery = 0.8
        self._out: list[bytes] = []
        self.reboot()
        self._out.clear()

    def reboot(self) -> None:
        """Switch it off and on."""
        self._speed_left = self._speed_right = 0
        self._body.drive(0.0, 0.0)
        self._offset_left, self._offset_right = self._rolled_steps()
        self._program = self._main()
        next(self._program)
        self._out.append(WELCOME)

    # ------------------------------------------------------------ the shell's side
    def receive(self, data: bytes, _now_s: float, _port: int) -> None:
        """Give the program each byte."""
        for byte in data:
            self._program.send(byte)

    def step(self, _now_s: float) -> bool:
        """Do nothing: all happens when a byte arrives."""
        return False

    def take(self, _port: int) -> list[bytes]:
        """Return what it has sent."""
        out, self._out = self._out, []
        return out

    def hung_up(self, _port: int) -> None:
        """Nothing: a serial line has no connection."""

    # ------------------------------------------------------------ hardware
    def _rolled_steps(self) -> tuple[int, int]:
        left_m, right_m = wheels_rolled(self._body.state(), WHEELS_APART_MM / 1e3)
        return int(left_m * 1e3 / MM_PER_STEP), int(right_m * 1e3 / MM_PER_STEP)

    def _steps(self) -> tuple[int, int]:
        left, right = self._rolled_steps()
        return left - self._offset_left, right - self._offset_right

    def _set_speeds(self, left: int, right: int) -> None:
        self._speed_left, self._speed_right = left, right
        cut = [max(-LIMIT, min(LIMIT, each)) * MM_PER_STEP / 1e3 for each in (left, right)]
        drive_wheels(self._body, cut[0], cut[1], WHEELS_APART_MM / 1e3)

    def _battery_raw(self) -> int:
        return int((3.4 + 0.8 * self.battery) * 4096 * 0.6 / 3.0)

    # ------------------------------------------------------------ the program
    def _main(self) -> Program:
        while True:
            c = yield
            if c >= 0x80:
                yield from self._binary(c)
            elif c > 0:
                yield from self._text(c)

    def _binary(self, c: int) -> Program:
        answer = bytearray()
        while c:
            command = chr((-c) & 0x7F)
            if command == "D":
                low_left, high_left = (yield), (yield)
                low_right, high_right = (yield), (yield)
                self._set_speeds(_signed(low_left, high_left), _signed(low_right, high_right))
            elif command == "E":
                answer += _two(self._speed_left) + _two(self._speed_right)
            elif command == "Q":
                left, right = self._steps()
                answer += _two(left) + _two(right)
            elif command == "P":
                low_left, high_left = (yield), (yield)
                low_right, high_right = (yield), (yield)
                left, right = self._rolled_steps()
                self._offset_left = left - _signed(low_left, high_left)
                self._offset_right = right - _signed(low_right, high_right)
            elif command == "b":
                answer += _two(self._battery_raw())
            elif command == "L":
                _ = (yield), (yield)
            c = yield  # all others are silently ignored
        if answer:
            self._out.append(bytes(answer))

    def _text(self, c: int) -> Program:
        while c in b"\r\n":
            c = yield
        line = chr(c)
        while (c := (yield)) not in b"\r\n":
            line += chr(c)
        name = line[0] if line[0] in "bg" else line[0].upper()
        if name == "D":
            try:
                left, right = (int(each) for each in line[1:].strip(", ").split(","))
            except ValueError:
                left, right = self._speed_left, self._speed_right  # sscanf finds nothing, and changes nothing
            self._set_speeds(left, right)
            self._out.append(b"d\r\n")
        elif name == "S":
            self._set_speeds(0, 0)
            self._out.append(b"s\r\n")
        elif name == "V":
            self._out.append(b"v,Version 2.0 January 2018 GCtronic\r\nHW version: FFFF\r\n")
        elif name == "E":
            self._out.append(f"e,{self._speed_left},{self._speed_right}\r\n".encode())
        elif name == "Q":
            self._out.append("q,{},{}\r\n".format(*self._steps()).encode())
        elif name == "b":
            self._out.append(f"b,{self._battery_raw()} ({round(100 * self.battery)}%)\r\n".encode())
        else:
            self._out.append(b"z,Command not found\r\n")


def _signed(low: int, high: int) -> int:
    number = low | high << 8
    return number - 65536 if number >= 32768 else number


def _two(number: int) -> bytes:
    return (number & 0xFFFF).to_bytes(2, "little")


class Epuck2Emulator(Emulator):
    """An e-puck2 on a pseudo terminal."""

    def __init__(self, path: str = "", body: Body | None = None, clock: Clock | None = None) -> None:
        body, clock = body_and_clock(body, clock)
        self.firmware, pty = Firmware(body), PtyPort(path)
        super().__init__(self.firmware, [pty], body, clock, seeds=(1, 2))
        self.url = f"epuck2://{pty.address}"

    @property
    def motors_on(self) -> None:
        """None: its steppers obey at any time, nothing switches them off."""
        return

    def reboot(self) -> None:
        """Switch it off and on: motors at zero, counters too."""
        self.do(self.firmware.reboot)

    def set_battery(self, fraction: float) -> None:
        """Fill its battery to this part."""
        self.firmware.battery = fraction


def start(url: str, body: Body) -> Epuck2Emulator:
    """Switch on the e-puck2 at the other end of a driver's URL."""
    path = urlsplit(url).path
    make_folder(path)
    return Epuck2Emulator(path, body).start()
