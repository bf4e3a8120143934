"""Gazebo's SDF worlds (sdformat.org/spec; Gazebo classic's ``.world`` files are SDF too).

Collision shapes of models are obstacles, except what robots drive over or below. Models that can move and have the
name of a robot are starts, included ones too, whose file is not needed. Other included models are read from the folders
that Gazebo searches. Poses are 4 x 4 transforms, composed along the frames that they are relative to.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import ConfigError, MissingExtra
from fullswarm.evaluate.scenarios.importers.draft import Draft, Imported, Planar
from fullswarm.evaluate.scenarios.importers.files import INSTALL, ROBOT_LIKE, Node, numbers, read_xml
from fullswarm.evaluate.scenarios.importers.sdf_models import Models
from fullswarm.evaluate.scenarios.model import Rectangle

ROBOT_HEIGHT_M = 0.5
"""What hangs higher is no obstacle."""

FLOOR_M = 0.02
"""What is lower is floor."""

EXPORTED_WALL, EXPORTED_GOAL = "fullswarm_wall_", "fullswarm_goal"
"""Names in worlds that come from `export_sdf`: they are walls and goal of the scenario, not boxes."""

_UNREAD = ("mesh", "heightmap", "image", "capsule", "ellipsoid", "cone", "empty")


@dataclass(frozen=True, slots=True)
class _Solid:
    """A collision shape and where it is."""

    shape: Node
    at: Transform
    model: str


@dataclass(slots=True)
class _World:
    draft: Draft
    models: Models
    solids: list[_Solid] = field(default_factory=list)
    ground_m: float = 0.0
    walls: dict[str, _Solid] = field(default_factory=dict)


def read(path: Path) -> Imported:
    """Return the first world of an SDF file as a scenario.

    Raises
    ------
    ConfigError
        Not readable, not SDF, or a broken element, named with its line.
    MissingExtra
        defusedxml is not installed.
    """
    root = read_xml(path, "SDF world")
    node = root if root.tag == "world" else root.child("world")
    if root.tag not in ("sdf", "gazebo", "world") or node is None:
        raise ConfigError("there is no <world> in it", where=root.where, hint="a model alone makes no scenario")
    world = _World(Draft(str(path)), Models.beside(path))
    _read_world(node, world)
    for solid in world.solids:
        _add(solid, world)
    _read_walls(world)
    return world.draft.finish(node.attributes.get("name", path.stem), f"From the Gazebo world {path.name}")


def _read_world(node: Node, world: _World) -> None:
    scope = Scope.of(node, np.eye(4))
    for child in node.children:
        if child.tag == "model":
            _read_model(child, scope, world)
        elif child.tag == "include":
            _read_include(child, scope, world)
        elif child.tag in ("actor", "population", "road", "state"):
            world.draft.note(f"<{child.tag}> {child.attributes.get('name', '')}".rstrip() + ": not read")


def _read_include(node: Node, scope: Scope, world: _World, outer_name: str = "", outer_static: bool = False) -> None:
    """Read an included model, or only its pose if it is a robot."""
    uri, name = (child.text.strip() if (child := node.child(tag)) else "" for tag in ("uri", "name"))
    if "ground_plane" in uri or uri.endswith("/sun") or "sun" in name.lower():
        return
    static = outer_static or _is_true(node.child("static"))
    # Of the URI the model's own name: Fuel's also has that of an owner, such as openrobotics.
    if not static and ROBOT_LIKE.search(f"{name} {uri.rstrip('/').rpartition('/')[2]}"):
        at = scope.locate(node)
        world.draft.starts.append(Planar(float(at[0, 3]), float(at[1, 3]), yaw_of(at)))
        return
    found = world.models.find(uri, node.where)
    if isinstance(found, str):
        at = scope.locate(node)
        world.draft.note(f"<include> {uri or name} at {at[0, 3]:.2f}, {at[1, 3]:.2f}: not read, {found}")
        return
    # The include's pose takes the place of the model's own.
    at = scope.locate(node if node.child("pose") else found)
    placement = node.child("placement_frame")
    if placement is not None:
        at = at @ np.linalg.inv(Scope.of(found, np.eye(4)).frame(placement.text.strip(), placement.where))
    own = name or found.attributes.get("name", "model")
    with world.models.inside(uri, node.where):
        _read_body(found, at, f"{outer_name}{own}", static or _is_static(found), world)


def _is_static(model: Node) -> bool:
    return _is_true(model.child("static")) or model.attributes.get("static") in ("true", "1")


def _read_model(node: Node, scope: Scope, world: _World, outer_name: str = "", outer_static: bool = False) -> None:
    at = scope.locate(node)
    placement = node.attributes.get("placement_frame")
    if placement:
        at = at @ np.linalg.inv(Scope.of(node, np.eye(4)).frame(placement, node.where))
    name = f"{outer_name}{node.attributes.get('name', 'model')}"
    _read_body(node, at, name, outer_static or _is_static(node), world)


def _read_body(node: Node, at: Transform, name: str, static: bool, world: _World) -> None:
    """Read what a model at a place consists of."""
    if name == EXPORTED_GOAL:
        _read_goal(node, at, world)
        return
    if not static and ROBOT_LIKE.search(name):
        world.draft.starts.append(Planar(float(at[0, 3]), float(at[1, 3]), yaw_of(at)))
        return
    inner = Scope.of(node, at)
    for link in node.all("link"):
        link_at = inner.locate(link)
        for collision in link.all("collision"):
            # A collision's pose is relative to its link's frame, and may name the model's frames.
            collision_at = Scope(link_at, inner.frames).locate(collision)
            _collect(_Solid(collision.need("geometry"), collision_at, name), static, world)
    for child in node.children:
        if child.tag == "model":
            _read_model(child, inner, world, f"{name}::", static)
        elif child.tag == "include":
            _read_include(child, inner, world, f"{name}::", static)


def _collect(solid: _Solid, static: bool, world: _World) -> None:
    plane = solid.shape.child("plane")
    if plane is not None:
        found = plane.child("normal")
        normal = solid.at[:3, :3] @ np.array(
            (0, 0, 1) if found is None else numbers(found.text, 3, "normal", found.where)
        )
        if normal[2] > 0.99 * np.linalg.norm(normal):
            world.ground_m = float(solid.at[2, 3])
        else:
            world.draft.note(f"{solid.model}: a plane that is no floor: left out")
        return
    if solid.model.startswith(EXPORTED_WALL):
        world.walls[solid.model.removeprefix(EXPORTED_WALL)] = solid
        return
    if not static:
        world.draft.note(f"{solid.model} can be moved in Gazebo: a fixed obstacle here")
    world.solids.append(solid)


def _add(solid: _Solid, world: _World) -> None:
    """Add what stands in a robot's way: shapes by their outline on the floor."""
    shape = next((child for child in solid.shape.children if child.tag not in ("", "plane")), None)
    if shape is None or shape.tag in _UNREAD:
        what = "no shape" if shape is None else f"<{shape.tag}>"
        world.draft.note(f"{solid.model}: {what} as its collision geometry: left out")
    elif shape.tag == "polyline":
        _add_polyline(shape, solid, world)
    elif shape.tag in ("box", "cylinder", "sphere"):
        _add_round_or_box(shape, solid, world)
    else:
        world.draft.note(f"{solid.model}: <{shape.tag}> is not known: left out")


def _add_round_or_box(shape: Node, solid: _Solid, world: _World) -> None:
    size = _size(shape)
    if min(size) <= 0.0:
        raise ConfigError(f"{solid.model}: a size must be above zero", where=shape.where)
    if not _in_the_way(solid, size, world):
        return
    x, y, yaw = float(solid.at[0, 3]), float(solid.at[1, 3]), yaw_of(solid.at)
    upright = abs(solid.at[2, 2]) > 1.0 - 1e-9
    if shape.tag == "sphere" or (shape.tag == "cylinder" and upright):
        world.draft.disc(x, y, size[0] / 2.0, solid.model)
        return
    if upright:
        world.draft.rectangle(Planar(x, y, yaw), size[0], size[1], solid.model)
        return
    # Lying on a side or tilted: the rectangle around its shadow, along its own heading.
    back = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    shadow = (back @ _corners(solid, size)[:2] - (back @ solid.at[:2, 3])[:, None]).T
    low, high = shadow.min(axis=0), shadow.max(axis=0)
    middle_x, middle_y = Planar(x, y, yaw).point(float(low[0] + high[0]) / 2.0, float(low[1] + high[1]) / 2.0)
    size_x, size_y = float(high[0] - low[0]), float(high[1] - low[1])
    world.draft.rectangle(Planar(middle_x, middle_y, yaw), size_x, size_y, solid.model)
    world.draft.note(f"{solid.model} is tilted: the rectangle around its shadow stands for it")


def _size(shape: Node) -> tuple[float, float, float]:
    """Return the sizes along a shape's own axes."""
    if shape.tag == "box":
        size = shape.need("size")
        x, y, z = numbers(size.text, 3, "size", size.where)
        return x, y, z
    radius = shape.need("radius")
    diameter = 2.0 * numbers(radius.text, 1, "radius", radius.where)[0]
    if shape.tag == "sphere":
        return diameter, diameter, diameter
    length = shape.need("length")
    return diameter, diameter, numbers(length.text, 1, "length", length.where)[0]


def _corners(solid: _Solid, size: tuple[float, float, float]) -> Transform:
    """Return the corners of the box around a shape in the world, shape (3, 8)."""
    signs = np.array(list(product((-0.5, 0.5), repeat=3))).T
    return np.asarray(solid.at[:3, :3] @ (signs * np.array(size)[:, None]) + solid.at[:3, 3:])


def _in_the_way(solid: _Solid, size: tuple[float, float, float], world: _World) -> bool:
    heights = _corners(solid, size)[2] - world.ground_m
    if heights.min() >= ROBOT_HEIGHT_M:
        world.draft.note(f"{solid.model} hangs {heights.min():.2f} m above the floor: robots pass below")
        return False
    if heights.max() <= FLOOR_M:
        world.draft.note(f"{solid.model} does not rise above the floor: no obstacle")
        return False
    return True


def _add_polyline(shape: Node, solid: _Solid, world: _World) -> None:
    points = [numbers(point.text, 2, "point", point.where) for point in shape.all("point")]
    in_world = [(solid.at[:2, :2] @ np.array(point) + solid.at[:2, 3]).tolist() for point in points]
    if len(in_world) < 3:
        raise ConfigError("a <polyline> needs three points", where=shape.where)
    world.draft.polygon([(x, y) for x, y in in_world], solid.model)


def _read_goal(node: Node, at: Transform, world: _World) -> None:
    visual = node.need("link").need("visual")
    radius = visual.need("geometry").need("cylinder").need("radius")
    world.draft.goals.append((float(at[0, 3]), float(at[1, 3]), numbers(radius.text, 1, "radius", radius.where)[0]))


def _read_walls(world: _World) -> None:
    """Take the arena from the inner faces of the four walls of an exported scenario."""
    if set(world.walls) != {"west", "south", "east", "north"}:
        for solid in world.walls.values():
            _add(solid, world)
        return

    def face(side: str, axis: int, inwards: float) -> float:
        solid = world.walls[side]
        return float(solid.at[axis, 3]) + inwards * _size(solid.shape.need("box"))[axis] / 2.0

    bounds: Rectangle = (face("west", 0, 1), face("south", 1, 1), face("east", 0, -1), face("north", 1, -1))
    world.draft.bounds = bounds
    world.draft.walls = True


def _is_true(node: Node | None) -> bool:
    return node is not None and node.text.strip().lower() in ("true", "1")


Transform = NDArray[np.float64]


@dataclass(slots=True)
class Scope:
    """A world's or a model's frames by name, and where its own frame is."""

    origin: Transform
    frames: dict[str, Node] = field(default_factory=dict)

    @classmethod
    def of(cls, owner: Node, origin: Transform) -> Scope:
        """Return the scope of a world or model: its models, links and frames can be named in `relative_to`."""
        named = [child for child in owner.children if child.tag in ("model", "link", "frame", "joint", "include")]
        return cls(origin, {_frame_name(child): child for child in named})

    def frame(self, name: str, where: str, seen: tuple[str, ...] = ()) -> Transform:
        """Return where the frame `name` is in the world, shape (4, 4); ``model::link`` is a frame of a model in it.

        Raises
        ------
        ConfigError
            It is not there, is relative to itself, or lies in an included file.
        """
        first, _, rest = name.partition("::")
        if first in seen:
            raise ConfigError(f"the frame '{first}' is relative to itself", where=where)
        if first not in self.frames:
            raise ConfigError(f"there is no frame '{first}' here", where=where)
        owner = self.frames[first]
        at = self.locate(owner, (*seen, first))
        if not rest:
            return at
        if owner.tag != "model":
            raise ConfigError(
                f"'{name}' is a frame of an included file", where=where, hint="put the model in its place"
            )
        return Scope.of(owner, at).frame(rest, where)

    def locate(self, node: Node, seen: tuple[str, ...] = ()) -> Transform:
        """Return an element's pose in the world, shape (4, 4).

        Raises
        ------
        ConfigError
            A frame that is not there, or that is relative to itself.
        """
        found = node.child("pose")
        frame = "" if found is None else found.attributes.get("relative_to") or found.attributes.get("frame", "")
        if not frame and node.tag == "frame":
            frame = node.attributes.get("attached_to", "")
        if not frame and node.tag == "joint" and (child := node.child("child")) is not None:
            frame = child.text.strip()
        own = np.eye(4) if found is None else matrix(found)
        if frame in ("", "world", "__model__", "__root__"):
            return np.asarray(self.origin @ own)
        return np.asarray(self.frame(frame, node.where, seen) @ own)


def _frame_name(node: Node) -> str:
    """Return how an element is called in `relative_to`: an include by its name, else by its model's."""
    if node.tag != "include":
        return node.attributes.get("name", "")
    name, uri = node.child("name"), node.child("uri")
    if name is not None:
        return name.text.strip()
    return uri.text.strip().rstrip("/").rpartition("/")[2] if uri is not None else ""


def matrix(pose: Node) -> Transform:
    """Return a ``<pose>`` as a transform, shape (4, 4): x y z roll pitch yaw, or a quaternion (SDF 1.9).

    Raises
    ------
    ConfigError
        Not as many numbers as it takes.
    """
    if not pose.text.strip():
        return np.eye(4)
    try:
        from scipy.spatial.transform import Rotation
    except ImportError as error:
        raise MissingExtra("reading SDF worlds needs SciPy", hint=INSTALL) from error
    if pose.attributes.get("rotation_format", "euler_rpy") == "quat_xyzw":
        x, y, z, *quaternion = numbers(pose.text, 7, "pose", pose.where)
        if max(map(abs, quaternion)) < 1e-9:
            raise ConfigError("pose: a quaternion without length", where=pose.where)
        rotation = Rotation.from_quat(quaternion)
    else:
        x, y, z, *angles = numbers(pose.text, 6, "pose", pose.where)
        if pose.attributes.get("degrees", "false") in ("true", "1"):
            angles = [math.radians(angle) for angle in angles]
        rotation = Rotation.from_euler("xyz", angles)  # about the fixed axes
    transform = np.eye(4)
    transform[:3, :3] = rotation.as_matrix()
    transform[:3, 3] = x, y, z
    return transform


def yaw_of(transform: Transform) -> float:
    """Return where a frame's x axis points on the floor, in radians."""
    return math.atan2(transform[1, 0], transform[0, 0])
