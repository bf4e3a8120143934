"""Names that exist: of the swarm that runs, of a fleet file, of the package. Fast, and silent about what is wrong."""

from __future__ import annotations

import contextlib
import socket
import tomllib
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

HUB = "tcp/127.0.0.1:7447"
RECORDS = Path(__file__).parents[1] / "core" / "behaviours.toml"
"""The core's records, read as data: this layer does not import the core."""
PROBE_S = 0.1
"""For the hub's computer to take a connection."""
CONNECT_S = 0.15
LISTEN_S = 0.15
"""Three periods of the robots' states; the core's answer takes a few milliseconds."""

Record = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Known:
    """What may be named on a command line."""

    robots: tuple[str, ...] = ()
    groups: dict[str, tuple[str, ...]] = field(default_factory=dict)
    behaviours: dict[str, Record] = field(default_factory=dict)  # by name, `like` resolved
    keys: tuple[str, ...] = ()  # of the core's database


def from_package() -> Known:
    """Return the behaviours that are installed here, those of other packages too."""
    from fullswarm import registry

    tables: dict[str, Record] = {}
    for file in (RECORDS, *registry.record_files()):
        with contextlib.suppress(OSError, ValueError):
            tables |= tomllib.loads(file.read_text("utf-8"))
    return Known(behaviours=resolved(tables), keys=tuple(f"behaviour/{name}" for name in tables))


def from_fleet(file: Path, known: Known) -> Known:
    """Return `known` with the robots and groups that a fleet file names.

    Raises
    ------
    OSError, ValueError
        It cannot be read.
    """
    table = tomllib.loads(file.read_text("utf-8-sig"))
    robots = [str(each["id"]) for each in table.get("robot", ()) if "id" in each]
    fleet = table.get("fleet", {})
    robots += [f"{fleet.get('prefix', 'r')}{number}" for number in range(1, int(fleet.get("count", 0)) + 1)]
    groups = {name: tuple(map(str, members)) for name, members in table.get("groups", {}).items()}
    return replace(known, robots=tuple(robots), groups=groups)


def from_swarm(hub: str | None, swarm: str, *, robots: bool) -> Known | None:
    """Return what a running swarm knows; None when its hub, or its core, does not answer at once.

    Without `robots` their states are not waited for.
    """
    endpoint = hub or HUB
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        # Before anything heavy is imported: mostly there is no hub, which takes a millisecond to learn.
        socket.create_connection((host.strip("[]"), int(port)), PROBE_S).close()
    except (OSError, ValueError):
        return None
    try:
        return _ask(endpoint, swarm, robots)
    except Exception:  # an old hub, a name that no swarm can have: then there is just nothing to offer
        return None


def _ask(endpoint: str, swarm: str, wanted: bool) -> Known | None:
    from fullswarm.bus.base import OPERATOR, NamedBus
    from fullswarm.bus.zenoh_bus import ZenohBus
    from fullswarm.clock import MonotonicClock
    from fullswarm.keys import Keys
    from fullswarm.messages import ParamReply, RobotStates
    from fullswarm.operator.params import ParamClient
    from fullswarm.output import log_to_stderr
    from fullswarm.runtime import Runtime

    log_to_stderr()
    keys, runtime = Keys(swarm), Runtime(MonotonicClock())
    bus = ZenohBus(runtime.mailbox, hub=endpoint)
    robots: set[str] = set()
    entries: dict[str, Any] = {}
    told: Counter[str] = Counter()  # states by host: once one repeats, all have been received

    def receive(reply: ParamReply) -> None:
        entries.update({entry.key: entry.value for entry in reply.entries})
        end()

    def hear(states: RobotStates) -> None:
        robots.update(states.robots)
        told[states.host] += 1
        end()

    def end() -> None:
        if entries and (not wanted or 3 in told.values()):
            runtime.stop()

    try:
        bus.wait_connected(CONNECT_S)
        if wanted:
            bus.subscribe(keys.state(), RobotStates, hear)
        ParamClient(NamedBus(bus, OPERATOR), keys, runtime, "completion").ask("get", "*", receive)
        runtime.run(LISTEN_S)
    finally:
        bus.close()
    return known_from(robots, entries) if entries else None


def known_from(robots: set[str], entries: dict[str, Any]) -> Known:
    """Return what a core's database and the robots' states say."""
    tables = {key.removeprefix("behaviour/"): value for key, value in entries.items() if key.startswith("behaviour/")}
    groups = {
        key.removeprefix("group/"): tuple(value.get("robots", ()))
        for key, value in entries.items()
        if key.startswith("group/") and isinstance(value, dict)
    }
    return Known(tuple(sorted(robots, key=natural)), groups, resolved(tables), tuple(sorted(entries)))


def resolved(tables: dict[str, Any]) -> dict[str, Record]:
    """Return the records that are tables, with the summary and the parameters that `like` lends them."""
    records: dict[str, Record] = {}
    for name, record in tables.items():
        if not isinstance(record, dict):
            continue
        base = tables.get(str(record.get("like")), {})
        base = base if isinstance(base, dict) else {}
        merged = {**base, **record}
        merged["parameters"] = {**(base.get("parameters") or {}), **(record.get("parameters") or {})}
        records[name] = merged
    return records


def natural(name: str) -> tuple[str, int, str]:
    """Return a key that sorts r2 before r10."""
    head = name.rstrip("0123456789")
    digits = name[len(head) :]
    return head, int(digits) if digits else -1, name
