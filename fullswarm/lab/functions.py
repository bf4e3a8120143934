"""Makes a behaviour of a plain function, of a module, or of a Python file: its control law and its record.

A function is ``f(view, params)`` or ``f(view, params, memory)``; keyword-only arguments with defaults become parameters
of the behaviour and are passed by name:

    def circle(view, *, speed_m_s=0.2): ...

Of a module, a file, or an object like a module counts what counts for an installed law: ``velocity`` or ``twist``, and
``Memory`` or ``Says`` if it has them. A record file beside it (``circle.toml`` beside ``circle.py``), or the object's
``record``, gives parameters, defaults and ranges.
"""

from __future__ import annotations

import inspect
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, Protocol, TypeGuard

import numpy as np

from fullswarm import registry
from fullswarm.agent.view import Params, View
from fullswarm.errors import ConfigError
from fullswarm.evaluate.pictures.ink import dark_points
from fullswarm.kernels import Array
from fullswarm.messages import Value

Law = Callable[..., Array]


class LawObject(Protocol):
    """An object like the module of a law: it has ``velocity`` or ``twist``, and what else such a module may have."""

    __name__: str

    @property
    def record(self) -> Mapping[str, Any]:
        """What a record file says, without a summary and the name of the law."""
        ...


Source = Law | ModuleType | LawObject | Path | str
FORMS = ("velocity", "twist")
BESIDE = ("Memory", "Says", "MERGE")
"""What a function may have as attributes."""


@dataclass(frozen=True)
class Given:
    """A behaviour that a program gives: `law` stands for the module of a control law, `record` for its table."""

    name: str
    law: Any
    record: dict[str, Any]


def behaviour_of(
    source: Source,
    parameters: Mapping[str, Value],
    on_error: Callable[[Exception], None],
    *,
    filtered: bool,
    twist: bool,
) -> Given:
    """Return the behaviour that a function, a module or the path of a Python file defines.

    Parameters
    ----------
    parameters : of the request; those of a control law that takes ``params`` need not be declared
    on_error : receives what the control law raises, which goes on to the agent
    filtered : it runs behind the safety filter
    twist : a function returns speed and turn rate, not a planar velocity

    Raises
    ------
    ConfigError
        The file does not load, or nothing in it can be a control law.
    """
    form = FORMS[twist]
    function: Any = source
    parts: Mapping[str, Any] = {each: getattr(source, each) for each in BESIDE if hasattr(source, each)}
    declared: dict[str, Any] = {}
    if isinstance(source, str | Path):
        source = _loaded(Path(source))
    if isinstance(source, ModuleType):
        form, function, name = _law_in(source, form)
        parts, declared = vars(source), _record_beside(source)
    elif _has_law(source):
        form = next(each for each in FORMS if hasattr(source, each))
        name, function, parts, declared = source.__name__, getattr(source, form), vars(source), dict(source.record)
    else:
        name = getattr(source, "__name__", type(source).__name__)
    name = _name(name)
    taken, named = _arguments(function, name)
    free = parameters if taken > 1 and "parameters" not in declared else {}
    known = declared.get("parameters", _declared(named, name))
    record = {"summary": f"{name}, given by a program", **declared, "law": "", "filtered": filtered}
    record["parameters"] = {**{key: parameter(key, each) for key, each in free.items()}, **known}
    law = _calling(function, name, taken, [each.name for each in named], on_error)
    others = {key: each for key, each in parts.items() if key not in FORMS}
    return Given(name, SimpleNamespace(**others, **{form: law}), record)


def _loaded(path: Path) -> ModuleType:
    if not path.is_file():
        raise ConfigError("no such file", where=str(path))
    return registry.load_file(path)


def _law_in(module: ModuleType, form: str) -> tuple[str, Any, str]:
    """Return form, function and name of a module's control law: by its form, or the one function that there is."""
    for each in FORMS:
        if callable(getattr(module, each, None)):
            return each, getattr(module, each), module.__name__.rpartition(".")[2]
    own = [
        each
        for name, each in vars(module).items()
        if inspect.isfunction(each) and each.__module__ == module.__name__ and not name.startswith("_")
    ]
    if len(own) == 1:
        return form, own[0], own[0].__name__
    names = ", ".join(each.__name__ for each in own)
    raise ConfigError(
        f"has no control law; which of its functions is it: {names}?" if own else "has no control law",
        where=str(module.__file__), hint="define velocity(view), or twist(view) for speed and turn rate",
    )  # fmt: skip


def _has_law(source: object) -> TypeGuard[LawObject]:
    return any(callable(getattr(source, form, None)) for form in FORMS)


def parameter(name: str, value: object) -> dict[str, Any]:
    """Return the declaration of a parameter by a value that it has.

    Raises
    ------
    ConfigError
        No parameter can have it.
    """
    kind = _kind(value)
    if kind is None:
        raise ConfigError(
            f"{name} = {value!r} cannot be a parameter", hint="a number, flag, word, point [x, y] or list of points"
        )
    return {"type": kind, "default": value}


def _kind(value: object) -> str | None:
    if isinstance(value, bool):
        return "flag"
    if isinstance(value, int | float):
        return "number"
    if isinstance(value, str):
        return "word"
    if isinstance(value, list | tuple) and value:
        if len(value) == 2 and all(isinstance(each, int | float) for each in value):
            return "point"
        if all(_kind(each) == "point" for each in value):
            return "points"
    return None


def _name(word: str) -> str:
    """Return a word that can name a behaviour."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", word).strip("_")[:48] or "behaviour"


def _arguments(function: Any, name: str) -> tuple[int, list[inspect.Parameter]]:
    """Return how many of view, params and memory a function takes, and its arguments by keyword.

    Raises
    ------
    ConfigError
        It is none, or takes other arguments.
    """
    if not callable(function):
        raise ConfigError(
            f"{function!r} is no behaviour",
            hint="its name, a function f(view, params), a module, or the path of a file",
        )
    arguments = inspect.signature(function).parameters.values()
    positional = [each for each in arguments if each.kind in (each.POSITIONAL_ONLY, each.POSITIONAL_OR_KEYWORD)]
    taken = 3 if any(each.kind is each.VAR_POSITIONAL for each in arguments) else len(positional)
    if not 1 <= taken <= 3:
        raise ConfigError(f"{name} takes {taken} arguments", hint="define it as f(view, params)")
    return taken, [each for each in arguments if each.kind is inspect.Parameter.KEYWORD_ONLY]


def _declared(named: list[inspect.Parameter], name: str) -> dict[str, Any]:
    """Return the parameters that arguments by keyword declare by their defaults."""
    for each in named:
        if each.default is inspect.Parameter.empty:
            raise ConfigError(
                f"the argument '{each.name}' has no default", where=name,
                hint=f"write {each.name}=0.0: its default declares its type",
            )  # fmt: skip
    return {each.name: parameter(each.name, plain(each.default)) for each in named}


def _calling(function: Law, name: str, taken: int, named: list[str], on_error: Callable[[Exception], None]) -> Law:
    """Return a control law that gives a function what it takes, checks what it returns, and reports what it raises."""

    def law(view: View, params: Params, *memory: Any) -> Array:
        given = (view, params, *memory)[:taken]
        try:
            answer = function(*given, **{each: getattr(params, each) for each in named})
            return checked(answer, len(view.position), name)
        except Exception as error:  # outside code, whatever it raises
            on_error(error)
            raise

    return law


def checked(answer: object, count: int, name: str) -> Array:
    """Return what a function of a program has returned as an array (count, 2).

    Raises
    ------
    ConfigError
        It is something else.
    """
    try:
        found = np.asarray(answer, float)
    except (TypeError, ValueError):
        found = np.empty(0)
    if found.shape != (count, 2):
        shape = found.shape if isinstance(answer, np.ndarray | list | tuple) else type(answer).__name__
        raise ConfigError(f"{name} returned {shape}, not an array of shape ({count}, 2): one row per robot")
    if not np.isfinite(found).all():
        raise ConfigError(f"{name} returned NaN or infinity", hint="is it divided by zero, or without neighbours?")
    return found


def _record_beside(module: ModuleType) -> dict[str, Any]:
    """Return the first record of the file beside a module, or one without parameters."""
    file = Path(module.__file__ or "").with_suffix(".toml")
    if not module.__file__ or not file.is_file():
        return {}
    try:
        tables = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(str(error), where=str(file), hint="correct the record of the behaviour") from error
    records = [each for each in tables.values() if isinstance(each, dict) and "like" not in each]
    return dict(records[0]) if records else {}


def plain(value: object) -> Any:
    """Return a value that a message can carry: arrays and tuples as lists, the path of a picture as its dark points."""
    if isinstance(value, Path):
        return dark_points(value)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    return value
