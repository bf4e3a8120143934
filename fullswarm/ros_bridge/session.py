"""`fullswarm ros bridge`: connects to the swarm and to the sides of ROS, and serves until Ctrl-C."""

from __future__ import annotations

import re
from dataclasses import dataclass

from fullswarm.bus.base import OPERATOR, NamedBus
from fullswarm.bus.endpoint import DEFAULT_HUB, credentials_at, host_of, is_loopback
from fullswarm.bus.renewal import renew_later
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock, wall_time_s
from fullswarm.errors import ConfigError
from fullswarm.keys import Keys
from fullswarm.operator.session import CONNECT_S, Session, Target, own_credentials
from fullswarm.output import progress
from fullswarm.ros_bridge.bridge import Bridge, Options
from fullswarm.ros_bridge.link import Link
from fullswarm.ros_bridge.zenoh_link import Keys as KeyFormat
from fullswarm.runtime import Mailbox, Runtime

NAME = "ros-bridge"
"""Of its certificate without commands, where the hub is secured; its role is ``observer``, which can send nothing."""
LAST_DOMAIN = 232
WAIT_S = 0.02
_NAMESPACE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*\Z")


@dataclass(frozen=True, slots=True)
class Sides:
    """Where ROS is.

    Parameters
    ----------
    ros2
        Endpoint of the zenoh router or bridge of ROS 2; None: there is no ROS 2.
    keys, domain
        Whose keys its messages have, ``zenoh`` (rmw_zenoh) or ``bridge``; the ROS domain.
    ros1
        URI of the ROS master, empty: that of the environment; None: there is no ROS 1.
    ros1_python
        The Python that has rospy.
    """

    ros2: str | None
    keys: KeyFormat
    domain: int
    ros1: str | None
    ros1_python: str


def bridge(target: Target, sides: Sides, options: Options) -> int:
    """Show a swarm to ROS until Ctrl-C or SIGTERM.

    Raises
    ------
    ConfigError
        No side of ROS is named, one of them is the swarm's own hub, or an option is malformed.
    MissingExtra
        rosbags is not installed.
    Unreachable
        No hub, no router of ROS 2 or no ROS master answers.
    """
    hub = target.hub or DEFAULT_HUB
    _check(sides, options, hub)
    runtime = Runtime(MonotonicClock(), Mailbox())
    if options.commands:
        credentials = own_credentials(hub, target.swarm, target.operator)
    else:
        credentials = credentials_at(hub, target.swarm, NAME, "observer")
    bus = ZenohBus(runtime.mailbox, hub=hub, credentials=credentials)
    links: list[Link] = []
    try:
        bus.wait_connected(CONNECT_S)
        keys = Keys(target.swarm)
        renew_later(bus, runtime, keys, credentials)
        session = Session(NamedBus(bus, OPERATOR), keys, runtime, hub, target.operator)
        links = _links(sides, runtime)
        node = Bridge(session.bus, keys, runtime, session.operator, links, options, _wall_ns)
        session.on_interrupt = lambda: node.finish(session.finish)
        shown = " and ".join(link.where for link in links)
        allowed = f"commands as {session.operator.name}" if options.commands else "no commands"
        progress(f"swarm '{target.swarm}' is shown to {shown}; {allowed}; Ctrl-C ends it")
        try:
            session.run()
        finally:
            node.close()
            session.operator.close()
    finally:
        for link in links:
            link.close()
        bus.close()
    return 0


def _links(sides: Sides, runtime: Runtime) -> list[Link]:
    found: list[Link] = []
    try:
        if sides.ros2 is not None:
            from fullswarm.ros_bridge.zenoh_link import ZenohLink

            found.append(ZenohLink(sides.ros2, sides.keys, sides.domain, _wall_ns))
        if sides.ros1 is not None:
            from fullswarm.ros_bridge.ros1_link import Ros1Link

            found.append(Ros1Link(sides.ros1, sides.ros1_python, runtime.clock, lambda: runtime.run(WAIT_S)))
    except BaseException:
        for link in found:
            link.close()
        raise
    return found


def _check(sides: Sides, options: Options, hub: str) -> None:
    if sides.ros2 is None and sides.ros1 is None:
        hint = "--ros2 tcp/127.0.0.1:7447 for a zenoh router of ROS 2, --ros1 http://127.0.0.1:11311 for a ROS master"
        raise ConfigError("no side of ROS is named", hint=hint)
    if sides.ros2 is not None and _place(sides.ros2) == _place(hub):
        raise ConfigError(
            "this is the swarm's own hub: ROS must not be on it", where=sides.ros2,
            hint="let the hub listen on another port ([hub] endpoint in the fleet file), or rmw_zenohd",
        )  # fmt: skip
    if not 0 <= sides.domain <= LAST_DOMAIN:
        raise ConfigError(f"domain {sides.domain} is none", where="--domain", hint=f"from 0 to {LAST_DOMAIN}")
    if options.namespace and not _NAMESPACE.match(options.namespace):
        hint = "letters, digits, _ and / between"
        raise ConfigError(f"'{options.namespace}' is no ROS namespace", where="--namespace", hint=hint)


def _place(endpoint: str) -> tuple[str, str]:
    host = host_of(endpoint)
    return "this computer" if is_loopback(host) else host, endpoint.rpartition(":")[2]


def _wall_ns() -> int:
    return round(1e9 * wall_time_s())
