"""Asks ports what robot is there, without moving anything: serial lines, and what the makes' own probes can ask.

A port is claimed exclusively while it is asked and released afterwards; one that another process holds is not touched.
Each make's own part is the ``probe.py`` of its folder, named by its record.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from urllib.parse import unquote, urlsplit

from serial.tools import list_ports

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.make import Probe, Scope, SerialProbe, make_of, makes
from fullswarm.drivers.probe.found import Asked, unasked
from fullswarm.drivers.probe.line import BAUDS, Line, SerialPort
from fullswarm.errors import FullswarmError

BY_ID = Path("/dev/serial/by-id")


def serial_ports() -> list[SerialPort]:
    """Return the serial ports of this machine that something is plugged into, those with a name by id first."""
    links = {str(each.resolve()): str(each) for each in sorted(BY_ID.glob("*"))}
    ports = [
        SerialPort(
            links.get(each.device, each.device),
            each.device,
            " ".join(filter(None, (each.manufacturer, each.product or each.description, each.serial_number))),
            each.vid,
        )
        for each in list_ports.comports()
        # Boards have many ttyS that lead nowhere; without USB only a Raspberry Pi's UARTs are worth a question.
        if each.vid is not None or Path(each.device).name.startswith(("ttyAMA", "ttyACM", "ttyUSB", "ttyTHS"))
    ]
    return sorted(ports, key=lambda port: (not port.path.startswith(str(BY_ID)), port.path))


def _usual_addresses(clock: Clock) -> Iterator[tuple[str, Callable[[], Asked]]]:
    """Yield questions to where the emulated robots of makes are whose probes know no other place to ask."""
    for make in makes():
        for model in make.emulation.models if make.emulation else ():
            probe = make.load_probe()
            if model.place != "path" and probe is not None and not hasattr(probe, "questions"):
                url = model.driver_url("")
                yield f"{model.place} {urlsplit(url).netloc}", partial(probe.ask_url, url, clock)


def probes() -> list[Probe]:
    """Return the probes of all makes, each once, in the order of the makes."""
    targets = dict.fromkeys(each.probe for each in makes() if each.probe)
    by_target = {each.probe: each for each in makes()}
    return [probe for target in targets if (probe := by_target[target].load_probe()) is not None]


def questions(scope: Scope, clock: Clock) -> list[tuple[str, Callable[[], Asked]]]:
    """Return what `robots find` asks, serial ports first; what is written wrong is refused before anything is asked."""
    named = [SerialPort(path, path) for path in scope.serial]
    serial = serial_ports() if scope.everything else named
    return [
        *((_name(port), lambda port=port: ask_serial(port, clock)) for port in serial),
        *(each for probe in probes() if hasattr(probe, "questions") for each in probe.questions(scope, clock)),
        *(_usual_addresses(clock) if scope.everything else ()),
    ]


def _name(port: SerialPort) -> str:
    return f"{port.path} ({port.product})" if port.product else port.path


def ask_serial(port: SerialPort | str, clock: Clock | None = None) -> Asked:
    """Ask what is on a serial port, one make after the other; some 4 s when nothing answers."""
    known = port if isinstance(port, SerialPort) else SerialPort(port, port)
    clock = clock or MonotonicClock()
    asked = Asked(known.path, known.product)
    serial: list[SerialProbe] = [each for each in probes() if hasattr(each, "ask_line")]  # type: ignore[misc]  # just asked
    try:
        with Line(known.path, clock) as line:
            for probe in serial:
                for baud in BAUDS:
                    line.set_baud(baud)
                    received = line.gather(probe.LISTEN_S) if probe.LISTEN_S else b""
                    if any(other.knows(known, received) for other in serial if other is not probe):
                        continue
                    robots = probe.ask_line(line, known, baud, received, clock)
                    if robots:
                        return replace(asked, robots=robots)
    except FullswarmError as error:
        return replace(unasked(known.path, error), product=known.product)
    except OSError as error:
        return replace(asked, problem=f"the port vanished while it was asked: {error.strerror or error}")
    return replace(asked, problem="no robot answers: is it switched on?")


def ask_url(url: str, clock: Clock | None = None) -> Asked:
    """Ask the port that a driver's URL names; a make without a probe is a `problem`.

    Raises
    ------
    ConfigError
        The URL is not one of its make.
    MissingExtra
        The make's library is not installed.
    """
    clock = clock or MonotonicClock()
    parts = urlsplit(url)
    probe = make_of(url).load_probe()
    if probe is None:
        return Asked(url, problem=f"'{parts.scheme}' cannot be asked without driving it")
    if hasattr(probe, "ask_line") and not parts.netloc:
        return ask_serial(unquote(parts.path), clock)
    return probe.ask_url(url, clock)
