"""A stranger on the network of a swarm without keys: floods it from a process of its own.

Usage: ``python -m tests.system.flood_process HUB KIND PER_SECOND SECONDS``; prints how many messages it sent.
"""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Callable, Iterator

import zenoh

from fullswarm.bus.codec import encode
from fullswarm.bus.zenoh_bus import client_config, wire_key
from fullswarm.keys import Keys
from fullswarm.messages import BehaviourRequest, EStop, Heartbeat, Message, RobotStates, StopRequest

KEYS = Keys()


def heartbeats() -> Iterator[tuple[str, str, Message]]:
    """Two cores take turns."""
    for number in itertools.count(1):
        yield KEYS.heartbeat("core"), "core", Heartbeat(node="core", process=f"fake-{number % 2}", sequence=number)


def states() -> Iterator[tuple[str, str, Message]]:
    """Each message comes from a robot that nobody knows, at its own place."""
    for number in itertools.count(1):
        name = f"ghost{number}"
        message = RobotStates(
            host=name, sequence=1, stamp_s=1.0, robots=(name,), x_m=(number % 97 / 10.0,), y_m=(number % 89 / 10.0,),
            heading_rad=(0.0,), speed_m_s=(0.0,), turn_rad_s=(0.0,), radius_m=(0.1,),
        )  # fmt: skip
        yield KEYS.state("all", name), name, message


def requests() -> Iterator[tuple[str, str, Message]]:
    """Requests that the core must look up, each with an id of its own."""
    for number in itertools.count(1):
        message = BehaviourRequest(id=f"flood-{number}", behaviour="flocking_bc", robots=("r1",), source="flood")
        yield KEYS.behaviour_request, "operator", message


def stops() -> Iterator[tuple[str, str, Message]]:
    """Stops and e-stops, each with an id of its own."""
    for number in itertools.count(1):
        if number % 2:
            yield KEYS.stop, "operator", StopRequest(id=f"flood-{number}", source="flood")
        else:
            yield KEYS.estop, "operator", EStop(id=f"flood-{number}", engaged=True, robots=("r2",), source="flood")


KINDS: dict[str, Callable[[], Iterator[tuple[str, str, Message]]]] = {
    "heartbeats": heartbeats, "states": states, "requests": requests, "stops": stops,
}  # fmt: skip


def main(hub: str, kind: str, per_second: float, seconds: float) -> None:
    """Flood, then end."""
    with zenoh.open(client_config(hub, multicast=False)) as session:
        time.sleep(0.3)
        began_s = time.monotonic()
        for sent, (key, sender, message) in enumerate(KINDS[kind](), 1):
            session.put(wire_key(key, sender), encode(message))
            now_s = time.monotonic() - began_s
            if now_s > seconds:
                break
            if sent / per_second > now_s:
                time.sleep(sent / per_second - now_s)
        sys.stdout.write(f"{sent}\n")
        sys.stdout.flush()
        time.sleep(0.2)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]), float(sys.argv[4]))
