"""Writes recordings: MCAP files (mcap.dev) whose chunks are on the disk twice a second, new ones by size.

A recording is one file, or several if it grows: ``run.mcap``, ``run.2.mcap``, … Each can be read by itself.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from mcap.records import Schema as McapSchema
from mcap.writer import CompressionType, IndexType, Writer

from fullswarm import __version__
from fullswarm.errors import ConfigError

PROFILE = "fullswarm"
CHUNK_BYTES = 1_000_000
MOST_CHANNELS = 10_000
"""Of one file; every answer to a question has a key of its own, and a stranger can invent more."""


@dataclass(frozen=True, slots=True)
class Schema:
    """How the messages of a channel are to be read: name, encoding and text of the schema, encoding of the messages."""

    name: str
    encoding: str
    data: bytes
    messages: str


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file that goes into each file of a recording."""

    name: str
    media_type: str
    data: bytes


class _Writer(Writer):
    """The library's writer, with a way to end the present chunk before it is full."""

    def end_chunk(self) -> None:
        # The library has no public call for it; `tests/unit/test_recording.py` fails if this one is renamed.
        self._Writer__finalize_chunk()  # type: ignore[attr-defined]


@dataclass(slots=True)
class Recording:
    """One recording.

    Parameters
    ----------
    path : of the first file
    about : written as metadata into each file, e.g. versions
    attachments : go into each file
    limit_bytes : from this size on a new file is begun; 0: never
    keep : so many of the newest files are kept; 0: all

    Raises
    ------
    ConfigError
        The file is there already, or cannot be written.
    """

    path: Path
    about: Mapping[str, str] = field(default_factory=dict)
    attachments: Sequence[Attachment] = ()
    limit_bytes: int = 0
    keep: int = 0
    files: list[Path] = field(default_factory=list)  # written so far, the first one first
    messages: int = 0
    refused: int = 0  # messages for which there was no more channel
    _writer: _Writer | None = None
    _stream: IO[bytes] | None = None
    _schemas: dict[Schema, int] = field(default_factory=dict)
    _channels: dict[tuple[str, str, str], int] = field(default_factory=dict)
    _sequence: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._begin(self.path)

    def write(self, topic: str, sender: str, schema: Schema, time_ns: int, data: bytes) -> None:
        """Add a message, which is on the disk after the next `flush`.

        Parameters
        ----------
        topic, sender : make the channel, with the schema
        time_ns : since 1970, when it was received
        """
        assert self._writer is not None  # noqa: S101  (narrows the type: it is open until `close`)
        channel = self._channels.get((topic, sender, schema.name))
        if channel is None:
            if len(self._channels) >= MOST_CHANNELS:
                self.refused += 1
                return
            channel = self._add_channel(topic, sender, schema)
        number = self._sequence[channel] = self._sequence.get(channel, 0) + 1
        self._writer.add_message(channel, time_ns, data, time_ns, number & 0xFFFFFFFF)
        self.messages += 1

    def flush(self) -> None:
        """Have all that was added on its way to the disk: what kills this process cannot take it back.

        Raises
        ------
        OSError
            The disk is full, or gone.
        """
        if self._writer is None or self._stream is None:
            return
        self._writer.end_chunk()
        self._stream.flush()
        if self.limit_bytes and self._stream.tell() >= self.limit_bytes:
            self._end()
            number = len(self.files) + 1
            self._begin(self.path.with_name(f"{self.path.stem}.{number}{self.path.suffix}"))
            if self.keep and number > self.keep:
                self.files[number - 1 - self.keep].unlink(missing_ok=True)

    def attach(self, name: str, media_type: str, time_ns: int, data: bytes) -> None:
        """Add an attachment to the present file, which is on the disk after the next `flush`."""
        if self._writer is not None:
            self._writer.add_attachment(time_ns, time_ns, name, media_type, data)

    def note(self, name: str, values: Mapping[str, str]) -> None:
        """Add metadata ``fullswarm.<name>`` to the present file. Raises `OSError` as `flush` does."""
        if self._writer is not None:
            self._writer.add_metadata(f"{PROFILE}.{name}", dict(values))

    def close(self) -> None:
        """Write the index and close. Closing twice is fine. Raises `OSError` as `flush` does."""
        if self._writer is not None:
            self._end()

    def abandon(self) -> None:
        """Close the file as it is, without its index."""
        stream, self._writer, self._stream = self._stream, None, None
        if stream is not None:
            with contextlib.suppress(OSError):
                stream.close()

    def _add_channel(self, topic: str, sender: str, schema: Schema) -> int:
        assert self._writer is not None  # noqa: S101  (as in `write`)
        number = self._schemas.get(schema)
        if number is None:
            number = self._schemas[schema] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        channel = self._writer.register_channel(topic, schema.messages, number, {"sender": sender} if sender else {})
        self._channels[topic, sender, schema.name] = channel
        return channel

    def _begin(self, path: Path) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb")
        except FileExistsError:
            raise ConfigError("this file is there already", where=str(path), hint="name another one") from None
        except OSError as error:
            raise ConfigError(f"cannot record: {error.strerror}", where=str(path)) from None
        self.files.append(path)
        self._schemas, self._channels, self._sequence = {}, {}, {}
        self._writer = writer_into(self._stream)
        for each in self.attachments:
            self._writer.add_attachment(0, 0, each.name, each.media_type, each.data)
        self._writer.add_metadata(PROFILE, {"version": __version__, **self.about})
        self._stream.flush()

    def _end(self) -> None:
        writer, stream, self._writer, self._stream = self._writer, self._stream, None, None
        if writer is not None and stream is not None:
            with stream:
                writer.finish()  # type: ignore[no-untyped-call]


def writer_into(stream: IO[bytes]) -> _Writer:
    """Return the library's writer of a file of ours, started."""
    writer = _Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD, index_types=IndexType.ALL)
    writer.start(PROFILE, f"fullswarm {__version__}")
    return writer


def schema_of(record: McapSchema | None, messages: str) -> Schema:
    """Return what a file says of a channel's messages."""
    if record is None:
        return Schema("", "", b"", messages)
    return Schema(record.name, record.encoding, record.data, messages)
