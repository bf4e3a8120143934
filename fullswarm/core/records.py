"""Records of the behaviours: read from the local database, and a request's parameters checked against them."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from fullswarm.config.parameter import Parameter
from fullswarm.core.centralised import LAWS as CENTRALISED_LAWS
from fullswarm.core.schema import Record, build
from fullswarm.core.shapes import shape
from fullswarm.errors import ConfigError, RequestRefused, did_you_mean
from fullswarm.messages import ParamEntry, Value
from fullswarm.reasons import Code
from fullswarm.store import Store, Stored

PREFIX = "behaviour/"
BEHAVIOURS = Path(__file__).with_name("behaviours.toml")

FILTER_STATIC = {"safety_margin_m": "agent/safety_margin_m", "barrier_gain_per_s": "agent/barrier_gain_per_s"}
"""What the main controller appends to every filtered request, from the local database (paper II.C.1)."""

Raw = dict[str, Any]
Lookup = Callable[[str], Stored]


def load_records(path: Path = BEHAVIOURS) -> dict[str, Raw]:
    """Return the tables of a behaviours file by name, all of them checked.

    Raises
    ------
    ConfigError
        Every error of the file at once, each with behaviour and key.
    """
    try:
        tables: dict[str, Raw] = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(str(error), where=str(path), hint="mend the file") from error
    problems = []
    for name in tables:
        try:
            make_record(name, tables)
        except ConfigError as error:
            problems.append(f"{error.where}: {error.what}")
    if problems:
        raise ConfigError("\n".join(problems), where=str(path))
    return tables


def make_record(name: str, tables: Mapping[str, Any]) -> Record:
    """Return the record `name` with everything that `like` lends it.

    Raises
    ------
    ConfigError
        All that is wrong with it.
    """
    record = build(name, _inherit(name, tables, ()))
    if record.centralised and record.law not in CENTRALISED_LAWS:
        raise ConfigError(
            f"law: no centralised law '{record.law}'",
            where=f"behaviour '{name}'",
            hint=did_you_mean(record.law, CENTRALISED_LAWS),
        )
    return record


def _inherit(name: str, tables: Mapping[str, Any], heirs: tuple[str, ...]) -> Raw:
    raw = tables[name]
    if not isinstance(raw, dict):
        raise ConfigError(f"{raw!r} is not a table", where=f"behaviour '{name}'", hint="see core/behaviours.toml")
    own = dict(raw)
    base_name = own.pop("like", None)
    if base_name is None:
        return own
    where = f"behaviour '{name}'"
    if not isinstance(base_name, str) or base_name not in tables:
        raise ConfigError(
            f"like: unknown behaviour '{base_name}'", where=where, hint=did_you_mean(str(base_name), tables)
        )
    if base_name in (*heirs, name):
        raise ConfigError(f"like: '{base_name}' leads back to itself", where=where)
    base = _inherit(base_name, tables, (*heirs, name))
    merged = {**base, **own}
    for table in ("parameters", "static", "static_from"):
        if isinstance(base.get(table), dict) and isinstance(own.get(table), dict):
            merged[table] = {**base[table], **own[table]}
    return merged


class Library:
    """The records in the local database, checked when they are first used, again when they change."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._records: dict[str, Record] = {}
        store.watch(lambda entry: self._records.clear() if entry.key.startswith(PREFIX) else None)

    def tables(self) -> dict[str, Any]:
        """Return the raw records by name."""
        return {entry.key.removeprefix(PREFIX): entry.value for entry in self._store.list(PREFIX)}

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
        """Return a record's entry with everything that `like` lends it; any other entry as it is."""
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

    def resolve(
        self, record: Record, parameters: Mapping[str, Value], robots: Sequence[str]
    ) -> dict[str, dict[str, Value]]:
        """Complete a request with values of the local database; see :func:`resolve`."""
        return resolve(record, parameters, robots, self._store.get)


def resolve(
    record: Record, parameters: Mapping[str, Value], robots: Sequence[str], lookup: Lookup = lambda _: None
) -> dict[str, dict[str, Value]]:
    """Return each robot's complete parameters: what was asked, defaults, static ones, its target of a formation.

    Parameters
    ----------
    robots
        The robots addressed, in the order of the request: the k-th target of a formation is the k-th robot's.
    lookup
        Reads the local database.

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
        if type(value) is float and low <= value <= high:  # what a stick sends twenty times a second
            complete[name] = value
        elif value is not None:
            try:
                complete[name] = parameter.check(name, value)
            except ValueError as error:
                problems.append(str(error))
        elif parameter.required or parameter.default_from:
            origin = f" or {parameter.default_from} in the database" if parameter.default_from else ""
            problems.append(f"{name} is missing: {parameter.wanted()}{origin}")
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
    left = {name: value for name, value in complete.items() if name not in ("targets", "shape", "centre", "spacing_m")}
    given, name, centre, spacing = (complete.get(key) for key in ("targets", "shape", "centre", "spacing_m"))
    if (given is None) == (name is None):
        problems.append("give either targets or shape" + (", not both" if given is not None else ""))
        return {}
    if isinstance(given, list):
        targets = [list(each) for each in given if isinstance(each, list)]
    elif isinstance(centre, list) and isinstance(spacing, int | float):
        x, y = (float(each) for each in centre if isinstance(each, int | float))
        targets = shape(str(name), len(robots), (x, y), float(spacing))
    else:
        problems.append(f"centre is missing: {record.parameters['centre'].wanted()}")
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
