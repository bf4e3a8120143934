"""The WebSocket of a program: states at a rate, twists, and what ends them."""

from __future__ import annotations

import asyncio
import contextlib
import json
from pathlib import Path
from typing import Any

import pytest
import websockets
from websockets.asyncio.client import ClientConnection

from fullswarm.operator.console.api import stream
from fullswarm.operator.console.api.access import MOST_STREAMS
from fullswarm.operator.console.api.reads import Reader
from fullswarm.operator.console.frames import MAX_BYTES
from fullswarm.operator.console.tokens import TokenFile
from tests.unit.api_lab import ApiLab, closing, frame, run, validator


async def say(line: ClientConnection, kind: str, **fields: Any) -> None:
    await line.send(json.dumps({"type": kind, **fields}))


async def twists(line: ClientConnection, sequence: int, ttl_s: float = 0.3, **robots: list[float]) -> None:
    await say(line, "twists", sequence=sequence, ttl_s=ttl_s, twists=robots or {"r0": [0.2, 0.0]})


def test_states_of_the_robots_that_are_subscribed_come_at_their_rate(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        document = (await lab.client.get("/openapi.json")).json()
        async with lab.stream(role="observer") as line:
            await say(line, "subscribe", rate_hz=20.0)
            first = await frame(line)
            validator(document, {"$ref": "#/components/schemas/States"}).validate(first)
            assert [each["robot"] for each in first["robots"]] == ["r0", "r1"]
            began_s, sequences = lab.runtime.now_s(), [(await frame(line))["sequence"] for _ in range(10)]
            assert sequences == list(range(2, 12))
            assert lab.runtime.now_s() - began_s > 0.4  # never faster than asked
            await say(line, "subscribe", robots=["r1"], rate_hz=5.0)
            while [each["robot"] for each in (await frame(line))["robots"]] != ["r1"]:
                pass
            await say(line, "subscribe", robots=["r7"])
            assert (await frame(line, "refused"))["status"] == 404
            await twists(line, 1)
            assert (await frame(line, "refused"))["status"] == 403  # an observer drives nothing

    run(tmp_path, story)


def test_a_client_without_headers_sends_its_token_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream, "HELLO_S", 0.2)

    async def story(lab: ApiLab) -> None:
        async with lab.stream(role="") as line:
            await say(line, "hello", token=lab.tokens["driver"])
            await say(line, "subscribe")
            assert (await frame(line))["type"] == "states"
        for first in ({"type": "hello", "token": "wrong"}, {"type": "subscribe"}, {"type": "hello", "token": 1}):
            async with lab.stream(role="") as line:
                await line.send(json.dumps(first))
                assert await closing(line) == stream.BAD_TOKEN
        async with lab.stream(role="") as line:
            assert await closing(line) == stream.NO_HELLO
        async with lab.stream(role="", additional_headers={"Authorization": "Bearer wrong"}) as line:
            assert await closing(line) == stream.BAD_TOKEN

    run(tmp_path, story)


def test_a_browsers_page_of_another_origin_opens_no_stream(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        for origin in ("http://evil.example", "null"):
            with pytest.raises(websockets.InvalidStatus) as refused:
                async with lab.stream(additional_headers={"Origin": origin}):
                    pass
            assert refused.value.response.status_code == 403
        # The page's own socket still needs its Origin.
        with pytest.raises(websockets.InvalidStatus):
            async with websockets.connect(f"ws://127.0.0.1:{lab.port}/ws", proxy=None):
                pass

    run(tmp_path, story)


@pytest.mark.alone
def test_twists_drive_and_end_with_their_time_or_with_the_connection(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        await lab.hold()
        async with lab.stream() as line:
            await twists(line, 1, ttl_s=1.0)
            assert (await frame(line)) == {"type": "accepted", "sequence": 1}
            await lab.until_driven()
            assert (await lab.ask("/robots/r0"))["driven_until_s"] > 0.0
            await twists(line, 1, ttl_s=1.0, r0=[0.4, 0.0])  # a copy
            assert (await frame(line))["status"] == 409
            await say(line, "release")
            assert await lab.until_stopped() < 0.8
            sent_s = lab.runtime.now_s()
            await twists(line, 2, ttl_s=0.8)
            await lab.until_driven()
            await lab.until_stopped()
            assert 0.75 < lab.runtime.now_s() - sent_s < 3.0
            await twists(line, 3, ttl_s=1.0)
            await lab.until_driven()
            line.transport.abort()  # as when the client is killed: no closing frame
            assert await lab.until_stopped() < 0.8

    run(tmp_path, story)


def test_each_robot_of_a_frame_gets_its_own_twist_and_one_that_is_not_held_is_said(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        await lab.hold("r0")
        async with lab.stream() as line:
            await twists(line, 1, r0=[0.2, 0.0], r1=[0.2, 0.0])
            refused = await frame(line)
            assert (refused["status"], refused["sequence"], "r1" in refused["detail"]) == (409, 1, True)
            await lab.until_driven("r0")
            assert not lab.driven("r1")
            await lab.hold("r1")
            sequence, wanted = 1, pytest.approx([0.2, -0.1], abs=0.01)
            async with asyncio.timeout(20.0):
                while [float(lab.whole.agents[robot].setpoints[0, 0]) for robot in ("r0", "r1")] != wanted:
                    sequence += 1
                    await twists(line, sequence, ttl_s=0.5, r0=[0.2, 0.0], r1=[-0.1, 0.0])
                    assert (await frame(line))["type"] == "accepted"
                    await asyncio.sleep(0.1)

    run(tmp_path, story)


@pytest.mark.alone
def test_an_estop_of_another_operator_ends_driving_until_it_is_released(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        await lab.hold()
        async with lab.stream() as line:
            await twists(line, 1, ttl_s=1.0)
            await lab.until_driven()
            await lab.ask("/estop", {}, role="driver")
            assert await lab.until_stopped() < 0.8
            await twists(line, 2)
            assert (await frame(line, "refused"))["detail"] == "e-stop while driving"
            await lab.ask("/estop/clear", {})
            await twists(line, 3)
            await frame(line, "refused")
            assert not lab.driven()
            await twists(line, 4, r0=[0.0, 0.0])
            await twists(line, 5, ttl_s=1.0)
            await lab.until_driven()

    run(tmp_path, story)


def test_frames_that_are_wrong_are_answered_and_those_too_large_or_too_many_end_the_stream(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        await lab.hold()
        async with lab.stream() as line:
            for text in (
                "{", "[]", "null", '{"type":"none"}', '{"type":"twists"}', '{"type":"subscribe","rate_hz":1e9}',
                '{"type":"twists","sequence":1,"twists":{"r0":[9,0]}}', '{"type":"hello","token":"x"}',
                '{"type":"twists","sequence":1,"twists":{"r0":[0]}}',
            ):  # fmt: skip
                await line.send(text)
                assert (await frame(line))["status"] in (400, 422)
            await line.send(b"\xff\x00")
            assert (await frame(line))["status"] == 400
            await line.send("x" * (MAX_BYTES + 1))
            assert await closing(line) == stream.TOO_LARGE
        async with lab.stream() as line:
            for _ in range(200):
                await line.send("{}")
            assert await closing(line) == stream.TOO_MANY

    run(tmp_path, story)


def test_a_client_that_takes_nothing_is_closed_and_delays_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "STALLED_S", 0.5)
    robots = Reader.some_robots  # hundreds of them: so their states soon fill what the system keeps for a client
    monkeypatch.setattr(Reader, "some_robots", lambda *arguments: 300 * robots(*arguments))

    async def story(lab: ApiLab) -> None:
        usage = lab.api.access.usage(lab.api.access.admit(lab.tokens["operator"]))
        async with (
            lab.stream(max_queue=1, close_timeout=0.1) as slow,
            lab.stream(role="driver", max_size=None) as quick,
        ):
            await lab.until(lambda: usage.streams == 1, "it is open")
            slow.transport.pause_reading()
            await say(slow, "subscribe", rate_hz=20.0)
            await say(quick, "subscribe", rate_hz=20.0)
            while usage.streams:
                await frame(quick)
            assert (await frame(quick))["type"] == "states"
            slow.transport.abort()

    run(tmp_path, story)


@pytest.mark.alone
def test_streams_of_a_token_are_limited_and_end_with_it(tmp_path: Path) -> None:
    async def story(lab: ApiLab) -> None:
        usage = lab.api.access.usage(lab.api.access.admit(lab.tokens["driver"]))
        async with contextlib.AsyncExitStack() as stack:
            lines = [await stack.enter_async_context(lab.stream(role="driver")) for _ in range(MOST_STREAMS)]
            await lab.until(lambda: usage.streams == MOST_STREAMS, "all are open")
            async with lab.stream(role="driver") as line:
                assert await closing(line) == stream.BUSY
            began_s = lab.runtime.now_s()
            TokenFile(lab.file.path).revoke("driver")
            assert {await closing(line) for line in lines} == {stream.BAD_TOKEN}
            assert lab.runtime.now_s() - began_s < 1.5

    run(tmp_path, story)
