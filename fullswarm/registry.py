"""Drivers and behaviours by name: a table first, entry points only on a miss.

Importing this file imports none of them. Outside packages use the entry point groups ``fullswarm.drivers`` (URL scheme
→ record of the make, or its driver class alone), ``fullswarm.behaviours`` (name of a law on board → module) and
``fullswarm.centralised`` (name of a law on the base station → module). A name of the table cannot be taken over.

A package under development need not be installed: the entry points of the ``pyproject.toml`` in the folder that the
environment variable :data:`DEVELOP` names count as well. `fullswarm up --reload` sets it; nothing on a robot does.
"""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import importlib.util
import os
import sys
import tomllib
import traceback
from importlib.machinery import ModuleSpec
from importlib.metadata import EntryPoint
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any
from urllib.parse import urlsplit

from fullswarm.errors import ConfigError, FullswarmError, did_you_mean

DRIVER_GROUP = "fullswarm.drivers"
BEHAVIOUR_GROUP = "fullswarm.behaviours"
CENTRALISED_GROUP = "fullswarm.centralised"

DEVELOP = "FULLSWARM_DEVELOP"
"""Name of the environment variable with the folder of a package under development."""

DRIVERS = MappingProxyType(
    {
        "sim": "fullswarm.drivers.sim:MAKE",
        "null": "fullswarm.drivers.null:MAKE",
        "create": "fullswarm.drivers.create_oi:MAKE",
        "can+odrive": "fullswarm.drivers.can:ODRIVE",
        "can+vesc": "fullswarm.drivers.can:VESC",
        "mavlink+udp": "fullswarm.drivers.mavlink:MAKE",
        "mavlink+udpout": "fullswarm.drivers.mavlink:MAKE",
        "mavlink+tcp": "fullswarm.drivers.mavlink:MAKE",
        "mavlink+serial": "fullswarm.drivers.mavlink:MAKE",
        "ros": "fullswarm.drivers.ros:MAKE",
    }
)
"""Each scheme's record (:class:`fullswarm.drivers.make.Make`). `robots find` tries them in this order."""

RANGE_SENSORS = MappingProxyType(
    {
        scheme: f"fullswarm.drivers.lidar:{record}"
        for record, names in {"LDROBOT": ("ld06", "ld19"), "SLAMTEC": ("rplidar",)}.items()
        for scheme in (*names, *(f"{name}+tcp" for name in names))
    }
)
"""Records of the drivers without wheels, for ``ranges`` in ``[[robot]]``."""

_LAWS = "fullswarm.agent.behaviours"
LAWS = MappingProxyType(
    {
        name: f"{_LAWS}.{name}"
        for name in (
            "move_to_goal",
            "navigate",
            "navigate_each",
            "flocking",
            "rendezvous",
            "formation",
            "voronoi_coverage",
            "move",
            "drive",
            "paper_bc",
            "stop",
            "dispersion",
            "aggregation",
            "leader_follower",
            "cyclic_pursuit",
            "perimeter",
            "area_sweep",
            "consensus",
            "average_consensus",
            "pursuit_evasion",
            "flocking_adaptive",
            "flocking_velocity",
            "task_auction",
            "pattern",
            "patrol",
            "exploration",
            "docking",
        )
    }
)

_CENTRALISED = "fullswarm.core.centralised.behaviours"
CENTRALISED = MappingProxyType(
    {name: f"{_CENTRALISED}.{name}" for name in ("formation_assigned", "voronoi_centralised", "teleop_centroid")}
)


def driver_class(url: str) -> Any:
    """Return the driver class for a URL such as ``create:///dev/ttyUSB0``.

    Raises
    ------
    ConfigError
        Unknown scheme, or a plug-in that does not import; names it and the cause.
    """
    found = record(url)
    return found if isinstance(found, type) else found.driver_class()


def record(url: str) -> Any:
    """Return what the table or an entry point names for a URL's scheme: the record of a make, or a driver class.

    Raises
    ------
    ConfigError
        Unknown scheme, or a plug-in that does not import; names it and the cause.
    """
    module, _, name = driver_target(url).partition(":")
    found = getattr(_import(module, url), name, None)
    if found is None:
        raise ConfigError(f"'{module}' has no '{name}'", where=url, hint="install its package again")
    return found


def driver_target(url: str) -> str:
    """Return where the record for a URL is, ``module:name``. Imports nothing: a mistyped URL is refused at once.

    Raises
    ------
    ConfigError
        Unknown scheme.
    """
    scheme = urlsplit(url).scheme
    target = DRIVERS.get(scheme) or RANGE_SENSORS.get(scheme) or _entry_point(DRIVER_GROUP, scheme)
    if target is None:
        raise ConfigError(f"no driver for '{scheme or url}'", where=url, hint=did_you_mean(scheme, driver_schemes()))
    return target


@functools.cache
def law_module(name: str) -> Any:
    """Return the module that holds the law `name` (a function ``velocity`` or ``twist``); found once per process.

    Raises
    ------
    ConfigError
        Unknown law, or a plug-in that does not import.
    """
    if name in _GIVEN:
        return _GIVEN[name]
    target = LAWS.get(name) or _entry_point(BEHAVIOUR_GROUP, name)
    if target is None:
        raise ConfigError(f"this robot has no control law '{name}'", hint=did_you_mean(name, law_names()))
    return _import(target.partition(":")[0], name)


@functools.cache
def centralised_module(name: str) -> Any:
    """Return the module that holds the centralised law `name`; found once per process.

    Raises
    ------
    ConfigError
        Unknown law, or a plug-in that does not import.
    """
    target = CENTRALISED.get(name) or _entry_point(CENTRALISED_GROUP, name)
    if target is None:
        raise ConfigError(f"no centralised law '{name}'", hint=did_you_mean(name, centralised_names()))
    return _import(target.partition(":")[0], name)


def driver_schemes() -> tuple[str, ...]:
    """Return all URL schemes that have a driver, plug-ins included."""
    return (*DRIVERS, *_entry_point_names(DRIVER_GROUP, DRIVERS))


def law_names() -> tuple[str, ...]:
    """Return the names of all laws on board, plug-ins included."""
    return (*LAWS, *_entry_point_names(BEHAVIOUR_GROUP, LAWS))


def centralised_names() -> tuple[str, ...]:
    """Return the names of all centralised laws, plug-ins included."""
    return (*CENTRALISED, *_entry_point_names(CENTRALISED_GROUP, CENTRALISED))


def record_files() -> tuple[Path, ...]:
    """Return the record files of outside behaviours: ``<law>.toml`` beside the law's module, if there is one.

    Finding them imports no law, so that a computer without a law's libraries can still be the core.
    """
    files = [file.with_suffix(".toml") for file in law_files().values()]
    return tuple(dict.fromkeys(file for file in files if file.is_file()))


# ---------------------------------------------------------------- laws of this process alone
_GIVEN: dict[str, Any] = {}


def give_law(name: str, module: Any) -> None:
    """Have this process find a law, a module or an object like one, that no package has installed.

    Raises
    ------
    ConfigError
        A law of that name is known already.
    """
    if name in _GIVEN or name in law_names():
        raise ConfigError(f"a control law '{name}' exists already", hint="give it another name")
    _GIVEN[name] = module
    law_module.cache_clear()


def take_law(name: str) -> None:
    """Forget a law that :func:`give_law` has made known."""
    _GIVEN.pop(name, None)
    law_module.cache_clear()


# ---------------------------------------------------------------- laws under development
def law_files() -> dict[str, Path]:
    """Return the files of outside laws, on board and centralised, by the name of the law; imports none."""
    found = {}
    for group, name in _outside():
        spec = _spec(group, name)
        if spec is not None and spec.origin:
            found[name] = Path(spec.origin)
    return found


def loaded(group: str) -> dict[str, ModuleType]:
    """Return the modules of outside laws of one entry point group that this process has imported, by name."""
    found = {}
    for each, name in _outside():
        module = sys.modules.get((_entry_point(each, name) or "").partition(":")[0])
        if each == group and module is not None and module.__file__:
            found[name] = module
    return found


def file_of(module: ModuleType) -> Path:
    """Return the file of a module that has one."""
    return Path(str(module.__file__))


def load_again(module: ModuleType) -> ModuleType:
    """Return a new module from the file of a law; the one in use is not touched.

    Raises
    ------
    ConfigError
        The file does not load, or has no law; names file and line.
    """
    return _load(module.__name__, file_of(module))


def check_law(name: str) -> None:
    """Load the file of an outside law without using it.

    Raises
    ------
    ConfigError
        The file does not load, or has no law; names file and line.
    """
    for group, each in _outside():
        spec = _spec(group, each) if each == name else None
        if spec is not None and spec.origin:
            _load(spec.name, Path(spec.origin))


def load_file(file: Path) -> ModuleType:
    """Return the module of a Python file that belongs to no package; it need not have a law.

    Raises
    ------
    ConfigError
        It does not load; names file and line.
    """
    name = f"fullswarm_file.{file.stem}"
    before = sys.modules.get(name)
    try:
        module = _load(name, file.absolute(), needs_law=False, register=True)
    except ConfigError:
        sys.modules.pop(name, None)
        if before is not None:
            sys.modules[name] = before
        raise
    return module


def put_in_place(module: ModuleType) -> None:
    """Use a module that :func:`load_again` has returned, in place of the one of its name."""
    sys.modules[module.__name__] = module
    parent, _, child = module.__name__.rpartition(".")
    if parent in sys.modules:
        setattr(sys.modules[parent], child, module)
    law_module.cache_clear()
    centralised_module.cache_clear()


def _load(name: str, file: Path, *, needs_law: bool = True, register: bool = False) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None:
        raise ConfigError("is no Python file", where=str(file))
    module = importlib.util.module_from_spec(spec)
    if register:
        sys.modules[name] = module  # a dataclass looks its module up
    try:
        # From the source itself: compiled files are told apart by whole seconds.
        exec(compile(file.read_bytes(), str(file), "exec"), module.__dict__)  # noqa: S102  (as any import does)
    except (Exception, SystemExit) as error:  # outside code: whatever it raises, the law before stays in use
        raise ConfigError(f"{type(error).__name__}: {_message(error)}", where=line_of(error, file)) from error
    if needs_law and not any(callable(getattr(module, form, None)) for form in ("velocity", "twist")):
        raise ConfigError("has no law", where=str(file), hint="define velocity(view, params) or twist(view, params)")
    return module


def _message(error: BaseException) -> str:
    return str(error.msg if isinstance(error, SyntaxError) else error)


def line_of(error: BaseException, file: Path) -> str:
    """Return file and line of an error: of its syntax, or the innermost line of `file` that led to it."""
    if isinstance(error, SyntaxError):
        return f"{error.filename or file}:{error.lineno}"
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(file)]
    return f"{file}:{lines[-1]}" if lines else str(file)


def _outside() -> list[tuple[str, str]]:
    """Return group and name of all laws from outside."""
    found = [(BEHAVIOUR_GROUP, name) for name in _entry_point_names(BEHAVIOUR_GROUP, LAWS)]
    return found + [(CENTRALISED_GROUP, name) for name in _entry_point_names(CENTRALISED_GROUP, CENTRALISED)]


def _spec(group: str, name: str) -> ModuleSpec | None:
    module = (_entry_point(group, name) or "").partition(":")[0]
    try:
        return importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None  # half uninstalled: reported when its robot is used


# ---------------------------------------------------------------- entry points
def _entry_point(group: str, name: str) -> str | None:
    if name in (developed := _developed(group)):
        return developed[name]
    found = [each for each in _installed(group, tuple(sys.path)) if each.name == name]
    if len(found) > 1:
        owners = ", ".join(sorted(each.dist.name if each.dist else "?" for each in found))
        raise ConfigError(f"'{name}' is offered by several packages: {owners}", hint="uninstall all but one")
    return found[0].value if found else None


def _entry_point_names(group: str, table: MappingProxyType[str, str]) -> tuple[str, ...]:
    installed = {each.name for each in _installed(group, tuple(sys.path))}
    return tuple(sorted((installed | set(_developed(group))) - set(table)))


@functools.lru_cache(maxsize=16)
def _installed(group: str, _path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Return the entry points of the packages on a path: reading them all takes tens of milliseconds."""
    return tuple(importlib.metadata.entry_points(group=group))


def _developed(group: str) -> dict[str, str]:
    """Return the entry points of the package under development, which can be imported from now on."""
    folder = Path(os.environ.get(DEVELOP) or os.devnull)
    file = folder / "pyproject.toml"
    if not file.is_file():
        return {}
    for each in (folder / "src", folder):
        if each.is_dir() and str(each) not in sys.path:
            sys.path.insert(0, str(each))
    found: dict[str, str] = _project(file, file.stat().st_mtime_ns).get(group, {})
    return found


@functools.lru_cache(maxsize=4)
def _project(file: Path, _changed_ns: int) -> dict[str, dict[str, str]]:
    """Return the entry points that a `pyproject.toml` declares, by group; read once per change."""
    try:
        found = tomllib.loads(file.read_text("utf-8")).get("project", {}).get("entry-points", {})
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(str(error), where=str(file), hint="correct the file") from error
    return {str(group): {str(name): str(target) for name, target in each.items()} for group, each in found.items()}


def _import(module: str, where: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ConfigError(f"'{module}' does not import: {error}", where=where) from error
    except Exception as error:  # of an outside module, whatever it raises
        why = str(error) if isinstance(error, FullswarmError) else f"{type(error).__name__}: {_message(error)}"
        raise ConfigError(f"'{module}' does not import: {why}", where=line_of(error, _file(module))) from error


def _file(module: str) -> Path:
    """Return the file of a module that does not import; if its package does not either, where it is to be."""
    try:
        spec = importlib.util.find_spec(module)
    except Exception:  # of an outside package, whatever it raises
        spec = None
    return Path(spec.origin) if spec is not None and spec.origin else Path(module.replace(".", "/"))
