"""IR-SIM worlds (YAML, ir-sim.readthedocs.io): world, obstacles, robots and their goals.

An entry can stand for several things: ``number`` of them, and a list of states, shapes or goals whose last element
goes on for the rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from fullswarm.errors import ConfigError, MissingExtra
from fullswarm.evaluate.scenarios.importers.draft import Draft, Imported, Planar, Xy
from fullswarm.evaluate.scenarios.importers.files import INSTALL, LARGEST, read_text
from fullswarm.evaluate.scenarios.model import Rectangle

Table = Mapping[str, object]
MAX_THINGS = 10_000
_DEFAULT_STATE, _DEFAULT_SHAPE = (0.0, 0.0, 0.0), {"name": "circle", "radius": 0.2}
_SIDE = 10.0


def read(path: Path) -> Imported:
    """Return an IR-SIM world as a scenario.

    Raises
    ------
    ConfigError
        Not readable, not YAML, or an entry that is none, named with its place.
    MissingExtra
        PyYAML is not installed.
    """
    document = read_yaml(path)
    if not isinstance(document, dict) or not {"world", "robot", "obstacle"} & set(document):
        raise ConfigError("not an IR-SIM world: no world, robot or obstacle", where=str(path))
    draft = Draft(str(path))
    world = _table(document.get("world") or {}, "world", draft)
    draft.bounds = _bounds(world, draft)
    if world.get("obstacle_map"):
        draft.note(f"world.obstacle_map {_short(world['obstacle_map'])}: a picture, not read")
    for kind in ("robot", "obstacle"):
        entries = document.get(kind) or []
        for index, entry in enumerate(entries if isinstance(entries, list) else [entries]):
            where = f"{kind}[{index}]"
            _entry(kind, _table(entry, where, draft), where, draft)
    name = world.get("name")
    return draft.finish(name if isinstance(name, str) else path.stem, f"From the IR-SIM world {path.name}")


def read_yaml(path: Path) -> object:
    """Return a YAML document.

    Raises
    ------
    ConfigError
        Not readable or not YAML; the line is named.
    MissingExtra
        PyYAML is not installed.
    """
    text = read_text(path, "IR-SIM world")
    try:
        import yaml
    except ImportError as error:
        raise MissingExtra("reading YAML worlds needs PyYAML", hint=INSTALL) from error
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise ConfigError(f"not valid YAML: {problem}", where=f"{path}{line}") from error


def _bounds(world: Table, draft: Draft) -> Rectangle:
    width = _number(world.get("width", _SIDE), "world.width", draft)
    height = _number(world.get("height", _SIDE), "world.height", draft)
    x, y = _numbers(world.get("offset", (0.0, 0.0)), 2, "world.offset", draft)[:2]
    if width <= 0.0 or height <= 0.0:
        raise ConfigError("world: width and height must be above zero", where=draft.where)
    return x, y, x + width, y + height


def _entry(kind: str, entry: Table, where: str, draft: Draft) -> None:
    count = _number(entry.get("number", 1), f"{where}.number", draft)
    if not 0 <= count <= MAX_THINGS:
        raise ConfigError(f"{where}.number: {count:g} is out of 0 to {MAX_THINGS}", where=draft.where)
    n = int(count)
    if n == 0:
        return
    found = entry.get("distribution") or {}
    distribution = _table({"name": found} if isinstance(found, str) else found, f"{where}.distribution", draft)
    method = distribution.get("name", "manual")
    shapes = _spread(entry.get("shape", _DEFAULT_SHAPE), n, _is_table)
    if kind == "obstacle" and (entry.get("kinematics") or entry.get("behavior")) and not entry.get("static"):
        draft.note(f"{where} moves in IR-SIM: a fixed obstacle here")
    if kind == "obstacle" and entry.get("unobstructed") is True:
        draft.note(f"{where} is unobstructed: robots pass through it; left out")
    elif method == "manual":
        states = _poses(entry.get("state", _DEFAULT_STATE), n, f"{where}.state", draft)
        goals = _poses(entry["goal"], n, f"{where}.goal", draft) if entry.get("goal") is not None else []
        _place(kind, states, goals, shapes, entry, where, draft)
    elif method == "circle":
        states, goals = _on_circle(distribution, n, where, draft)
        _place(kind, states, goals, shapes, entry, where, draft)
    elif method == "random":
        _scatter(kind, distribution, shapes, n, where, draft)
    else:
        draft.note(f"{where}: the distribution {_short(method)} is not known: left out")


def _place(
    kind: str,
    states: Sequence[Planar],
    goals: Sequence[Planar],
    shapes: Sequence[object],
    entry: Table,
    where: str,
    draft: Draft,
) -> None:
    if kind == "robot":
        reached = _number(entry.get("goal_threshold", 0.1), f"{where}.goal_threshold", draft)
        draft.starts.extend(states)
        draft.goals.extend((goal.x, goal.y, max(reached, 0.01)) for goal in goals)
        return
    for state, shape in zip(states, shapes, strict=True):
        _add(_table(shape, f"{where}.shape", draft), state, where, draft)


def _add(shape: Table, at: Planar, where: str, draft: Draft) -> None:
    name = shape.get("name")
    if shape.get("random_shape") is True:
        draft.note(f"{where}: random shapes are left out")
    elif name == "circle":
        centre = at.point(*_numbers(shape.get("center", (0.0, 0.0)), 2, f"{where}.shape.center", draft)[:2])
        draft.disc(*centre, _number(shape.get("radius", 0.2), f"{where}.shape.radius", draft), where)
    elif name == "rectangle":
        length = _number(shape.get("length", 1.0), f"{where}.shape.length", draft)
        width = _number(shape.get("width", 1.0), f"{where}.shape.width", draft)
        # With a wheelbase a state is that of the rear axle.
        base = shape.get("wheelbase")
        shift = 0.0 if base is None else _number(base, f"{where}.shape.wheelbase", draft) / 2.0
        middle = at.then(Planar(shift, 0.0, 0.0))
        draft.rectangle(middle, length, width, where)
    elif name in ("polygon", "linestring"):
        points = _points(shape.get("vertices"), f"{where}.shape.vertices", draft)
        outline = [at.point(*point) for point in points]
        if name == "polygon":
            draft.polygon(outline, where)
        else:
            draft.lines(outline, False, where)
    else:
        draft.note(f"{where}: the shape {_short(name)} is not known: left out")


def _on_circle(distribution: Table, n: int, where: str, draft: Draft) -> tuple[list[Planar], list[Planar]]:
    radius = _number(distribution.get("radius", 4.0), f"{where}.distribution.radius", draft)
    x, y = _numbers(distribution.get("center", (5.0, 5.0)), 2, f"{where}.distribution.center", draft)[:2]
    angles = [2.0 * math.pi * i / n for i in range(n)]
    states = [Planar(x + radius * math.cos(a), y + radius * math.sin(a), a - math.pi) for a in angles]
    goals = [Planar(x - radius * math.cos(a), y - radius * math.sin(a), 0.0) for a in angles]
    return states, goals


def _scatter(kind: str, distribution: Table, shapes: Sequence[object], n: int, where: str, draft: Draft) -> None:
    low = _numbers(distribution.get("range_low", (0.0, 0.0)), 2, f"{where}.distribution.range_low", draft)
    high = _numbers(distribution.get("range_high", (_SIDE, _SIDE)), 2, f"{where}.distribution.range_high", draft)
    region = low[0], low[1], high[0], high[1]
    if kind == "robot":
        draft.start_regions.append(region)
        draft.note(f"{where}: {n} random robots; their region is the spawn region, their random goals are left out")
        return
    sizes = [_outline(_table(shape, f"{where}.shape", draft), where, draft) for shape in shapes]
    known = [size for size in sizes if size is not None]
    if not known:
        draft.note(f"{where}: no random boxes can stand for their shapes; these are left out")
        return
    size = max(each[0] for each in known), max(each[1] for each in known)
    if draft.scatter(n, size, region, where):
        draft.note(f"{where}: {n} random boxes of {size[0]:g} x {size[1]:g} m, placed by the trial's seed")


def _outline(shape: Table, where: str, draft: Draft) -> Xy | None:
    """Return the sizes of the box that stands for a randomly placed shape."""
    if shape.get("random_shape") is True or shape.get("name") not in ("circle", "rectangle"):
        return None
    if shape["name"] == "circle":
        side = 2.0 * _number(shape.get("radius", 0.2), f"{where}.shape.radius", draft)
        sizes = side, side
    else:
        length = _number(shape.get("length", 1.0), f"{where}.shape.length", draft)
        sizes = length, _number(shape.get("width", 1.0), f"{where}.shape.width", draft)
    if min(sizes) <= 0.0:
        raise ConfigError(f"{where}.shape: a size must be above zero", where=draft.where)
    return sizes


# ------------------------------------------------------------------------------------------------------- values
def _spread(value: object, n: int, is_one: Callable[[object], bool]) -> list[object]:
    """Return n values of one, or of a list whose last element goes on."""
    many = value if isinstance(value, list) and not is_one(value) else [value]
    return [many[min(i, len(many) - 1)] for i in range(n)] if many else []


def _is_table(value: object) -> bool:
    return isinstance(value, dict)


def _is_state(value: object) -> bool:
    return isinstance(value, list | tuple) and all(isinstance(each, int | float) for each in value)


def _poses(value: object, n: int, what: str, draft: Draft) -> list[Planar]:
    poses = []
    for each in _spread(value, n, _is_state):
        x, y, *rest = _numbers(each, 2, what, draft)
        poses.append(Planar(x, y, rest[0] if rest else 0.0))
    return poses


def _points(value: object, what: str, draft: Draft) -> list[Xy]:
    if not isinstance(value, list) or len(value) < 2:
        raise ConfigError(f"{what} should be a list of points", where=draft.where)
    points = []
    for each in value:
        x, y = _numbers(each, 2, what, draft)[:2]
        points.append((x, y))
    return points


def _short(value: object) -> str:
    """Return a value for a message; what holds others by its kind: it may be endless."""
    return repr(value)[:60] if value is None or isinstance(value, str | int | float) else f"a {type(value).__name__}"


def _table(value: object, what: str, draft: Draft) -> Table:
    if not isinstance(value, dict):
        raise ConfigError(f"{what} should be keys with values, not {_short(value)}", where=draft.where)
    return value


def _number(value: object, what: str, draft: Draft) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
        raise ConfigError(f"{what} should be a number, not {_short(value)}", where=draft.where)
    return float(value)


def _numbers(value: object, least: int, what: str, draft: Draft) -> list[float]:
    if not isinstance(value, list | tuple) or len(value) < least:
        raise ConfigError(f"{what} should be {least} numbers at least, not {_short(value)}", where=draft.where)
    return [_number(each, what, draft) for each in value]
