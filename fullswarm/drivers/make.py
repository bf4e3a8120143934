"""Describes a make of robot in one record, which every part of the package that deals with makes reads.

A record names its code as ``module:name`` and imports it only on use: reading all records costs no library of any make.
The registry finds them: the built-in ones by a table, outside ones by the entry point group ``fullswarm.drivers``.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

from fullswarm import registry
from fullswarm.errors import ConfigError, MissingExtra, did_you_mean

if TYPE_CHECKING:
    from fullswarm.clock import Clock
    from fullswarm.drivers.probe.found import Asked, Found
    from fullswarm.drivers.probe.line import Line, SerialPort

Place = Literal["path", "udp", "tcp"]
Proof = Literal["emulated", "recording", "real firmware", "hardware"]
PROOFS: tuple[Proof, ...] = ("emulated", "recording", "real firmware", "hardware")


# ---------------------------------------------------------------- what a record names
class Emulator(Protocol):
    """An emulated robot on a port; it may have more methods, see :mod:`fullswarm.bringup.emulate`."""

    @property
    def url(self) -> str:
        """The URL with which a driver opens it."""
        ...

    def close(self) -> None:
        """Switch the robot off and release its port."""
        ...


class Probe(Protocol):
    """A module or object that asks ports what robot is there, without moving it.

    `ask_url` is enough; `robots find` then asks where the make's emulated robots are. `questions` replaces that by
    places of its own; a make on serial ports has `knows` and `ask_line` besides.
    """

    def ask_url(self, url: str, clock: Clock) -> Asked:
        """Ask the port that a driver's URL names."""
        ...

    def questions(self, scope: Scope, clock: Clock) -> Sequence[tuple[str, Callable[[], Asked]]]:
        """Return what `robots find` asks, with the name of each port; asks nothing itself."""
        ...


class SerialProbe(Probe, Protocol):
    """A probe whose make is found on serial ports."""

    LISTEN_S: float
    """How long to listen at each rate before asking."""

    def knows(self, port: SerialPort, received: bytes) -> bool:
        """Tell whether the port is surely one of this make, so that no other make's question is sent there."""
        ...

    def ask_line(self, line: Line, port: SerialPort, baud: int, received: bytes, clock: Clock) -> tuple[Found, ...]:
        """Return the robots on a claimed line at one rate."""
        ...


@dataclass(frozen=True, slots=True)
class Scope:
    """Which ports `robots find` asks; all empty: all that there are."""

    serial: tuple[str, ...] = ()
    can: tuple[str, ...] = ()
    udp: tuple[str, ...] = ()

    @property
    def everything(self) -> bool:
        """No port was named."""
        return not (self.serial or self.can or self.udp)


@dataclass(frozen=True, slots=True)
class Bench:
    """What `fullswarm emulate` asks for; None: not given. `path` is where a serial port shall be."""

    path: str
    port: Path | None = None
    listen: str | None = None
    url: str | None = None
    model: str | None = None


@dataclass(frozen=True, slots=True)
class Claim:
    """Something that only one robot of a computer can have: in words, and what to do when two name the same."""

    words: tuple[str, ...]
    advice: str = "give each robot a port of its own"


def device_claim(path: str, *, elsewhere: bool) -> Claim:
    """Return the claim on a serial device; links such as those of /dev/serial/by-id are followed on this computer."""
    return Claim(("the port", path if elsewhere else os.path.realpath(path)))


# ---------------------------------------------------------------- the record
@dataclass(frozen=True, slots=True)
class Model:
    """A robot that can be emulated.

    Parameters
    ----------
    name
        The word of ``emulate =`` in a fleet file and of `fullswarm emulate MAKE --model`.
    url
        The driver's URL, with ``{port}``: a path of a serial port, or a port number. Empty: not for fleet files.
    place, first_port, port_step
        What ``{port}`` is; for a number the first robot's, and how far apart those of a fleet are.
    """

    name: str
    url: str = ""
    place: Place = "path"
    first_port: int = 0
    port_step: int = 1

    def driver_url(self, path: str | Path, index: int = 0) -> str:
        """Return the URL for the `index`-th robot of this model, on `path` if it has a serial port."""
        port = path if self.place == "path" else self.first_port + self.port_step * index
        return self.url.replace("{port}", str(port))


@dataclass(frozen=True, slots=True)
class Emulation:
    """How robots of a make are emulated.

    Parameters
    ----------
    start
        ``module:function``: (url, body) → a started :class:`Emulator` at the other end of a driver's URL.
    models
        The first is the usual one.
    bench
        ``module:function``: (:class:`Bench`, body) → a started emulator, if `fullswarm emulate` takes more than a URL.
    listens
        It takes ``--listen``.
    clients
        ``module:function``: url → how other clients open that robot, by their names.
    mode
        ``module:function``: emulator → the name of its firmware's mode.
    shows
        ``module:function``: emulator → what its lamps, displays and speakers do now, for people; empty: nothing.
    """

    start: str
    models: tuple[Model, ...]
    bench: str = ""
    listens: bool = False
    clients: str = ""
    mode: str = ""
    shows: str = ""


@dataclass(frozen=True, slots=True)
class Icon:
    """The outline and the letter that stand for a make on the console's map."""

    shape: Literal["circle", "square", "hexagon"] = "circle"
    letter: str = ""


@dataclass(frozen=True, slots=True)
class Evidence:
    """One thing that was proven for a make: how, with which version of what, when (ISO date)."""

    proof: Proof
    what: str
    date: str


@dataclass(frozen=True, slots=True)
class Make:
    """A make of robot.

    Parameters
    ----------
    name
        The word of `fullswarm emulate`.
    robots
        What its robots are called, in the plural.
    schemes, driver
        Schemes of its URLs, and ``module:class`` of the driver.
    example
        One URL.
    limits
        What the driver does and does not do, for the table of the documentation.
    claims
        ``module:function``: (URL, whether it is another computer's) → what the robot needs for itself there (see
        :class:`Claim`); empty: the URL as a whole.
    extra
        Optional dependency of fullswarm that its driver needs.
    simulated
        It has no device: nothing to find, to test or to put on board.
    guarded
        Its driver can have a guardian (decision 14): it has ``guard()``.
    check
        What to check when no robot was found.
    """

    name: str
    robots: str
    schemes: tuple[str, ...]
    driver: str
    example: str = ""
    limits: str = ""
    claims: str = ""
    extra: str = ""
    simulated: bool = False
    guarded: bool = False
    emulation: Emulation | None = None
    probe: str = ""
    check: str = ""
    icon: Icon = Icon()
    evidence: tuple[Evidence, ...] = ()

    def driver_class(self) -> Any:
        """Import and return the driver class."""
        return part(self.driver)

    def load_probe(self) -> Probe | None:
        """Import and return the probe, if there is one."""
        return part(self.probe) if self.probe else None

    def claims_of(self, url: str, *, elsewhere: bool) -> tuple[Claim, ...]:
        """Return what a robot with this URL needs for itself on its computer, `elsewhere`: not on this one."""
        if self.claims:
            return tuple(part(self.claims)(url, elsewhere))
        return () if self.simulated else (Claim(("the URL", url)),)

    def proven(self) -> str:
        """Return the evidence as a sentence."""
        if not self.evidence:
            return "nothing is recorded"
        known = "; ".join(f"{each.proof} ({each.what}, {each.date})" for each in self.evidence)
        return known if self.on_hardware else f"{known}; never on hardware"

    @property
    def on_hardware(self) -> bool:
        """It has driven hardware."""
        return any(each.proof == "hardware" for each in self.evidence)


def part(target: str) -> Any:
    """Import what ``module:name`` or ``module`` names.

    Raises
    ------
    ConfigError
        It does not import.
    """
    module, _, name = target.partition(":")
    try:
        found = importlib.import_module(module)
        return getattr(found, name) if name else found
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"'{target}' does not import: {error}", hint="install its package again") from error


# ---------------------------------------------------------------- all records
def makes() -> tuple[Make, ...]:
    """Return all makes, the built-in ones first; an outside one that does not import is left out, see `broken`."""
    return tuple(each for each in _records().values() if isinstance(each, Make))


def built_in() -> tuple[Make, ...]:
    """Return the makes of this package."""
    return tuple({make.name: make for scheme in registry.DRIVERS for make in (make_of(f"{scheme}:"),)}.values())


def broken() -> dict[str, str]:
    """Return why an outside make could not be read, by the scheme of its entry point."""
    return {scheme: each for scheme, each in _records().items() if isinstance(each, str)}


def _records() -> dict[str, Make | str]:
    records: dict[str, Make | str] = {}
    for scheme in registry.driver_schemes():
        try:
            make = make_of(f"{scheme}:")
        except ConfigError as error:
            records[f"{scheme}:"] = str(error)  # no name of a make has a colon
            continue
        records.setdefault(make.name, make)
    return records


def make_of(url: str) -> Make:
    """Return the make for a driver's URL.

    Raises
    ------
    ConfigError
        Unknown scheme, or a plug-in that does not import.
    """
    found = registry.record(url)
    if isinstance(found, Make):
        return found
    scheme = url.partition(":")[0]  # an entry point that names a driver class alone
    return Make(scheme, scheme, (scheme,), registry.driver_target(url))


def named(name: str, also: Iterable[str] = ()) -> Make:
    """Return the make of that name that can be emulated.

    Parameters
    ----------
    also : other names that the user may have meant

    Raises
    ------
    ConfigError
        There is none.
    """
    known = {each.name: each for each in makes() if each.emulation}
    if name not in known:
        names = [*known, *also]
        choice = ", ".join(f"'{each}'" for each in names)
        raise ConfigError(f"'{name}' is not one of {choice}", where="emulate", hint=did_you_mean(name, names))
    return known[name]


def emulated() -> Mapping[str, tuple[Make, Model]]:
    """Return the words of ``emulate =`` in a fleet file; a built-in one cannot be taken over."""
    words: dict[str, tuple[Make, Model]] = {}
    for make, model in _models():
        if model.url:
            words.setdefault(model.name, (make, model))
    return words


def emulated_as(word: str) -> tuple[Make, Model]:
    """Return the make and model of a word of ``emulate =``.

    Raises
    ------
    ConfigError
        There is none.
    """
    words = emulated()
    if word not in words:
        raise ConfigError(f"no emulated robot '{word}'", where="emulate", hint=did_you_mean(word, words))
    return words[word]


def _models() -> Iterator[tuple[Make, Model]]:
    for make in makes():
        for model in make.emulation.models if make.emulation else ():
            yield make, model


def emulation_part(make: Make, target: str) -> Any:
    """Import what an emulation names; ``MissingExtra`` where emulators were left out, as on a robot."""
    if target.startswith("fullswarm.emulators") and importlib.util.find_spec("fullswarm.emulators") is None:
        raise MissingExtra(
            f"this fullswarm has no emulators ({make.name})", hint="run it on the base: no release brings them on board"
        )
    return part(target)
