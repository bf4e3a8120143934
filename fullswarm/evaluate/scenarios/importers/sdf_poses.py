"""Poses of an SDF file in the world: 4 x 4 transforms, composed along the frames that they are told in."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import ConfigError
from fullswarm.evaluate.scenarios.importers.files import Node, numbers

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
        return cls(origin, {child.attributes.get("name", ""): child for child in named})

    def locate(self, node: Node, seen: tuple[str, ...] = ()) -> Transform:
        """Return an element's pose in the world, shape (4, 4).

        Raises
        ------
        ConfigError
            A frame that is not there, or that is told relative to itself.
        """
        told = node.child("pose")
        frame = "" if told is None else told.attributes.get("relative_to") or told.attributes.get("frame", "")
        if not frame and node.tag == "frame":
            frame = node.attributes.get("attached_to", "")
        own = np.eye(4) if told is None else matrix(told)
        if frame in ("", "world", "__model__", "__root__"):
            return np.asarray(self.origin @ own)
        if frame in seen:
            raise ConfigError(f"the frame '{frame}' is told relative to itself", where=node.where)
        if frame not in self.frames:
            raise ConfigError(f"there is no frame '{frame}' here", where=node.where)
        return np.asarray(self.locate(self.frames[frame], (*seen, frame)) @ own)


def matrix(pose: Node) -> Transform:
    """Return a ``<pose>`` as a transform, shape (4, 4): x y z roll pitch yaw, or a quaternion (SDF 1.9).

    Raises
    ------
    ConfigError
        Not as many numbers as it takes.
    """
    if not pose.text.strip():
        return np.eye(4)
    if pose.attributes.get("rotation_format", "euler_rpy") == "quat_xyzw":
        x, y, z, *quaternion = numbers(pose.text, 7, "pose", pose.where)
        rotation = _from_quaternion(quaternion, pose.where)
    else:
        x, y, z, *angles = numbers(pose.text, 6, "pose", pose.where)
        if pose.attributes.get("degrees", "false") in ("true", "1"):
            angles = [math.radians(angle) for angle in angles]
        rotation = rpy(*angles)
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = x, y, z
    return transform


def rpy(roll: float, pitch: float, yaw: float) -> NDArray[np.float64]:
    """Return the rotation about the fixed axes x, y, z in this order, shape (3, 3)."""
    (ca, sa), (cb, sb), (cc, sc) = ((math.cos(angle), math.sin(angle)) for angle in (yaw, pitch, roll))
    return np.array(
        [
            [ca * cb, ca * sb * sc - sa * cc, ca * sb * cc + sa * sc],
            [sa * cb, sa * sb * sc + ca * cc, sa * sb * cc - ca * sc],
            [-sb, cb * sc, cb * cc],
        ]
    )


def yaw_of(transform: Transform) -> float:
    """Return where a frame's x axis points on the floor, in radians."""
    return math.atan2(transform[1, 0], transform[0, 0])


def _from_quaternion(quaternion: list[float], where: str) -> NDArray[np.float64]:
    length = math.sqrt(sum(each * each for each in quaternion))
    if length < 1e-9:
        raise ConfigError("pose: a quaternion without length", where=where)
    x, y, z, w = (each / length for each in quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
