"""Reads the bindings of a gamepad's controls from a typed TOML file; reports every error with its line."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Self

from pydantic import AfterValidator, BaseModel, Field, model_validator
from pydantic_core import ErrorDetails

from fullswarm.config.models import Section
from fullswarm.config.toml_errors import KeyPath, explain, parse_section
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.keys import ROBOT_ID
from fullswarm.messages import Value
from fullswarm.operator.joystick.state import AXES, BUTTONS, PadState, shaped

DEFAULT = Path(__file__).with_name("bindings.toml")
SWITCH_AT = 1.2
"""On a diagonal the other axis must be further out by this factor before the direction changes (hysteresis)."""


def _axis(text: str) -> str:
    if text.removeprefix("-") not in AXES:
        raise ValueError(f"'{text}' is not an axis, {did_you_mean(text.removeprefix('-'), AXES)}")
    return text


def _button(text: str) -> str:
    if text not in BUTTONS:
        raise ValueError(f"'{text}' is not a button, {did_you_mean(text, BUTTONS)}")
    return text


def _button_or_none(text: str) -> str:
    return _button(text) if text else text


def _behaviour(text: str) -> str:
    if not ROBOT_ID.match(text):
        raise ValueError(f"'{text}' cannot name a behaviour")
    return text


Axis = Annotated[str, AfterValidator(_axis)]
Button = Annotated[str, AfterValidator(_button)]
OptionalButton = Annotated[str, AfterValidator(_button_or_none)]
BehaviourName = Annotated[str, AfterValidator(_behaviour)]


class Motion(Section):
    """How a stick's offset is converted to a magnitude."""

    dead_zone: float = Field(0.15, ge=0.0, le=0.9)
    expo: float = Field(0.0, ge=0.0, le=1.0)
    share_without_turbo: float = Field(0.5, gt=0.0, le=1.0)


class Buttons(Section):
    """The button of each function; empty: none."""

    dead_man: Button = "leftshoulder"
    stop: Button = "a"
    estop: Button = "b"
    turbo: OptionalButton = "rightshoulder"
    take: OptionalButton = "back"
    next_robot: OptionalButton = "dpright"
    previous_robot: OptionalButton = "dpleft"
    next_group: OptionalButton = "dpup"
    previous_group: OptionalButton = "dpdown"


class Directions(Section):
    """A stick on the operator's map: one behaviour per direction (the paper's ``move_left`` with a magnitude)."""

    x: Axis
    y: Axis
    left: BehaviourName
    right: BehaviourName
    forward: BehaviourName
    backward: BehaviourName
    magnitude: str = "magnitude"
    parameters: dict[str, Value] = Field(default_factory=dict)
    one_robot: bool = False

    def inputs(self) -> tuple[str, ...]:
        """Return the axes it reads."""
        return self.x, self.y

    def read(self, offsets: tuple[float, ...], before: str) -> tuple[str, dict[str, float]]:
        """Return behaviour and magnitude; `before` is the behaviour that is streamed."""
        x, y = offsets
        across, along = abs(x), abs(y)
        if before in (self.left, self.right):
            across *= SWITCH_AT
        elif before in (self.forward, self.backward):
            along *= SWITCH_AT
        if across > along:
            return (self.right if x > 0 else self.left), {self.magnitude: abs(x)}
        return (self.forward if y > 0 else self.backward), {self.magnitude: abs(y)}


class Stick(Section):
    """Axes that are parameters of one behaviour, such as ``drive_bc``."""

    behaviour: BehaviourName
    axes: dict[str, Axis] = Field(min_length=1)
    parameters: dict[str, Value] = Field(default_factory=dict)
    one_robot: bool = False

    def inputs(self) -> tuple[str, ...]:
        """Return the axes it reads."""
        return tuple(self.axes.values())

    def read(self, offsets: tuple[float, ...], before: str) -> tuple[str, dict[str, float]]:  # noqa: ARG002  (as Directions)
        """Return behaviour and parameters, -1 to 1."""
        return self.behaviour, dict(zip(self.axes, offsets, strict=True))


class BoundRequest(Section):
    """A behaviour that a button starts."""

    behaviour: BehaviourName
    parameters: dict[str, Value] = Field(default_factory=dict)


class Bindings(Section):
    """All of a bindings file."""

    motion: Motion = Motion()
    buttons: Buttons = Buttons()
    directions: tuple[Directions, ...] = ()
    sticks: tuple[Stick, ...] = ()
    requests: dict[Button, BoundRequest] = Field(default_factory=dict)

    @property
    def all_sticks(self) -> tuple[Directions | Stick, ...]:
        """Return all sticks; the first that is off its centre drives."""
        return (*self.directions, *self.sticks)

    def offsets(self, pad: PadState, stick: Directions | Stick) -> tuple[float, ...]:
        """Return a stick's offsets after the dead zone; all zero: it is centred."""
        raw = (_signed(pad, axis) for axis in stick.inputs())
        return shaped(tuple(raw), self.motion.dead_zone, self.motion.expo)

    def meanings(self) -> dict[str, str]:
        """Return control → its function in words."""
        found = {button: role.replace("_", " ") for role, button in self.buttons if button}
        found |= {button: f"request {order.behaviour}" for button, order in self.requests.items()}
        for way in self.directions:
            found[way.x.removeprefix("-")] = f"{way.left} / {way.right}"
            found[way.y.removeprefix("-")] = f"{way.forward} / {way.backward}"
        for stick in self.sticks:
            found |= {axis.removeprefix("-"): f"{stick.behaviour} {name}" for name, axis in stick.axes.items()}
        return found

    @model_validator(mode="after")
    def _nothing_twice(self) -> Self:
        roles: dict[str, str] = {}
        named = [*((f"buttons.{role}", button) for role, button in self.buttons if button)]
        named += [(f"requests.{button}", button) for button in self.requests]
        for role, button in named:
            if button in roles:
                raise ValueError(f"'{button}' is both {roles[button]} and {role}")
            roles[button] = role
        if not self.all_sticks:
            raise ValueError("no stick drives: give [[directions]] or [[sticks]]")
        return self


def _signed(pad: PadState, axis: str) -> float:
    offset = pad.axes.get(axis.removeprefix("-"), 0.0)
    offset = max(-1.0, min(1.0, offset)) if math.isfinite(offset) else 0.0
    return -offset if axis.startswith("-") else offset


def load_bindings(path: Path | None = None) -> Bindings:
    """Read and check a bindings file; None: the one of the package.

    Raises
    ------
    ConfigError
        All errors, one line each: ``file:line: key: what``.
    """
    path = path or DEFAULT
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"is not UTF-8 text (byte {error.start})", where=str(path)) from None
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", where=str(path), hint=f"copy {DEFAULT}") from None
    return parse_bindings(text, str(path))


def parse_bindings(text: str, name: str = "bindings") -> Bindings:
    """Check the text of a bindings file; raises as `load_bindings`."""
    return parse_section(text, name, Bindings, _explained)


def _explained(error: ErrorDetails, schema: type[BaseModel]) -> tuple[KeyPath, str]:
    path, what = explain(error, schema)
    path = tuple(part for part in path if part != "[key]")  # a dict's key is wrong, not its value
    if "parameters" in path[:-1]:  # one complaint instead of one per type that it is not
        return path[: path.index("parameters") + 2], "must be a flag, number, word, point or list of points"
    return path, what
