"""What one client of the MCP server can cause at most: rates, sizes, calls in flight, tokens."""

from __future__ import annotations

import asyncio
import json
import math
import os
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest
from mcp.shared.message import SessionMessage
from mcp_types import JSONRPCRequest, JSONRPCResponse

from fullswarm.clock import SimClock
from fullswarm.errors import ConfigError, FullswarmError, RequestRefused
from fullswarm.mcp_server.authority import TOKEN_S, DryRuns
from fullswarm.mcp_server.limits import LONGEST_TEXT, MOST_ENTRIES, RateLimit, plain
from fullswarm.mcp_server.pipe import IN_FLIGHT, LONGEST_LINE, WAITING, Pipe, Streams
from fullswarm.mcp_server.server import model_name
from fullswarm.mcp_server.tools import LARGEST_ANSWER, Arguments, Tool

CONTENT = {"behaviour": "flocking_bc", "robots": ["r1"], "parameters": {"gain": 1.0}}


# ---------------------------------------------------------------- values, rates, tokens
def test_texts_are_printable_and_all_sizes_are_bounded() -> None:
    assert plain("a\x1b[2Jb\u202ec\n\ud800") == "a?[2Jb?c??"
    assert len(plain("x" * 10**6)) == LONGEST_TEXT + 1
    assert plain([math.nan, math.inf, 1.5, True, None]) == [None, None, 1.5, True, None]
    assert len(plain(list(range(10**5)))) == MOST_ENTRIES
    assert len(plain({str(each): 0 for each in range(10**5)})) == MOST_ENTRIES
    deep: Any = "end"
    for _ in range(10_000):
        deep = [deep]
    json.dumps(plain(deep))


def test_a_rate_limit_admits_a_burst_and_then_its_rate() -> None:
    clock = SimClock()
    rate = RateLimit(clock, 2.0, 4.0)
    assert [rate.admit() for _ in range(6)] == [True] * 4 + [False] * 2
    clock.advance_to(1.0)
    assert [rate.admit() for _ in range(3)] == [True, True, False]
    clock.advance_to(1000.0)
    assert sum(rate.admit() for _ in range(100)) == 4


def test_a_token_admits_the_same_content_once_and_for_a_short_time() -> None:
    clock = SimClock()
    runs = DryRuns(clock)
    with pytest.raises(RequestRefused, match="needs the token"):
        runs.redeem("", CONTENT)
    with pytest.raises(RequestRefused, match="unknown"):
        runs.redeem("0" * 24, CONTENT)
    token = runs.issue(CONTENT)
    runs.redeem(token, dict(reversed(CONTENT.items())))
    with pytest.raises(RequestRefused, match="was used"):
        runs.redeem(token, CONTENT)
    token = runs.issue(CONTENT)
    with pytest.raises(RequestRefused, match="belongs to another request"):
        runs.redeem(token, CONTENT | {"robots": ["r1", "r2"]})
    with pytest.raises(RequestRefused, match="was used"):
        runs.redeem(token, CONTENT)
    token = runs.issue(CONTENT)
    clock.advance_to(TOKEN_S + 0.1)
    with pytest.raises(RequestRefused, match="too old"):
        runs.redeem(token, CONTENT)
    first = runs.issue(CONTENT)
    for _ in range(1000):
        runs.issue(CONTENT)
    with pytest.raises(RequestRefused, match="unknown"):
        runs.redeem(first, CONTENT)


def test_no_model_acts_under_the_name_of_a_person(monkeypatch: pytest.MonkeyPatch) -> None:
    assert model_name("anna@lab") == "mcp/anna@lab"
    assert model_name("mcp/anna") == "mcp/anna"
    monkeypatch.setenv("FULLSWARM_OPERATOR", "bert")
    assert model_name("") == "mcp/bert"
    with pytest.raises(ConfigError):
        model_name("a b")


# ---------------------------------------------------------------- answers of tools
class Number(Arguments):
    number: int


def tool(work: Callable[[int], dict[str, Any]]) -> Tool:
    async def call(given: Number) -> dict[str, Any]:
        return work(given.number)

    return Tool("try", "read", "", Number, call)


def answer(work: Callable[[int], dict[str, Any]], given: dict[str, Any]) -> Any:
    return asyncio.run(tool(work).answer(given))


def test_each_failure_of_a_tool_is_an_answer_with_its_parts() -> None:
    def refuse(_: int) -> dict[str, Any]:
        raise RequestRefused("no", where="r1", hint="ask", code="held")

    found = answer(refuse, {"number": 1})
    assert (found.is_error, found.content[0].text) == (True, "r1: no (ask)")
    assert found.structured_content["error"] == {
        "what": "no", "where": "r1", "hint": "ask", "code": "held", "exit_code": 2,
    }  # fmt: skip
    found = answer(lambda number: {"share": 1 / number}, {"number": 0})
    assert found.structured_content["error"]["what"] == "ZeroDivisionError, a bug in fullswarm"
    for wrong in ({}, {"number": "x" * 10**5}, {"number": 1, "y" * 10**5: 2}):
        found = answer(lambda _: {}, wrong)
        assert found.is_error
        assert len(found.content[0].text) < 600
    found = answer(lambda _: {"rows": ["x" * 400] * MOST_ENTRIES}, {"number": 1})
    assert f"more than {LARGEST_ANSWER} bytes" in found.content[0].text


# ---------------------------------------------------------------- the transport
@asynccontextmanager
async def piped(per_s: float = 1e6) -> AsyncIterator[tuple[int, int, Streams, SimClock]]:
    """Yield the client's ends of two pipes, and what the server reads and writes."""
    clock = SimClock()
    (source, client_out), (client_in, sink) = os.pipe(), os.pipe()
    os.set_blocking(client_out, False)
    os.set_blocking(client_in, False)
    try:
        pipe = Pipe(
            source, sink, RateLimit(clock, per_s, per_s), frozenset({"halt", "latch"}), frozenset({"latch"})
        )  # fmt: skip
        async with pipe.streams() as streams:
            yield client_out, client_in, streams, clock
    finally:
        for end in (source, client_out, client_in, sink):
            os.close(end)


def call(number: int, name: str = "read") -> bytes:
    message = {"jsonrpc": "2.0", "id": number, "method": "tools/call", "params": {"name": name}}
    return json.dumps(message).encode() + b"\n"


async def lines(end: int, count: int) -> list[dict[str, Any]]:
    data = b""
    with anyio.fail_after(10.0):
        while data.count(b"\n") < count:
            await anyio.wait_readable(end)
            data += os.read(end, 65_536)
    return [json.loads(line) for line in data.splitlines()]


async def received(streams: Streams) -> SessionMessage:
    with anyio.fail_after(10.0):
        found = await streams[0].receive()
    assert isinstance(found, SessionMessage)
    return found


async def reply(streams: Streams, message: SessionMessage) -> None:
    assert isinstance(message.message, JSONRPCRequest)
    await streams[1].send(SessionMessage(JSONRPCResponse(jsonrpc="2.0", id=message.message.id, result={"ok": True})))


def test_lines_that_are_no_messages_or_too_long_are_refused_and_the_next_one_is_read() -> None:
    async def run() -> None:
        async with piped() as (out, back, streams, _):
            async with anyio.create_task_group() as tasks:

                async def send() -> None:
                    for data in (b"garbage\n\n\xff\xfe\n[1, 2]\n", b"x" * (3 * LONGEST_LINE), b"\n", call(7)):
                        while data:
                            await anyio.wait_writable(out)
                            data = data[os.write(out, data[:4096]) :]

                tasks.start_soon(send)
                message = await received(streams)
            assert isinstance(message.message, JSONRPCRequest)
            assert message.message.id == 7
            await reply(streams, message)
            found = await lines(back, 5)
            assert [each.get("error", {}).get("code") for each in found] == [-32700, -32700, -32700, -32600, None]
            assert found[-1] == {"jsonrpc": "2.0", "id": 7, "result": {"ok": True}}

    anyio.run(run)


def test_calls_beyond_the_rate_are_answered_as_errors_but_a_stop_never_is() -> None:
    async def run() -> None:
        async with piped(per_s=2.0) as (out, back, streams, clock):
            os.write(out, call(1) + call(2) + call(3) + call(4, "halt"))
            for wanted in (1, 2, 4):
                message = await received(streams)
                assert isinstance(message.message, JSONRPCRequest)
                assert message.message.id == wanted
                await reply(streams, message)
            found = await lines(back, 4)
            refused = next(each for each in found if each["id"] == 3)
            assert refused["result"]["isError"] is True
            assert "more than 2 calls per second" in refused["result"]["content"][0]["text"]
            clock.advance_to(1.0)
            os.write(out, call(5))
            await received(streams)

    anyio.run(run)


def test_what_is_in_flight_is_bounded_also_when_the_client_cancels() -> None:
    async def run() -> None:
        async with piped() as (out, _, streams, _clock):
            os.write(out, b"".join(call(each) for each in range(IN_FLIGHT + 5)))
            taken = [await received(streams) for _ in range(IN_FLIGHT)]
            with pytest.raises(TimeoutError), anyio.fail_after(0.2):
                await streams[0].receive()
            assert taken[0].metadata is not None
            await taken[0].metadata.on_request_unanswered()  # type: ignore[union-attr,misc]
            await received(streams)
            await reply(streams, taken[1])
            await received(streams)

    anyio.run(run)


def test_an_estop_overtakes_calls_that_wait_for_others_to_be_answered_and_a_stop_does_not() -> None:
    async def run() -> None:
        async with piped() as (out, back, streams, _clock):
            many = IN_FLIGHT + 20
            os.write(out, b"".join(call(each) for each in range(many)))
            taken = [await received(streams) for _ in range(IN_FLIGHT)]
            for number in range(3):  # copies with the same id, too
                os.write(out, call(1000, "latch") + call(2000 + number, "halt"))
                first = await received(streams)
                assert isinstance(first.message, JSONRPCRequest)
                assert first.message.id == 1000
                await reply(streams, first)
            answers = await lines(back, 3)
            assert {each["id"] for each in answers} == {1000}
            for message in taken:
                await reply(streams, message)
            order = []
            for _ in range(20 + 3):
                message = await received(streams)
                assert isinstance(message.message, JSONRPCRequest)
                order.append(message.message.id)
                await reply(streams, message)
            assert order == sorted(order), "in the order in which they came"
            assert order[-3:] == [2000, 2001, 2002]

    anyio.run(run)


def test_calls_for_which_there_is_no_room_are_refused_and_an_estop_behind_them_is_not() -> None:
    async def run() -> None:
        async with piped() as (out, back, streams, _clock):
            os.write(out, b"".join(call(each) for each in range(250)))
            first = await received(streams)
            os.write(out, call(2000, "halt") + call(1000, "latch"))
            while True:
                message = await received(streams)
                assert isinstance(message.message, JSONRPCRequest)
                if message.message.id == 1000:
                    break
            refused = await lines(back, 250 - IN_FLIGHT - 2 * WAITING)
            assert len(refused) <= 250 - IN_FLIGHT
            assert all("have no answer yet" in each["result"]["content"][0]["text"] for each in refused)
            await reply(streams, first)

    anyio.run(run)


def test_a_client_that_reads_nothing_ends_the_server(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fullswarm.mcp_server.pipe.WRITE_S", 0.2)

    async def run() -> None:
        async with piped() as (out, _, streams, _clock):
            os.write(out, call(1))
            await received(streams)
            long = {"text": "x" * 1_000_000}  # longer than what a pipe holds
            await streams[1].send(SessionMessage(JSONRPCResponse(jsonrpc="2.0", id=1, result=long)))
            await anyio.sleep(10.0)

    with pytest.raises(BaseExceptionGroup) as caught:
        anyio.run(run)
    assert caught.group_contains(FullswarmError, match="has read nothing", depth=None)


def test_notifications_before_the_first_call_are_not_kept() -> None:
    async def run() -> None:
        async with piped() as (out, _, streams, _clock):
            os.write(out, b'{"jsonrpc": "2.0", "method": "notifications/x"}\n' * 500 + call(1))
            message = await received(streams)
            assert isinstance(message.message, JSONRPCRequest)

    anyio.run(run)
