"""`fullswarm emulate MAKE`: one emulated robot on a real port, on an endless floor, for anybody's client.

Prints what a client opens on stdout and the commands that the robot receives on stderr; stdin takes faults to inject.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from fullswarm import output
from fullswarm.bringup import injected_faults
from fullswarm.clock import MonotonicClock
from fullswarm.drivers.make import Bench, Emulation, Emulator, emulation_part, make_of, named
from fullswarm.emulators.base import LinkFaults
from fullswarm.errors import ConfigError, FullswarmError, did_you_mean
from fullswarm.launch.typed import Typed
from fullswarm.runtime import Runtime
from fullswarm.simulation.bodies import Body, FreeBody

LOOK_S, TELL_S, LISTEN_S = 0.1, 1.0, 0.05


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
        injected_faults.set_link(emulator, faults)
        for each in orders:
            injected_faults.obey(emulator, each)
        _announce(options, emulator.url, as_json=as_json)
        teller, typed = _Teller(emulator, body), Typed()
        runtime.every(LOOK_S, lambda: teller.look(runtime.now_s()), first_s=0.0)
        runtime.every(LISTEN_S, lambda: _listen(typed, emulator, runtime))
        runtime.run(seconds)
    return 130 if runtime.exit_signal == 2 else 0


def _refuse_misfits(options: EmulateOptions) -> None:
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
    emulation = named(name).emulation
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
    try:
        yield emulator
    finally:
        emulator.close()


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
    """Return what other clients open for the robot that our driver opens as `url`."""
    make = make_of(url)
    clients = make.emulation.clients if make.emulation else ""
    found: dict[str, str] = emulation_part(make, clients)(url) if clients else {}
    return found


def _json_line(value: object) -> str:
    import json

    return json.dumps(value, ensure_ascii=False)


# ---------------------------------------------------------------- while it runs
class _Teller:
    """Prints on stderr what the robot receives and does: on a change, and each second while it moves."""

    def __init__(self, emulator: Emulator, body: FreeBody) -> None:
        self._emulator, self._body = emulator, body
        self._told, self._told_s = "", -math.inf

    def look(self, now_s: float) -> None:
        """Look once."""
        state = self._body.state()
        doing = f"{self._mode()}{_plain(state.speed_m_s):+.2f} m/s {_plain(state.turn_rad_s):+.2f} rad/s"
        moves = bool(_plain(state.speed_m_s) or _plain(state.turn_rad_s))
        if doing == self._told and not (moves and now_s - self._told_s >= TELL_S):
            return
        self._told, self._told_s = doing, now_s
        heading = math.degrees(state.heading_rad)
        x, y = _plain(state.x_m), _plain(state.y_m)
        output.progress(f"{doing}  at x {x:.2f} y {y:.2f} m, heading {heading:.0f} degrees")

    def _mode(self) -> str:
        """Return the mode that the firmware is in, where it has one."""
        make = make_of(self._emulator.url)
        mode = make.emulation.mode if make.emulation else ""
        return f"{emulation_part(make, mode)(self._emulator)} " if mode else ""


def _plain(value: float) -> float:
    return round(value, 2) + 0.0  # -0.00 looks like a motion


def _listen(typed: Typed, emulator: Emulator, runtime: Runtime) -> None:
    while (line := typed.line()) is not None:
        if line in ("quit", "exit"):
            runtime.stop()
        elif line == "help":
            output.progress(injected_faults.explain(emulator))
        elif line:
            try:
                injected_faults.obey(emulator, line)
                output.progress(f"done: {line}")
            except FullswarmError as error:
                output.progress(f"error: {error}")
