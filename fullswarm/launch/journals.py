"""Builds the nodes of a process with a journal, and builds them again of one.

Both ways call the same function of :mod:`fullswarm.launch.nodes`, with the ports of :mod:`fullswarm.journal`.
"""

from __future__ import annotations

import hashlib
import os
import platform
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import msgspec
import numpy as np

import fullswarm
from fullswarm import __version__, kernels, registry
from fullswarm.bus.base import CENTRALISED, CORE, SenderBus
from fullswarm.clock import wall_time_s
from fullswarm.config import SwarmConfig
from fullswarm.drivers.base import Description, Fleet
from fullswarm.journal import feed as fed
from fullswarm.journal import ports
from fullswarm.journal.feed import Feed
from fullswarm.journal.journal import Journal, JournalFile, Kind
from fullswarm.launch import nodes
from fullswarm.launch.nodes import AgentPorts, Node
from fullswarm.runtime import Runtime, Scheduler

if TYPE_CHECKING:
    from fullswarm.store import Store

FOLDER = "FULLSWARM_JOURNAL"
"""Name of the environment variable with the folder into which the processes of a run write their journals."""
FLUSH_S = 0.25
"""A kill loses at most what came since the last flush."""
AGENT = "agent"
BUILD, CLOSE, MEASUREMENTS, REPORT = "build", "close", "publish_measurements", "report"


def code_hash() -> str:
    """Return what tells this code from other code: of this package and of all behaviours and records beside it."""
    digest = hashlib.sha256()
    package = Path(fullswarm.__file__).parent
    own = sorted(path for path in package.rglob("*") if path.suffix in (".py", ".toml"))
    outside = sorted({*registry.law_files().values(), *registry.record_files()})
    for path in (*own, *outside):
        name = path.relative_to(package).as_posix() if path.is_relative_to(package) else path.name
        digest.update(name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def journal_folder(run: Path) -> Path:
    """Return the folder of the journals of a run, within that of its logs."""
    return run / "journal"


class Begin(Protocol):
    """Begins the journal of a process."""

    def __call__(self, process: str, head: dict[str, object]) -> Journal:
        """Return a new journal with this head."""
        ...


def head_of(kind: str, process: str, config: SwarmConfig, **more: object) -> dict[str, object]:
    """Return the head of a process's journal: what its nodes are built of, and what else their results depend on."""
    return {
        "kind": kind, "process": process, "config": config.model_dump_json(), "version": __version__,
        "python": platform.python_version(), "numpy": np.__version__, "machine": platform.machine(),
        "compiled": kernels.is_compiled(), **more,
    }  # fmt: skip


def noted(found: AgentPorts, journal: Journal) -> AgentPorts:
    """Return the same ports, whose use goes into a journal."""
    return AgentPorts(
        ports.JournalBus(found.bus, journal),
        ports.JournalScheduler(found.scheduler, journal),
        ports.JournalFleet(found.fleet, journal),
        ports.noted_loop(found.loop, journal),
        ports.noted_wall(found.wall_s, journal),
        ports.JournalDisk(found.disk, journal),
    )


class Given(NamedTuple):
    """What the nodes of a process of the base station use of the world around them."""

    bus: SenderBus
    scheduler: Scheduler
    wall_s: Callable[[], float]


def given(
    bus: SenderBus, scheduler: Scheduler, journal: Journal | None, wall_s: Callable[[], float] = wall_time_s
) -> Given:
    """Return these ports, whose use goes into a journal if there is one."""
    if journal is None:
        return Given(bus, scheduler, wall_s)
    return Given(
        ports.JournalBus(bus, journal), ports.JournalScheduler(scheduler, journal), ports.noted_wall(wall_s, journal)
    )


def agent_head(
    config: SwarmConfig, fleet: Fleet, host: str, process: str, latches: Path | None, clock: str
) -> dict[str, object]:
    """Return the head of an agent's journal; `latches` and `clock` as :func:`fullswarm.launch.nodes.agent_process`."""
    descriptions = [msgspec.to_builtins(each) for each in fleet.descriptions]
    return head_of(
        AGENT, process, config, host=host, ids=fleet.ids, urls=fleet.urls, descriptions=descriptions,
        latches=None if latches is None else str(latches), clock=clock,
    )  # fmt: skip


def core_head(config: SwarmConfig, process: str, store: Store, audit: Path | None, *, watch: bool) -> dict[str, object]:
    """Return the head of a core's journal: with what its database and the end of its audit log hold."""
    from fullswarm.audit.log import newest_entry

    log = None if audit is None else newest_entry(audit)
    return head_of(CORE, process, config, store=store.dump(), audit=log, watch=watch)


class LiveJournal:
    """The journal of a live process, written to the run's folder; a node that closes after those that it notes."""

    def __init__(self, folder: Path, process: str, head: dict[str, object], runtime: Runtime) -> None:
        self.journal = Journal(head)
        self._file = JournalFile(folder, process, self.journal)
        self._timer = runtime.every(FLUSH_S, self._file.flush)

    def close(self) -> None:
        """Write the rest."""
        self._timer.cancel()
        self._file.close()


def begin_live(runtime: Runtime, process: str, head: Callable[[], dict[str, object]]) -> LiveJournal | None:
    """Begin the journal of this process where the environment asks for it."""
    folder = os.environ.get(FOLDER, "")
    return LiveJournal(Path(folder), process, head(), runtime) if folder else None


def built(build: Callable[[], list[Node]], journal: Journal | None) -> list[Node]:
    """Return the nodes that `build` makes, as one node whose beginning and end are events of a journal, if any."""
    if journal is None:
        return build()
    found: list[Node] = []
    journal.run((Kind.CALL, BUILD), lambda: found.extend(build()))
    return [Noted(found, journal)]


def called(name: str, call: Callable[[], None], journal: Journal | None) -> None:
    """Call nodes from outside, as an event of their journal if they have one."""
    if journal is None:
        call()
    else:
        journal.run((Kind.CALL, name), call)


class Noted:
    """Nodes whose end is an event of their journal, too."""

    def __init__(self, built: list[Node], journal: Journal) -> None:
        self._nodes, self._journal = built, journal

    def close(self) -> None:
        """Close the nodes, the last one first."""
        self._journal.run((Kind.CALL, CLOSE), lambda: close_all(self._nodes))


def close_all(built: list[Node]) -> None:
    """Close nodes, the last one first."""
    for node in reversed(built):
        node.close()


# ---------------------------------------------------------------- the other way
@dataclass(slots=True)
class Rebuilt:
    """The nodes of a journal, fed from it.

    Attributes
    ----------
    calls : what the process called itself, by name; `BUILD` makes the nodes
    robots : names of the rows of the commands
    """

    feed: Feed
    robots: tuple[str, ...]
    calls: dict[str, Callable[[], None]]
    _stack: ExitStack = field(default_factory=ExitStack)

    def close(self) -> None:
        """Remove what it has made."""
        self._stack.close()


def rebuild(head: dict[str, Any]) -> Rebuilt:
    """Return the nodes that a head describes, to be built by the call `BUILD`.

    Raises
    ------
    ValueError
        The head is of something else, or lacks something.
    """
    try:
        config = SwarmConfig.model_validate_json(head["config"])
        kind = head["kind"]
        if kind == AGENT:
            return _agent(head, config)
        if kind == CENTRALISED:
            return _centralised(head, config)
        if kind == CORE:
            return _core(head, config)
    except (KeyError, TypeError, msgspec.ValidationError) as error:
        raise ValueError(f"the head of the journal lacks something: {error}") from None
    raise ValueError(f"a journal of kind '{kind}'")


def _agent(head: dict[str, Any], config: SwarmConfig) -> Rebuilt:
    from fullswarm.agent.node import AgentNode
    from fullswarm.agent.state import Identity

    feed, stack = Feed(), ExitStack()
    ids = tuple(head["ids"])
    descriptions = tuple(msgspec.convert(each, Description) for each in head["descriptions"])
    given = AgentPorts(
        fed.FeedBus(feed), fed.FeedScheduler(feed), fed.FeedFleet(feed, ids, tuple(head["urls"]), descriptions),
        fed.fed_loop(feed), fed.fed_wall(feed), fed.FeedDisk(feed),
    )  # fmt: skip
    latches = None if head["latches"] is None else Path(head["latches"])
    identity = Identity(head["host"], head["process"])
    built: list[Node] = []

    def build() -> None:
        built.extend(nodes.agent_process(given, config, identity, latches, head["clock"]))

    def publish() -> None:
        for node in built:
            if isinstance(node, AgentNode):
                node.publish_measurements()

    return Rebuilt(feed, ids, {BUILD: build, MEASUREMENTS: publish, CLOSE: lambda: close_all(built)}, stack)


def _centralised(head: dict[str, Any], config: SwarmConfig) -> Rebuilt:
    feed = Feed()
    built: list[Node] = []

    def build() -> None:
        bus, scheduler = fed.FeedBus(feed), fed.FeedScheduler(feed)
        built.extend(nodes.centralised_process(bus, scheduler, config, head["process"], watch=head["watch"]))

    return Rebuilt(feed, (), {BUILD: build, CLOSE: lambda: close_all(built)})


def _core(head: dict[str, Any], config: SwarmConfig) -> Rebuilt:
    from fullswarm.perf.summarizers import Summarizer
    from fullswarm.store import Store

    feed, stack = Feed(), ExitStack()
    audit = None
    if head["audit"] is not None:
        name, line = head["audit"]
        audit = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="fullswarm-")))
        if name:
            (audit / Path(name).name).write_bytes(line)
    core = config.core.model_copy(update={"store": None, "results": None, "audit": None})
    config = config.model_copy(update={"core": core})
    built: list[Node] = []

    def build() -> None:
        wall_s = fed.fed_wall(feed)
        store = Store(None, wall_s)
        store.restore(head["store"])
        bus, scheduler = fed.FeedBus(feed), fed.FeedScheduler(feed)
        built.extend(
            nodes.core_process(
                bus, scheduler, config, head["process"], wall_s, audit=audit, store=store, watch=head["watch"]
            )
        )

    def report() -> None:
        for node in built:
            for each in getattr(node, "extra", ()):
                if isinstance(each, Summarizer):
                    each.report()

    return Rebuilt(feed, (), {BUILD: build, REPORT: report, CLOSE: lambda: close_all(built)}, stack)
