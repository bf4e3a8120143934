"""Shell completion: robots, groups, behaviours, parameters, scenarios, experiments.

The names come from the running swarm if its hub answers at once, else from the fleet file, else from the package.
Nothing here may report an error, wait or import much: it runs at each press of a key.
"""

from __future__ import annotations

import contextlib
import io
import os
import socket
import sys
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import typer

Offer = list[tuple[str, str]]
"""Words with their explanations, which zsh and fish show."""

SWITCH = "_FULLSWARM_COMPLETE"
"""Environment variable that the shell's script sets to the name of the shell."""
PACKAGE = Path(__file__).parents[1]
EXAMPLES = {"point": "1.0,2.0", "points": "[[0,0],[1,1]]", "number": "1.0", "integer": "1", "word": "word"}

HUB = "tcp/127.0.0.1:7447"
RECORDS = PACKAGE / "core" / "behaviours.toml"
"""The core's records, read as data: importing the core would take too long."""
PROBE_S = 0.1
"""For the hub's computer to accept a connection."""
CONNECT_S = 0.15
LISTEN_S = 0.15
"""Three periods of the robots' states; the core's answer takes a few milliseconds."""


# ---------------------------------------------------------------- what the options call
def robots(context: typer.Context, incomplete: str) -> Offer:
    """Offer ids and @groups for the last word of ``r1,r2,…``."""
    known = _known(context, live=True, robots=True)
    offer = [(robot, "") for robot in known.robots]
    offer += [(f"@{name}", ", ".join(members)) for name, members in known.groups.items()]
    return _listed(offer, incomplete)


def robot_ids(context: typer.Context, incomplete: str) -> Offer:
    """Offer ids alone: an order that goes straight to the robots cannot address groups."""
    return _listed([(robot, "") for robot in _known(context, live=True, robots=True).robots], incomplete)


def fleet_robots(context: typer.Context, incomplete: str) -> Offer:
    """Offer the ids that the fleet file on the line names."""
    return _listed([(robot, "") for robot in _known(context, live=False).robots], incomplete)


def emulated_makes(incomplete: str) -> Offer:
    """Offer the makes and range sensors that can be emulated."""
    from fullswarm.drivers.make import makes
    from fullswarm.drivers.ranges import KINDS

    offer = [(each.name, each.robots) for each in makes() if each.emulation]
    return _listed([*offer, *KINDS.items()], incomplete)


def behaviours(context: typer.Context, incomplete: str) -> Offer:
    """Offer the behaviours that can be requested."""
    records = _known(context, live=True).behaviours
    return _begun([(name, str(record.get("summary", ""))) for name, record in records.items()], incomplete)


def parameters(context: typer.Context, incomplete: str) -> Offer:
    """Offer ``key=`` of the behaviour on the line, and after the equals sign example values."""
    # An option that still lacks its value keeps the parser from returning the words before it.
    named = context.params.get("behaviour") or next(iter(context.args), None)
    record = _known(context, live=True).behaviours.get(str(named), {})
    offer: Offer = []
    for key, spec in (record.get("parameters") or {}).items():
        if isinstance(spec, dict) and not _given(context, key):
            unit = f" ({spec['unit']})" if spec.get("unit") else ""
            # Never `key=` alone: a shell ends a word that is the only one with a space.
            offer += [(f"{key}={value}", f"{spec.get('doc', '')}{unit}") for value in ("", *_values(spec))]
    return [each for each in _begun(offer, incomplete) if each[0] != incomplete]


def database_keys(context: typer.Context, incomplete: str) -> Offer:
    """Offer the keys of the core's database."""
    return _begun([(key, "") for key in _known(context, live=True).keys], incomplete)


def layers(incomplete: str) -> Offer:
    """Offer the layers that have a database."""
    return _begun([("core", "the base station's main controller and request handler")], incomplete)


def scenarios(incomplete: str) -> Offer:
    """Offer the scenarios of the package."""
    return _begun(_files("evaluate/scenarios"), incomplete)


def experiments(incomplete: str) -> Offer:
    """Offer the experiments of the package."""
    return _begun(_files("evaluate/experiment"), incomplete)


def settings(incomplete: str) -> Offer:
    """Offer the keys of a fleet file, for ``--set agent.sensing_radius_m=5``."""
    from fullswarm.config import SwarmConfig

    offer: Offer = []
    for section, model_field in SwarmConfig.model_fields.items():
        fields = getattr(model_field.annotation, "model_fields", None)
        if section == "world":
            fields = type(SwarmConfig().world_or_default).model_fields
        offer += [(f"{section}.{key}={_plain(each.default)}", "") for key, each in (fields or {}).items()]
    offer += [(word.partition("=")[0] + "=", text) for word, text in offer]
    return [each for each in _begun(sorted(offer), incomplete) if each[0] != incomplete]


# ---------------------------------------------------------------- names that exist
Record = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Known:
    """Names that exist: of the running swarm, of a fleet file, of the package."""

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
    """Return the names of a running swarm; None when its hub, or its core, does not answer at once.

    Without `robots` their states are not waited for.
    """
    endpoint = hub or HUB
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        # Before anything heavy is imported: without a hub this takes a millisecond.
        socket.create_connection((host.strip("[]"), int(port)), PROBE_S).close()
    except (OSError, ValueError):
        return None
    try:
        return _ask_swarm(endpoint, swarm, robots)
    except Exception:  # an old hub, a name that no swarm can have: nothing to offer
        return None


def _ask_swarm(endpoint: str, swarm: str, wanted: bool) -> Known | None:
    from fullswarm.bus.base import OPERATOR, NamedBus
    from fullswarm.bus.zenoh_bus import ZenohBus
    from fullswarm.clock import MonotonicClock
    from fullswarm.keys import Keys
    from fullswarm.logs import log_to_stderr
    from fullswarm.messages import ParamReply, RobotStates
    from fullswarm.operator.params import ParamClient
    from fullswarm.operator.session import own_credentials
    from fullswarm.runtime import Runtime

    log_to_stderr(at_once=False)
    keys, runtime = Keys(swarm), Runtime(MonotonicClock())
    bus = ZenohBus(runtime.mailbox, hub=endpoint, credentials=own_credentials(endpoint, swarm))
    robots: set[str] = set()
    entries: dict[str, Any] = {}
    received: Counter[str] = Counter()  # states by host: once one repeats, all have been received

    def receive(reply: ParamReply) -> None:
        entries.update({entry.key: entry.value for entry in reply.entries})
        end()

    def receive_states(states: RobotStates) -> None:
        robots.update(states.robots)
        received[states.host] += 1
        end()

    def end() -> None:
        if entries and (not wanted or 3 in received.values()):
            runtime.stop()

    try:
        bus.wait_connected(CONNECT_S)
        if wanted:
            bus.subscribe(keys.state(), RobotStates, receive_states)
        ParamClient(NamedBus(bus, OPERATOR), keys, runtime, "completion").ask("get", "*", receive)
        runtime.run(LISTEN_S)
    finally:
        bus.close()
    return known_from(robots, entries) if entries else None


def known_from(robots: set[str], entries: dict[str, Any]) -> Known:
    """Return the names in a core's database and in the robots' states."""
    tables = {key.removeprefix("behaviour/"): value for key, value in entries.items() if key.startswith("behaviour/")}
    from fullswarm.operator.view import natural

    groups = {
        key.removeprefix("group/"): tuple(value.get("robots", ()))
        for key, value in entries.items()
        if key.startswith("group/") and isinstance(value, dict)
    }
    return Known(tuple(sorted(robots, key=natural)), groups, resolved(tables), tuple(sorted(entries)))


def resolved(tables: dict[str, Any]) -> dict[str, Record]:
    """Return the records that are tables, with the summary and the parameters of the record that `like` names."""
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


def _known(context: typer.Context, *, live: bool, robots: bool = False) -> Known:
    given = context.params
    hub, swarm = given.get("hub"), given.get("swarm") or "swarm"
    named = given.get("fleet") or os.environ.get("FULLSWARM_FLEET")
    if live:
        seen = from_swarm(hub or os.environ.get("FULLSWARM_HUB"), str(swarm), robots=robots)
        if seen is not None:
            return seen
    known = from_package()
    if named:
        with contextlib.suppress(Exception):  # part of a path, or a file that is being written
            return from_fleet(Path(str(named)), known)
    return known


def _files(folder: str) -> Offer:
    offer: Offer = []
    for file in sorted((PACKAGE / folder).glob("*.toml")):
        text = tomllib.loads(file.read_text("utf-8"))
        offer.append((file.stem, str(text.get("summary") or text.get("title") or "")))
    return offer


def _given(context: typer.Context, key: str) -> bool:
    return any(str(each).startswith(f"{key}=") for each in context.params.get("settings") or ())


def _values(spec: Mapping[str, Any]) -> Iterable[str]:
    if spec.get("choices"):
        return [str(each) for each in spec["choices"]]
    if spec.get("type") == "flag":
        return ["true", "false"]
    default = spec.get("default")
    return [EXAMPLES.get(str(spec.get("type")), "1.0") if default is None else _plain(default)]


def _plain(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return ",".join(map(_plain, value))
    return str(value) if isinstance(value, int | float | str) else ""


# ---------------------------------------------------------------- matching
def _begun(offer: Offer, incomplete: str) -> Offer:
    return [each for each in offer if each[0].startswith(incomplete)]


def _listed(offer: Offer, incomplete: str) -> Offer:
    before, comma, _ = incomplete.rpartition(",")
    taken = set(before.split(","))
    return _begun([(f"{before}{comma}{word}", text) for word, text in offer if word not in taken], incomplete)


# ---------------------------------------------------------------- the shell's protocol
def answer(program: Callable[[], object]) -> int:
    """Run the program as the shell's script requests, and print only the words to offer.

    Bash ends words at ``=``, ``@`` and ``:``: the parts are joined for the program, and the part that bash keeps is
    removed from the answer.
    """
    kept, instruction = "", os.environ.get(SWITCH, "")
    if instruction == "complete_bash":
        words, at, kept = joined(os.environ.get("COMP_WORDS", "").split("\n"), os.environ.get("COMP_CWORD", "0"))
        os.environ["COMP_WORDS"], os.environ["COMP_CWORD"] = _quoted(words), str(at)
    out = io.StringIO()
    with contextlib.suppress(BaseException), contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
        program()
    lines = out.getvalue().splitlines()
    if kept:
        lines = [line.removeprefix(kept) for line in lines]
    if lines:
        sys.stdout.write("\n".join(lines) + "\n")
        sys.stdout.flush()
    return 0


def joined(words: list[str], at: str) -> tuple[list[str], int, str]:
    """Join the words that bash has split at ``=``, ``@`` and ``:``.

    Returns
    -------
    tuple
        The words, the index of the one with the cursor, and the part of that one that bash keeps before an answer.
    """
    cursor = int(at) if at.isdecimal() else len(words)
    words = [*words, *[""] * (cursor + 1 - len(words))]
    whole: list[str] = []
    glue, place, kept = False, 0, ""
    for number, word in enumerate(words):
        split = word[:1] in ("=", ":") or (word[:1] == "@" and bool(whole) and whole[-1].endswith(","))
        if (glue or split) and len(whole) > 1 and (word or number == cursor):
            before, whole[-1] = whole[-1], whole[-1] + word
        else:
            before = ""
            whole.append(word)
        if number == cursor:
            # Behind a = or : bash appends the answer; an @ is replaced together with what follows.
            place, kept = len(whole) - 1, (before + (word if word in ("=", ":") else "")).removesuffix("@")
        glue = word[-1:] in ("=", ":") or word == "@"
    return whole, place, kept


def _quoted(words: Iterable[str]) -> str:
    """Join words so that splitting like a shell returns them; an open quote stays as it is."""
    return "\n".join(word.replace("[", "\\[") if word else "''" for word in words)
