"""What a behaviour's record may say, and the checks that a record must pass before it is relied on."""

from __future__ import annotations

from typing import Any, Literal

import msgspec
from pydantic import Field, ValidationError, model_validator

from fullswarm.config import Section
from fullswarm.config.limits import EXPIRES_S
from fullswarm.config.parameter import Parameter, Raw
from fullswarm.errors import ConfigError
from fullswarm.messages import Value
from fullswarm.words import ROBOT_ID

FORMATION = ("targets", "shape", "centre", "spacing_m")
"""Parameters that a record with `formation` must declare; they become a target per robot."""


class Record(Section):
    """A behaviour that can be asked for by name."""

    name: str
    summary: str
    law: str = ""  # module of the law; empty: nothing runs, the robot stands
    centralised: bool = False
    filtered: bool = False  # behind the safety filter (`_bc`)
    survives_core: bool = False
    team: Literal["request", "swarm"] = "request"  # which robots the law counts as neighbours
    expires_s: float = Field(0.0, ge=EXPIRES_S[0], le=EXPIRES_S[1])  # > 0: an intent, to be repeated
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
