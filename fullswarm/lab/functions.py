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
    parameters : of the request; those that nothing declares are declared by their values
    on_error : receives what a function raises, which goes on to the agent
    filtered : it runs behind the safety filter
    twist : a function returns speed and turn rate, not a planar velocity

    Raises
    ------
    ConfigError
        The file does not load, or nothing in it can be a control law.
    """
    if isinstance(source, str | Path):
        path = Path(source)
        if not path.is_file():
            raise ConfigError("no such file", where=str(path))
        source = _in_file(registry.load_file(path))
    law: Any
    if isinstance(source, ModuleType):
        name, law, declared = source.__name__.rpartition(".")[2], _noting(source, on_error), _record_beside(source)
    elif not _has_law(source):
        function: Any = source
        name = getattr(function, "__name__", type(function).__name__)
        law, declared = _law_of(function, _name(name), twist, on_error), {"parameters": _declared(function)}
    else:
        name, law, declared = source.__name__, _noting(source, on_error), dict(source.record)
    name = _name(name)
    record = {"summary": f"{name}, given by a program", **declared, "law": "", "filtered": filtered}
    known = record.setdefault("parameters", {})
    record["parameters"] = {**{key: parameter(key, each) for key, each in parameters.items()}, **known}
    return Given(name, law, record)


def _noting(source: object, on_error: Callable[[Exception], None]) -> Any:
    """Return a copy of a module, or of an object like one, whose control law reports what it raises."""

    def noting(law: Law) -> Law:
        def call(*given: Any) -> Array:
            try:
                return law(*given)
            except Exception as error:  # outside code, whatever it raises
                on_error(error)
                raise

        return call

    laws = {form: noting(getattr(source, form)) for form in FORMS if callable(getattr(source, form, None))}
    return SimpleNamespace(**{**vars(source), **laws})


def _in_file(module: ModuleType) -> ModuleType | Law:
    """Return a module that has a law, or the one function of a module that has none."""
    if any(callable(getattr(module, form, None)) for form in FORMS):
        return module
    own = [
        each
        for name, each in vars(module).items()
        if inspect.isfunction(each) and each.__module__ == module.__name__ and not name.startswith("_")
    ]
    if len(own) == 1:
        found: Law = own[0]
        return found
    names = ", ".join(each.__name__ for each in own) or "none"
    raise ConfigError(
        f"has several functions or none ({names})", where=str(module.__file__),
        hint="name the one that is the control law velocity(view, params), or twist for speed and turn rate",
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


def _declared(function: Law) -> dict[str, Any]:
    found = {}
    for each in inspect.signature(function).parameters.values():
        if each.kind is inspect.Parameter.KEYWORD_ONLY:
            if each.default is inspect.Parameter.empty:
                raise ConfigError(
                    f"the argument '{each.name}' has no default", where=getattr(function, "__name__", "behaviour"),
                    hint=f"write {each.name}=0.0: its default declares its type",
                )  # fmt: skip
            found[each.name] = parameter(each.name, plain(each.default))
    return found


def _law_of(function: Law, name: str, twist: bool, on_error: Callable[[Exception], None]) -> Any:
    """Return an object like the module of a law, whose function passes keyword arguments and checks what comes back."""
    if not callable(function):
        raise ConfigError(
            f"{function!r} is no behaviour",
            hint="its name, a function f(view, params), a module, or the path of a file",
        )
    arguments = inspect.signature(function).parameters.values()
    named = [each.name for each in arguments if each.kind is inspect.Parameter.KEYWORD_ONLY]
    positional = [each for each in arguments if each.kind in (each.POSITIONAL_ONLY, each.POSITIONAL_OR_KEYWORD)]
    taken = 3 if any(each.kind is each.VAR_POSITIONAL for each in arguments) else len(positional)
    memory = getattr(function, "Memory", None)
    if not 1 <= taken <= 3:
        raise ConfigError(f"{name} takes {taken} arguments", hint="define it as f(view, params)")

    def law(view: View, params: Params, *memory: Any) -> Array:
        given = (view, params, *memory)[:taken]
        try:
            answer = function(*given, **{each: getattr(params, each) for each in named})
            return checked(answer, len(view.position), name)
        except Exception as error:  # outside code, whatever it raises
            on_error(error)
            raise

    found = SimpleNamespace(**{FORMS[twist]: law})
    if memory is not None:
        found.Memory = memory
    if (says := getattr(function, "Says", None)) is not None:
        found.Says = says
    return found


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
    """Return a value that a message can carry: arrays and tuples as lists, NumPy's numbers as Python's."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    return value
