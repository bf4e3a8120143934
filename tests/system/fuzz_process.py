"""Sends messages of every type, typed as they must be and otherwise wild, in the names of members and strangers.

Usage: ``python -m tests.system.fuzz_process HUB SEED COUNT PER_SECOND``.
"""

from __future__ import annotations

import random
import re
import sys
import time

import msgspec
import zenoh

from fullswarm import keys, messages
from fullswarm.bus.zenoh_bus import client_config, wire_key
from fullswarm.messages import Message
from tests.unit.test_bus_wild import WORDS
from tests.unit.wild import KINDS, Wild

SWARM = "swarm"
SENDERS = ("r1", "r2", "core", "operator", "stranger")


def addresses() -> list[tuple[str, type[Message]]]:
    """Return the keys of all messages, as the table of ``keys.py`` states them, with ``<...>`` for parts to fill."""
    found: list[tuple[str, type[Message]]] = []
    for key, name in re.findall(r"^``(\S+)``\s+(\S+)", keys.__doc__ or "", flags=re.MULTILINE):
        plural = name == "…Measurement"
        kinds = (messages.CoverageMeasurement, messages.RobotMeasurement) if plural else (getattr(messages, name),)
        found += [(key.removeprefix("<swarm>/"), kind) for kind in kinds]
    assert {kind for _, kind in found} == set(KINDS), set(KINDS) - {kind for _, kind in found}
    return found


def main(hub: str, seed: int, count: int, per_second: float) -> None:
    """Send, then end."""
    wild, chance, there = Wild(seed, WORDS), random.Random(seed), addresses()
    with zenoh.open(client_config(hub, multicast=False)) as session:
        time.sleep(0.3)
        began_s = time.monotonic()
        for sent in range(1, count + 1):
            key, kind = there[sent % len(there)]
            places = ("r1", "r2", "r3", "all", "core", f"x{sent}")
            sender, raw = chance.choice(SENDERS), wild.raw(kind)
            if (
                chance.random() < 0.5
            ):  # as if from its own: else most are refused for naming another host than their key
                key = re.sub(r"<(host|robot|id|process|node)>", sender, key)
                fields = msgspec.msgpack.decode(raw)
                own = {name: sender for name in ("host", "robot", "node", "name") if name in fields}
                raw = msgspec.msgpack.encode(fields | own)
            key = "/".join(chance.choice(places) if part.startswith("<") else part for part in key.split("/"))
            session.put(wire_key(f"{SWARM}/{key}", sender), raw)
            ahead_s = sent / per_second - (time.monotonic() - began_s)
            if ahead_s > 0.01:
                time.sleep(ahead_s)
        time.sleep(0.5)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4]))
