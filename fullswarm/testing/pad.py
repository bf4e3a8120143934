"""A virtual gamepad for tests: SDL's own, without hardware or display. What SDL sees of it is like any other pad."""

from __future__ import annotations

import ctypes
from typing import Any

from fullswarm.operator.joystick.pads import FULL, load_sdl
from fullswarm.operator.joystick.state import AXES, BUTTONS

BUTTON_COUNT = 15  # as far as the cross; a mapping has nothing beyond
_VENDOR = 0x1234
_TRIGGERS = ("lefttrigger", "righttrigger")


class VirtualPad:
    """A pad that is plugged in from its making until `unplug`. Any thread may use it.

    Parameters
    ----------
    known
        Whether SDL takes it for a gamepad, with axes and buttons in SDL's own order; else it is one without a mapping.
    product
        Tells kinds of pads apart: pads with equal names and products have one GUID.
    """

    def __init__(
        self, name: str = "Virtual pad", *, known: bool = True, product: int = 1, axes: int = 6, hats: int = 0
    ) -> None:
        self._sdl = load_sdl()
        sdl = self._sdl
        sdl.SDL_Init(sdl.SDL_INIT_GAMECONTROLLER)
        self.rumbles: list[int] = []
        self._rumble = sdl.joystick.CFUNC_Rumble(self._on_rumble)  # kept: SDL holds only a pointer
        description = sdl.SDL_VirtualJoystickDesc(
            version=sdl.SDL_VIRTUAL_JOYSTICK_DESC_VERSION,
            type=sdl.SDL_JOYSTICK_TYPE_GAMECONTROLLER if known else sdl.SDL_JOYSTICK_TYPE_UNKNOWN,
            naxes=axes, nbuttons=BUTTON_COUNT, nhats=hats,
            vendor_id=_VENDOR, product_id=product,
            button_mask=(1 << BUTTON_COUNT) - 1, axis_mask=(1 << axes) - 1,
            name=name.encode(), Rumble=self._rumble,
        )  # fmt: skip
        index = sdl.SDL_JoystickAttachVirtualEx(ctypes.byref(description))
        if index < 0:
            raise OSError(sdl.SDL_GetError().decode())
        self.id = int(sdl.SDL_JoystickGetDeviceInstanceID(index))
        self._joystick: Any = sdl.SDL_JoystickOpen(index)
        for trigger in _TRIGGERS if known else ():
            self.axis(trigger, 0.0)
        sdl.SDL_JoystickUpdate()  # SDL takes an axis's first value for its rest

    def _on_rumble(self, _data: object, low: int, high: int) -> int:
        self.rumbles.append(max(low, high))
        return 0

    def axis(self, axis: str | int, share: float) -> None:
        """Push an axis to a share of its way, -1 to 1: by number, or by SDL's name, then triggers from 0."""
        number = AXES.index(axis) if isinstance(axis, str) else axis
        share = 2.0 * share - 1.0 if axis in _TRIGGERS else share
        self._sdl.SDL_JoystickSetVirtualAxis(self._joystick, number, round(share * FULL))

    def button(self, button: str | int, down: bool) -> None:
        """Press or release a button, by SDL's name or by number."""
        number = BUTTONS.index(button) if isinstance(button, str) else button
        self._sdl.SDL_JoystickSetVirtualButton(self._joystick, number, int(down))

    def hat(self, hat: int, bits: int) -> None:
        """Press a hat: 0 none, 1 up, 2 right, 4 down, 8 left."""
        self._sdl.SDL_JoystickSetVirtualHat(self._joystick, hat, bits)

    def unplug(self) -> None:
        """Pull it out; again does nothing."""
        sdl = self._sdl
        for index in range(sdl.SDL_NumJoysticks()):
            if sdl.SDL_JoystickGetDeviceInstanceID(index) == self.id:
                sdl.SDL_JoystickDetachVirtual(index)
                sdl.SDL_JoystickClose(self._joystick)
                return
