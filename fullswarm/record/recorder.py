"""Records a live swarm: every message that an observer may receive, and the logs of its processes."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import msgspec

from fullswarm.bus.base import Carried, Tap
from fullswarm.bus.codec import decode
from fullswarm.errors import ConfigError, MessageError
from fullswarm.identity.access import TOPICS, Topic
from fullswarm.journal.journal import JournalTail
from fullswarm.keys import Keys
from fullswarm.messages import CameraPicture, Message, RangeReport
from fullswarm.record.recording import Schema
from fullswarm.record.scene import Drawn, Scene, log_line
from fullswarm.record.table import Table
from fullswarm.runtime import Scheduler
from fullswarm.schemas import json_schema, tag_of

FLUSH_S = 0.25
"""A kill loses at most what came since the last flush."""
SCENE_S = 1.0
"""From one whole scene to the next."""
TABLE_S = 0.25
"""From one table of all robots to the next."""
LONGEST_LINE = 2000
JOURNAL, JOURNAL_TYPE = "journal", "application/vnd.fullswarm.journal"
"""Name and media type of attachments with blocks of journals: MessagePack, a list of process and compressed block."""
JOURNAL_BYTES = 1_000_000
"""Of one process at one flush, at most."""
LOG_BYTES = 65_536
"""Of one log at one flush, at most: a process that floods its log must not delay the recording."""


class TapBus(Protocol):
    """A bus whose messages can be had unread; see :meth:`fullswarm.bus.zenoh_bus.ZenohBus.tap`."""

    def tap(self, expressions: Sequence[str]) -> Tap:
        """Collect all messages on matching keys."""
        ...


class Sink(Protocol):
    """Where a recorder writes: a :class:`~fullswarm.record.recording.Recording`, or the viewers that are connected.

    Attributes
    ----------
    refused : messages for which there was no more channel
    """

    refused: int

    def write(self, topic: str, sender: str, schema: Schema, time_ns: int, data: bytes) -> None:
        """Add a message; see :meth:`fullswarm.record.recording.Recording.write`."""
        ...

    def flush(self) -> None:
        """Pass on what was added. Raises `OSError` or `ConfigError` when that is possible no more."""
        ...

    def attach(self, name: str, media_type: str, time_ns: int, data: bytes) -> None:
        """Add an attachment."""
        ...

    def note(self, name: str, values: Mapping[str, str]) -> None:
        """Add metadata."""
        ...

    def close(self) -> None:
        """End in order."""
        ...

    def abandon(self) -> None:
        """End as it is, after a failure."""
        ...


Journals = Callable[[], Iterable[tuple[str, bytes]]]


def no_journals() -> Iterable[tuple[str, bytes]]:
    """Return none: the processes write none, or run elsewhere."""
    return ()


def journals_in(folder: Path) -> Journals:
    """Return what reads the journals that processes write into a folder."""
    tail = JournalTail(folder)
    return lambda: tail.read(JOURNAL_BYTES)


class Recorder:
    """Writes what it receives into a recording, which it owns from here on, or shows it to viewers.

    Parameters
    ----------
    flush_s : how often it does so
    start_ns : nanoseconds since 1970 now
    logs : folder of the processes' logs, if they run on this machine
    on_failure : called once when nothing can be written any more, with the reason
    journals : returns the processes' newest journal blocks, compressed, for replay

    Attributes
    ----------
    strange : messages that were none of ours
    failed : it could not write all
    """

    def __init__(
        self,
        bus: TapBus,
        keys: Keys,
        scheduler: Scheduler,
        recording: Sink,
        start_ns: int,
        logs: Path | None = None,
        on_failure: Callable[[str], None] = lambda _: None,
        journals: Journals = no_journals,
        flush_s: float = FLUSH_S,
    ) -> None:
        self._swarm, self._scheduler, self._recording = keys.swarm, scheduler, recording
        self._start_ns, self._start_s = start_ns, scheduler.now_s()
        self._on_failure = on_failure
        self._scene, self._table = Scene(), Table()
        self._logs, self._journals = LogTail(logs), journals
        self._scene_every, self._table_every = (max(1, round(each_s / flush_s)) for each_s in (SCENE_S, TABLE_S))
        self._schemas = {kind: _schema(kind) for topic in TOPICS for kind in topic.messages}
        self.strange, self.failed, self._flushes, self._open = 0, False, 0, True
        self._topics = [topic for topic in TOPICS if "observer" in topic.receive]
        self._tap = bus.tap([f"{self._swarm}/{topic.expression()}" for topic in self._topics])
        self._timer = scheduler.every(flush_s, self._flush)

    def _ns(self, at_s: float) -> int:
        return self._start_ns + round(1e9 * (at_s - self._start_s))

    def _take(self, carried: Carried) -> None:
        message = _read(self._topics[carried.number], carried.data)
        if message is None:
            self.strange += 1
            return
        time_ns = self._ns(carried.arrival_s)
        if not isinstance(message, CameraPicture | RangeReport):  # these are recorded once, as viewers show them
            name = "/" + carried.key.partition("/")[2]
            data = msgspec.json.encode(message)
            self._recording.write(name, carried.sender, self._schemas[type(message)], time_ns, data)
        self._table.take(message, carried.arrival_s)
        for drawn in self._scene.take(message, carried.arrival_s, time_ns):
            self._draw(drawn, time_ns)

    def _draw(self, drawn: Drawn, time_ns: int) -> None:
        self._recording.write(drawn.topic, "", drawn.schema, time_ns, drawn.data)

    def _flush(self) -> None:
        if not self._open:
            return
        now_s = self._scheduler.now_s()
        now_ns = self._ns(now_s)
        try:
            for carried in self._tap.take():
                self._take(carried)
            for drawn in self._scene.frames():
                self._draw(drawn, now_ns)
            for process, line in self._logs.read():
                self._draw(log_line(process, line, now_ns), now_ns)
            if blocks := list(self._journals()):
                self._recording.attach(JOURNAL, JOURNAL_TYPE, now_ns, msgspec.msgpack.encode(blocks))
            if self._flushes % self._scene_every == 0:
                self._draw(self._scene.whole(now_s, now_ns), now_ns)
            if self._flushes % self._table_every == 0:
                self._draw(self._table.whole(now_s), now_ns)
            self._flushes += 1
            self._recording.flush()
        except (OSError, ConfigError) as error:  # also where the next file cannot be begun
            self._open, self.failed = False, True
            self._recording.abandon()
            self._on_failure(f"the recording ends here: {getattr(error, 'strerror', '') or error}")

    def close(self) -> None:
        """Write the rest and close the recording. Closing twice is fine."""
        self._timer.cancel()
        self._tap.close()
        self._flush()
        if self._open:
            self._open = False
            counts = {"dropped": self._tap.dropped, "strange": self.strange, "refused": self._recording.refused}
            try:
                self._recording.note("end", {name: str(count) for name, count in counts.items()})
                self._recording.close()
            except OSError as error:
                self.failed = True
                self._recording.abandon()
                self._on_failure(f"the end of the recording is missing: {error.strerror or error}")


class LogTail:
    """Reads what the logs in a folder get, line by line, from where they end now."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._read: dict[Path, int] = {path: path.stat().st_size for path in self._paths()}

    def _paths(self) -> list[Path]:
        return [] if self._folder is None else sorted(self._folder.glob("*.log"))

    def read(self) -> list[tuple[str, str]]:
        """Return (process, line) of whole lines that are new."""
        found: list[tuple[str, str]] = []
        for path in self._paths():
            start = self._read.get(path, 0)
            try:
                size = path.stat().st_size
                if size == start:
                    continue
                with path.open("rb") as file:
                    file.seek(start if size > start else 0)  # it began anew
                    start = file.tell()
                    data = file.read(LOG_BYTES)
            except OSError:
                continue  # moved aside just now
            text, end, _ = data.rpartition(b"\n")
            too_long = not end and len(data) == LOG_BYTES
            self._read[path] = start + (LOG_BYTES if too_long else len(text) + len(end))
            lines = text.decode(errors="replace").splitlines()
            found += [(path.stem, line[:LONGEST_LINE]) for line in lines if line.strip()]
        return found


def _read(topic: Topic, data: bytes) -> Message | None:
    """Return a message of one of the topic's types; None: it is none."""
    for kind in topic.messages:
        try:
            return decode(data, kind)
        except MessageError:
            continue
    return None


def _schema(kind: type[Message]) -> Schema:
    """Return the JSON Schema of a message as an object at the top, as viewers want it."""
    text = json.dumps(_with_null(json_schema(kind)))
    return Schema(f"fullswarm.{tag_of(kind)}", "jsonschema", text.encode(), "json")


def _with_null(schema: Any) -> Any:
    """Return a schema in which a number without bounds may be null, as JSON has no NaN and no infinity."""
    if isinstance(schema, dict):
        if schema.get("type") == "number" and not {"minimum", "maximum", "exclusiveMinimum"} & schema.keys():
            return {**schema, "type": ["number", "null"]}
        return {name: _with_null(each) for name, each in schema.items()}
    return [_with_null(each) for each in schema] if isinstance(schema, list) else schema
