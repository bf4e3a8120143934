"""The behaviours that exist: their records, the checks of a record, a request's parameters completed by one.

Records come from ``behaviours.toml``, from other installed packages (their law is an entry point, their record lies
beside the law) and from the local database, where they can be changed while the core runs.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from pydantic import Field, ValidationError, model_validator

from fullswarm import registry
from fullswarm.config import Section
from fullswarm.config.models import EXPIRES_S
from fullswarm.config.parameter import Parameter, Raw
from fullswarm.errors import ConfigError, RequestRefused, did_you_mean
from fullswarm.fitness import ANYTHING
from fullswarm.keys import ROBOT_ID
from fullswarm.messages import Needs, ParamEntry, Value
from fullswarm.reasons import Code
from fullswarm.store import Store, Stored

PREFIX = "behaviour/"
BEHAVIOURS = Path(__file__).with_name("behaviours.toml")

SEE = "see core/behaviours.toml"

FILTER_STATIC = {"safety_margin_m": "agent/safety_margin_m", "barrier_gain_per_s": "agent/barrier_gain_per_s"}
"""What the main controller appends to every filtered request, from the local database (paper II.C.1)."""

Table = dict[str, Any]
Lookup = Callable[[str], Stored]

FORMATION = ("targets", "shape", "centre", "spacing_m")
"""Parameters that a record with `formation` must declare; they become a target per robot."""


class NeedsSection(Section):
    """``needs``: what a robot must be able to do. A number may be the name of a parameter, whose value is needed."""

    capabilities: tuple[str, ...] = Field((), max_length=64)
    makes: tuple[str, ...] = Field((), max_length=64)
    speed_m_s: Annotated[float, Field(ge=0.0, le=1e4)] | str = 0.0
    turn_rad_s: Annotated[float, Field(ge=0.0, le=1e4)] | str = 0.0
    accel_m_s2: Annotated[float, Field(ge=0.0, le=1e5)] | str = 0.0
    radius_m: Annotated[float, Field(ge=0.0, le=1e5)] | str = 0.0
    battery: Annotated[float, Field(ge=0.0, le=1.0)] | str = 0.0


NO_NEEDS = NeedsSection()


class RoleSection(Section):
    """``roles.<name>``: who may have a role, and how many must or may."""

    needs: tuple[str, ...] = Field((), max_length=64)  # capabilities
    at_least: int = Field(0, ge=0, le=10_000)
    at_most: int | None = Field(None, ge=1, le=10_000)
    doc: str = ""


class Record(Section):
    """A behaviour that can be requested by name."""

    name: str
    summary: str
    title: str = ""  # for people, in a few words; empty: made of the name
    law: str = ""  # module of the control law; empty: nothing runs, the robot stands
    centralised: bool = False
    filtered: bool = False  # behind the safety filter (`_bc`)
    survives_core: bool = False
    team: Literal["request", "group", "swarm"] = "request"  # which robots the law counts as neighbours
    needs: NeedsSection = NeedsSection()  # what its robots must be able to do
    roles: dict[str, RoleSection] = Field(default_factory=dict, max_length=64)  # that its law gives to robots
    finished: Literal["leaves", "stays"] = "leaves"  # what a robot that has ended is to the others of its team
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
                raise ValueError(f"static {name} is not a flag, number, word, point or list of points")
        twice = sorted(set(self.parameters) & {*self.static, *self.static_from})
        if twice:
            raise ValueError(f"both static and a parameter: {', '.join(twice)}")
        missing = [name for name in FORMATION if name not in self.parameters] if self.formation else []
        if missing:
            raise ValueError(f"a formation needs the parameters {', '.join(missing)}")
        for name, value in self.needs:
            if isinstance(value, str) and value not in self.parameters and value not in self.static:
                raise ValueError(f"needs.{name}: there is no parameter '{value}'")
        for name in self.roles:
            if not ROBOT_ID.match(name):
                raise ValueError(f"'{name}' cannot name a role: use letters, digits, '-' and '_', 64 at most")
        if self.roles and self.expires_s > 0.0:
            raise ValueError("roles are not for an intent (expires_s)")
        if self.team == "group" and self.expires_s > 0.0:
            raise ValueError('team = "group" is not for an intent (expires_s), which is sent too often')
        if self.team != "request" and self.centralised:
            raise ValueError("team: a centralised behaviour always has the robots of its request as neighbours")
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


def _problem(error: Any) -> str:
    key = ".".join(str(part) for part in error["loc"])
    text = str(error["msg"]).removeprefix("Value error, ")
    if error["type"] == "extra_forbidden":
        text = "no such key"
    return f"{key}: {text}" if key else text


# ------------------------------------------------------------ reading the files
def load_records(path: Path = BEHAVIOURS) -> dict[str, Table]:
    """Return the tables of a behaviours file by name, all of them checked.

    Raises
    ------
    ConfigError
        Every error of the file at once, each with behaviour and key.
    """
    tables = _read(path, "correct the file")
    _check_all(tables, tables, path)
    return tables


def all_records() -> dict[str, Table]:
    """Return the records of the package and of all others that are installed, each checked.

    Raises
    ------
    ConfigError
        A record is broken, or has a name that is taken; names the file.
    """
    tables = load_records()
    owner: dict[str, Path] = {}
    for file in registry.record_files():
        found = _read(file, "correct it, or uninstall its package")
        for name in found:
            if name in tables:
                taken = f"by {owner[name]}" if name in owner else "by fullswarm itself"
                raise ConfigError(f"'{name}' is taken {taken}", where=str(file), hint="give the behaviour another name")
        tables |= found
        owner |= dict.fromkeys(found, file)
        _check_all(found, tables, file)
    return tables


def _read(path: Path, hint: str) -> dict[str, Table]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(str(error), where=str(path), hint=hint) from error


def _check_all(names: Iterable[str], tables: Mapping[str, Any], path: Path) -> None:
    errors = []
    for name in names:
        try:
            make_record(name, tables)
        except ConfigError as error:
            errors.append(error)
    if errors:
        hint = errors[0].hint if len(errors) == 1 else ""
        raise ConfigError("\n".join(f"{each.where}: {each.what}" for each in errors), where=str(path), hint=hint)


def make_record(name: str, tables: Mapping[str, Any]) -> Record:
    """Return the record `name` with everything that it takes from the one named in `like`.

    Raises
    ------
    ConfigError
        All that is wrong with it at once, each with its key.
    """
    where, raw = f"behaviour '{name}'", _inherit(name, tables, ())
    try:
        record = Record.model_validate({**raw, "name": name})
    except ValidationError as error:
        problems = [_problem(each) for each in error.errors()]
        raise ConfigError("; ".join(problems), where=where, hint=SEE) from None
    if (
        record.centralised
        and record.law not in registry.CENTRALISED
        and record.law not in (known := registry.centralised_names())
    ):
        hint = did_you_mean(record.law, known)
        raise ConfigError(f"law: no centralised law '{record.law}'", where=where, hint=hint)
    return record


def _inherit(name: str, tables: Mapping[str, Any], derived: tuple[str, ...]) -> Table:
    raw = tables[name]
    if not isinstance(raw, dict):
        raise ConfigError(f"{raw!r} is not a table", where=f"behaviour '{name}'", hint=SEE)
    own = dict(raw)
    base_name = own.pop("like", None)
    if base_name is None:
        return own
    where = f"behaviour '{name}'"
    if not isinstance(base_name, str) or base_name not in tables:
        raise ConfigError(
            f"like: unknown behaviour '{base_name}'", where=where, hint=did_you_mean(str(base_name), tables)
        )
    if base_name in (*derived, name):
        raise ConfigError(f"like: '{base_name}' refers back to itself", where=where)
    base = _inherit(base_name, tables, (*derived, name))
    merged = {**base, **own}
    for table in ("parameters", "static", "static_from"):
        if isinstance(base.get(table), dict) and isinstance(own.get(table), dict):
            merged[table] = {**base[table], **own[table]}
    return merged


# ------------------------------------------------------------ using the records
class Library:
    """The records in the local database, checked when they are first used, again when they change."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._records: dict[str, Record] = {}
        store.watch(lambda entry: self._records.clear() if entry.key.startswith(PREFIX) else None)

    def tables(self) -> dict[str, Any]:
        """Return the raw records by name."""
        return {entry.key.removeprefix(PREFIX): entry.value for entry in self._store.list(PREFIX)}

    def expires(self, name: str) -> bool:
        """Tell whether requests for behaviour `name` end unless they are repeated; an unknown one does not."""
        if name not in self._records and self._store.entry(PREFIX + name) is None:
            return False  # at once: looking for a similar name takes milliseconds
        try:
            return self.get(name).expires_s > 0.0
        except RequestRefused:
            return False

    def get(self, name: str) -> Record:
        """Return the record of behaviour `name`.

        Raises
        ------
        RequestRefused
            There is none, or it is broken.
        """
        record = self._records.get(name)
        if record is None:
            tables = self.tables()
            if name not in tables:
                raise RequestRefused(f"unknown behaviour '{name}'", hint=did_you_mean(name, tables))
            try:
                record = self._records[name] = make_record(name, tables)
            except ConfigError as error:
                raise RequestRefused(error.what, where=error.where, hint=error.hint) from error
        return record

    def expand(self, entry: ParamEntry) -> ParamEntry:
        """Return a record's entry with everything that it takes by `like`; any other entry as it is."""
        name, tables = entry.key.removeprefix(PREFIX), self.tables()
        if not entry.key.startswith(PREFIX) or name not in tables:
            return entry
        try:
            return msgspec.structs.replace(entry, value=_inherit(name, tables, ()))
        except ConfigError:
            return entry

    def check(self, key: str, value: object) -> Stored:
        """Return a record fit to be stored under ``behaviour/<name>``; None takes a record away.

        Raises
        ------
        ConfigError
            The record, or one that is like it, would be broken.
        """
        name, tables = key.removeprefix(PREFIX), self.tables()
        if value is None:
            tables.pop(name, None)
        else:
            tables[name] = value
            make_record(name, tables)
        for other, raw in tables.items():
            if other != name and isinstance(raw, dict) and "like" in raw:
                make_record(other, tables)
        return value  # type: ignore[return-value]  # make_record has just read it as a table

    def needs(self, record: Record, parameters: Mapping[str, Value]) -> Needs:
        """Return what a request with these parameters needs of its robots by the record."""
        if record.needs == NO_NEEDS:  # a stick sends twenty requests a second
            return ANYTHING
        values: dict[str, Stored] = dict(record.static)
        for name, parameter in record.parameters.items():
            given = parameters.get(name)
            values[name] = _default(parameter, self._store.get) if given is None else given
        found: dict[str, Any] = {}
        for name, needed in record.needs:
            value = values.get(needed) if isinstance(needed, str) else needed
            if isinstance(value, tuple | float | int):  # anything else is refused with the parameters
                found[name] = value
        try:
            return msgspec.convert(found, Needs)
        except msgspec.ValidationError:  # a number out of range, which is refused with the parameters
            return ANYTHING

    def resolve(
        self, record: Record, parameters: Mapping[str, Value], robots: Sequence[str]
    ) -> dict[str, dict[str, Value]]:
        """Complete a request with values of the local database; see :func:`resolve`."""
        return resolve(record, parameters, robots, self._store.get)


def resolve(
    record: Record, parameters: Mapping[str, Value], robots: Sequence[str], lookup: Lookup = lambda _: None
) -> dict[str, dict[str, Value]]:
    """Return each robot's complete parameters: requested ones, defaults, static ones, its target of a formation.

    Parameters
    ----------
    robots
        The robots addressed, in the order of the request: the k-th target of a formation is the k-th robot's.
    lookup
        Reads a key of the local database.

    Raises
    ------
    RequestRefused
        All that is wrong with the parameters, in one sentence each.
    """
    problems: list[str] = []
    complete = _static(record, lookup, problems)
    for name in sorted(parameters.keys() - record.parameters.keys()):
        fixed = name in complete
        known = did_you_mean(name, record.parameters) if record.parameters else "it takes none"
        problems.append(f"parameter '{name}' is " + ("fixed by the record" if fixed else f"unknown ({known})"))
    for name, parameter in record.parameters.items():
        given = parameters.get(name)
        value = _default(parameter, lookup) if given is None else given
        low, high = parameter.span
        if type(value) is float and low <= value <= high:  # the fast path: a stick sends twenty requests a second
            complete[name] = value
        elif value is not None:
            try:
                complete[name] = parameter.check(name, value)
            except ValueError as error:
                problems.append(str(error))
        elif parameter.required or parameter.default_from:
            origin = f" or {parameter.default_from} in the database" if parameter.default_from else ""
            problems.append(f"{name} is missing: {parameter.expected()}{origin}")
    each = dict.fromkeys(robots, complete)
    if record.formation and not problems:
        each = _targets(record, complete, robots, problems)
    if problems:
        text = "; ".join(problems)
        hint = f"parameters of {record.name}: {', '.join(record.parameters) or 'none'}"
        raise RequestRefused(text, hint=hint, code=Code.PARAMETERS, parameters={"problems": text})
    return each


def _static(record: Record, lookup: Lookup, problems: list[str]) -> dict[str, Value]:
    values: dict[str, Value] = dict(record.static)
    sources = {**FILTER_STATIC, **record.static_from} if record.filtered else record.static_from
    for name, key in sources.items():
        value = lookup(key)
        if value is not None and not isinstance(value, dict):
            values[name] = value
        elif name in record.static_from:
            problems.append(f"the database has no {key} for {name}")
    return values


def _default(parameter: Parameter, lookup: Lookup) -> Stored:
    value = lookup(parameter.default_from) if parameter.default_from else None
    return parameter.default if value is None else value


def _targets(
    record: Record, complete: dict[str, Value], robots: Sequence[str], problems: list[str]
) -> dict[str, dict[str, Value]]:
    """Turn `targets`, or the shape, into one `target` per robot, or `targets` for the centralised node."""
    left = {name: value for name, value in complete.items() if name not in FORMATION}
    given, name, centre, spacing = (complete.get(key) for key in FORMATION)
    if (given is None) == (name is None):
        problems.append("give either targets or shape" + (", not both" if given is not None else ""))
        return {}
    if isinstance(given, list):
        targets = [list(each) for each in given if isinstance(each, list)]
    elif isinstance(centre, list) and isinstance(spacing, int | float):
        x, y = (float(each) for each in centre if isinstance(each, int | float))
        targets = shape(str(name), len(robots), (x, y), float(spacing))
    else:
        problems.append(f"centre is missing: {record.parameters['centre'].expected()}")
        return {}
    if len(targets) != len(robots):
        problems.append(f"{_count(len(targets), 'target')} for {_count(len(robots), 'robot')}: give one per robot")
        return {}
    if record.formation == "assigned":
        both: dict[str, Value] = {**left, "targets": list(targets)}
        return dict.fromkeys(robots, both)
    return {robot: {**left, "target": list(target)} for robot, target in zip(robots, targets, strict=True)}


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"


def shape(name: str, count: int, centre: tuple[float, float], spacing_m: float) -> list[list[float]]:
    """Return `count` targets around `centre`, neighbours `spacing_m` apart.

    Parameters
    ----------
    name
        ``circle`` (from the east, counter-clockwise), ``line`` (west to east) or ``grid`` (from the south west).
    """
    x, y = centre
    if name == "circle":
        # Neighbours on the circle are a chord of 2 r sin(π/n) apart; a single robot stands in the middle.
        radius = spacing_m / (2.0 * math.sin(math.pi / count)) if count > 1 else 0.0
        angles = [math.tau * k / count for k in range(count)]
        return [[x + radius * math.cos(angle), y + radius * math.sin(angle)] for angle in angles]
    columns = count if name == "line" else math.ceil(math.sqrt(count))
    rows = math.ceil(count / columns)
    return [
        [
            x + (k % columns - (columns - 1) / 2.0) * spacing_m,
            y + (k // columns - (rows - 1) / 2.0) * spacing_m,
        ]
        for k in range(count)
    ]
