"""Reads gamepads through SDL, without display, window or thread. No other file uses SDL.

SDL knows some hundred pads by itself; ``gamecontrollerdb.txt`` in the user's configuration folder adds others (the
community's file, or what `fullswarm joystick map` wrote).
"""

from __future__ import annotations

import ctypes
import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fullswarm.errors import FullswarmError, MissingExtra
from fullswarm.operator.joystick import mapping
from fullswarm.operator.joystick.state import AXES, BUTTONS, PadState, RawState

FULL = 32767.0
_NO_WINDOW = {
    "SDL_VIDEODRIVER": "dummy",
    "SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS": "1",  # a program without a window never has the focus
    "SDL_NO_SIGNAL_HANDLERS": "1",  # Ctrl-C is handled by the runtime
}


@dataclass(slots=True)
class _Pad:
    """A pad that is open; `controller` is None while SDL has no mapping for it."""

    id: int
    name: str
    guid: str
    joystick: Any
    controller: Any


def load_sdl() -> Any:
    """Return the module ``sdl2``, prepared for a program without a window.

    Raises
    ------
    MissingExtra
        It is not installed, or its library is not there.
    """
    for name, value in _NO_WINDOW.items():
        os.environ.setdefault(name, value)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns that it uses its own copy of the library
            import sdl2
    except ImportError as error:
        raise MissingExtra(
            f"a gamepad needs PySDL2: {error}", where="joystick", hint="pip install 'fullswarm[joystick]'"
        ) from None
    return sdl2


class Pads:
    """All gamepads of this machine, including those that are plugged in later.

    Raises
    ------
    ConfigError
        The file of mappings is wrong.
    FullswarmError
        SDL does not start.
    """

    def __init__(self, mappings: Path | None = None) -> None:
        self._sdl = load_sdl()
        sdl = self._sdl
        if sdl.SDL_Init(sdl.SDL_INIT_GAMECONTROLLER) != 0:
            raise FullswarmError(f"SDL failed to start: {self._error()}", where="joystick")
        for quiet in (sdl.SDL_JOYAXISMOTION, sdl.SDL_CONTROLLERAXISMOTION):
            sdl.SDL_EventState(quiet, sdl.SDL_IGNORE)  # a thousand a second; the state is polled instead
        self._event = sdl.SDL_Event()
        self._pads: dict[int, _Pad] = {}
        self._pressed: dict[int, set[str]] = {}
        for line in mapping.read_file(mappings or mapping.user_file()):
            if line.platform in ("", sdl.SDL_GetPlatform().decode()):
                self.add_mapping(line)
        self._update_pads()

    def _error(self) -> str:
        return str(self._sdl.SDL_GetError().decode(errors="replace"))

    def add_mapping(self, line: mapping.Mapping) -> None:
        """Add the mapping of a model of pads, for those that are plugged in already too.

        Raises
        ------
        FullswarmError
            SDL rejects it.
        """
        if self._sdl.SDL_GameControllerAddMapping(line.text.encode()) < 0:
            raise FullswarmError(f"SDL rejects the mapping of '{line.name}': {self._error()}", where="joystick")
        for pad in self._pads.values():
            self._close(pad)
        self._pads.clear()
        self._update_pads()

    def poll(self) -> tuple[PadState, ...]:
        """Return the state of all pads."""
        self._pressed = {}
        if self._process_events():
            self._update_pads()
        return tuple(map(self._state, self._pads.values()))

    def _process_events(self) -> bool:
        """Process SDL's events; return whether a pad was plugged in or unplugged."""
        sdl, changed = self._sdl, False
        sdl.SDL_PumpEvents()  # SDL_PollEvent alone does not sample the pads while older events wait
        while sdl.SDL_PollEvent(ctypes.byref(self._event)):
            kind = self._event.type
            if kind == sdl.SDL_CONTROLLERBUTTONDOWN:
                button = self._event.cbutton
                if button.button < len(BUTTONS):
                    self._pressed.setdefault(button.which, set()).add(BUTTONS[button.button])
            elif kind in (sdl.SDL_JOYDEVICEADDED, sdl.SDL_JOYDEVICEREMOVED):
                changed = True
        return changed

    def _update_pads(self) -> None:
        """Open pads that are new and close those that were unplugged."""
        sdl = self._sdl
        there = {sdl.SDL_JoystickGetDeviceInstanceID(index): index for index in range(sdl.SDL_NumJoysticks())}
        for gone in [pad for pad in self._pads.values() if pad.id not in there]:
            self._close(gone)
            del self._pads[gone.id]
        for number, index in there.items():
            if number not in self._pads:
                pad = self._open(number, index)
                if pad is not None:
                    self._pads[number] = pad

    def _open(self, number: int, index: int) -> _Pad | None:
        sdl = self._sdl
        controller = sdl.SDL_GameControllerOpen(index) if sdl.SDL_IsGameController(index) else None
        joystick = sdl.SDL_GameControllerGetJoystick(controller) if controller else sdl.SDL_JoystickOpen(index)
        if not joystick:
            return None  # unplugged already, or not readable
        text = ctypes.create_string_buffer(33)
        sdl.SDL_JoystickGetGUIDString(sdl.SDL_JoystickGetGUID(joystick), text, len(text))
        name = (sdl.SDL_JoystickName(joystick) or b"unnamed gamepad").decode(errors="replace")
        return _Pad(number, name, text.value.decode(), joystick, controller)

    def _close(self, pad: _Pad) -> None:
        if pad.controller:
            self._sdl.SDL_GameControllerClose(pad.controller)
        else:
            self._sdl.SDL_JoystickClose(pad.joystick)

    def _state(self, pad: _Pad) -> PadState:
        sdl, controller = self._sdl, pad.controller
        if not controller:
            return PadState(pad.id, pad.name, pad.guid, known=False)
        axes = {name: _share(sdl.SDL_GameControllerGetAxis(controller, axis)) for axis, name in enumerate(AXES)}
        down = {name for at, name in enumerate(BUTTONS) if sdl.SDL_GameControllerGetButton(controller, at)}
        return PadState(
            pad.id, pad.name, pad.guid, axes=axes, buttons=frozenset(down | self._pressed.get(pad.id, set()))
        )

    def raw(self, pad: int) -> RawState:
        """Return a pad's unmapped axes, buttons and hats; empty when it was unplugged."""
        sdl, found = self._sdl, self._pads.get(pad)
        if found is None:
            return RawState()
        stick = found.joystick
        return RawState(
            tuple(_share(sdl.SDL_JoystickGetAxis(stick, each)) for each in range(sdl.SDL_JoystickNumAxes(stick))),
            frozenset(
                each for each in range(sdl.SDL_JoystickNumButtons(stick)) if sdl.SDL_JoystickGetButton(stick, each)
            ),
            tuple(sdl.SDL_JoystickGetHat(stick, each) for each in range(sdl.SDL_JoystickNumHats(stick))),
        )

    def rumble(self, pad: int, strength: float, seconds: float) -> None:
        """Rumble a pad; does nothing if it cannot or was unplugged."""
        found = self._pads.get(pad)
        if found is not None:
            force = int(max(0.0, min(1.0, strength)) * 0xFFFF)
            self._sdl.SDL_JoystickRumble(found.joystick, force, force, int(seconds * 1e3))

    def close(self) -> None:
        """Close all pads."""
        for pad in self._pads.values():
            self._close(pad)
        self._pads.clear()
        self._sdl.SDL_QuitSubSystem(self._sdl.SDL_INIT_GAMECONTROLLER)


def _share(value: int) -> float:
    """Return an axis from -1 to 1; SDL's range has one more negative value."""
    return max(-1.0, value / FULL)
