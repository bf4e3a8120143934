"""Menge crowd scenes (XML): explicit obstacle sets, agents of explicit and grid generators, goals.

Corners counter-clockwise: the inside is solid. Clockwise: agents are inside, the line is a wall. A project file names
scene and behaviour; for a scene alone the behaviour is looked for beside it (``hallS.xml``, ``hallB.xml``).
"""

from __future__ import annotations

import math
from pathlib import Path

from fullswarm.errors import ConfigError
from fullswarm.evaluate.scenarios.importers.draft import Draft, Imported, Planar, Xy, signed_area
from fullswarm.evaluate.scenarios.importers.files import Node, read_xml

POINT_GOAL_M = 0.25
"""Radius of a goal that is a point: the distance of Menge's own examples."""

MAX_AGENTS = 100_000

_Room = tuple[str, list[Xy]]


def read(path: Path) -> Imported:
    """Return a Menge scene or project as a scenario.

    Raises
    ------
    ConfigError
        Not readable, no scene, or a broken element, named with its line.
    MissingExtra
        defusedxml is not installed.
    """
    root = read_xml(path, "Menge scene")
    draft = Draft(str(path))
    behaviour: Path | None = None
    if root.tag == "Project":
        behaviour = path.parent / root.attributes["behavior"] if "behavior" in root.attributes else None
        scene_path = path.parent / root.attribute("scene")
        root = read_xml(scene_path, "Menge scene")
    elif path.stem.endswith("S"):
        beside = path.with_name(f"{path.stem[:-1]}B{path.suffix}")
        behaviour = beside if beside.is_file() else None
    if root.tag != "Experiment":
        raise ConfigError(f"<{root.tag}> is neither a Menge scene nor a project", where=root.where)
    for group in root.all("AgentGroup"):
        _agents(group, draft)
    rooms: list[_Room] = []
    for obstacles in root.all("ObstacleSet"):
        _obstacles(obstacles, rooms, draft)
    _rooms(rooms, draft)
    if behaviour is None:
        draft.note("no behaviour file beside it: its goals are not known")
    else:
        _goals(behaviour, draft)
    return draft.finish(path.stem, f"From the Menge scene {path.name}")


def _obstacles(obstacles: Node, rooms: list[_Room], draft: Draft) -> None:
    kind = obstacles.attributes.get("type", "explicit")
    if kind != "explicit":
        draft.note(f"<ObstacleSet type='{kind}'>: its file is not read")
        return
    for number, obstacle in enumerate(obstacles.all("Obstacle")):
        points = [(vertex.number("p_x"), vertex.number("p_y")) for vertex in obstacle.all("Vertex")]
        what = f"obstacle {number} ({obstacle.where})"
        if len(points) < 2:
            raise ConfigError("an <Obstacle> needs two <Vertex> at least", where=obstacle.where)
        closed = obstacle.attributes.get("closed", "1") not in ("0", "false")
        area = signed_area(points)
        if closed and area > 1e-8:
            draft.polygon(points, what)
            continue
        if closed and area < -1e-8:
            rooms.append((what, points))
        else:
            draft.lines(points, closed and len(points) > 2, what)


def _rooms(rooms: list[_Room], draft: Draft) -> None:
    """Take a single upright rectangle around everything as the arena; else walls along the edges."""
    if len(rooms) == 1:
        xs, ys = sorted({x for x, _ in rooms[0][1]}), sorted({y for _, y in rooms[0][1]})
        places = [(start.x, start.y) for start in draft.starts] + [(box[0], box[1]) for box in draft.boxes]
        inside = all(xs[0] < x < xs[-1] and ys[0] < y < ys[-1] for x, y in places)
        if len(rooms[0][1]) == 4 and len(xs) == len(ys) == 2 and inside:
            draft.bounds, draft.walls = (xs[0], ys[0], xs[1], ys[1]), True
            return
    for what, points in rooms:
        draft.note(f"{what}: its corners go clockwise, so it is hollow: walls along its edges")
        draft.lines(points, True, what)


def _agents(group: Node, draft: Draft) -> None:
    generator = group.need("Generator")
    kind = generator.attribute("type")
    if kind == "explicit":
        draft.starts.extend(Planar(agent.number("p_x"), agent.number("p_y")) for agent in generator.all("Agent"))
    elif kind == "rect_grid":
        draft.starts.extend(_grid(generator))
    else:
        draft.note(f"<Generator type='{kind}'> ({generator.where}): not read; its agents are left out")


def _grid(generator: Node) -> list[Planar]:
    """Return the agents of a lattice: `count` by `offset` from the anchor, turned about it by `rotation` degrees."""
    columns, rows = (generator.number(f"count_{axis}") for axis in "xy")
    if not (0 <= columns * rows <= MAX_AGENTS and min(columns, rows) >= 0):
        raise ConfigError(f"{columns:g} x {rows:g} agents cannot be", where=generator.where)
    turned = math.radians(generator.number("rotation", 0.0))
    anchor = Planar(generator.number("anchor_x"), generator.number("anchor_y"), turned)
    x, y = generator.number("offset_x"), generator.number("offset_y")
    places = [anchor.point(i * x, j * y) for j in range(int(rows)) for i in range(int(columns))]
    return [Planar(*place) for place in places]


def _goals(path: Path, draft: Draft) -> None:
    root = read_xml(path, "Menge behaviour")
    for goal_set in root.all("GoalSet"):
        for goal in goal_set.all("Goal"):
            _goal(goal, draft)


def _goal(goal: Node, draft: Draft) -> None:
    kind = goal.attribute("type")
    if kind == "point":
        draft.goals.append((goal.number("x"), goal.number("y"), POINT_GOAL_M))
    elif kind == "circle":
        draft.goals.append((goal.number("x"), goal.number("y"), goal.number("radius")))
    elif kind == "AABB":
        low = goal.number("min_x"), goal.number("min_y")
        high = goal.number("max_x"), goal.number("max_y")
        _box_goal((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, high[0] - low[0], high[1] - low[1], goal, draft)
    elif kind == "OBB":
        width, height = goal.number("width"), goal.number("height")
        corner = Planar(goal.number("x"), goal.number("y"), math.radians(goal.number("angle", 0.0)))
        _box_goal(*corner.point(width / 2, height / 2), width, height, goal, draft)
    else:
        draft.note(f"<Goal type='{kind}'> ({goal.where}): not known, left out")


def _box_goal(x: float, y: float, width: float, height: float, goal: Node, draft: Draft) -> None:
    """Keep the largest disc inside: a robot that reached it has reached the box."""
    if min(width, height) <= 0.0:
        raise ConfigError("a goal's sizes must be above zero", where=goal.where)
    draft.goals.append((x, y, min(width, height) / 2))
    draft.note(f"the goal {goal.where} is a rectangle: the largest disc in it stands for it")
