"""The wire between a simulated robot's driver and its world: small UDP datagrams, bytes only.

::

    driver                          world
      Hello (5 Hz, also keep-alive)  ->
                                    <-  Welcome | Refusal
      Drive (one per command)        ->
                                    <-  BodyReading (one per world step)
      Bye                            ->

Each datagram is one MessagePack struct with its name and version; an unknown version or field is refused.
"""

from __future__ import annotations

from urllib.parse import urlsplit

import msgspec
import numpy as np

from fullswarm.drivers.make import Claim
from fullswarm.errors import MessageError
from fullswarm.kernels import Array

MAX_BYTES = 65507  # of a UDP datagram's payload
HELLO_PERIOD_S = 0.2
ALIVE_S = 1.0  # a driver that was silent for longer has gone

Triple = tuple[float, float, float]


class Datagram(
    msgspec.Struct,
    frozen=True,
    kw_only=True,
    forbid_unknown_fields=True,
    tag_field="kind",
    tag=lambda name: f"sim.{name}/1",
):
    """Base of all datagrams. `session` names one opened driver, to tell it from a second one."""

    robot: str
    session: str


class Hello(Datagram, frozen=True, kw_only=True, tag="sim.Hello/2"):
    """A driver wants this robot, or still has it; with all that was asked of its actuators, so that none is lost."""

    sensing_m: float
    actuators: dict[str, str] = {}


class Welcome(Datagram, frozen=True, kw_only=True):
    """The driver has the robot; `world` names one run of a world."""

    world: str
    firmware: str
    limits: tuple[float, float, float, float]  # m/s, rad/s, m/s², rad/s²


class Refusal(Datagram, frozen=True, kw_only=True):
    """The driver cannot have the robot."""

    reason: str
    hint: str


class Drive(Datagram, frozen=True, kw_only=True):
    """A set-point; `sequence` grows, an older one is ignored."""

    sequence: int
    linear_m_s: float
    angular_rad_s: float
    active: bool


class Scan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A scan of a body's range sensor: as :class:`~fullswarm.drivers.base.RangeScan`, its rays evenly spread."""

    number: int  # grows by one with each scan
    distances: bytes  # little-endian doubles; infinite and NaN as there
    first_rad: float
    step_rad: float
    max_m: float
    mount: Triple
    sigma_m: float
    cone_rad: float = 0.0


class BodyReading(Datagram, frozen=True, kw_only=True, tag="sim.BodyReading/3"):
    """What a body senses after a world step; obstacles are rows of six little-endian doubles, bodies of three."""

    time_s: float
    pose: Triple
    odometry: Triple
    twist: tuple[float, float]
    contacts: int
    hazards: int
    obstacles: bytes
    bodies: bytes | None = None
    scan: Scan | None = None  # with each reading until there is a newer one: a datagram may be lost
    senses_pose: bool = True  # False: `pose` is void
    battery: float | None = None  # 0 to 1; None: the world has no batteries
    charging: bool | None = None


class Bye(Datagram, frozen=True, kw_only=True):
    """The driver lets go of the robot."""


_encoder = msgspec.msgpack.Encoder()
AnyDatagram = Hello | Welcome | Refusal | Drive | BodyReading | Bye
_decoder: msgspec.msgpack.Decoder[AnyDatagram] = msgspec.msgpack.Decoder(AnyDatagram)


def encode(datagram: Datagram) -> bytes:
    """Return the bytes of a datagram."""
    return _encoder.encode(datagram)


def decode(data: bytes) -> AnyDatagram:
    """Return the datagram that `data` holds; `MessageError` if it is none of this version."""
    try:
        return _decoder.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MessageError(str(error), where="simulator link") from error


def pack_rows(rows: Array) -> bytes:
    """Return rows of numbers as bytes."""
    return rows.astype("<f8", copy=False).tobytes()


def unpack_rows(data: bytes, columns: int) -> Array:
    """Return the rows (k, columns) that `data` holds; `MessageError` if it is not whole rows."""
    if len(data) % (8 * columns):
        raise MessageError(f"{len(data)} bytes are not rows of {columns} doubles", where="simulator link")
    return np.frombuffer(data, dtype="<f8").reshape(-1, columns)


def claims(url: str, elsewhere: bool) -> tuple[Claim, ...]:
    """Return what only one agent can have: the simulated robot, whichever computer asks."""
    del elsewhere
    parts = urlsplit(url)
    return (Claim(("the simulated robot", f"{parts.netloc}{parts.path}")),)
