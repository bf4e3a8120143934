"""Converts plain values to the bytes of ROS 1 and ROS 2 messages and back, by the `rosbags` library.

Extra: ``pip install 'fullswarm[ros-bridge]'``.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from fullswarm.errors import MessageError, MissingExtra
from fullswarm.ros_bridge.link import Values

TWIST, STRING = "geometry_msgs/msg/Twist", "std_msgs/msg/String"
ODOMETRY, BATTERY = "nav_msgs/msg/Odometry", "sensor_msgs/msg/BatteryState"
TF, GRID = "tf2_msgs/msg/TFMessage", "nav_msgs/msg/OccupancyGrid"
SCAN = "sensor_msgs/msg/LaserScan"
MARKERS, DIAGNOSTICS = "visualization_msgs/msg/MarkerArray", "diagnostic_msgs/msg/DiagnosticArray"

TRIGGER = "std_srvs/srv/Trigger"
TRIGGER_HASH = "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"
"""By REP 2016 of the service with its request, response and event, which rosbags does not have."""

_TF_ROS1 = "geometry_msgs/TransformStamped[] transforms\n"
"""As published in ros/geometry2; rosbags does not have it among the types of ROS 1."""
_NUMPY = {"byte": "uint8", "octet": "uint8", "char": "uint8"}
Make = Callable[[Any], Any]


class Codec:
    """The message types of one ROS.

    Raises
    ------
    MissingExtra
        rosbags is not installed.
    """

    def __init__(self, ros: Literal[1, 2]) -> None:
        self._ros = ros
        self._store = _typestore(ros)
        self._makers: dict[str, dict[str, Make]] = {}

    def encode(self, kind: str, values: Values) -> bytes:
        """Return a message in the wire format of ROS 1, or in little-endian CDR with its header.

        Raises
        ------
        KeyError
            The type has no such field.
        """
        message = self._build(kind, values)
        write = self._store.serialize_ros1 if self._ros == 1 else self._store.serialize_cdr
        return bytes(write(message, kind))

    def decode(self, kind: str, data: bytes) -> Any:
        """Return a message as an object with the type's fields.

        Raises
        ------
        MessageError
            The bytes are no such message.
        """
        read = self._store.deserialize_ros1 if self._ros == 1 else self._store.deserialize_cdr
        try:
            return read(data, kind)
        except Exception as error:  # of damaged bytes the library's generated code may raise anything
            raise MessageError(f"{len(data)} bytes that are no {kind}") from error

    def type_hash(self, kind: str) -> str:
        """Return the hash of a type by REP 2016: ``RIHS01_…``."""
        if kind == TRIGGER:
            return TRIGGER_HASH
        return str(self._store.hash_rihs01(kind))

    def trigger_response(self, success: bool, message: str) -> bytes:
        """Return the response of a ``std_srvs/srv/Trigger`` in CDR: the flag, padding, and the text with its length."""
        text = message.encode() + b"\0"
        return struct.pack("<BBHB3xI", 0, 1, 0, success, len(text)) + text

    def definition(self, kind: str) -> tuple[str, str]:
        """Return the full text of a ROS 1 type, and its MD5 sum."""
        text, digest = self._store.generate_msgdef(kind, ros_version=1)
        return text, digest

    # ------------------------------------------------------------ building
    def _build(self, kind: str, values: Values) -> Any:
        makers = self._makers.get(kind)
        if makers is None:
            makers = self._makers[kind] = {name: self._maker(node) for name, node in self._store.fielddefs[kind][1]}
        if unknown := values.keys() - makers.keys():
            raise KeyError(f"{kind} has no field {', '.join(sorted(unknown))}")
        return self._store.types[kind](**{name: make(values.get(name)) for name, make in makers.items()})

    def _maker(self, node: Any) -> Make:
        """Return what makes the value of a field; None gives its zero."""
        from rosbags.interfaces import Nodetype

        sort, about = node
        if sort == Nodetype.NAME:
            return lambda value: self._build(about, value or {})
        if sort == Nodetype.BASE:
            zero: Any = {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}.get(about[0], 0)
            return lambda value: zero if value is None else value
        (inner, name), size = about
        length = size if sort == Nodetype.ARRAY else 0
        if inner == Nodetype.NAME or name[0] == "string":
            make = self._maker((inner, name))
            return lambda value: [make(each) for each in (value or [None] * length)]
        dtype = np.dtype(_NUMPY.get(name[0], name[0]))
        return lambda value: np.zeros(length, dtype) if value is None else np.asarray(value, dtype)


@functools.cache
def _typestore(ros: Literal[1, 2]) -> Any:
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise MissingExtra(
            "a bridge to ROS needs the package rosbags", hint="pip install 'fullswarm[ros-bridge]'"
        ) from error
    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_JAZZY)
    if ros == 1:
        store.register(get_types_from_msg(_TF_ROS1, TF))
    return store
