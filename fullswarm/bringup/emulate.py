"""Runs `fullswarm emulate`: one emulated robot or range sensor on a real port, with faults typed while it runs.

A fault is a line such as ``cliff on``, ``battery 0.1`` or ``unplug``. Every make's emulator has the same names for
them; what a make does not support is refused.
"""

from __future__ import annotations

import math
import os
import signal
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote, urlsplit

from fullswarm import output
from fullswarm.clock import MonotonicClock
from fullswarm.drivers.make import Bench, Emulation, Emulator, emulation_part, make_of, named
from fullswarm.drivers.ranges import KINDS as SENSORS
from fullswarm.drivers.tof.settings import SCHEME as TOF
from fullswarm.emulators.base import LinkFaults
from fullswarm.errors import ConfigError, FullswarmError, did_you_mean
from fullswarm.output import TypedLines
from fullswarm.runtime import Runtime
from fullswarm.simulation.bodies import Body, FreeBody

LOOK_S, PRINT_S, LISTEN_S = 0.1, 1.0, 0.05
SWITCHES = {"on": True, "off": False, "1": True, "0": False, "yes": True, "no": False}


@dataclass(frozen=True, slots=True)
class EmulateOptions:
    """Options of the command line; None: not given."""

    make: str
    port: Path | None = None
    listen: str | None = None
    url: str | None = None
    model: str | None = None


def run(
    options: EmulateOptions, faults: LinkFaults, orders: Sequence[str], seconds: float | None, *, as_json: bool
) -> int:
    """Serve until Ctrl-C, ``quit`` or for so many seconds; return the exit code.

    Raises
    ------
    ConfigError
        An option does not fit the make, or an order is wrong.
    DriverError
        The port cannot be had.
    MissingExtra
        The make's library is not installed.
    """
    _refuse_misfits(options)
    runtime = Runtime(MonotonicClock())
    runtime.stop_on_signals()
    body = FreeBody()
    with _port_path(options) as path, _started(options, path, body) as emulator:
        set_link(emulator, faults)
        for each in orders:
            inject(emulator, each)
        _announce(options, emulator.url, as_json=as_json)
        typed = TypedLines()
        if options.make not in SENSORS:
            printer = _Printer(emulator, body)
            runtime.every(LOOK_S, lambda: printer.print_change(runtime.now_s()), first_s=0.0)
        runtime.every(LISTEN_S, lambda: _listen(typed, emulator, runtime))
        runtime.run(seconds)
    return output.INTERRUPTED if runtime.exit_signal == signal.SIGINT else 0


def _refuse_misfits(options: EmulateOptions) -> None:
    if options.make in SENSORS:
        useless = {"listen": True, "model": True, "url": options.make != TOF}
    else:
        emulation = _emulation(options.make)
        useless = {
            "listen": not emulation.listens,
            "model": len(emulation.models) < 2,
            "port": emulation.models[0].place != "path" and not emulation.listens,
        }
    for name, nothing in useless.items():
        if nothing and getattr(options, name) is not None:
            raise ConfigError(f"means nothing to an emulated {options.make}", where=f"--{name}")
    if sum(each is not None for each in (options.port, options.listen, options.url)) > 1:
        raise ConfigError("--port, --listen and --url exclude each other", hint="name one place")


def _emulation(name: str) -> Emulation:
    emulation = named(name, also=SENSORS).emulation
    assert emulation is not None, name  # noqa: S101  (`named` returns no other)
    return emulation


# ---------------------------------------------------------------- starting
@contextmanager
def _port_path(options: EmulateOptions) -> Iterator[str]:
    """Yield the path for a serial port: the given one, or one in a new folder."""
    if options.port is not None:
        yield os.path.abspath(options.port)  # noqa: PTH100  (resolve() would follow the link that an emulator left)
        return
    with tempfile.TemporaryDirectory(prefix="fullswarm-") as folder:
        yield str(Path(folder) / options.make)


@contextmanager
def _started(options: EmulateOptions, path: str, body: Body) -> Iterator[Emulator]:
    emulator = _sensor(options, path, body) if options.make in SENSORS else _robot(options, path, body)
    try:
        yield emulator
    finally:
        emulator.close()


def _sensor(options: EmulateOptions, path: str, body: Body) -> Emulator:
    emulator: Emulator
    if options.make == TOF:
        from fullswarm.emulators.tof.emulator import FIVE, RoomTof

        emulator = RoomTof(options.url or f"{TOF}://{quote(path)}{FIVE}", body).start()
    else:
        from fullswarm.emulators.lidar.emulator import RoomLidar

        emulator = RoomLidar(options.make, path, body).start()
    return emulator


def _robot(options: EmulateOptions, path: str, body: Body) -> Emulator:
    make, emulation = named(options.make), _emulation(options.make)
    emulator: Emulator
    if emulation.bench:
        bench = Bench(path, options.port, options.listen, options.url, options.model)
        emulator = emulation_part(make, emulation.bench)(bench, body)
    else:
        models = {each.name: each for each in emulation.models}
        name = options.model or emulation.models[0].name
        if name not in models:
            raise ConfigError(f"no model '{name}'", where="--model", hint=did_you_mean(name, models))
        emulator = emulation_part(make, emulation.start)(options.url or models[name].driver_url(quote(path)), body)
    return emulator


# ---------------------------------------------------------------- what a client opens
def _announce(options: EmulateOptions, url: str, *, as_json: bool) -> None:
    clients = openings(url)
    if as_json:
        # One line, and at once: programs wait for it.
        output.data(_json_line({"make": options.make, "url": url, "clients": clients, "pid": os.getpid()}))
    else:
        output.data(f"our driver:  {url}")
        for client, opening in clients.items():
            output.data(f"{client + ':':12} {opening}")
    output.progress("type `help` for the faults to inject; Ctrl-C ends")


def openings(url: str) -> dict[str, str]:
    """Return what other clients open for the robot or sensor that our driver opens as `url`."""
    if urlsplit(url).scheme in SENSORS:
        return {"fleet file": f'ranges = "{url}"'}
    make = make_of(url)
    clients = make.emulation.clients if make.emulation else ""
    found: dict[str, str] = emulation_part(make, clients)(url) if clients else {}
    return found


def _json_line(value: object) -> str:
    import json

    return json.dumps(value, ensure_ascii=False)


# ---------------------------------------------------------------- while it runs
class _Printer:
    """Prints on stderr what the robot receives and does: on a change, and each second while it moves."""

    def __init__(self, emulator: Emulator, body: FreeBody) -> None:
        self._emulator, self._body = emulator, body
        self._printed, self._printed_s = "", -math.inf

    def print_change(self, now_s: float) -> None:
        """Print the state when it has changed."""
        state = self._body.state()
        doing = f"{self._named('mode')}{_plain(state.speed_m_s):+.2f} m/s {_plain(state.turn_rad_s):+.2f} rad/s"
        if shows := self._named("shows"):
            doing += f", {shows.rstrip()}"
        moves = bool(_plain(state.speed_m_s) or _plain(state.turn_rad_s))
        if doing == self._printed and not (moves and now_s - self._printed_s >= PRINT_S):
            return
        self._printed, self._printed_s = doing, now_s
        heading = math.degrees(state.heading_rad)
        x, y = _plain(state.x_m), _plain(state.y_m)
        output.progress(f"{doing}  at x {x:.2f} y {y:.2f} m, heading {heading:.0f} degrees")

    def _named(self, part: Literal["mode", "shows"]) -> str:
        """Return the firmware's mode, or what the robot shows, where its make names a function for that."""
        make = make_of(self._emulator.url)
        target = getattr(make.emulation, part) if make.emulation else ""
        text = str(emulation_part(make, target)(self._emulator)) if target else ""
        return f"{text} " if text else ""


def _plain(value: float) -> float:
    return round(value, 2) + 0.0  # -0.00 looks like a motion


def _listen(typed: TypedLines, emulator: Emulator, runtime: Runtime) -> None:
    while (line := typed.line()) is not None:
        if line in ("quit", "exit"):
            runtime.stop()
        elif line == "help":
            output.progress(explain_faults(emulator))
        elif line:
            try:
                inject(emulator, line)
                output.progress(f"done: {line}")
            except FullswarmError as error:
                output.progress(f"error: {error}")


# ---------------------------------------------------------------- faults
@dataclass(frozen=True, slots=True)
class Fault:
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


def _sensor_cable(emulator: Any, text: str) -> None:
    which, _, on = text.partition(" ")
    emulator.wire_sensor(which, switch(on))


def _infrared(emulator: Any, text: str) -> None:
    code = None if text == "none" else int(number(text, 0, 255))
    emulator.set_infrared(code, code or 0, code or 0)


FAULTS: dict[str, Fault] = {
    "unplug": Fault("", "pull the cable", lambda it, _: it.unplug(), "unplug"),
    "replug": Fault("", "put it back", lambda it, _: it.replug(), "replug"),
    "reboot": Fault("", "restart the firmware", lambda it, _: it.reboot(), "reboot"),
    "mute": Fault("on|off", "receives, but sends nothing", lambda it, text: it.mute(switch(text)), "mute"),
    "sensor": Fault("WHICH on|off", "the cable of one time-of-flight sensor", _sensor_cable, "wire_sensor"),
    "stick": Fault("on|off", "repeats old sensor values", lambda it, text: it.stick_sensors(switch(text)),
                   "stick_sensors"),
    "battery": Fault("0..1", "charge", lambda it, text: it.set_battery(number(text, 0.0, 1.0)), "set_battery"),
    "estop": Fault("on|off", "the red button", lambda it, text: it.press_estop(switch(text)), "press_estop"),
    "cliff": Fault("on|off", "no floor in front", _cliff, "set_cliff"),
    "wheel_drop": Fault("on|off", "the wheels hang", _wheel_drop, "set_wheel_drop"),
    "overcurrent": Fault("on|off", "the wheels are blocked", _overcurrent, "set_overcurrent"),
    "charger": Fault("on|off", "the charger's plug", lambda it, text: it.set_charger(switch(text)), "set_charger"),
    "pilot": Fault("NUMBER", "the pilot's mode switch", lambda it, text: it.pilot_mode(int(number(text, 0, 255))),
                   "pilot_mode"),
    "gps": Fault("on|off", "position from satellites", lambda it, text: it.set_gps(switch(text)), "set_gps"),
    "dock": Fault("on|off", "on its home base", lambda it, text: it.set_dock(switch(text)), "set_dock"),
    "button": Fault("NAME[,NAME]|none", "buttons held down", _button, "press_buttons"),
    "wall": Fault("0..1023", "wall at its right", lambda it, text: it.set_wall(int(number(text, 0, 1023))), "set_wall"),
    "light": Fault("LEFT [RIGHT]", "light bumper, 0 to 4095", _light, "set_light_bumper"),
    "infrared": Fault("0..255|none", "byte that it receives", _infrared, "set_infrared"),
    "virtual_wall": Fault("on|off", "a virtual wall ahead", lambda it, text: it.set_virtual_wall(switch(text)),
                          "set_virtual_wall"),
    "bump": Fault("on|off|left|right", "press the bumper", _bump),
    "push": Fault("METRES [RADIANS]", "move it by hand", _push),
    "block": Fault("on|off", "hold the lidar's motor", lambda it, text: it.block(switch(text)), "block"),
    "drop": Fault("0..1", "share of chunks lost", _set_fault("drop", 1.0), "faults"),
    "corrupt": Fault("0..1", "share of chunks with a flipped bit", _set_fault("corrupt", 1.0), "faults"),
    "delay": Fault("SECONDS", "of each direction", _set_fault("delay_s", 10.0), "faults"),
}  # fmt: skip


def inject(emulator: object, line: str) -> None:
    """Apply one line of commands to an emulator.

    Raises
    ------
    ConfigError
        No such command, an argument that does not fit, or a fault that this make does not support.
    """
    name, _, argument = " ".join(line.split()).partition(" ")
    order = FAULTS.get(name)
    if order is None:
        raise ConfigError(f"no command '{name}'", hint=did_you_mean(name, [*FAULTS, "help", "quit"]))
    if name not in supported_faults(emulator):
        raise ConfigError(
            f"'{name}' is not supported by this make", hint=f"supported: {', '.join(supported_faults(emulator))}"
        )
    if bool(argument) != bool(order.usage):
        raise ConfigError(f"'{line}' has wrong arguments", hint=f"{name} {order.usage}".strip())
    order.act(emulator, argument)


def supported_faults(emulator: object) -> list[str]:
    """Return the commands that an emulator supports."""
    return [
        name for name, order in FAULTS.items()
        if (not order.needs or hasattr(emulator, order.needs)) and name not in getattr(emulator, "lacks", ())
    ]  # fmt: skip


def explain_faults(emulator: object) -> str:
    """Return the commands with what they do, a line each."""
    rows = [(f"{name} {FAULTS[name].usage}", FAULTS[name].help) for name in supported_faults(emulator)]
    return "\n".join(f"  {usage:<26} {what}" for usage, what in [*rows, ("quit", "end")])
