"""A live view: what a client of the Foxglove WebSocket protocol gets, and what hostile ones can do.

The client is written here from the protocol's specification, on the ``websockets`` library; JSON is checked by
``jsonschema``, protobuf by its own decoder.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import random
import socket
import struct
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any, NamedTuple

import jsonschema
import pytest
import websockets
from mcap.reader import make_reader
from mcap.records import Schema as McapSchema
from mcap_protobuf.decoder import DecoderFactory
from websockets.asyncio.client import ClientConnection, connect

from fullswarm.clock import MonotonicClock, SimClock
from fullswarm.keys import Keys
from fullswarm.messages import CameraPicture, HealthReport, RobotHealth, SeenObstacles
from fullswarm.operator.console.access import Server, uvicorn_server
from fullswarm.record.recorder import Recorder
from fullswarm.record.recording import Recording, Schema
from fullswarm.record.viewer import (
    KEPT_S,
    LATCHED_BYTES,
    MOST_CHANNELS,
    MOST_VIEWERS,
    ROOM_BYTES,
    SUBPROTOCOLS,
    Channels,
    Outbox,
    Viewer,
    Web,
)
from fullswarm.runtime import Runtime
from tests.unit.test_recording import START_NS, Air, states

PLAIN = Schema("plain", "jsonschema", b'{"type":"object"}', "json")
FLUSH_S = 0.05
PATIENCE_S = 10.0


class Got(NamedTuple):
    """A message as the client has received it."""

    topic: str
    time_ns: int
    data: bytes


class Client:
    """A client of the protocol."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket
        self.info: dict[str, Any] = {}
        self.channels: dict[int, dict[str, Any]] = {}
        self.status: list[dict[str, Any]] = []
        self.got: list[Got] = []

    async def say(self, **frame: object) -> None:
        await self.socket.send(json.dumps(frame))

    async def subscribe(self, *topics: str) -> None:
        wanted = [number for number, each in self.channels.items() if not topics or each["topic"] in topics]
        await self.say(op="subscribe", subscriptions=[{"id": each + 1000, "channelId": each} for each in wanted])

    async def until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(PATIENCE_S):
            while not condition():
                self._take(await self.socket.recv())

    def _take(self, frame: str | bytes) -> None:
        if isinstance(frame, bytes):
            operation, subscription, time_ns = struct.unpack_from("<BIQ", frame)
            assert operation == 1
            self.got.append(Got(self.channels[subscription - 1000]["topic"], time_ns, frame[13:]))
            return
        found = json.loads(frame)
        if found["op"] == "serverInfo":
            self.info = found
        elif found["op"] == "advertise":
            self.channels |= {each["id"]: each for each in found["channels"]}
        elif found["op"] == "unadvertise":
            for each in found["channelIds"]:
                del self.channels[each]
        else:
            assert found["op"] == "status"
            self.status.append(found)


class Rig:
    """A recorder in simulated time, whose channels a real server shows on a real port."""

    def __init__(self, stalled_s: float = 10.0) -> None:
        self.runtime = Runtime(SimClock())
        self.air = Air(self.runtime)
        self.channels = Channels("a swarm", "session 1", self.runtime.now_s)
        self.recorder = Recorder(self.air, Keys("s"), self.runtime, self.channels, START_NS, flush_s=FLUSH_S)
        self.web = Web(self.channels, MonotonicClock().now_s, frozenset({"https://viewer.example"}), stalled_s)
        self.port = 0
        self.server: Server | None = None

    @contextlib.asynccontextmanager
    async def client(self, name: str = SUBPROTOCOLS[0], **options: Any) -> AsyncIterator[Client]:
        async with connect(
            f"ws://127.0.0.1:{self.port}", subprotocols=[websockets.Subprotocol(name)], proxy=None, **options
        ) as made:
            client = Client(made)
            known = len(self.channels._by_key)
            await client.until(lambda: bool(client.info) and len(client.channels) >= known)
            yield client


def on(rig: Rig, test: Callable[[Rig], Awaitable[None]]) -> None:
    """Run a test while the server serves."""

    async def run() -> None:
        with socket.create_server(("127.0.0.1", 0)) as listener:
            rig.port = listener.getsockname()[1]
            rig.server = server = uvicorn_server(rig.web.app())
            serving = asyncio.create_task(server.serve([listener]))
            try:
                async with asyncio.timeout(60):
                    await test(rig)
            finally:
                server.should_exit = True
                await serving

    asyncio.run(run())


def health(robot: str, **values: Any) -> HealthReport:
    known = {"driver": "null://", "make": "null", "model": "", "firmware": "", "lifecycle": "READY"}
    row = RobotHealth(robot=robot, **known | values)
    return HealthReport(host=robot, process=f"{robot}-1", version="1", robots=(row,))


def say_all(air: Air) -> None:
    air.say("s/state/all/r1", states(1.0))
    air.say("s/health/r1", health("r1", battery=0.5, behaviour="flocking"))
    air.say("s/obstacles/r1", SeenObstacles(host="r1", rows=((1.0, 2.0, 0.5, 0.25, 0.0, 0.1),), stamp_s=0.0))
    air.say("s/camera/hall", CameraPicture(camera="hall", jpeg=b"\xff\xd8"))


def decoded(channel: dict[str, Any], data: bytes) -> Any:
    """Return a message, checked against the schema that was announced with its channel."""
    if channel["encoding"] == "json":
        schema = json.loads(channel["schema"])
        found = json.loads(data)
        jsonschema.Draft202012Validator(schema).validate(found)
        return found
    schema = McapSchema(1, base64.b64decode(channel["schema"]), "protobuf", channel["schemaName"])
    decoder = DecoderFactory().decoder_for("protobuf", schema)
    assert decoder is not None
    return decoder(data)


@pytest.mark.parametrize("name", SUBPROTOCOLS)
def test_a_client_gets_what_is_announced_and_it_fits_its_schema(name: str) -> None:
    async def test(rig: Rig) -> None:
        say_all(rig.air)
        rig.runtime.run(2 * FLUSH_S)
        async with rig.client(name) as client:
            assert client.socket.subprotocol == name
            assert client.info["capabilities"] == []
            assert (client.info["name"], client.info["sessionId"]) == ("a swarm", "session 1")
            topics = {each["topic"] for each in client.channels.values()}
            assert topics == {
                "/state/all/r1", "/health/r1", "/obstacles/r1", "/camera/hall", "/tf", "/scene", "/robots",
            }  # fmt: skip
            await client.subscribe()
            await client.until(lambda: {each.topic for each in client.got} == topics)  # the last ones, at once
            old = len(client.got)
            say_all(rig.air)
            rig.runtime.run(1.0)
            await client.until(lambda: {each.topic for each in client.got[old:]} == topics)
            by_topic = {each["topic"]: each for each in client.channels.values()}
            found = {each.topic: decoded(by_topic[each.topic], each.data) for each in client.got}
            assert found["/state/all/r1"]["x_m"] == [1.0]
            assert found["/tf"].transforms[0].child_frame_id == "r1"
            assert [each.id for each in found["/scene"].entities] == ["robot r1", "obstacles"]
            (row,) = found["/robots"]["robots"]
            assert (row["robot"], row["x_m"], row["battery"], row["behaviour"]) == ("r1", 1.0, 0.5, "flocking")
            late_s = [1e-9 * (each.time_ns - START_NS) for each in client.got[old:]]
            assert all(2 * FLUSH_S <= each <= 1.2 for each in late_s)

    on(Rig(), test)


def test_a_recording_and_a_view_have_the_same_channels(tmp_path: Path) -> None:
    rig = Rig()
    recording = Recording(tmp_path / "run.mcap")
    beside = Air(rig.runtime)
    recorder = Recorder(beside, Keys("s"), rig.runtime, recording, START_NS)
    say_all(rig.air)
    say_all(beside)
    rig.runtime.run(2.0)
    recorder.close()
    with (tmp_path / "run.mcap").open("rb") as file:
        recorded = {
            (channel.topic, channel.message_encoding, schema.name, schema.encoding, schema.data)
            for schema, channel, _ in make_reader(file).iter_messages()
            if schema is not None
        }
    shown = set()
    for channel in rig.channels._by_id.values():
        each = {name: str(value) for name, value in channel.announcement.items()}
        raw = base64.b64decode(each["schema"]) if each["schemaEncoding"] == "protobuf" else each["schema"].encode()
        shown.add((each["topic"], each["encoding"], each["schemaName"], each["schemaEncoding"], raw))
    assert shown == recorded


def test_a_client_can_publish_nothing_and_is_told_so() -> None:
    async def test(rig: Rig) -> None:
        rig.air.say("s/state/all/r1", states(1.0))
        rig.runtime.run(FLUSH_S)
        async with rig.client() as client:
            refused: list[str | bytes] = [
                json.dumps({"op": "advertise", "channels": [{"id": 1, "topic": "/stop", "encoding": "json"}]}),
                struct.pack("<BI", 1, 1) + b"{}",
                json.dumps({"op": "setParameters", "parameters": [{"name": "a", "value": 1}]}),
                json.dumps({"op": "getParameters", "parameterNames": []}),
                struct.pack("<BII", 2, 1, 1) + b"json",
                json.dumps({"op": "fetchAsset", "uri": "file:///etc/passwd", "requestId": 1}),
            ]  # fmt: skip
            for number, frame in enumerate(refused, 1):
                await client.socket.send(frame)
                await client.until(lambda number=number: len(client.status) == number)  # type: ignore[misc]
            assert all("read-only" in each["message"] and each["level"] == 2 for each in client.status)
            await client.subscribe("/state/all/r1")
            await client.until(lambda: bool(client.got))  # and it still gets what there is

    on(Rig(), test)


def test_a_subscription_that_cannot_be_is_refused_and_one_ends_when_it_is_ended() -> None:
    async def test(rig: Rig) -> None:
        rig.air.say("s/state/all/r1", states(1.0))
        rig.runtime.run(FLUSH_S)
        async with rig.client() as client:
            number = next(each["id"] for each in client.channels.values() if each["topic"] == "/state/all/r1")
            once = {"id": number + 1000, "channelId": number}
            await client.say(
                op="subscribe", subscriptions=[once, {"id": 7, "channelId": number}, {"id": 8, "channelId": 99}]
            )
            await client.until(lambda: len(client.status) == 1 and len(client.got) == 1)
            (told,) = client.status
            assert told["message"] == f"channel {number} is subscribed already, and 1 more that cannot be"
            await client.say(op="unsubscribe", subscriptionIds=[once["id"], 4711])
            await client.say(op="unsubscribe", subscriptionIds="all")  # answered: what came before it is done
            await client.until(lambda: len(client.status) == 2)
            rig.air.say("s/state/all/r1", states(2.0))
            rig.runtime.run(FLUSH_S)
            await client.say(op="?")
            await client.until(lambda: len(client.status) == 3)
            assert len(client.got) == 1

    on(Rig(), test)


def test_garbage_harms_nobody_but_its_sender() -> None:
    chance = random.Random(5)
    words = ['{"op":"subscribe"', '"subscriptions":', "[", "]", "{", "}", '"id":', "1e999", "-1", "null", ",", "\x00"]
    frames: list[str | bytes] = [
        "",
        b"",
        "{}",
        "[" * 50_000,
        '{"op":"subscribe","subscriptions":[{"id":-1,"channelId":0}]}',
    ]
    frames += ["".join(chance.choices(words, k=chance.randrange(1, 12))) for _ in range(150)]
    frames += [chance.randbytes(chance.randrange(1, 2000)) for _ in range(150)]

    async def test(rig: Rig) -> None:
        rig.air.say("s/state/all/r1", states(1.0))
        rig.runtime.run(FLUSH_S)
        async with rig.client() as good, rig.client() as bad:
            await good.subscribe("/state/all/r1")
            for frame in frames:
                await bad.socket.send(frame)
            await bad.until(lambda: len(bad.status) == len(frames))
            with contextlib.suppress(websockets.ConnectionClosed):
                await bad.socket.send("x" * 2_000_000)
                await bad.until(lambda: False)
            assert bad.socket.close_code == 1009
            await good.until(lambda: len(good.got) == 1)
            async with rig.client() as flood:
                with contextlib.suppress(websockets.ConnectionClosed):
                    for _ in range(8000):
                        await flood.socket.send("?")
                    await flood.until(lambda: False)
                assert flood.socket.close_code == 1008
            async with rig.client() as flood:  # few frames that ask for much
                wanted = {"subscriptions": [{"id": each, "channelId": 9999} for each in range(3000)]}
                with contextlib.suppress(websockets.ConnectionClosed):
                    for _ in range(3):
                        await flood.say(op="subscribe", **wanted)
                    await flood.until(lambda: False)
                assert flood.socket.close_code == 1008
            rig.air.say("s/state/all/r1", states(2.0))
            rig.runtime.run(FLUSH_S)
            await good.until(lambda: len(good.got) == 2)

    on(Rig(), test)


def test_a_client_that_takes_nothing_is_closed_and_holds_nobody_up() -> None:
    async def test(rig: Rig) -> None:
        rig.channels.write("/big", "", PLAIN, START_NS, b"{}")
        async with rig.client() as good:
            await good.subscribe("/big")
            await good.until(lambda: len(good.got) == 1)
            asleep = await sleeper(rig)
            data = b'{"a":"' + b"x" * 100_000 + b'"}'
            took = MonotonicClock().now_s()
            for number in range(200):
                rig.channels.write("/big", "", PLAIN, START_NS + number, data)
                await good.until(lambda number=number: len(good.got) == number + 2)  # type: ignore[misc]
            assert MonotonicClock().now_s() - took < 5.0
            waiting = max(each.outbox._data_bytes for each in rig.channels.viewers)
            assert 0 < waiting <= ROOM_BYTES
            async with asyncio.timeout(PATIENCE_S):
                while len(rig.channels.viewers) > 1:
                    await asyncio.sleep(0.02)
            assert rig.server is not None
            async with asyncio.timeout(PATIENCE_S):
                while len(rig.server.server_state.connections) > 1:
                    await asyncio.sleep(0.02)
            asleep.close()
            rig.channels.write("/big", "", PLAIN, START_NS, b"{}")
            await good.until(lambda: len(good.got) == 202)

    on(Rig(stalled_s=0.5), test)


async def sleeper(rig: Rig) -> socket.socket:
    """Return the connection of a client that subscribes to all there is, and then reads nothing."""
    made = socket.create_connection(("127.0.0.1", rig.port))
    made.setblocking(False)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    loop = asyncio.get_running_loop()
    ask = (
        "GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Protocol: {SUBPROTOCOLS[0]}\r\n\r\n"
    )
    await loop.sock_sendall(made, ask.encode())
    answer = b""
    while b"\r\n\r\n" not in answer:
        answer += await loop.sock_recv(made, 1)
    text = json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 1}]}).encode()
    frame = bytes([0x81, 0x80 | len(text)]) + bytes(4) + text  # masked with zeros
    assert len(text) < 126
    await loop.sock_sendall(made, frame)
    async with asyncio.timeout(PATIENCE_S):
        while not any(each.wants(1) == 1 for each in rig.channels.viewers):
            await asyncio.sleep(0.01)
    return made


def test_idle_connections_and_too_many_viewers_keep_no_viewer_out_for_long() -> None:
    async def test(rig: Rig) -> None:
        idle: list[socket.socket] = []
        for _ in range(300):  # each says half a request, or nothing
            made = socket.create_connection(("127.0.0.1", rig.port))
            made.send(b"GET / HTTP/1.1\r\nHost:"[: len(idle) % 22])
            idle.append(made)
            await asyncio.sleep(0)
        async with contextlib.AsyncExitStack() as stack:
            viewers = [await stack.enter_async_context(rig.client()) for _ in range(MOST_VIEWERS)]
            with pytest.raises(websockets.ConnectionClosed):
                await stack.enter_async_context(rig.client())
            await viewers[0].socket.close()
            async with asyncio.timeout(PATIENCE_S):
                while len(rig.channels.viewers) == MOST_VIEWERS:
                    await asyncio.sleep(0.01)
            await stack.enter_async_context(rig.client())
        for each in idle:
            each.close()

    on(Rig(), test)


@pytest.mark.parametrize(
    ("origin", "allowed"),
    [
        ("https://app.foxglove.dev", True), ("file://", True), ("http://localhost:8080", True),
        ("http://[::1]:8080", True), ("https://viewer.example", True), ("https://app.foxglove.dev.evil.example", False),
        ("https://evil.example", False), ("null", False), ("http://[", False), ("http://localhost.evil.example", False),
    ],
)  # fmt: skip
def test_only_pages_of_known_origins_may_read(origin: str, allowed: bool) -> None:
    async def test(rig: Rig) -> None:
        headers = {"Origin": origin}
        if allowed:
            async with rig.client(additional_headers=headers):
                return
        with pytest.raises(websockets.InvalidStatus) as refused:
            async with rig.client(additional_headers=headers):
                pass
        assert refused.value.response.status_code == 403
        assert b"--allow-origin" in (refused.value.response.body or b"")

    on(Rig(), test)


def test_another_protocol_is_refused_with_the_names_of_the_right_ones() -> None:
    async def test(rig: Rig) -> None:
        with pytest.raises(websockets.InvalidStatus) as refused:
            async with rig.client("rosbridge.v2"):
                pass
        assert refused.value.response.status_code == 400
        assert SUBPROTOCOLS[0].encode() in (refused.value.response.body or b"")

    on(Rig(), test)


def test_invented_keys_fill_neither_the_memory_nor_the_list_for_ever() -> None:
    clock = SimClock()
    channels = Channels("a", "1", clock.now_s)
    viewer = Viewer(Outbox(clock.now_s))
    channels.viewers.append(viewer)
    for number in range(MOST_CHANNELS + 5):
        channels.write(f"/t{number}", "", PLAIN, START_NS, b"{}")
    assert (len(channels._by_id), channels.refused) == (MOST_CHANNELS, 5)
    assert viewer.subscribe(1, 1) == ""
    clock.advance_to(KEPT_S + 1.0)
    channels.write("/t1", "", PLAIN, START_NS, b"{}")
    channels.write("/new", "", PLAIN, START_NS, b"x" * (LATCHED_BYTES + 1))
    assert (len(channels._by_id), channels.refused) == (MOST_CHANNELS, 5)
    assert ("/t0", "plain") not in channels._by_key
    assert ("/t1", "plain") in channels._by_key
    assert viewer.wants(1) is None  # its channel is closed
    assert channels._by_key["/new", "plain"].last is None


def test_what_waits_for_a_client_is_bounded_and_the_oldest_goes_first() -> None:
    clock = SimClock()
    outbox = Outbox(clock.now_s)
    for number in range(2000):
        outbox.data(b"%06d" % number + b"x" * 10_000)
    assert outbox._data_bytes <= ROOM_BYTES
    assert outbox._data[-1][:6] == b"001999"
    assert outbox.lost == 2000 - len(outbox._data)
    assert [json.loads(each)["message"] for each in outbox._control] == ["Send buffer limit reached"]
    for _ in range(400):
        outbox.control({"op": "advertise", "channels": ["x" * 100_000]})
    assert outbox.overrun
    assert not outbox._data
    assert not outbox._control
