"""A parameter of a behaviour: its type, its range, and the check that core and robots share."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any, Literal, cast

from pydantic import model_validator

from fullswarm.config.models import BARRIER_GAIN_PER_S, BARRIERS, SAFETY_MARGIN_M, Section
from fullswarm.messages import Value

Kind = Literal["number", "integer", "flag", "word", "point", "points"]
Raw = bool | int | float | str | list[Any]

HUGE = 10**300
"""Numbers beyond it (NaN and infinity among them) would not stay finite in a control law."""


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
        """Return `value` in the parameter's type; ``ValueError`` names the problem and the range."""
        if self.type == "flag":
            if not isinstance(value, bool):
                raise ValueError(f"{name} = {value!r} is not a flag: true or false")
            return value
        if self.type == "word":
            if not isinstance(value, str) or (self.choices and value not in self.choices):
                raise ValueError(f"{name} = {value!r} is not {self.expected()}")
            return value
        if self.type == "point":
            return cast(Value, self._point(name, value))
        if self.type == "points":
            if not isinstance(value, list | tuple) or not value:
                raise ValueError(f"{name} = {value!r} is not {self.expected()}")
            return [self._point(f"{name}[{k}]", each) for k, each in enumerate(value)]
        return self._number(name, value)

    def expected(self) -> str:
        """Return in words what the parameter accepts: ``number in [0.05, 5] 1/s``."""
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


SAFETY_MARGIN = Parameter(type="number", unit="m", min=SAFETY_MARGIN_M[0], max=SAFETY_MARGIN_M[1])
BARRIER_GAIN = Parameter(type="number", unit="1/s", min=BARRIER_GAIN_PER_S[0], max=BARRIER_GAIN_PER_S[1])
FILTER = {
    "safety_margin_m": SAFETY_MARGIN,
    "barrier_gain_per_s": BARRIER_GAIN,
    "barrier": Parameter(type="word", choices=BARRIERS),
    "coordination": Parameter(type="flag"),
}
"""Settings of a filtered request. The core appends the first two to each; a record may fix the others as `static`."""
