"""A base's topics over zenoh: the keys of rmw_zenoh and of zenoh-bridge-ros2dds, messages in CDR.

rmw_zenoh (its docs/design.md): a topic's key is ``<domain>/<name>/<type>/<type hash>``, each message bears an
attachment with its number, time and origin, and liveliness tokens tell ROS's graph of nodes and publishers. The
bridge: the key is the topic's name, after its ``namespace`` if it has one.
"""

from __future__ import annotations

from collections.abc import Sequence

from fullswarm.drivers.base import STAND, Twist
from fullswarm.drivers.ros import protocol as p
from fullswarm.drivers.ros.relay_process import Task
from fullswarm.drivers.ros.session import patience_s
from fullswarm.drivers.ros.settings import Settings
from fullswarm.errors import MessageError

HASHES = {
    p.TWIST: "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    p.TWIST_STAMPED: "RIHS01_5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
}
"""Type hashes (REP 2016) of what is published; subscriptions take any."""
NODE = "fullswarm"
QOS = "1:2:1,1:,:,:,,"
"""Reliable, volatile, keep the last one: the form of rmw_zenoh's ``qos_to_keyexpr``."""


def dds_type(kind: str) -> str:
    """Return a type as it is in a key: ``geometry_msgs::msg::dds_::Twist_``."""
    package, sort, name = kind.split("/")
    return f"{package}::{sort}::dds_::{name}_"


def command_type(settings: Settings) -> str:
    """Return the type that the base takes."""
    return p.TWIST_STAMPED if settings.stamped else p.TWIST


def subscribed(settings: Settings) -> list[tuple[str, str]]:
    """Return name and type of the base's topics; the odometry first."""
    topics = settings.topics
    found = (
        (topics.odom, p.ODOMETRY), (topics.battery, p.BATTERY), (topics.hazards, p.HAZARDS), (topics.estop, p.BOOL),
        (topics.scan, p.LASER_SCAN),
    )  # fmt: skip
    return [(name, kind) for name, kind in found if name]


def relay_task(settings: Settings) -> Task:
    """Return what the relay process has to do for a robot."""
    native, kind, name = settings.transport == "zenoh", command_type(settings), settings.topics.cmd
    topics = subscribed(settings)
    prefix, typed = f"{settings.domain}/", {each: dds_type(each) for _, each in topics}
    stamp_s = 0.0 if settings.stamped else None
    return Task(
        endpoint=f"tcp/{settings.host}:{settings.port}",
        topics=tuple(f"{prefix}{each}/{typed[type_]}/*" if native else each for each, type_ in topics),
        latched=tuple(number for number, (_, type_) in enumerate(topics) if type_ == p.BOOL),
        command=f"{prefix}{name}/{dds_type(kind)}" if native else name,
        command_hash=HASHES[kind] if native else "",
        tokens=tokens(settings) if native else (),
        attach=native,
        stop=p.twist_cdr(STAND, stamp_s).hex(),
        silence_s=0.0 if settings.guardian is False else patience_s(settings.description),
    )


def tokens(settings: Settings) -> tuple[str, ...]:
    """Return the liveliness tokens of a node with its publisher and subscriptions, with ``{zid}`` for the session."""
    kind, domain = command_type(settings), settings.domain
    head, named = f"@ros2_lv/{domain}/{{zid}}/0", f"%/%/{NODE}"
    publisher = f"{head}/1/MP/{named}/{_mangled(settings.topics.cmd)}/{dds_type(kind)}/{HASHES[kind]}/{QOS}"
    return (f"{head}/0/NN/{named}", publisher)


def _mangled(name: str) -> str:
    return f"/{name}".replace("/", "%")


class ZenohWire:
    """Messages ↔ packets of the relay."""

    streams = False

    def __init__(self, settings: Settings) -> None:
        self._kinds = [kind for _, kind in subscribed(settings)]
        self.trouble = ""

    def linked(self) -> None:
        """Begin anew: the link is open."""

    def received(self, chunk: bytes) -> Sequence[p.Report]:
        """Return the report in a packet; raises ``MessageError``."""
        if not chunk or chunk[0] >= len(self._kinds):
            raise MessageError("a packet of no topic")
        return (p.read_cdr(self._kinds[chunk[0]], chunk[1:]),)

    def outgoing(self) -> Sequence[bytes]:
        """Return what the link itself has to send: nothing."""
        return ()

    def drive(self, twist: Twist, stamp_s: float | None) -> bytes:
        """Return the packet of a command."""
        return bytes([twist != STAND]) + p.twist_cdr(twist, stamp_s)

    def farewell(self) -> Sequence[bytes]:
        """Return what ends the link: nothing."""
        return ()
