"""Shows a recording in the console: its messages go through the console's own nodes on a simulated clock.

The file is read once, from its beginning, in slices between which pages are served. What pages would have been shown is
kept in a temporary file, in segments, so that any moment that has been read is found at once.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from mcap.records import Attachment, Channel, Message, Metadata
from mcap.records import Schema as SchemaRecord

from fullswarm import __version__
from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.config.fleet_file import load_swarm
from fullswarm.core.settings import record_seeds, seeds
from fullswarm.errors import ConfigError, FullswarmError
from fullswarm.keys import Keys
from fullswarm.messages import Message as BusMessage
from fullswarm.messages import ParamEntry, ParamReply, ParamRequest
from fullswarm.operator.console import frames
from fullswarm.operator.console.charts import ChartDesk
from fullswarm.operator.console.clips import Download
from fullswarm.operator.console.frames import Answer
from fullswarm.operator.console.gateway import Gateway, Identity, StampedTrails
from fullswarm.operator.console.history import History, Limits
from fullswarm.operator.console.samples import Samples
from fullswarm.operator.console.sessions import Listener, refusal_of
from fullswarm.operator.console.timeline import About, Timeline
from fullswarm.operator.console.tokens import Role
from fullswarm.record.decoding import Decoder
from fullswarm.record.reading import continued, records, size_of
from fullswarm.record.recording import PROFILE
from fullswarm.runtime import Runtime, Scheduler

SLICE_S = 0.02
"""So long messages are read at a time: a page that seeks waits no longer for its turn."""
PAUSE_S = 0.001
SHOW_S = 0.25
"""How often pages are told what has been read: also a sign of life."""
LIMITS = Limits(seconds=math.inf, bytes=4_000_000_000, entries=20_000)
FLEET = "fleet.toml"
NO_ROBOTS = "this is a recording: there are no robots to command"


class Recorded(NamedTuple):
    """A message of the bus: nanoseconds since 1970, key without the swarm, and itself."""

    time_ns: int
    topic: str
    message: BusMessage


class FileShelf:
    """Keeps segments in a temporary file that only this user can read, and that vanishes with the process."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115  (closed by `close`)
        self._places: list[tuple[int, int]] = []

    def put(self, data: bytes) -> int:
        """Keep a segment; return its number."""
        start = self._file.seek(0, 2)
        self._file.write(data)
        self._places.append((start, len(data)))
        return len(self._places) - 1

    def get(self, number: int) -> bytes:
        """Return a segment."""
        start, length = self._places[number]
        self._file.seek(start)
        return self._file.read(length)

    def drop(self, number: int) -> None:
        """Forget a segment; the file does not shrink."""
        self._places[number] = (0, 0)

    def close(self) -> None:
        """Remove the file."""
        self._file.close()


class RecordedSwarm:
    """Reads a recording from its beginning to its end, message by message.

    Attributes
    ----------
    swarm : its name
    seeds : the core's database as far as the file states it, by key
    first_ns : of its first message, nanoseconds since 1970

    Raises
    ------
    ConfigError
        A file cannot be read, is no recording, or holds no message.
    """

    def __init__(self, path: Path) -> None:
        self._files = [path, *continued(path)]
        self._sizes = [size_of(file) for file in self._files]
        self.decoder = Decoder()
        self.swarm, self.seeds = "", record_seeds()
        self._file = self._bytes = 0
        self._found = self._read()
        first = next(self._found, None)
        if first is None:
            hint = "record with `fullswarm up --record` or `fullswarm record start`"
            raise ConfigError("it holds no message of a swarm", where=str(path), hint=hint)
        self._first, self.first_ns = first, first.time_ns

    @property
    def share(self) -> float:
        """How much of the files has been read, 0 to 1."""
        return min(1.0, (sum(self._sizes[: self._file]) + self._bytes) / max(1, sum(self._sizes)))

    def _note_bytes(self, count: int) -> None:
        self._bytes = count

    def messages(self) -> Iterator[Recorded]:
        """Yield all messages in the order of the file; once."""
        yield self._first
        yield from self._found

    def _read(self) -> Iterator[Recorded]:
        for number, file in enumerate(self._files):
            self._file = number
            schemas: dict[int, str] = {}
            channels: dict[int, tuple[str, str]] = {}
            for record in records(file, self._note_bytes):
                if isinstance(record, SchemaRecord):
                    schemas[record.id] = record.name
                elif isinstance(record, Channel):
                    channels[record.id] = record.topic, schemas.get(record.schema_id, "")
                elif isinstance(record, Message):
                    topic, schema = channels.get(record.channel_id, ("", ""))
                    if self.decoder.knows(schema) and (message := self.decoder.decode(schema, record.data)) is not None:
                        yield Recorded(record.log_time, topic.removeprefix("/"), message)
                else:
                    self._note(record)

    def _note(self, record: object) -> None:
        """Take what the file says of itself: the swarm's name, and its fleet file."""
        if isinstance(record, Metadata) and record.name == PROFILE:
            self.swarm = record.metadata.get("swarm", "") or self.swarm
        elif isinstance(record, Attachment) and record.name == FLEET:
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / FLEET
                file.write_bytes(record.data)
                try:
                    self.seeds = seeds(load_swarm(file))
                except FullswarmError:  # of another version: the page then shows no arena
                    return


def feed(found: Recorded, first_ns: int, runtime: Runtime, bus: LocalBus, keys: Keys) -> None:
    """Publish a recorded message at its time, after what is due before; its clock began at `first_ns`."""
    wait_s = 1e-9 * (found.time_ns - first_ns) - runtime.now_s()
    if wait_s > 0.0:
        runtime.run(wait_s)
    bus.publish(f"{keys.swarm}/{found.topic}", found.message)


@dataclass(slots=True)
class PlaybackSession:
    """One page that looks at a recording."""

    playback: Playback
    listener: Listener
    name: str
    role: Role

    def handle(self, command: frames.Command, listener: Listener) -> Answer:
        """Carry out a frame: only the past can be asked for."""
        if isinstance(command, frames.Charts):
            return self.playback.charts.handle(command, listener)
        if isinstance(command, frames.Ping | frames.Release | frames.Input):
            return Answer(ref=command.ref)
        if isinstance(command, frames.Look):
            return self.playback.timeline.handle(command, listener, self.name)
        if isinstance(command, frames.Mark | frames.Clip):
            if reason := refusal_of(self.role):
                return Answer(ref=command.ref, ok=False, reason=reason)
            return self.playback.timeline.handle(command, listener, self.name)
        return Answer(ref=command.ref, ok=False, reason=NO_ROBOTS)


@dataclass(slots=True)
class _Core:
    """Answers the console's questions for the core's database."""

    bus: LocalBus
    keys: Keys
    seeds: dict[str, Any]

    def answer(self, request: ParamRequest) -> None:
        entries = tuple(ParamEntry(key=key, value=value, author="", changed=0.0) for key, value in self.seeds.items())
        reply = ParamReply(id=request.id, ok=True, entries=entries)
        self.bus.publish(self.keys.param_reply("core", request.id), reply)


class Playback:
    """Serves pages from a recording, in place of the console's gateway.

    Parameters
    ----------
    scheduler : of the pages; the recording has a clock of its own, which begins at 0
    icons : URL scheme → outline and letter of its make
    """

    def __init__(
        self, path: Path, scheduler: Scheduler, recorded: RecordedSwarm, icons: Mapping[str, tuple[str, str]]
    ) -> None:
        self.path, self.recorded = path, recorded
        self._scheduler, self._icons = scheduler, icons
        self._runtime = Runtime(SimClock())
        self._bus = LocalBus(self._runtime.mailbox)
        self._keys = keys = Keys(recorded.swarm or "swarm")
        self._shelf = FileShelf()
        self._listeners: list[Listener] = []
        self._events_sent, self._done = 0, False
        core = _Core(self._bus, keys, recorded.seeds)
        self._bus.subscribe(keys.param_request("core"), ParamRequest, core.answer)

        def new_history(trails: StampedTrails) -> History:
            return History(trails, LIMITS, self._shelf)

        identity = Identity("", "playback", __version__, read_only=True)
        self._gateway = Gateway(
            self._bus, keys, self._runtime, identity, lambda: self._wall_s(self._runtime.now_s()), new_history,
            Samples(math.inf),
        )  # fmt: skip
        self.charts = ChartDesk(self._gateway.samples, scheduler)
        self._names_sent = 0
        history = self._gateway.timeline.history
        self.timeline = Timeline(
            history,
            scheduler,
            lambda: history.to_s,
            lambda: self._wall_s(history.to_s),
            self._send,
            About(path.name, file=lambda: path),
        )
        self._messages = recorded.messages()
        self._timer = scheduler.every(SHOW_S, self._show)
        scheduler.after(PAUSE_S, self._slice)

    # ---------------------------------------------------------------- pages
    def join(
        self, key: str, name: str, listener: Listener, *, named: bool = False, role: Role = "operator"
    ) -> PlaybackSession:
        """Add a page; see :meth:`fullswarm.operator.console.gateway.Gateway.join`."""
        del key, named
        hello: dict[str, Any] = {
            "t": "hello", "swarm": self._keys.swarm, "version": __version__, "read_only": True, "operator": name,
            "icons": dict(self._icons),
        }  # fmt: skip
        for frame in (hello, self.timeline.events(), self._shown(), self.timeline.bookmarks(), self.charts.catalogue()):
            listener.put(frame["t"], frames.encode(frame))
        self._listeners.append(listener)
        return PlaybackSession(self, listener, name, role)

    def leave(self, session: PlaybackSession, listener: Listener) -> None:
        """Forget a page."""
        self.timeline.leave(listener)
        self.charts.leave(listener)
        if session.listener in self._listeners:
            self._listeners.remove(session.listener)

    def download(self, key: str) -> Download | None:
        """Return a clip by the key that its page got; None: there is none."""
        return self.timeline.clips.download(key)

    def close(self) -> None:
        """End reading and showing."""
        self._done = True
        self._timer.cancel()
        self.timeline.close()
        self.charts.close()
        self._gateway.close()
        self._shelf.close()

    def _send(self, frame: dict[str, Any]) -> None:
        text = frames.encode(frame)
        for listener in tuple(self._listeners):
            listener.put(frame["t"], text)

    def _shown(self) -> dict[str, Any]:
        return self.timeline.shown(None if self._done else self.recorded.share)

    def _show(self) -> None:
        self._send(self._shown())
        count = len(self.timeline.history.entries)
        if count != self._events_sent:
            self._events_sent = count
            self._send(self.timeline.events())
        if len(self._gateway.samples.names) != self._names_sent:
            self._names_sent = len(self._gateway.samples.names)
            self._send(self.charts.catalogue())

    def _wall_s(self, at_s: float) -> float:
        return 1e-9 * self.recorded.first_ns + at_s

    # ---------------------------------------------------------------- reading
    def _slice(self) -> None:
        """Read for a short time; the loop serves pages before the next slice."""
        until_s = self._scheduler.now_s() + SLICE_S
        while not self._done and self._scheduler.now_s() < until_s:
            self.read_one()
        if not self._done:
            self._scheduler.after(PAUSE_S, self._slice)

    def read_one(self) -> None:
        """Feed the next message, after what is due before it."""
        found = next(self._messages, None)
        if found is None:
            self._done = True
            self._runtime.run(0.5)  # what the last messages changed
            self.timeline.history.close()
            return
        feed(found, self.recorded.first_ns, self._runtime, self._bus, self._keys)

    @property
    def read(self) -> bool:
        """Whether all of it has been read."""
        return self._done
