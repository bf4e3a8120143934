"""`record clip`: a part of a recording as a recording of its own, with what its messages need from before."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import msgspec
from mcap.records import Attachment, Channel, Message, Metadata
from mcap.records import Schema as SchemaRecord

from fullswarm.errors import ConfigError
from fullswarm.files import replacing
from fullswarm.record.reading import Contents, contents, continued, records, size_of
from fullswarm.record.recorder import JOURNAL
from fullswarm.record.recording import PROFILE, Schema, schema_of, writer_into

LATE_NS = 1_000_000_000
"""Messages of one flush may be out of order by so much."""
PARAMETERS = "/params/"
"""Topics on which each message states one entry of a database: of each entry the newest is needed."""
MOST_ENTRIES = 20_000


TOLD_EACH = 1000
"""Messages between two calls of what shows progress."""


@dataclass(frozen=True, slots=True)
class Range:
    """A part of a recording: nanoseconds since 1970."""

    from_ns: int
    to_ns: int


def range_of(path: Path, from_text: str, to_text: str) -> Range:
    """Return the part that is asked for.

    Parameters
    ----------
    from_text, to_text : seconds from the first message, or a time like 2026-11-27T12:03:14; empty: from the beginning,
        to the end

    Raises
    ------
    ConfigError
        One of them is neither, the part is empty, or the file cannot be read or is no recording.
    """
    size_of(path)
    first_ns = next((each.log_time for each in records(path) if isinstance(each, Message)), None)
    if first_ns is None:
        raise ConfigError("it holds no message", where=str(path))
    found = Range(
        first_ns if not from_text else _moment(from_text, "--from", first_ns),
        2**63 - 1 if not to_text else _moment(to_text, "--to", first_ns),
    )
    if found.from_ns >= found.to_ns:
        raise ConfigError(f"nothing is between {from_text} and {to_text}", where="--from, --to")
    return found


def _moment(text: str, option: str, first_ns: int) -> int:
    try:
        seconds = float(text)
        if not math.isfinite(seconds) or abs(seconds) > 1e9:
            raise ConfigError(f"'{text}' is no number of seconds", where=option, hint="for example 12.5")
        return first_ns + round(1e9 * seconds)
    except ValueError:
        pass
    try:
        return round(1e9 * datetime.fromisoformat(text).astimezone().timestamp())
    except (ValueError, OverflowError, OSError):
        hint = "seconds from its beginning, such as 12.5, or a time such as 2026-11-27T12:03:14"
        raise ConfigError(f"invalid time '{text}'", where=option, hint=hint) from None


def clip(path: Path, out: Path, wanted: Range, tell: Callable[[int], None] = lambda _: None) -> Contents:
    """Copy a part of a recording into the new file `out`; return what that holds.

    The newest message of each channel before the part, and the newest of each parameter, stand at its beginning: poses,
    health and settings are known from its first moment on. Journals are left out: nodes cannot be run again from the
    middle. `tell` is called with the number of messages that were read, now and then.

    Raises
    ------
    ConfigError
        `path` cannot be read or is no recording, nothing was recorded then, or `out` is there already or cannot be
        written.
    """
    if out.suffix.lower() != ".mcap":
        raise ConfigError(
            f"cannot make a '{out.suffix or out.name}'", where=str(out), hint="it ends in .mcap, .gif, .mp4"
        )
    if out.exists():
        raise ConfigError("this file is there already", where=str(out), hint="name another one with --out")
    try:
        with replacing(out, 0o600) as part:
            with part.open("wb") as stream:
                copy = _Copy(writer_into(stream), wanted, tell)
                for file in (path, *continued(path)):
                    if not copy.file(file):
                        break
                copy.finish(path.name)
            if not copy.messages:
                hint = "see `fullswarm record info` for how long it is"
                raise ConfigError("nothing was recorded then", where=str(path), hint=hint)
    except OSError as error:
        raise ConfigError(f"cannot write: {error.strerror or error}", where=str(out)) from None
    return contents(out)


@dataclass(slots=True)
class _Copy:
    """Writes the messages of a part, and before the first of them what was known by then."""

    writer: Any
    wanted: Range
    tell: Callable[[int], None]
    read: int = 0
    messages: int = 0
    earlier: int = 0
    _known: dict[tuple[str, str, str], Message] = field(default_factory=dict)  # by topic, sender, key of a parameter
    _channels: dict[tuple[str, str, str], int] = field(default_factory=dict)
    _schemas: dict[Schema, int] = field(default_factory=dict)
    _began: bool = False
    _noted: set[str] = field(default_factory=set)
    _found: dict[tuple[str, str, str], tuple[Channel, Schema]] = field(default_factory=dict)

    def file(self, path: Path) -> bool:
        """Copy of one file; return whether a later one may hold more."""
        schemas: dict[int, SchemaRecord] = {}
        channels: dict[int, Channel] = {}
        for record in records(path):
            if isinstance(record, SchemaRecord):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message) and record.channel_id in channels:
                self.read += 1
                if self.read % TOLD_EACH == 0:
                    self.tell(self.read)
                if record.log_time > self.wanted.to_ns + LATE_NS:
                    return False
                channel = channels[record.channel_id]
                self._message(record, channel, schema_of(schemas.get(channel.schema_id), channel.message_encoding))
            elif isinstance(record, Metadata | Attachment):
                self._note(record)
        return True

    def finish(self, source: str) -> None:
        """Write the end."""
        about = {"source": source, "from_ns": str(self.wanted.from_ns), "earlier": str(self.earlier)}
        self.writer.add_metadata(f"{PROFILE}.clip", about)
        self.writer.finish()

    def _message(self, record: Message, channel: Channel, schema: Schema) -> None:
        key = (channel.topic, channel.metadata.get("sender", ""), _entry(channel.topic, record.data))
        self._found[key] = channel, schema
        if record.log_time < self.wanted.from_ns:
            if key in self._known or len(self._known) < MOST_ENTRIES:
                self._known[key] = record
            return
        if record.log_time > self.wanted.to_ns:
            return
        if not self._began:
            self._began = True
            self._write_known()
        self.messages += 1
        self.writer.add_message(
            self._channel(channel, schema), record.log_time, record.data, record.publish_time, record.sequence
        )

    def _write_known(self) -> None:
        for key, record in sorted(self._known.items(), key=lambda each: each[1].log_time):
            channel, schema = self._found[key]
            self.earlier += 1
            # Its own time stays in `publish_time`.
            number = self._channel(channel, schema)
            self.writer.add_message(number, self.wanted.from_ns, record.data, record.publish_time, record.sequence)
        self._known.clear()

    def _channel(self, channel: Channel, schema: Schema) -> int:
        key = (channel.topic, channel.metadata.get("sender", ""), schema.name)
        number = self._channels.get(key)
        if number is None:
            kind = self._schemas.get(schema, 0)
            if not kind and schema.name:
                kind = self._schemas[schema] = self.writer.register_schema(schema.name, schema.encoding, schema.data)
            number = self.writer.register_channel(channel.topic, channel.message_encoding, kind, dict(channel.metadata))
            self._channels[key] = number
        return number

    def _note(self, record: Metadata | Attachment) -> None:
        """Copy metadata and attachments once, though each file of a recording has them."""
        if record.name in self._noted or record.name == JOURNAL:
            return
        self._noted.add(record.name)
        if isinstance(record, Metadata):
            self.writer.add_metadata(record.name, dict(record.metadata))
        else:
            self.writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)


class _Named(msgspec.Struct):
    key: str = ""


class _Changed(msgspec.Struct):
    entry: _Named = msgspec.field(default_factory=_Named)


_changed = msgspec.json.Decoder(_Changed)


def _entry(topic: str, data: bytes) -> str:
    """Return the key of the parameter that a message states; empty: it states none."""
    if not topic.startswith(PARAMETERS):
        return ""
    try:
        return _changed.decode(data).entry.key
    except (msgspec.DecodeError, UnicodeDecodeError):
        return ""


def messages_in(path: Path, wanted: Range) -> Iterator[tuple[float, str, str, bytes]]:
    """Yield seconds from the first message, topic, schema's name and bytes of each message up to the end of a part.

    Those before its beginning come, too: they state what was known by then.
    """
    first_ns: int | None = None
    for file in (path, *continued(path)):
        schemas: dict[int, str] = {}
        channels: dict[int, tuple[str, str]] = {}
        for record in records(file):
            if isinstance(record, SchemaRecord):
                schemas[record.id] = record.name
            elif isinstance(record, Channel):
                channels[record.id] = record.topic, schemas.get(record.schema_id, "")
            elif isinstance(record, Message) and record.channel_id in channels:
                first_ns = record.log_time if first_ns is None else first_ns
                if record.log_time > wanted.to_ns:
                    return
                topic, schema = channels[record.channel_id]
                yield 1e-9 * (record.log_time - first_ns), topic, schema, record.data
