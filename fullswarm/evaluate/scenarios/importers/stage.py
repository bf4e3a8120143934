"""Stage worlds (rtv.github.io/Stage): floor plan, models with blocks, robots, ``define`` and ``include``.

A model's blocks are stretched to its size, whatever their points say (libstage/block.cc). Angles are in degrees,
lengths in metres, unless the file says otherwise.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

from fullswarm.errors import ConfigError
from fullswarm.evaluate.scenarios.importers.draft import Draft, Imported
from fullswarm.evaluate.scenarios.importers.files import ROBOT_LIKE, numbers
from fullswarm.evaluate.scenarios.importers.shapes import Planar, Xy
from fullswarm.evaluate.scenarios.importers.stage_bitmap import NotTraced, trace
from fullswarm.evaluate.scenarios.importers.stage_syntax import Entity, Value, WorldFile, parse

ROBOT_HEIGHT_M = 0.5
"""What begins higher is no obstacle."""

_BODIES = ("model", "box", "obstacle", "puck")
_NO_BODIES = (
    *("window", "gui", "ranger", "laser", "camera", "fiducial", "blobfinder", "actuator", "gripper", "bumper"),
    *("indicator", "lightindicator", "blinkenlight", "sensor", "speech", "power_pack", "wifi", "block", "region"),
)
_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_OLD_BLOCK = re.compile(r"(?:block|polygon)\[(\d+)\]\.(.+)")


@dataclass(frozen=True, slots=True)
class _Units:
    metre: float
    radian: float


def read(path: Path) -> Imported:
    """Return a Stage world as a scenario.

    Raises
    ------
    ConfigError
        Not readable or not in Stage's syntax: told with its line.
    """
    world = parse(path)
    if not world.root.parts:
        raise ConfigError("there is no model in it", where=str(path))
    draft = Draft(str(path))
    for file in world.missing:
        draft.note(f'include "{file}": there is no such file; what it defines is not known')
    units = _Units(
        _UNITS.get(str(world.root.properties.get("unit_length", "m")), 1.0),
        1.0 if world.root.properties.get("unit_angle") == "radians" else math.pi / 180.0,
    )
    for part in world.root.parts:
        _entity(part, Planar(), 0.0, world, units, draft)
    return draft.finish(_text(world.root, "name") or path.stem, f"From the Stage world {path.name}")


def _flat(entity: Entity, world: WorldFile) -> tuple[tuple[str, ...], Entity]:
    """Return an entity's types, from its own to the built-in one, and it with all that it inherits."""
    chain, kinds = [entity], [entity.kind]
    while kinds[-1] in world.defined and len(chain) < 50:
        below = world.defined[kinds[-1]]
        chain.append(below)
        if below.kind in kinds:
            raise ConfigError(f"the type '{below.kind}' is defined by itself", where=below.where)
        kinds.append(below.kind)
    whole = Entity(entity.kind, entity.where)
    for each in reversed(chain):
        # Blocks of a nearer type take the place of those below.
        if any(part.kind == "block" for part in each.parts) or any(map(_OLD_BLOCK.match, each.properties)):
            whole.parts = [part for part in whole.parts if part.kind != "block"]
            whole.properties = {key: value for key, value in whole.properties.items() if not _OLD_BLOCK.match(key)}
        whole.properties.update(each.properties)
        whole.parts.extend(each.parts)
    return tuple(kinds), whole


def _entity(entity: Entity, outer: Planar, height: float, world: WorldFile, units: _Units, draft: Draft) -> None:
    kinds, whole = _flat(entity, world)
    base = kinds[-1]
    if base in _NO_BODIES:
        return
    name = f"{entity.kind} {_text(whole, 'name')}".strip()
    pose, z = _pose(whole, "pose", units)
    at, bottom = outer.then(pose), height + z
    if base == "position" or (
        base not in _BODIES and base not in ("map", "floorplan") and ROBOT_LIKE.search(f"{name} {kinds}")
    ):
        draft.starts.append(at)
        return
    if base not in (*_BODIES, "map", "floorplan"):
        draft.note(f"{name} ({entity.where}): its type is not known: left out")
        return
    origin, _ = _pose(whole, "origin", units)
    size = _lengths(whole, "size", (0.1, 0.1), units)
    if min(size) <= 0.0:
        raise ConfigError(f"{name}: a size must be above zero", where=entity.where)
    _model(name, kinds, whole, at.then(origin), size, bottom, draft)
    for part in whole.parts:
        _entity(part, at, bottom, world, units, draft)


def _model(name: str, kinds: tuple[str, ...], whole: Entity, at: Planar, size: Xy, bottom: float, draft: Draft) -> None:
    floor = "bitmap" in whole.properties and _text(whole, "boundary") == "1"
    is_floor = floor or any(each in ("floorplan", "map", "floor") for each in kinds)
    if is_floor and draft.bounds is None:
        _floor(whole, at, size, draft)
    if _text(whole, "obstacle_return") in ("0", "false"):
        draft.note(f"{name} has obstacle_return 0: robots pass through it; left out")
        return
    if _text(whole, "boundary") == "1" and not draft.walls:
        corners = [at.point(i * size[0] / 2, j * size[1] / 2) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        draft.lines(corners, True, f"{name}, its boundary")
    if bottom >= ROBOT_HEIGHT_M:
        draft.note(f"{name} begins {bottom:.2f} m above the floor: robots pass below")
    elif "bitmap" in whole.properties:
        _bitmap(name, whole, at, size, draft)
    else:
        _blocks(name, whole, at, size, is_floor, draft)


def _floor(whole: Entity, at: Planar, size: Xy, draft: Draft) -> None:
    cos, sin = abs(math.cos(at.yaw)), abs(math.sin(at.yaw))
    half_x, half_y = (size[0] * cos + size[1] * sin) / 2, (size[0] * sin + size[1] * cos) / 2
    draft.bounds = at.x - half_x, at.y - half_y, at.x + half_x, at.y + half_y
    square = min(cos, sin) < 1e-6
    draft.walls = _text(whole, "boundary") == "1" and square
    if not square:
        draft.note("the floor plan is turned: the arena is the rectangle around it")


def _bitmap(name: str, whole: Entity, at: Planar, size: Xy, draft: Draft) -> None:
    picture = _text(whole, "bitmap")
    path = Path(whole.where.rpartition(":")[0]).parent / picture
    try:
        rectangles, (left, low, columns, rows) = trace(path)
    except NotTraced as error:
        draft.note(f"{name}: the bitmap {picture} is left out: {error.what}")
        return
    # As in Stage, the dark part is stretched to the model's size, not the picture.
    cell_x, cell_y = size[0] / columns, size[1] / rows
    for column, row, width, height in rectangles:
        x = (column - left + width / 2) * cell_x - size[0] / 2
        y = (row - low + height / 2) * cell_y - size[1] / 2
        draft.rectangle(at.then(Planar(x, y, 0.0)), width * cell_x, height * cell_y, name)
    draft.note(f"{name}: the bitmap {picture} became {len(rectangles)} boxes of {cell_x:.3f} m pixels")


def _blocks(name: str, whole: Entity, at: Planar, size: Xy, is_floor: bool, draft: Draft) -> None:
    blocks = [_block_points(part) for part in whole.parts if part.kind == "block"] or _old_blocks(whole)
    blocks = [block for block in blocks if block]
    if not blocks:
        if is_floor:
            draft.note(f"{name} has neither bitmap nor blocks: taken as floor")
        else:
            draft.rectangle(at, size[0], size[1], name)
        return
    xs, ys = [x for block in blocks for x, _ in block], [y for block in blocks for _, y in block]
    width, height = max(xs) - min(xs), max(ys) - min(ys)
    if min(width, height) <= 0.0:
        raise ConfigError(f"{name}: its blocks have no area", where=whole.where)
    for block in blocks:
        points = [
            at.point(
                (x - min(xs) - width / 2) * size[0] / width,
                (y - min(ys) - height / 2) * size[1] / height,
            )
            for x, y in block
        ]
        draft.polygon(points, name)


def _block_points(block: Entity) -> list[Xy]:
    count = int(_number(block.properties.get("points", "0"), "points", block.where))
    return [_point(block.properties, f"point[{i}]", block.where) for i in range(count)]


def _old_blocks(whole: Entity) -> list[list[Xy]]:
    """Read blocks in the syntax of Stage 2: ``block[0].points``, ``block[0].point[3]``, also ``polygon``."""
    grouped: dict[int, dict[str, Value]] = {}
    for key, value in whole.properties.items():
        if match := _OLD_BLOCK.match(key):
            grouped.setdefault(int(match[1]), {})[match[2]] = value
    return [_block_points(Entity("block", whole.where, properties)) for _, properties in sorted(grouped.items())]


# ------------------------------------------------------------------------------------------------------- values
def _point(properties: dict[str, Value], key: str, where: str) -> Xy:
    if key not in properties:
        raise ConfigError(f"a block without {key}", where=where)
    x, y = numbers(_joined(properties[key]), 2, key, where)
    return x, y


def _pose(entity: Entity, key: str, units: _Units) -> tuple[Planar, float]:
    """Return a pose and its height. Stage 3 and later tell x y z heading, Stage 2 x y heading."""
    told = entity.properties.get(key)
    if told is None:
        return Planar(), 0.0
    words = _joined(told).split()
    values = numbers(" ".join(words), max(2, min(len(words), 4)), key, entity.where)
    x, y, *rest = values
    z = rest[0] * units.metre if len(rest) == 2 else 0.0
    angle = rest[-1] * units.radian if rest else 0.0
    return Planar(x * units.metre, y * units.metre, angle), z


def _lengths(entity: Entity, key: str, default: Xy, units: _Units) -> Xy:
    told = entity.properties.get(key)
    if told is None:
        return default
    x, y = numbers(_joined(told), 2, key, entity.where)
    return x * units.metre, y * units.metre


def _number(value: Value, what: str, where: str) -> float:
    return numbers(_joined(value), 1, what, where)[0]


def _joined(value: Value) -> str:
    return value if isinstance(value, str) else " ".join(value)


def _text(entity: Entity, key: str) -> str:
    return _joined(entity.properties.get(key, ""))
