"""ARGoS experiments (``.argos``): arena, boxes, cylinders, robots, and ``<distribute>``.

Orientations are three angles in degrees, about z first. Lengths stand between commas.
"""

from __future__ import annotations

import math
from itertools import product
from pathlib import Path

from fullswarm.errors import ConfigError
from fullswarm.evaluate.scenarios.importers.draft import MAX_BOXES, Draft, Imported, Planar
from fullswarm.evaluate.scenarios.importers.files import Node, numbers, read_xml
from fullswarm.evaluate.scenarios.model import Rectangle

_NO_BODIES = ("floor", "light", "positional_indices")
_SIGMAS = 2.0
"""Of a normal distribution that become a region."""

_LEAST_REGION_M = 0.5


def read(path: Path) -> Imported:
    """Return the arena of an ARGoS experiment as a scenario.

    Raises
    ------
    ConfigError
        Not readable, not an ARGoS file, or a broken element, named with its line.
    MissingExtra
        defusedxml is not installed.
    """
    root = read_xml(path, "ARGoS file")
    arena = root.child("arena")
    if root.tag != "argos-configuration" or arena is None:
        raise ConfigError("not an ARGoS experiment: no <arena> in an <argos-configuration>", where=root.where)
    draft = Draft(str(path))
    size = numbers(arena.attribute("size"), 3, "arena size", arena.where)
    centre = numbers(arena.attributes.get("center", "0,0,0"), 3, "arena center", arena.where)
    draft.bounds = (
        centre[0] - size[0] / 2,
        centre[1] - size[1] / 2,
        centre[0] + size[0] / 2,
        centre[1] + size[1] / 2,
    )
    for entity in arena.children:
        if entity.tag == "distribute":
            _distribute(entity, draft)
        elif entity.tag not in _NO_BODIES:
            body = entity.child("body") or entity
            _entity(entity, _pose(body), draft)
    _read_time(root, draft)
    if root.child("loop_functions") is not None:
        draft.note("<loop_functions> may add or move things: not read")
    return draft.finish(path.stem, f"From the ARGoS experiment {path.name}")


def _read_time(root: Node, draft: Draft) -> None:
    framework = root.child("framework")
    experiment = framework.child("experiment") if framework else None
    if experiment is not None and (length := experiment.number("length", 0.0)) > 0.0:
        draft.time_limit_s = length


def _pose(body: Node) -> Planar:
    x, y, _ = numbers(body.attributes.get("position", "0,0,0"), 3, "position", body.where)
    yaw, pitch, roll = numbers(body.attributes.get("orientation", "0,0,0"), 3, "orientation", body.where)
    if pitch or roll:
        raise ConfigError("only orientations about z can be read", where=body.where, hint="orientation='z,0,0'")
    return Planar(x, y, math.radians(yaw))


def _entity(entity: Node, at: Planar, draft: Draft) -> None:
    what = f"{entity.tag} {entity.name}"
    if entity.tag in ("box", "cylinder") and entity.attributes.get("movable", "false") == "true":
        draft.note(f"{what} can be pushed in ARGoS: a fixed obstacle here")
    if entity.tag == "box":
        size = _positive(entity, numbers(entity.attribute("size"), 3, "size", entity.where))
        draft.rectangle(at, size[0], size[1], what)
    elif entity.tag == "cylinder":
        draft.disc(at.x, at.y, _positive(entity, (entity.number("radius"),))[0], what)
    elif entity.child("controller") is not None:
        draft.starts.append(at)
    else:
        draft.note(f"<{entity.tag}> {entity.attributes.get('id', '')}".rstrip() + ": not known, left out")


def _positive(entity: Node, sizes: tuple[float, ...]) -> tuple[float, ...]:
    if min(sizes) <= 0.0:
        raise ConfigError(f"{entity.tag} {entity.name}: a size must be above zero", where=entity.where)
    return sizes


# ------------------------------------------------------------------------------------------------ <distribute>
def _distribute(node: Node, draft: Draft) -> None:
    position, entity = node.need("position"), node.need("entity")
    quantity = int(entity.number("quantity"))
    thing = next(iter(entity.children), None)
    if thing is None:
        raise ConfigError("<entity> without what to distribute", where=entity.where)
    method = position.attribute("method")
    what = f"{quantity} x <{thing.tag}> {thing.name}"
    if quantity < 1:
        return
    turn = _turn(node, what, draft)
    if method == "grid":
        for x, y in _grid(position)[:quantity]:
            _entity(thing, Planar(x, y, turn), draft)
    elif method == "constant":
        x, y, _ = numbers(position.attribute("values"), 3, "values", position.where)
        _entity(thing, Planar(x, y, turn), draft)
    elif method in ("uniform", "gaussian"):
        region = _uniform(position) if method == "uniform" else _gaussian(position, what, draft)
        _scatter(thing, quantity, region, what, draft)
    else:
        draft.note(f"{what}: distributed by '{method}', which is not known: left out")


def _turn(node: Node, what: str, draft: Draft) -> float:
    orientation = node.child("orientation")
    if orientation is None:
        return 0.0
    if orientation.attributes.get("method") == "constant":
        return math.radians(numbers(orientation.attribute("values"), 3, "values", orientation.where)[0])
    if next(iter(node.need("entity").children)).tag == "box":
        draft.note(f"{what}: random orientations became 0")
    return 0.0


def _grid(position: Node) -> list[tuple[float, float]]:
    """Return the points of a grid around its centre, x running first, as ARGoS does."""
    centre = numbers(position.attribute("center"), 3, "center", position.where)
    apart = numbers(position.attribute("distances"), 3, "distances", position.where)
    layout = [int(each) for each in numbers(position.attribute("layout"), 3, "layout", position.where)]
    if min(layout[:2]) < 1:
        raise ConfigError("a grid's layout needs numbers above zero", where=position.where)
    x0, y0 = (centre[i] - apart[i] * (layout[i] - 1) / 2 for i in (0, 1))
    if layout[0] * layout[1] > MAX_BOXES:
        raise ConfigError(f"a grid of {layout[0]} x {layout[1]} is too large", where=position.where)
    return [(x0 + i * apart[0], y0 + j * apart[1]) for j, i in product(range(layout[1]), range(layout[0]))]


def _uniform(position: Node) -> Rectangle:
    low = numbers(position.attribute("min"), 3, "min", position.where)
    high = numbers(position.attribute("max"), 3, "max", position.where)
    return _region(low[0], low[1], high[0], high[1])


def _gaussian(position: Node, what: str, draft: Draft) -> Rectangle:
    mean = numbers(position.attribute("mean"), 3, "mean", position.where)
    sigma = numbers(position.attribute("std_dev"), 3, "std_dev", position.where)
    draft.note(f"{what}: a normal distribution became a region of {_SIGMAS:g} standard deviations to each side")
    x, y = _SIGMAS * sigma[0], _SIGMAS * sigma[1]
    return _region(mean[0] - x, mean[1] - y, mean[0] + x, mean[1] + y)


def _region(x_min: float, y_min: float, x_max: float, y_max: float) -> Rectangle:
    """Return the rectangle, widened where it has no width: a region needs an area."""
    wide = max(0.0, _LEAST_REGION_M - (x_max - x_min)) / 2
    high = max(0.0, _LEAST_REGION_M - (y_max - y_min)) / 2
    return x_min - wide, y_min - high, x_max + wide, y_max + high


def _scatter(thing: Node, quantity: int, region: Rectangle, what: str, draft: Draft) -> None:
    if thing.tag == "box":
        size_x, size_y, _ = _positive(thing, numbers(thing.attribute("size"), 3, "size", thing.where))
        if draft.scatter(quantity, (size_x, size_y), region, what):
            draft.note(f"{what}: random boxes, placed by the trial's seed")
    elif thing.tag == "cylinder":
        side = 2.0 * _positive(thing, (thing.number("radius"),))[0]
        if draft.scatter(quantity, (side, side), region, what):
            draft.note(f"{what}: random boxes, the squares around them, placed by the trial's seed")
    elif thing.child("controller") is not None:
        draft.start_regions.append(region)
        draft.note(f"{what}: their region is the spawn region; give their number when the scenario is used")
    else:
        draft.note(f"{what}: not known, left out")
