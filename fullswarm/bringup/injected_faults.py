"""What may be done to an emulated robot while it runs, typed as a line: ``cliff on``, ``battery 0.1``, ``unplug``.

Every make's emulator has the same names for injected faults; what a make does not support is refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from fullswarm.emulators.base import LinkFaults
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.simulation.bodies import FreeBody

SWITCHES = {"on": True, "off": False, "1": True, "0": False, "yes": True, "no": False}


@dataclass(frozen=True, slots=True)
class Order:
    """One command: how its argument is written, what it does, which method of the emulator it needs."""

    usage: str
    help: str
    act: Callable[[Any, str], object]  # (emulator, argument)
    needs: str = ""


def switch(text: str) -> bool:
    """Read ``on`` or ``off``."""
    if text.lower() not in SWITCHES:
        raise ConfigError(f"'{text}' is neither on nor off")
    return SWITCHES[text.lower()]


def number(text: str, low: float = -math.inf, high: float = math.inf) -> float:
    """Read a finite number within limits."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and low <= value <= high):
        limits = f" from {low:g} to {high:g}" if math.isfinite(low) and math.isfinite(high) else ""
        raise ConfigError(f"'{text}' is not a number{limits}")
    return value


def set_link(emulator: Any, faults: LinkFaults) -> None:
    """Give an emulator's link these faults from now on."""
    link: LinkFaults = emulator.faults
    link.drop, link.corrupt, link.delay_s = faults.drop, faults.corrupt, faults.delay_s


def _set_fault(name: str, high: float) -> Callable[[Any, str], None]:
    def act(emulator: Any, text: str) -> None:
        faults: LinkFaults = emulator.faults
        setattr(faults, name, number(text, 0.0, high))

    return act


def _body(emulator: Any) -> FreeBody:
    body: object = emulator.body
    if not isinstance(body, FreeBody):
        raise ConfigError("its body belongs to a simulated world and cannot be lifted here")
    return body


def _bump(emulator: Any, text: str) -> None:
    sides = {"left": (True, False), "right": (False, True)}
    left, right = sides[text] if text in sides else (switch(text),) * 2
    _body(emulator).press(left, right)


def _push(emulator: Any, text: str) -> None:
    distance, _, turn = text.partition(" ")
    _body(emulator).push(number(distance, -100.0, 100.0), number(turn or "0", -100.0, 100.0))


def _cliff(emulator: Any, text: str) -> None:
    floor_gone = switch(text)
    emulator.set_cliff(front_left=floor_gone, front_right=floor_gone)


def _wheel_drop(emulator: Any, text: str) -> None:
    hang = switch(text)
    emulator.set_wheel_drop(left=hang, right=hang)


def _overcurrent(emulator: Any, text: str) -> None:
    much = switch(text)
    emulator.set_overcurrent(left=much, right=much)


def _button(emulator: Any, text: str) -> None:
    names = () if text == "none" else tuple(text.split(","))
    try:
        emulator.press_buttons(*names)
    except KeyError as error:
        known = "clean, spot, dock, minute, hour, day, schedule, clock, play, advance or none"
        raise ConfigError(f"no button {error}", hint=known) from error


def _light(emulator: Any, text: str) -> None:
    left, right = (number(each, 0, 4095) for each in (text.partition(" ")[0], text.partition(" ")[2] or "0"))
    emulator.set_light_bumper(
        left=int(left), front_left=int(left), centre_left=int(left), centre_right=int(right), front_right=int(right),
        right=int(right),
    )  # fmt: skip


def _infrared(emulator: Any, text: str) -> None:
    code = None if text == "none" else int(number(text, 0, 255))
    emulator.set_infrared(code, code or 0, code or 0)


ORDERS: dict[str, Order] = {
    "unplug": Order("", "pull the cable", lambda it, _: it.unplug(), "unplug"),
    "replug": Order("", "put it back", lambda it, _: it.replug(), "replug"),
    "reboot": Order("", "restart the firmware", lambda it, _: it.reboot(), "reboot"),
    "mute": Order("on|off", "hears, but says nothing", lambda it, text: it.mute(switch(text)), "mute"),
    "stick": Order("on|off", "repeats old sensor values", lambda it, text: it.stick_sensors(switch(text)),
                   "stick_sensors"),
    "battery": Order("0..1", "charge", lambda it, text: it.set_battery(number(text, 0.0, 1.0)), "set_battery"),
    "estop": Order("on|off", "the red button", lambda it, text: it.press_estop(switch(text)), "press_estop"),
    "cliff": Order("on|off", "no floor in front", _cliff, "set_cliff"),
    "wheel_drop": Order("on|off", "the wheels hang", _wheel_drop, "set_wheel_drop"),
    "overcurrent": Order("on|off", "the wheels are blocked", _overcurrent, "set_overcurrent"),
    "charger": Order("on|off", "the charger's plug", lambda it, text: it.set_charger(switch(text)), "set_charger"),
    "pilot": Order("NUMBER", "the pilot's mode switch", lambda it, text: it.pilot_mode(int(number(text, 0, 255))),
                   "pilot_mode"),
    "gps": Order("on|off", "position from satellites", lambda it, text: it.set_gps(switch(text)), "set_gps"),
    "dock": Order("on|off", "stands on its home base", lambda it, text: it.set_dock(switch(text)), "set_dock"),
    "button": Order("NAME[,NAME]|none", "buttons held down", _button, "press_buttons"),
    "wall": Order("0..1023", "wall at its right", lambda it, text: it.set_wall(int(number(text, 0, 1023))), "set_wall"),
    "light": Order("LEFT [RIGHT]", "light bumper, 0 to 4095", _light, "set_light_bumper"),
    "infrared": Order("0..255|none", "byte that it receives", _infrared, "set_infrared"),
    "virtual_wall": Order("on|off", "a virtual wall ahead", lambda it, text: it.set_virtual_wall(switch(text)),
                          "set_virtual_wall"),
    "bump": Order("on|off|left|right", "press the bumper", _bump),
    "push": Order("METRES [RADIANS]", "move it by hand", _push),
    "drop": Order("0..1", "share of chunks lost", _set_fault("drop", 1.0), "faults"),
    "corrupt": Order("0..1", "share of chunks with a flipped bit", _set_fault("corrupt", 1.0), "faults"),
    "delay": Order("SECONDS", "of each direction", _set_fault("delay_s", 10.0), "faults"),
}  # fmt: skip


def obey(emulator: object, line: str) -> None:
    """Apply one line of commands to an emulator.

    Raises
    ------
    ConfigError
        No such command, an argument that does not fit, or a fault that this make does not support.
    """
    name, _, argument = " ".join(line.split()).partition(" ")
    order = ORDERS.get(name)
    if order is None:
        raise ConfigError(f"no command '{name}'", hint=did_you_mean(name, [*ORDERS, "help", "quit"]))
    if order.needs and not hasattr(emulator, order.needs):
        raise ConfigError(f"'{name}' means nothing to this robot", hint=f"it knows: {', '.join(known(emulator))}")
    if bool(argument) != bool(order.usage):
        raise ConfigError(f"'{line}' is not how it is written", hint=f"{name} {order.usage}".strip())
    order.act(emulator, argument)


def known(emulator: object) -> list[str]:
    """Return the commands that mean something to an emulator."""
    return [name for name, order in ORDERS.items() if not order.needs or hasattr(emulator, order.needs)]


def explain(emulator: object) -> str:
    """Return the commands with what they do, a line each."""
    rows = [(f"{name} {ORDERS[name].usage}", ORDERS[name].help) for name in known(emulator)]
    return "\n".join(f"  {usage:<26} {what}" for usage, what in [*rows, ("quit", "end")])
