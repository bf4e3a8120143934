"""`fullswarm fixes`: motion capture in over UDP/JSON, pose fixes out on the bus."""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import uuid
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import structlog

from fullswarm.bus.base import Bus
from fullswarm.bus.endpoint import is_loopback
from fullswarm.clock import Clock
from fullswarm.config import DEFAULT_HUB, HubConfig, SwarmConfig
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.identity import Role
from fullswarm.keys import ROBOT_ID, Keys
from fullswarm.localization.mocap import UNITS, Format, Refused, Sighting
from fullswarm.messages import HealthReport, ObjectFix, PoseFix
from fullswarm.runtime import Mailbox, Runtime, Scheduler

if TYPE_CHECKING:
    from fullswarm.launch.nodes import Node

log = structlog.get_logger()

IDENTITY = "fixes"
"""Name of the certificate with which it connects to a secured hub; its role is ``source``."""

MAX_BYTES = 65_536
WAITING = 1024
"""Datagrams that wait to be read; when there are more, the oldest are of no use any more."""
CLOSING_S = 0.2
REPORT_S = 10.0
KNOWN_S = 5.0
"""By then every robot has reported its health twice."""
LARGEST_M = 100.0
KINDS = 50
"""Most kinds of errors that are logged, so that no sender can fill the log."""

Datagram = tuple[float, str, bytes]
"""Arrival, the sender's IP address, content."""


@dataclass(frozen=True, slots=True)
class Options:
    """The options of the command."""

    listen: str = "127.0.0.1:9870"
    robots: dict[str, str] = field(default_factory=dict)  # robot id by the name in the capture system
    format: Format = field(default_factory=Format)
    insecure_network: bool = False
    objects: dict[str, float] = field(default_factory=dict)  # radius in m by the name in the capture system


def parse_objects(words: Iterable[str]) -> dict[str, float]:
    """Read ``NAME=RADIUS_M`` words.

    Raises
    ------
    ConfigError
        Not of that form, or a name comes twice.
    """
    found: dict[str, float] = {}
    for word in words:
        name, equals, text = word.rpartition("=")
        try:
            radius_m = float(text) if equals and name else math.nan
        except ValueError:
            radius_m = math.nan
        if not 0.0 < radius_m <= LARGEST_M:
            raise ConfigError("expected NAME=RADIUS_M", where=f"--object {word}", hint="like --object 'Person 1=0.3'")
        if name in found:
            raise ConfigError("the name is given twice", where=f"--object {word}")
        found[name] = radius_m
    return found


def parse_map(words: Iterable[str]) -> dict[str, str]:
    """Read ``NAME=ROBOT`` words.

    Raises
    ------
    ConfigError
        Not of that form, or a name or a robot comes twice.
    """
    found: dict[str, str] = {}
    for word in words:
        name, equals, robot = word.rpartition("=")
        if not equals or not name or not ROBOT_ID.match(robot):
            raise ConfigError("expected NAME=ROBOT", where=f"--map {word}", hint="like --map 'Rigid Body 1=r1'")
        if name in found or robot in found.values():
            raise ConfigError("the name or the robot is mapped already", where=f"--map {word}")
        found[name] = robot
    return found


def unit_of(word: str) -> float:
    """Return the length in metres of a unit: m, cm or mm.

    Raises
    ------
    ConfigError
        None of these.
    """
    if word not in UNITS:
        raise ConfigError(f"'{word}' is not a unit", where="--unit", hint=did_you_mean(word, UNITS))
    return UNITS[word]


class Port:
    """A UDP port with a thread that only receives; the node reads what waits.

    Raises
    ------
    ConfigError
        The address is no address, taken, not ours, or not loopback.
    """

    def __init__(self, listen: str, insecure_network: bool, clock: Clock, mailbox: Mailbox) -> None:
        host, _, port = listen.rpartition(":")
        if not host or not port.isdecimal() or int(port) > 65535:
            raise ConfigError("expected HOST:PORT", where=f"--listen {listen}", hint="like 127.0.0.1:9870")
        if not is_loopback(host) and not insecure_network:
            raise ConfigError(
                "this address is open to the network: any computer there could send the robots wrong poses",
                where=f"--listen {listen}",
                hint="use 127.0.0.1, or allow it with --insecure-network on a network that you trust",
            )
        self._clock, self._mailbox = clock, mailbox
        self.waiting: deque[Datagram] = deque(maxlen=WAITING)
        self._closing = False
        self._socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host.strip("[]"), int(port)))
        except OSError as error:
            self._socket.close()
            raise ConfigError(
                f"cannot listen there: {error.strerror or error}",
                where=f"--listen {listen}",
                hint="is another `fullswarm fixes` running? or the address is not of this machine",
            ) from error
        self._socket.settimeout(CLOSING_S)
        self._thread: threading.Thread | None = None

    @property
    def address(self) -> str:
        """Where it listens, ``host:port``."""
        host, port = self._socket.getsockname()[:2]
        return f"{host}:{port}"

    def start(self, node: FixesNode) -> None:
        """Receive from now on, for `node`."""
        self._thread = threading.Thread(target=self._receive, args=(node,), name="fixes", daemon=True)
        self._thread.start()

    def _receive(self, node: FixesNode) -> None:
        while not self._closing:
            with contextlib.suppress(OSError):  # nothing came; closing is seen above
                data, sender = self._socket.recvfrom(MAX_BYTES)
                self.waiting.append((self._clock.now_s(), sender[0], data))
                self._mailbox.put(node.read, None)

    def close(self) -> None:
        """Stop receiving."""
        self._closing = True
        if self._thread is not None:
            self._thread.join()
        self._socket.close()


class FixesNode:
    """Turns datagrams into fixes, and logs one error for each kind of invalid ones.

    Attributes
    ----------
    sent : fixes published
    bad : objects refused, by kind
    """

    def __init__(
        self, bus: Bus, scheduler: Scheduler, keys: Keys, options: Options, process: str, waiting: deque[Datagram]
    ) -> None:
        self._bus, self._keys, self._scheduler = bus, keys, scheduler
        self._options, self._process, self._waiting = options, process, waiting
        self.sent = 0
        self.bad: Counter[str] = Counter()
        self._reported = (0, 0)
        self._known: set[str] = set()
        self._strange: set[str] = set()
        self._began_s = scheduler.now_s()
        self._subscription = bus.subscribe(keys.health(), HealthReport, self._on_health, latest=True)
        self._timer = scheduler.every(REPORT_S, self._report)

    def read(self, _: object = None) -> None:
        """Read all datagrams that wait."""
        while self._waiting:
            arrival_s, sender, data = self._waiting.popleft()
            for each in self._options.format.read(data):
                if isinstance(each, Refused):
                    self._refuse(each, sender)
                elif each.tracked:
                    self._publish(each, arrival_s, sender)

    def _publish(self, seen: Sighting, arrival_s: float, sender: str) -> None:
        radius_m = self._options.objects.get(seen.name)
        if radius_m is not None:
            self._publish_object(seen, radius_m, arrival_s)
            return
        robot = self._options.robots.get(seen.name, seen.name)
        if not ROBOT_ID.match(robot):
            hint = f"{seen.name!r:.60}: say --map NAME=ROBOT which one it is"
            self._refuse(Refused("no robot can be called so", hint), sender)
            return
        self._look_for(robot)
        self.sent += 1
        fix = PoseFix(
            robot=robot,
            x_m=seen.x_m,
            y_m=seen.y_m,
            heading_rad=seen.heading_rad,
            position_sigma_m=seen.position_sigma_m,
            heading_sigma_rad=seen.heading_sigma_rad,
            # A source has one clock: that of the sender's machine if it states its time, else this one.
            source=self._process if seen.time_s is None else f"{self._process}/{sender}",
            stamp_s=arrival_s if seen.time_s is None else seen.time_s,
            contacts=seen.contacts,
        )
        self._bus.publish(self._keys.pose_fix(robot), fix)

    def _publish_object(self, seen: Sighting, radius_m: float, arrival_s: float) -> None:
        """Tell the robots where something is that is no robot of the fleet."""
        self.sent += 1
        number = list(self._options.objects).index(seen.name)
        fix = ObjectFix(
            object=seen.name, x_m=seen.x_m, y_m=seen.y_m, radius_m=radius_m, source=self._process, stamp_s=arrival_s
        )  # fmt: skip
        self._bus.publish(self._keys.object_fix(f"o{number}"), fix)  # its name may not fit into a key

    def _refuse(self, refused: Refused, sender: str) -> None:
        first = refused.kind not in self.bad
        if first and len(self.bad) >= KINDS:
            self.bad["other"] += 1
            return
        self.bad[refused.kind] += 1
        if first:
            log.warning("a datagram was refused", why=str(refused), sender=sender)

    def _on_health(self, report: HealthReport) -> None:
        self._known.update(each.robot for each in report.robots)

    def _look_for(self, robot: str) -> None:
        """Log once that a robot is unknown: a wrong name looks like a robot that is switched off."""
        if robot in self._known or robot in self._strange or self._scheduler.now_s() - self._began_s < KNOWN_S:
            return
        if len(self._strange) < KINDS:
            self._strange.add(robot)
            log.warning("fixes for a robot that is not here", robot=robot, hint=did_you_mean(robot, self._known))

    def _report(self) -> None:
        now = (self.sent, self.bad.total())
        if now != self._reported:
            log.info("fixes", sent=now[0], refused=now[1], **({"why": dict(self.bad)} if self.bad else {}))
            self._reported = now

    def close(self) -> None:
        """Log the result, and stop."""
        self._timer.cancel()
        self._subscription.close()
        self._report()


def run(hub: str | None, swarm: str, options: Options, with_parent: bool) -> int:
    """Serve until Ctrl-C, SIGTERM or the death of the process that started this one; return the exit code."""
    from fullswarm.bus.base import WORLD
    from fullswarm.launch.processes import serve_on_bus

    keys = Keys(swarm)
    config = SwarmConfig(swarm=swarm, hub=HubConfig(endpoint=hub or DEFAULT_HUB))

    def build(bus: Bus, runtime: Runtime) -> list[Node]:
        port = Port(options.listen, options.insecure_network, runtime.clock, runtime.mailbox)
        node = FixesNode(bus, runtime, keys, options, f"fixes-{uuid.uuid4().hex[:8]}", port.waiting)
        port.start(node)
        log.info("listening", udp=port.address, swarm=swarm, hub=config.hub.endpoint)
        return [node, port]

    identity: tuple[str, Role] = (IDENTITY, "source")
    return serve_on_bus(config, with_parent, build, WORLD, identity)  # where the simulated world stands in simulation
