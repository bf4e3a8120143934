"""What a behaviour's record may say, and the checks that a record must pass before anybody relies on it."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any, Literal, cast

import msgspec
from pydantic import Field, ValidationError, model_validator

from fullswarm.config import Section
from fullswarm.errors import ConfigError
from fullswarm.messages import Value
from fullswarm.words import ROBOT_ID

Kind = Literal["number", "integer", "flag", "word", "point", "points"]
Raw = bool | int | float | str | list[Any]

HUGE = 10**300
"""Numbers beyond it (NaN and infinity among them) would not stay finite in a law."""

FORMATION = ("targets", "shape", "centre", "spacing_m")
"""Parameters that a record with `formation` must declare; they become a target per robot."""


class Parameter(Section):
    """One parameter of a behaviour."""

    type: Kind
    unit: str = ""
    doc: str = ""
    default: Raw | None = None
    default_from: str = ""  # key of the local database; `default` is used when that is empty
    required: bool = False
    min: float | None = None  # of a number, or of each coordinate of a point
    max: float | None = None
    choices: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _agree(self) -> Parameter:
        if self.required and (self.default is not None or self.default_from):
            raise ValueError("is required and has a default: choose one")
        if self.min is not None and self.max is not None and self.min > self.max:
            raise ValueError(f"min = {self.min:g} is above max = {self.max:g}")
        if self.choices and self.type != "word":
            raise ValueError("only a word has choices")
        if self.default is not None:
            self.check("default", self.default)
        return self

    @cached_property
    def span(self) -> tuple[float, float]:
        """Smallest and largest float that need no further check; an empty span when it takes no floats."""
        if self.type != "number":
            return math.inf, -math.inf
        low, high = -math.inf if self.min is None else self.min, math.inf if self.max is None else self.max
        below_huge = math.nextafter(float(HUGE), 0.0)
        return max(low, -below_huge), min(high, below_huge)

    def check(self, name: str, value: object) -> Value:
        """Return `value` in the parameter's type; ``ValueError`` says what is wrong, with the range."""
        if self.type == "flag":
            if not isinstance(value, bool):
                raise ValueError(f"{name} = {value!r} is not a flag: true or false")
            return value
        if self.type == "word":
            if not isinstance(value, str) or (self.choices and value not in self.choices):
                raise ValueError(f"{name} = {value!r} is not {self.wanted()}")
            return value
        if self.type == "point":
            return cast(Value, self._point(name, value))
        if self.type == "points":
            if not isinstance(value, list | tuple) or not value:
                raise ValueError(f"{name} = {value!r} is not {self.wanted()}")
            return [self._point(f"{name}[{k}]", each) for k, each in enumerate(value)]
        return self._number(name, value)

    def wanted(self) -> str:
        """Say in words what the parameter accepts: ``number in [0.05, 5] 1/s``."""
        if self.choices:
            return f"one of {', '.join(self.choices)}"
        shape = {"point": "point [x, y]", "points": "list of points [x, y]"}.get(self.type, self.type)
        words = [shape, f"in {self._range()}" if self._bounded else "", self.unit]
        return " ".join(word for word in words if word)

    @property
    def _bounded(self) -> bool:
        return self.min is not None or self.max is not None

    def _range(self) -> str:
        low = "-inf" if self.min is None else f"{self.min:g}"
        high = "inf" if self.max is None else f"{self.max:g}"
        return f"[{low}, {high}]"

    def _number(self, name: str, value: object) -> int | float:
        whole = self.type == "integer"
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < HUGE:
            raise ValueError(f"{name} = {value!r} is not {'an integer' if whole else 'a finite number'}")
        if whole and (value != int(value) or abs(value) >= 2**63):
            raise ValueError(f"{name} = {value!r} is not an integer of 64 bits")
        if (self.min is not None and value < self.min) or (self.max is not None and value > self.max):
            raise ValueError(f"{name} = {value:.6g} is outside {self._range()} {self.unit}".rstrip())
        return int(value) if whole else float(value)

    def _point(self, name: str, value: object) -> list[float]:
        if not isinstance(value, list | tuple) or len(value) != 2:
            raise ValueError(f"{name} = {value!r} is not a point [x, y]")
        return [float(self._number(f"{name}.{axis}", each)) for axis, each in zip("xy", value, strict=True)]


class Record(Section):
    """A behaviour that can be asked for by name."""

    name: str
    summary: str
    law: str = ""  # module of the law; empty: nothing runs, the robot stands
    centralised: bool = False
    filtered: bool = False  # behind the safety filter (`_bc`)
    survives_core: bool = False
    team: Literal["request", "swarm"] = "request"  # whom the law counts as neighbours
    expires_s: float = Field(0.0, ge=0.0, le=60.0)  # > 0: an intent, to be repeated by who holds the stick
    formation: Literal["", "each", "assigned"] = ""  # a target per robot, or all targets to the centralised node
    parameters: dict[str, Parameter] = Field(default_factory=dict)
    static: dict[str, Raw] = Field(default_factory=dict)
    static_from: dict[str, str] = Field(default_factory=dict)  # parameter → key of the local database

    @model_validator(mode="after")
    def _agree(self) -> Record:
        if not ROBOT_ID.match(self.name):
            raise ValueError(f"'{self.name}' cannot name a behaviour: use letters, digits, '-' and '_', 64 at most")
        for name, value in self.static.items():
            if not _travels(value):
                raise ValueError(f"static {name} is no flag, number, word, point or list of points")
        twice = sorted(set(self.parameters) & {*self.static, *self.static_from})
        if twice:
            raise ValueError(f"both static and a parameter: {', '.join(twice)}")
        missing = [name for name in FORMATION if name not in self.parameters] if self.formation else []
        if missing:
            raise ValueError(f"a formation needs the parameters {', '.join(missing)}")
        if self.centralised and not self.law:
            raise ValueError("a centralised behaviour needs a law")
        if (self.formation == "assigned") != (self.centralised and bool(self.formation)):
            raise ValueError('formation = "assigned" goes with centralised = true, "each" without')
        return self


def _travels(value: object) -> bool:
    """Tell whether a message can carry the value."""
    try:
        msgspec.convert(value, Value)
        msgspec.msgpack.encode(value)
    except (msgspec.ValidationError, OverflowError):
        return False
    return True


def build(name: str, raw: dict[str, Any]) -> Record:
    """Return the record that `raw` describes.

    Raises
    ------
    ConfigError
        All that is wrong with it at once, each with its key.
    """
    try:
        return Record.model_validate({**raw, "name": name})
    except ValidationError as error:
        problems = [_problem(each) for each in error.errors()]
        raise ConfigError("; ".join(problems), where=f"behaviour '{name}'", hint="see core/behaviours.toml") from None


def _problem(error: Any) -> str:
    key = ".".join(str(part) for part in error["loc"])
    text = str(error["msg"]).removeprefix("Value error, ")
    if error["type"] == "extra_forbidden":
        text = "no such key"
    return f"{key}: {text}" if key else text
