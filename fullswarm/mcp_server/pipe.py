"""The transport: one JSON-RPC message per line over two pipes, with bounds on size, rate and calls in flight.

The SDK's own transport for stdin and stdout bounds none of these: a line may have any length, and a client that sends
without reading makes the server keep every answer.
"""

from __future__ import annotations

import contextlib
import os
import select
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
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
IN_FLIGHT, WAITING, STOPS = 32, 64, 64
"""Calls that are being answered, and messages that wait for one of them to be; what comes then is refused, but for so
many stops. Reading goes on all the time: an e-stop may come behind them."""
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
    first : those of them whose calls overtake all that waits
    """

    def __init__(
        self, source: int, sink: int, rate: RateLimit, urgent: frozenset[str], first: frozenset[str] = frozenset()
    ) -> None:
        self._source, self._sink, self._rate, self._urgent, self._first = source, sink, rate, urgent, first
        self._source_polls = self._sink_polls = True
        self._opened = False
        self._in_flight, self._first_in_flight = anyio.Semaphore(IN_FLIGHT), anyio.Semaphore(IN_FLIGHT)
        self._overtaking: Counter[str | int] = Counter()  # ids of calls that are being answered beside the others
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
        waiting, taken = anyio.create_memory_object_stream[JSONRPCMessage](WAITING + STOPS)
        async with inward, anyio.create_task_group() as tasks:
            tasks.start_soon(self._pass_on, taken, inward)
            with contextlib.suppress(anyio.BrokenResourceError, anyio.ClosedResourceError):
                async with waiting:
                    async for line in self._lines():
                        await self._take(line, waiting, inward)

    async def _pass_on(
        self,
        taken: MemoryObjectReceiveStream[JSONRPCMessage],
        inward: MemoryObjectSendStream[SessionMessage | Exception],
    ) -> None:
        """Hand what waits on to the SDK's server, in order, while there is room for it."""
        with contextlib.suppress(anyio.BrokenResourceError, anyio.ClosedResourceError):
            async with taken:
                async for message in taken:
                    if isinstance(message, JSONRPCRequest):
                        await self._in_flight.acquire()
                        self._opened = True
                    await self._hand_on(message, inward)

    async def _hand_on(
        self, message: JSONRPCMessage, inward: MemoryObjectSendStream[SessionMessage | Exception]
    ) -> None:
        if isinstance(message, JSONRPCRequest):
            metadata = ServerMessageMetadata(on_request_unanswered=partial(self._settled, message.id))
            await inward.send(SessionMessage(message, metadata))
        else:
            await inward.send(SessionMessage(message))

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

    async def _take(
        self,
        line: bytes,
        waiting: MemoryObjectSendStream[JSONRPCMessage],
        inward: MemoryObjectSendStream[SessionMessage | Exception],
    ) -> None:
        """Have one message wait for its turn, hand it on at once, or refuse it."""
        if not line.strip():
            return
        try:
            message = jsonrpc_message_adapter.validate_json(line, by_name=False)
        except ValidationError:
            await self._refuse_line(PARSE_ERROR, "a line is no JSON-RPC message")
            return
        if isinstance(message, JSONRPCRequest):
            tool = _tool(message)
            if tool in self._first and self._opened:
                await self._first_in_flight.acquire()
                self._overtaking[message.id] += 1
                await self._hand_on(message, inward)
            elif tool in self._urgent:
                await waiting.send(message)
            elif not self._rate.admit():
                await self._send(_refusal(message, f"more than {self._rate.per_s:g} calls per second"))
            elif not _offer(waiting, message):
                await self._send(_refusal(message, f"{IN_FLIGHT + WAITING} calls have no answer yet"))
        # What comes before the first request would be kept by the SDK, without a bound.
        elif (self._opened or waiting.statistics().current_buffer_used) and (_cancels(message) or self._rate.admit()):
            _offer(waiting, message)

    async def _refuse_line(self, code: int, text: str) -> None:
        if self._rate.admit():
            await self._send(JSONRPCError(jsonrpc="2.0", id=None, error=ErrorData(code=code, message=text)))

    async def _settled(self, call: str | int) -> None:
        """Note that a call has ended, also without an answer: its client has cancelled it."""
        if self._overtaking[call] > 0:
            self._overtaking[call] -= 1
            self._first_in_flight.release()
        else:
            self._in_flight.release()

    # ---------------------------------------------------------------- writing
    async def _write_answers(self, outward: MemoryObjectReceiveStream[SessionMessage]) -> None:
        async with outward:
            async for each in outward:
                try:
                    await self._send(each.message)
                finally:
                    if isinstance(each.message, JSONRPCResponse | JSONRPCError) and each.message.id is not None:
                        await self._settled(each.message.id)

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


def _refusal(message: JSONRPCRequest, what: str) -> JSONRPCMessage:
    """Return the answer to a call that is not taken; a model sees an error of a tool only."""
    error = FullswarmError(what, where=message.method[:64], hint="wait a second, then call")
    if message.method == "tools/call":
        result = failed(error).model_dump(by_alias=True, mode="json", exclude_none=True)
        return JSONRPCResponse(jsonrpc="2.0", id=message.id, result=result)
    return JSONRPCError(jsonrpc="2.0", id=message.id, error=ErrorData(code=TOO_FAST, message=str(error)))


def _tool(message: JSONRPCRequest) -> str:
    """Return the tool that a request calls; empty: it calls none."""
    name = (message.params or {}).get("name") if message.method == "tools/call" else ""
    return name if isinstance(name, str) else ""


def _offer(waiting: MemoryObjectSendStream[JSONRPCMessage], message: JSONRPCMessage) -> bool:
    """Have a message wait; return whether there was room for it."""
    if waiting.statistics().current_buffer_used >= WAITING:
        return False
    waiting.send_nowait(message)
    return True


def _cancels(message: Any) -> bool:
    return isinstance(message, JSONRPCNotification) and message.method == "notifications/cancelled"
