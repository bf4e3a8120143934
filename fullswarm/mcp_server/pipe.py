"""The transport: one JSON-RPC message per line over two pipes, with bounds on size, rate and calls in flight.

The SDK's own transport for stdin and stdout bounds none of these: a line may have any length, and a client that sends
without reading makes the server keep every answer.
"""

from __future__ import annotations

import contextlib
import os
import select
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import anyio
from anyio.streams.memory import MemoryObjectReceiveStream, MemoryObjectSendStream
from mcp.shared.message import ServerMessageMetadata, SessionMessage
from mcp_types import (
    INVALID_REQUEST,
    PARSE_ERROR,
    ErrorData,
    JSONRPCError,
    JSONRPCMessage,
    JSONRPCNotification,
    JSONRPCRequest,
    JSONRPCResponse,
    jsonrpc_message_adapter,
)
from pydantic import ValidationError

from fullswarm.errors import FullswarmError
from fullswarm.mcp_server.limits import RateLimit
from fullswarm.mcp_server.tools import failed

LONGEST_LINE = 262_144
"""Bytes of one message; the longest that a tool needs has a few thousand."""
CHUNK = 65_536
IN_FLIGHT = 32
"""Calls that are being answered; the next one is read when one of them has been."""
WRITE_S = 30.0
"""A client that reads nothing for so long is lost."""
TOO_FAST = -32_005
"""JSON-RPC error code of this server, from the range that the protocol leaves to implementations."""

Streams = tuple[MemoryObjectReceiveStream[SessionMessage | Exception], MemoryObjectSendStream[SessionMessage]]


class Pipe:
    """Reads messages of one client from a descriptor, and writes answers to another one.

    Parameters
    ----------
    urgent : tools whose calls no rate limit refuses
    """

    def __init__(self, source: int, sink: int, rate: RateLimit, urgent: frozenset[str]) -> None:
        self._source, self._sink, self._rate, self._urgent = source, sink, rate, urgent
        self._source_polls = self._sink_polls = True
        self._opened = False
        self._in_flight = anyio.Semaphore(IN_FLIGHT)
        self._writing = anyio.Lock()

    @asynccontextmanager
    async def streams(self) -> AsyncIterator[Streams]:
        """Yield what the SDK's server reads from and writes to."""
        inward, received = anyio.create_memory_object_stream[SessionMessage | Exception](0)
        answers, outward = anyio.create_memory_object_stream[SessionMessage](0)
        with inward, received, answers, outward:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(self._read, inward)
                tasks.start_soon(self._write_answers, outward)
                try:
                    yield received, answers
                finally:
                    tasks.cancel_scope.cancel()

    # ---------------------------------------------------------------- reading
    async def _read(self, inward: MemoryObjectSendStream[SessionMessage | Exception]) -> None:
        with contextlib.suppress(anyio.BrokenResourceError, anyio.ClosedResourceError):
            async with inward:
                async for line in self._lines():
                    await self._take(line, inward)

    async def _lines(self) -> AsyncIterator[bytes]:
        """Yield each line of at most `LONGEST_LINE` bytes; refuse longer ones, whose bytes are not kept."""
        kept, searched, dropping = bytearray(), 0, False
        while data := await self._chunk():
            kept += data
            while (end := kept.find(b"\n", searched)) >= 0:
                line = bytes(kept[:end])
                del kept[: end + 1]
                searched = 0
                if not dropping:
                    yield line
                dropping = False
            searched = len(kept)
            if searched > LONGEST_LINE:
                if not dropping:
                    await self._refuse_line(INVALID_REQUEST, f"a message is longer than {LONGEST_LINE} bytes")
                kept.clear()
                searched, dropping = 0, True

    async def _chunk(self) -> bytes:
        if self._source_polls:
            try:
                await anyio.wait_readable(self._source)
            except PermissionError:  # a regular file is always readable, and cannot be polled
                self._source_polls = False
        if not self._source_polls:
            await anyio.lowlevel.checkpoint()
        return os.read(self._source, CHUNK)

    async def _take(self, line: bytes, inward: MemoryObjectSendStream[SessionMessage | Exception]) -> None:
        """Hand one message on, or refuse it."""
        if not line.strip():
            return
        try:
            message = jsonrpc_message_adapter.validate_json(line, by_name=False)
        except ValidationError:
            await self._refuse_line(PARSE_ERROR, "a line is no JSON-RPC message")
            return
        if isinstance(message, JSONRPCRequest):
            if not self._is_urgent(message) and not self._rate.admit():
                await self._send(self._too_fast(message))
                return
            await self._in_flight.acquire()
            self._opened = True
            metadata = ServerMessageMetadata(on_request_unanswered=self._settled)
            await inward.send(SessionMessage(message, metadata))
        elif self._opened and (_cancels(message) or self._rate.admit()):
            # What comes before the first request would be kept by the SDK, without a bound.
            await inward.send(SessionMessage(message))

    def _is_urgent(self, message: JSONRPCRequest) -> bool:
        return message.method == "tools/call" and (message.params or {}).get("name") in self._urgent

    def _too_fast(self, message: JSONRPCRequest) -> JSONRPCMessage:
        """Return the answer to a call that the rate limit refuses; a model sees an error of a tool only."""
        error = FullswarmError(
            f"more than {self._rate.per_s:g} calls per second",
            where=message.method[:64],
            hint="wait a second, then call",
        )
        if message.method == "tools/call":
            result = failed(error).model_dump(by_alias=True, mode="json", exclude_none=True)
            return JSONRPCResponse(jsonrpc="2.0", id=message.id, result=result)
        return JSONRPCError(jsonrpc="2.0", id=message.id, error=ErrorData(code=TOO_FAST, message=str(error)))

    async def _refuse_line(self, code: int, text: str) -> None:
        if self._rate.admit():
            await self._send(JSONRPCError(jsonrpc="2.0", id=None, error=ErrorData(code=code, message=text)))

    async def _settled(self) -> None:
        """Note that a call has ended without an answer: its client has cancelled it."""
        self._in_flight.release()

    # ---------------------------------------------------------------- writing
    async def _write_answers(self, outward: MemoryObjectReceiveStream[SessionMessage]) -> None:
        async with outward:
            async for each in outward:
                try:
                    await self._send(each.message)
                finally:
                    if isinstance(each.message, JSONRPCResponse | JSONRPCError):
                        self._in_flight.release()

    async def _send(self, message: JSONRPCMessage) -> None:
        data = message.model_dump_json(by_alias=True, exclude_unset=True).encode(errors="replace") + b"\n"
        async with self._writing:
            for start in range(0, len(data), select.PIPE_BUF):
                await self._write(data[start : start + select.PIPE_BUF])

    async def _write(self, data: bytes) -> None:
        """Write at most as much as a pipe that can be written to takes without blocking."""
        while data:
            with anyio.move_on_after(WRITE_S if self._sink_polls else None) as scope:
                await self._writable()
            if scope.cancelled_caught:
                raise FullswarmError(
                    f"the client has read nothing for {WRITE_S:g} s", where="stdout", hint="start the server again"
                )
            data = data[os.write(self._sink, data) :]

    async def _writable(self) -> None:
        if self._sink_polls:
            try:
                await anyio.wait_writable(self._sink)
            except PermissionError:
                self._sink_polls = False


def _cancels(message: Any) -> bool:
    return isinstance(message, JSONRPCNotification) and message.method == "notifications/cancelled"
