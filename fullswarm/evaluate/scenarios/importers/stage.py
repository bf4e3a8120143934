"""Stage worlds (rtv.github.io/Stage): floor plan, models with blocks, robots, ``define`` and ``include``.

A model's blocks are stretched to its size, whatever their points are (libstage/block.cc). Angles are in degrees,
lengths in metres, unless the file sets other units. Dark pixels of a floor plan (127 of 255 or less) are solid. The
syntax is that of libstage/worldfile.cc: words may hold indices (``point[0]``), tuples stand in brackets, ``#`` begins a
comment.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import ConfigError, FullswarmError
from fullswarm.evaluate.scenarios.importers.draft import Draft, Imported, Planar, Xy
from fullswarm.evaluate.scenarios.importers.files import ROBOT_LIKE, numbers, read_text

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
        Not readable or not in Stage's syntax, named with its line.
    """
    world = parse(path)
    draft = Draft(str(path))
    collect(world, draft)
    return draft.finish(text_of(world.root, "name") or path.stem, f"From the Stage world {path.name}")


def collect(world: WorldFile, draft: Draft, robots: frozenset[str] | None = None) -> dict[str, Planar]:
    """Put all that stands in a world into a draft; return the poses of its robots by their names, as far as they have.

    Parameters
    ----------
    robots
        Names of the models that are robots: others that could drive are obstacles. None: all that can drive.

    Raises
    ------
    ConfigError
        The world is empty, or something in it is no model, named with its line.
    """
    if not world.root.parts:
        raise ConfigError("there is no model in it", where=world.root.where)
    for file in world.missing:
        draft.note(f'include "{file}": there is no such file; what it defines is not known')
    units = _Units(
        _UNITS.get(str(world.root.properties.get("unit_length", "m")), 1.0),
        1.0 if world.root.properties.get("unit_angle") == "radians" else math.pi / 180.0,
    )
    reading = _Reading(world, units, draft, robots)
    for part in world.root.parts:
        _entity(part, Planar(), 0.0, reading)
    return reading.found


def names_in(world: WorldFile) -> tuple[str, ...]:
    """Return the names of the models of a world."""

    def names(entity: Entity) -> Iterator[str]:
        for part in entity.parts:
            if name := text_of(part, "name"):
                yield name
            yield from names(part)

    return tuple(dict.fromkeys(names(world.root)))


@dataclass(slots=True)
class _Reading:
    """A world that is being read, and the robots found so far."""

    world: WorldFile
    units: _Units
    draft: Draft
    robots: frozenset[str] | None
    found: dict[str, Planar] = field(default_factory=dict)

    def is_robot(self, base: str, kinds: tuple[str, ...], whole: Entity, name: str) -> bool:
        """Tell whether a model is a robot: it drives, or no type is known and it is called like one."""
        own = text_of(whole, "name")
        if self.robots is not None and own:
            return own in self.robots
        if base == "position":
            return self.robots is None
        known = (*_BODIES, "map", "floorplan")
        return self.robots is None and base not in known and bool(ROBOT_LIKE.search(f"{name} {kinds}"))


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


def _entity(entity: Entity, outer: Planar, height: float, reading: _Reading) -> None:
    units, draft = reading.units, reading.draft
    kinds, whole = _flat(entity, reading.world)
    base = kinds[-1]
    if base in _NO_BODIES:
        return
    name = f"{entity.kind} {text_of(whole, 'name')}".strip()
    pose, z = _pose(whole, "pose", units)
    at, bottom = outer.then(pose), height + z
    if reading.is_robot(base, kinds, whole, name):
        draft.starts.append(at)
        if own := text_of(whole, "name"):
            reading.found.setdefault(own, at)
        return
    if base == "position":
        draft.note(f"{name} ({entity.where}) has no driver: a fixed obstacle")
    elif base not in (*_BODIES, "map", "floorplan"):
        draft.note(f"{name} ({entity.where}): its type is not known: left out")
        return
    origin, _ = _pose(whole, "origin", units)
    size = _lengths(whole, "size", (0.1, 0.1), units)
    if min(size) <= 0.0:
        raise ConfigError(f"{name}: a size must be above zero", where=entity.where)
    _model(name, kinds, whole, at.then(origin), size, bottom, draft)
    for part in whole.parts:
        _entity(part, at, bottom, reading)


def _model(name: str, kinds: tuple[str, ...], whole: Entity, at: Planar, size: Xy, bottom: float, draft: Draft) -> None:
    floor = "bitmap" in whole.properties and text_of(whole, "boundary") == "1"
    is_floor = floor or any(each in ("floorplan", "map", "floor") for each in kinds)
    if is_floor and draft.bounds is None:
        _floor(whole, at, size, draft)
    if text_of(whole, "obstacle_return") in ("0", "false"):
        draft.note(f"{name} has obstacle_return 0: robots pass through it; left out")
        return
    if text_of(whole, "boundary") == "1" and not draft.walls:
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
    draft.walls = text_of(whole, "boundary") == "1" and square
    if not square:
        draft.note("the floor plan is turned: the arena is the rectangle around it")


def _bitmap(name: str, whole: Entity, at: Planar, size: Xy, draft: Draft) -> None:
    picture = text_of(whole, "bitmap")
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
    x, y = numbers(joined(properties[key]), 2, key, where)
    return x, y


def _pose(entity: Entity, key: str, units: _Units) -> tuple[Planar, float]:
    """Return a pose and its height. Stage 3 and later write x y z heading, Stage 2 x y heading."""
    found = entity.properties.get(key)
    if found is None:
        return Planar(), 0.0
    words = joined(found).split()
    values = numbers(" ".join(words), max(2, min(len(words), 4)), key, entity.where)
    x, y, *rest = values
    z = rest[0] * units.metre if len(rest) == 2 else 0.0
    angle = rest[-1] * units.radian if rest else 0.0
    return Planar(x * units.metre, y * units.metre, angle), z


def _lengths(entity: Entity, key: str, default: Xy, units: _Units) -> Xy:
    found = entity.properties.get(key)
    if found is None:
        return default
    x, y = numbers(joined(found), 2, key, entity.where)
    return x * units.metre, y * units.metre


def _number(value: Value, what: str, where: str) -> float:
    return numbers(joined(value), 1, what, where)[0]


def joined(value: Value) -> str:
    """Return a property's value as one text; the members of a tuple are divided by spaces."""
    return value if isinstance(value, str) else " ".join(value)


def text_of(entity: Entity, key: str) -> str:
    """Return a property as text; empty: the entity does not have it."""
    return joined(entity.properties.get(key, ""))


MAX_PIXELS = 4_000_000
MAX_RECTANGLES = 4_000
_DARK = 127

Cells = tuple[int, int, int, int]
"""Column and row of the lowest corner, columns, rows; row 0 is the picture's lowest."""


class NotTraced(FullswarmError):
    """Why a bitmap did not become boxes."""


def trace(path: Path) -> tuple[list[Cells], tuple[int, int, int, int]]:
    """Return rectangles of dark pixels, and the first column, first row, columns and rows that they span together.

    Raises
    ------
    NotTraced
        Pillow is not installed, the picture cannot be read, or it is too large or too ragged.
    """
    dark = _dark_pixels(path)
    if not dark.any():
        raise NotTraced("it has no dark pixel")
    rectangles = rectangles_of(dark)
    if len(rectangles) > MAX_RECTANGLES:
        raise NotTraced(f"it would make {len(rectangles)} boxes, {MAX_RECTANGLES} at most")
    rows, columns = np.flatnonzero(dark.any(axis=1)), np.flatnonzero(dark.any(axis=0))
    span = int(columns[0]), int(rows[0]), int(columns[-1] - columns[0]) + 1, int(rows[-1] - rows[0]) + 1
    return rectangles, span


def rectangles_of(solid: NDArray[np.bool_]) -> list[Cells]:
    """Return rectangles that cover exactly the true cells: runs of a row, joined with equal runs above them."""
    open_runs: dict[tuple[int, int], int] = {}
    done: list[Cells] = []
    for row in range(len(solid) + 1):
        edges = np.diff(np.concatenate(([0], solid[row].view(np.int8), [0]))) if row < len(solid) else np.zeros(1)
        runs = list(zip(np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist(), strict=True))
        for run in [each for each in open_runs if each not in runs]:
            start = open_runs.pop(run)
            done.append((run[0], start, run[1] - run[0], row - start))
        for run in runs:
            open_runs.setdefault(run, row)
    return done


def _dark_pixels(path: Path) -> NDArray[np.bool_]:
    """Return the picture, row 0 the lowest, shape (rows, columns)."""
    try:
        from PIL import Image
    except ImportError as error:
        raise NotTraced("reading it needs Pillow: pip install 'fullswarm[experiments]'") from error
    try:
        with Image.open(path) as picture:
            if picture.width * picture.height > MAX_PIXELS:
                raise NotTraced(f"it has more than {MAX_PIXELS // 1_000_000} million pixels")
            # What is transparent is floor.
            canvas = Image.new("RGBA", picture.size, "white")
            canvas.alpha_composite(picture.convert("RGBA"))
            grey = np.asarray(canvas.convert("L"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise NotTraced(f"it cannot be read: {error}") from error
    return np.ascontiguousarray(grey[::-1] <= _DARK)


Value = str | tuple[str, ...]
MAX_DEPTH = 20
MAX_ENTITIES = 50_000

_TOKEN = re.compile(
    r"""(?P<space>[ \t\r\f\v]+)|(?P<comment>\#[^\n]*)|(?P<newline>\n)|"(?P<string>[^"\n]*)"
    |(?P<word>[A-Za-z_][\w.\-/]*(?:\[\d+\][\w.]*)*)|(?P<number>[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)
    |(?P<mark>[()\[\]])""",
    re.VERBOSE,
)


@dataclass(frozen=True, slots=True)
class Token:
    """A word, number, string or mark, and its line."""

    kind: str
    text: str
    where: str


@dataclass(slots=True)
class Entity:
    """Something with a type, properties and parts."""

    kind: str
    where: str
    properties: dict[str, Value] = field(default_factory=dict)
    parts: list[Entity] = field(default_factory=list)


@dataclass(slots=True)
class WorldFile:
    """Entities of a file and of all that it includes; what a defined type is made of."""

    root: Entity
    defined: dict[str, Entity] = field(default_factory=dict)
    """By the new type's name; the entity's `kind` is the type below it."""
    missing: list[str] = field(default_factory=list)
    """Includes that are not there."""
    entities: int = 0


def parse(path: Path, what: str = "Stage world") -> WorldFile:
    """Return what a world file and its includes define; errors call it `what`.

    Raises
    ------
    ConfigError
        Not readable, or not in this syntax, named with its line.
    """
    world = WorldFile(Entity("world", str(path)))
    _parse_into(world, path, 0, what)
    return world


def _parse_into(world: WorldFile, path: Path, depth: int, what: str) -> None:
    if depth > MAX_DEPTH:
        raise ConfigError(f"more than {MAX_DEPTH} files include one another", where=str(path))
    tokens = list(_tokens(read_text(path, what), path))
    position = 0
    while position < len(tokens):
        token = tokens[position]
        if token.kind == "word" and token.text == "include":
            name = _expect(tokens, position + 1, "string", token)
            included = path.parent / name.text
            if included.is_file():
                _parse_into(world, included, depth + 1, what)
            else:
                world.missing.append(name.text)
            position += 2
        elif token.kind == "word" and token.text == "define":
            new = _expect(tokens, position + 1, "word", token)
            below = _expect(tokens, position + 2, "word", token)
            _expect(tokens, position + 3, "(", token)
            entity = Entity(below.text, new.where)
            position = _body(world, tokens, position + 4, entity, 0)
            world.defined[new.text] = entity
        else:
            position = _statement(world, tokens, position, world.root, 0)


def _tokens(text: str, path: Path) -> Iterator[Token]:
    line, position = 1, 0
    while position < len(text):
        match = _TOKEN.match(text, position)
        if match is None:
            raise ConfigError(f"not expected here: '{text[position]}'", where=f"{path}:{line}")
        kind, position = match.lastgroup or "", match.end()
        if kind == "newline":
            line += 1
        elif kind not in ("space", "comment"):
            found = match.group(kind)
            yield Token(found if kind == "mark" else kind, found, f"{path}:{line}")


def _expect(tokens: list[Token], position: int, kind: str, after: Token) -> Token:
    if position >= len(tokens) or tokens[position].kind != kind:
        found = f"'{tokens[position].text}'" if position < len(tokens) else "the end of the file"
        raise ConfigError(f"after '{after.text}' should come a {kind}, not {found}", where=after.where)
    return tokens[position]


def _statement(world: WorldFile, tokens: list[Token], position: int, owner: Entity, depth: int) -> int:
    """Read a property or a part of `owner`; return where the next one begins."""
    name = tokens[position]
    if name.kind != "word":
        raise ConfigError(f"not expected here: '{name.text}'", where=name.where)
    if position + 1 >= len(tokens):
        raise ConfigError(f"'{name.text}' has no value", where=name.where)
    value = tokens[position + 1]
    if value.kind == "(":
        world.entities += 1
        if depth > MAX_DEPTH or world.entities > MAX_ENTITIES:
            raise ConfigError("too many entities, or too deep in one another", where=name.where)
        part = Entity(name.text, name.where)
        owner.parts.append(part)
        return _body(world, tokens, position + 2, part, depth + 1)
    if value.kind == "[":
        end = position + 2
        while end < len(tokens) and tokens[end].kind in ("number", "word", "string"):
            end += 1
        _expect(tokens, end, "]", tokens[end - 1])
        owner.properties[name.text] = tuple(token.text for token in tokens[position + 2 : end])
        return end + 1
    if value.kind in ("number", "string", "word"):
        owner.properties[name.text] = value.text
        return position + 2
    raise ConfigError(f"'{name.text}' has no value", where=name.where)


def _body(world: WorldFile, tokens: list[Token], position: int, entity: Entity, depth: int) -> int:
    while position < len(tokens):
        if tokens[position].kind == ")":
            return position + 1
        position = _statement(world, tokens, position, entity, depth)
    raise ConfigError(f"the parenthesis of '{entity.kind}' is not closed", where=entity.where)
