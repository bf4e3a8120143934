"""Reads recordings: what a file holds, and a file that ends in the middle made whole."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Channel, Footer, Message, Metadata, Statistics
from mcap.records import Schema as SchemaRecord
from mcap.stream_reader import StreamReader

from fullswarm.errors import ConfigError
from fullswarm.record.recording import schema_of, writer_into

LONGEST_RECORD = 64 * 2**20


@dataclass(slots=True)
class Contents:
    """What a file holds.

    Attributes
    ----------
    whole : it has its end; else it was cut off, and what is stated is what can be read
    about : metadata by name, e.g. versions; counts of what was lost at the end
    attachments : name → bytes of all attachments of that name
    topics : (topic, schema) → messages
    """

    path: Path
    bytes: int
    whole: bool = False
    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0
    about: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, int] = field(default_factory=dict)
    topics: Counter[tuple[str, str]] = field(default_factory=Counter)

    @property
    def seconds(self) -> float:
        """From the first message to the last one."""
        return 1e-9 * (self.last_ns - self.first_ns)


def contents(path: Path) -> Contents:
    """Read a whole file and return what it holds.

    Raises
    ------
    ConfigError
        It cannot be read, or is no MCAP file.
    """
    found = Contents(path, size_of(path))
    channels: dict[int, Channel] = {}
    schemas: dict[int, SchemaRecord] = {}
    for record in records(path):
        if isinstance(record, SchemaRecord):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Message):
            channel = channels.get(record.channel_id)
            if channel is None:
                continue
            schema = schemas.get(channel.schema_id)
            found.topics[channel.topic, schema.name if schema else ""] += 1
            found.first_ns = min(found.first_ns or record.log_time, record.log_time)
            found.last_ns = max(found.last_ns, record.log_time)
            found.messages += 1
        elif isinstance(record, Metadata):
            found.about[record.name] = dict(record.metadata)
        elif isinstance(record, Attachment):
            found.attachments[record.name] = found.attachments.get(record.name, 0) + len(record.data)
        elif isinstance(record, Footer):
            found.whole = True
    return found


def repair(path: Path, out: Path) -> Contents:
    """Write what can be read of `path` into the new file `out`, with an index; return what that holds.

    Raises
    ------
    ConfigError
        `path` cannot be read or is no MCAP file, or `out` is there already or cannot be written.
    """
    size_of(path)
    first = next(iter(records(path)), None)
    if first is None:
        raise ConfigError("nothing of it can be read", where=str(path))
    try:
        stream = os.fdopen(os.open(out, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb")
    except FileExistsError:
        raise ConfigError("this file is there already", where=str(out), hint="name another one with --out") from None
    except OSError as error:
        raise ConfigError(f"cannot write: {error.strerror}", where=str(out)) from None
    with stream:
        writer = writer_into(stream)
        _copy(records(path), writer)
        writer.finish()  # type: ignore[no-untyped-call]
    return contents(out)


def _copy(found: Iterator[Any], writer: Any) -> None:
    schemas: dict[int, SchemaRecord] = {}
    numbers: dict[int, int] = {}
    channels: dict[int, int] = {}
    for record in found:
        if isinstance(record, SchemaRecord):
            schemas[record.id] = record
        elif isinstance(record, Channel) and record.id not in channels:
            schema = schemas.get(record.schema_id)
            text = schema_of(schema, record.message_encoding)
            number = numbers.get(record.schema_id, 0)
            if schema is not None and not number:
                number = numbers[record.schema_id] = writer.register_schema(text.name, text.encoding, text.data)
            channels[record.id] = writer.register_channel(
                record.topic, record.message_encoding, number, dict(record.metadata)
            )
        elif isinstance(record, Message) and record.channel_id in channels:
            channel = channels[record.channel_id]
            writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
        elif isinstance(record, Metadata):
            writer.add_metadata(record.name, dict(record.metadata))
        elif isinstance(record, Attachment):
            writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)


def records(path: Path, on_read: Callable[[int], None] = lambda _: None) -> Iterator[Any]:
    """Yield the records of a file up to its end, or to where it is damaged or cut off.

    Parameters
    ----------
    on_read : called before each record with the bytes of the file that have been read
    """
    try:
        with path.open("rb") as stream:
            # Each chunk has a checksum: one that was written in part is not taken for whole.
            reader = StreamReader(stream, validate_crcs=True, record_size_limit=LONGEST_RECORD)
            for record in reader.records:
                on_read(stream.tell())
                if isinstance(record, Statistics):
                    continue
                yield record
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", where=str(path)) from None
    except Exception:  # of damaged bytes the library, and the decompressors below it, raise anything
        return


def continued(path: Path) -> Iterator[Path]:
    """Yield the files that continue a recording, such as ``run.2.mcap``."""
    number = 2
    while (file := path.with_name(f"{path.stem}.{number}{path.suffix}")).is_file():
        yield file
        number += 1


def size_of(path: Path) -> int:
    """Return the bytes of a file; raise `ConfigError` if it cannot be read or is no MCAP file."""
    try:
        with path.open("rb") as stream:
            if stream.read(8) != b"\x89MCAP0\r\n":
                raise ConfigError("no MCAP file", where=str(path), hint="recordings end in .mcap")
        return path.stat().st_size
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", where=str(path)) from None
