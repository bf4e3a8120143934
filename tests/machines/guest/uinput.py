"""A gamepad that the kernel itself makes: what a program reads from it went through evdev, as from a real one."""

from __future__ import annotations

import fcntl
import os
import struct
from types import TracebackType
from typing import Self

_CREATE, _DESTROY = 0x5501, 0x5502
_SET_EVENT, _SET_KEY, _SET_AXIS = 0x40045564, 0x40045565, 0x40045567
_SYNC, _KEY, _ABS = 0, 1, 3
_USB, _MICROSOFT, _XBOX_360 = 3, 0x045E, 0x028E
_DEVICE = struct.Struct("80s4HI64i64i64i64i")
_EVENT = struct.Struct("llHHi")

BUTTONS = {"a": 0x130, "b": 0x131, "x": 0x133, "y": 0x134, "leftshoulder": 0x136, "rightshoulder": 0x137,
           "back": 0x13A, "start": 0x13B, "guide": 0x13C, "leftstick": 0x13D, "rightstick": 0x13E}  # fmt: skip
STICK, TRIGGER, HAT = (-32768, 32767), (0, 255), (-1, 1)
AXES = {"leftx": (0, STICK), "lefty": (1, STICK), "lefttrigger": (2, TRIGGER), "rightx": (3, STICK),
        "righty": (4, STICK), "righttrigger": (5, TRIGGER), "hatx": (16, HAT), "haty": (17, HAT)}  # fmt: skip


class Pad:
    """An Xbox 360 pad that is plugged in while this context manager is open."""

    def __init__(self, name: str = "Microsoft X-Box 360 pad") -> None:
        self._file = os.open("/dev/uinput", os.O_RDWR)
        for kind in (_SYNC, _KEY, _ABS):
            fcntl.ioctl(self._file, _SET_EVENT, kind)
        for code in BUTTONS.values():
            fcntl.ioctl(self._file, _SET_KEY, code)
        least, most = [0] * 64, [0] * 64
        for code, (low, high) in AXES.values():
            fcntl.ioctl(self._file, _SET_AXIS, code)
            least[code], most[code] = low, high
        none = [0] * 64
        os.write(
            self._file,
            _DEVICE.pack(name.encode(), _USB, _MICROSOFT, _XBOX_360, 0x0114, 0, *most, *least, *none, *none),
        )
        fcntl.ioctl(self._file, _CREATE)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        fcntl.ioctl(self._file, _DESTROY)
        os.close(self._file)

    def press(self, button: str, down: bool = True) -> None:
        """Press a button, or let it go."""
        self._emit(_KEY, BUTTONS[button], int(down))

    def push(self, axis: str, value: int) -> None:
        """Push an axis so far."""
        self._emit(_ABS, AXES[axis][0], value)

    def _emit(self, kind: int, code: int, value: int) -> None:
        os.write(self._file, _EVENT.pack(0, 0, kind, code, value) + _EVENT.pack(0, 0, _SYNC, 0, 0))
