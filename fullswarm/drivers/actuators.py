"""What a robot has beside its wheels: actuators by name, each with the values that it takes.

A make declares them in ``Description.actuators``. A value is a state, not an event: the same again changes nothing, and
what is asked for holds until another is. Sounds are lists of pairs; an empty list is silence, after which the same
sound plays again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from fullswarm.errors import did_you_mean

Pairs = tuple[tuple[float, float], ...]
ActuatorValue = bool | float | str | Pairs
Kind = Literal["flag", "number", "word", "pairs"]
Span = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Actuator:
    """One actuator; make it by :func:`flag`, :func:`number`, :func:`word`, :func:`text` or :func:`pairs`.

    Parameters
    ----------
    name : as a control law names it, e.g. ``lamp``
    doc : one line for people
    unit : of a number; of pairs both, e.g. ``("MIDI note", "s")``
    span : least and largest number; of pairs both
    choices : words that there are; none: any printable ASCII text of at most `longest` characters
    longest : most characters or pairs
    """

    name: str
    kind: Kind
    doc: str = ""
    unit: tuple[str, ...] = ()
    span: tuple[Span, ...] = ()
    choices: tuple[str, ...] = ()
    longest: int = 0

    def check(self, value: object) -> ActuatorValue:
        """Return the value in the type that drivers take: bool, float, str or pairs of floats.

        Raises
        ------
        ValueError
            It is none of this actuator's; says what is.
        """
        found: ActuatorValue | None = None
        if self.kind == "flag":
            found = bool(value) if isinstance(value, bool) or _is_flag(value) else None
        elif self.kind == "number":
            found = _within(value, self.span[0])
        elif self.kind == "word":
            found = self._word(value)
        else:
            found = self._pairs(value)
        if found is None:
            raise ValueError(f"actuator '{self.name}' takes {self.expected()}, not {_short(value)}")
        return found

    def expected(self) -> str:
        """Return what values it takes, in words."""
        if self.kind == "flag":
            return "true or false"
        if self.kind == "number":
            return _range(self.span[0], self.unit[0])
        if self.kind == "word":
            return " | ".join(self.choices) or f"up to {self.longest} printable ASCII characters"
        both = ", ".join(_range(span, unit) for span, unit in zip(self.span, self.unit, strict=True))
        return f"up to {self.longest} pairs ({both})"

    def shown(self, value: object) -> str:
        """Return a value that it takes in words: ``on``, ``0.5 m``, ``red``, ``3 pairs``."""
        found = self.check(value)
        if isinstance(found, bool):
            return "on" if found else "off"
        if isinstance(found, float):
            return f"{found:.4g} {self.unit[0]}".rstrip()
        if isinstance(found, str):
            return found.strip() or "blank"
        return f"{len(found)} pair{'' if len(found) == 1 else 's'}" if found else "silent"

    def _word(self, value: object) -> str | None:
        if not isinstance(value, str):
            return None
        if self.choices:
            return str(value) if value in self.choices else None
        return str(value) if len(value) <= self.longest and value.isascii() and value.isprintable() else None

    def _pairs(self, value: object) -> Pairs | None:
        if not isinstance(value, Sequence) or isinstance(value, str | bytes) or len(value) > self.longest:
            return None
        pairs = []
        for each in value:
            if not isinstance(each, Sequence) or len(each) != 2:
                return None
            first, second = _within(each[0], self.span[0]), _within(each[1], self.span[1])
            if first is None or second is None:
                return None
            pairs.append((first, second))
        return tuple(pairs)


def flag(name: str, doc: str = "") -> Actuator:
    """Return an actuator that is on or off."""
    return Actuator(name, "flag", doc)


def number(name: str, low: float, high: float, unit: str, doc: str = "") -> Actuator:
    """Return an actuator with a position or strength."""
    return Actuator(name, "number", doc, (unit,), ((low, high),))


def word(name: str, choices: Iterable[str], doc: str = "") -> Actuator:
    """Return an actuator with a few named states."""
    return Actuator(name, "word", doc, choices=tuple(choices))


def text(name: str, longest: int, doc: str = "") -> Actuator:
    """Return a display of a few characters."""
    return Actuator(name, "word", doc, longest=longest)


def pairs(name: str, spans: tuple[Span, Span], units: tuple[str, str], longest: int, doc: str = "") -> Actuator:
    """Return an actuator that takes a list of pairs, such as notes with their durations."""
    return Actuator(name, "pairs", doc, units, spans, longest=longest)


@runtime_checkable
class Actuates(Protocol):
    """A driver whose robot has actuators; which, its description says."""

    def actuate(self, name: str, value: object) -> None:
        """Bring an actuator into a state; returns at once, and never delays a stop.

        Raises
        ------
        ValueError
            The robot has no such actuator, or it does not take that value.
        DriverError
            The robot takes it in another state only, e.g. while ACTIVE.
        """
        ...


def checked(actuators: Sequence[Actuator], name: str, value: object) -> ActuatorValue:
    """Return a value as the actuator `name` takes it.

    Raises
    ------
    ValueError
        There is no such actuator, or it does not take that value.
    """
    by_name: Mapping[str, Actuator] = {each.name: each for each in actuators}
    if name not in by_name:
        hint = did_you_mean(name, by_name) if by_name else "it has none"
        raise ValueError(f"the robot has no actuator '{name}' ({hint})")
    return by_name[name].check(value)


def _is_flag(value: object) -> bool:
    return type(value).__name__ == "bool" and type(value).__module__ == "numpy"


def _within(value: object, span: Span) -> float | None:
    if isinstance(value, bool) or not hasattr(value, "__float__") or isinstance(value, str):
        return None
    try:
        found = float(value)
    except (TypeError, ValueError, OverflowError):
        return None
    return found if math.isfinite(found) and span[0] <= found <= span[1] else None


def _range(span: Span, unit: str) -> str:
    return f"{span[0]:g} to {span[1]:g} {unit}".rstrip()


def _short(value: object) -> str:
    shown = repr(value)
    return shown if len(shown) <= 60 else f"{shown[:57]}..."
