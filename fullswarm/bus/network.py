"""What a bad network does, as people write it: ``loss=20%,delay=100ms±50,partition=r1+r2|*@5s-10s``."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from fullswarm.errors import ConfigError, did_you_mean

EXAMPLE = "loss=20%,delay=100ms±50,partition=r1+r2|*"
REST = "*"
"""In a partition: all processes that are not named."""
LONGEST_S = 60.0
"""A message that is later than that is of no use."""

_SHARE = re.compile(r"(\d+(?:\.\d*)?|\.\d+)(%?)\Z")
_TIME = re.compile(r"(\d+(?:\.\d*)?|\.\d+)(ms|s)?\Z")
_NAME = re.compile(r"(?:[A-Za-z0-9_-]{1,64}|\*)\Z")
_UNIT_S = {"ms": 0.001, "s": 1.0}


@dataclass(frozen=True, slots=True)
class Partition:
    """Processes on different sides do not hear each other from `start_s` to `end_s`.

    Parameters
    ----------
    sides
        Names of processes; ``*`` stands for all that no side names. A process on no side receives all.
    """

    sides: tuple[frozenset[str], ...]
    start_s: float = 0.0
    end_s: float = math.inf

    def parts(self, one: str, other: str, time_s: float) -> bool:
        """Tell whether two processes are cut off from each other at `time_s`."""
        if not self.start_s <= time_s < self.end_s:
            return False
        here, there = self._side(one), self._side(other)
        return here is not None and there is not None and here != there

    def _side(self, name: str) -> int | None:
        rest = None
        for index, side in enumerate(self.sides):
            if name in side:
                return index
            if REST in side:
                rest = index
        return rest


@dataclass(frozen=True, slots=True)
class Network:
    """The conditions that every message meets on its way from one process to another, for each receiver anew.

    Attributes
    ----------
    loss
        Share of the messages that do not arrive, 0 to 1.
    delay_s, jitter_s
        They arrive ``delay_s ± jitter_s`` later, evenly spread, in the order in which they were sent.
    duplicate
        Share that arrives once more, with a delay of its own.
    reorder
        Share that takes another way: up to `DETOUR_S` longer, past those that wait and passed by later ones.
    partitions
        Which processes are cut off from each other, and when.
    """

    loss: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    partitions: tuple[Partition, ...] = ()

    @property
    def names(self) -> frozenset[str]:
        """Every process that a partition names."""
        return frozenset(name for each in self.partitions for side in each.sides for name in side) - {REST}


def parse_network(text: str, where: str = "--network") -> Network:
    """Read conditions separated by commas, e.g. ``loss=20%,delay=100ms±50,partition=r1+r2|*@5s-10s``.

    Raises
    ------
    ConfigError
        Says which condition, at which character of `text`, what is wrong with it.
    """
    values: dict[str, float] = {}
    partitions: list[Partition] = []
    at = 0
    for part in text.split(","):
        column = at + len(part) - len(part.lstrip()) + 1
        at += len(part) + 1
        try:
            _take(part.strip(), values, partitions)
        except ConfigError as error:
            place = f"'{part.strip()}' at character {column}" if part.strip() else f"'{text}'"
            raise ConfigError(error.what, where=f"{where}: {place}" if where else place, hint=error.hint) from None
    if values.get("jitter_s", 0.0) > values.get("delay_s", 0.0):
        raise ConfigError(
            "the jitter is longer than the delay: some messages would arrive before they are sent",
            where=f"{where}: '{text}'" if where else f"'{text}'",
            hint="delay=100ms±50 is 50 to 150 ms",
        )
    return Network(**values, partitions=tuple(partitions))


def check_names(network: Network, known: Iterable[str], where: str = "--network") -> None:
    """Refuse a partition that names a process that is not `known`.

    Raises
    ------
    ConfigError
        Names it.
    """
    known = tuple(known)
    for name in sorted(network.names - set(known)):
        raise ConfigError(
            f"the partition names '{name}', which is no process of this swarm", where=where,
            hint=did_you_mean(name, known),
        )  # fmt: skip


def _take(part: str, values: dict[str, float], partitions: list[Partition]) -> None:
    """Add one condition to what has been read."""
    if not part:
        raise ConfigError("there is no condition between the commas", hint=f"for example {EXAMPLE}")
    key, equals, value = (each.strip() for each in part.partition("="))
    if key not in _READ and key != "partition":
        raise ConfigError(f"'{key}' is no condition of a network", hint=did_you_mean(key, [*_READ, "partition"]))
    if not equals or not value:
        raise ConfigError("a value is missing", hint=f"for example {EXAMPLE}")
    if key == "partition":
        partitions.append(_partition(value))
        return
    for field, number in _READ[key](key, value).items():
        if field in values:
            raise ConfigError(f"{field.removesuffix('_s')} is given twice")
        values[field] = number


def _share(key: str, value: str) -> dict[str, float]:
    match = _SHARE.match(value)
    share = math.nan if match is None else float(match[1]) / (100.0 if match[2] else 1.0)
    if not 0.0 <= share <= 1.0:
        raise ConfigError(f"'{value}' is not a share", hint="write 0% to 100%, or 0.0 to 1.0")
    return {key: share}


def _delay(key: str, value: str) -> dict[str, float]:
    del key
    middle, sign, spread = value.replace("+-", "±").partition("±")
    delay_s, unit = _time(middle.strip())
    if not sign:
        return {"delay_s": delay_s}
    return {"delay_s": delay_s, "jitter_s": _time(spread.strip(), unit)[0]}


def _jitter(key: str, value: str) -> dict[str, float]:
    del key
    return {"jitter_s": _time(value)[0]}


def _time(value: str, unit: str = "") -> tuple[float, str]:
    """Return seconds, and the unit they were given in; `unit` is that of a number that has none."""
    match = _TIME.match(value)
    if match is None:
        raise ConfigError(f"'{value}' is not a time", hint="for example 100ms or 0.1s")
    unit = match[2] or unit
    if not unit:
        raise ConfigError(f"'{value}' has no unit", hint=f"{value}ms or {value}s?")
    seconds = float(match[1]) * _UNIT_S[unit]
    if seconds > LONGEST_S:
        raise ConfigError(f"'{value}' is too long", hint=f"{LONGEST_S:g}s at most")
    return seconds, unit


def _partition(value: str) -> Partition:
    sides_text, at, when = value.partition("@")
    sides = [tuple(name.strip() for name in side.split("+")) for side in sides_text.split("|")]
    if len(sides) < 2:
        raise ConfigError("a partition needs two sides", hint="r1+r2|* cuts r1 and r2 off from all others")
    names = [name for side in sides for name in side]
    for name in names:
        if not _NAME.match(name):
            what = f"'{name}' cannot name a process" if name else "a side of the partition is empty"
            raise ConfigError(what, hint="names with '+' between them, sides with '|': r1+r2|*")
        if names.count(name) > 1:
            raise ConfigError(f"'{name}' is named twice: it can be on one side only")
    start_s, end_s = _span(when) if at else (0.0, math.inf)
    return Partition(tuple(frozenset(side) for side in sides), start_s, end_s)


def _span(when: str) -> tuple[float, float]:
    """Read ``5s-10s``, or ``5s`` and ``5s-``: from then on."""
    first, _, last = when.partition("-")
    start_s, unit = _moment(first.strip())
    end_s = _moment(last.strip(), unit)[0] if last.strip() else math.inf
    if end_s <= start_s:
        raise ConfigError(f"'{when}' ends before it begins", hint="for example @5s-10s")
    return start_s, end_s


def _moment(value: str, unit: str = "") -> tuple[float, str]:
    match = _TIME.match(value)
    if match is None or not (match[2] or unit):
        raise ConfigError(f"'{value}' is not a time since the start", hint="for example @5s-10s")
    unit = match[2] or unit
    return float(match[1]) * _UNIT_S[unit], unit


_READ: dict[str, Callable[[str, str], dict[str, float]]] = {
    "loss": _share,
    "delay": _delay,
    "jitter": _jitter,
    "duplicate": _share,
    "reorder": _share,
}
