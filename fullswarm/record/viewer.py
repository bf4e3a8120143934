"""Shows a live swarm to Foxglove, Lichtblick and other clients of the Foxglove WebSocket protocol.

The channels are those of a recording, because the same :class:`~fullswarm.record.recorder.Recorder` fills them. Clients
can subscribe, and nothing else: the server announces no capability. What each client may keep waiting is bounded; a
client that is slow loses its oldest messages, and one that takes nothing is closed.

Protocol: https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md. Its two names mean the same.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import struct
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any
from urllib.parse import urlsplit

import msgspec
import structlog
from msgspec import Meta
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from fullswarm.bus.endpoint import is_loopback
from fullswarm.operator.console.access import Bucket
from fullswarm.record.recording import Schema

log = structlog.get_logger()

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
FOXGLOVE = "https://app.foxglove.dev"
DESKTOP = "file://"
"""Origin of pages that are files on this computer, as those of the desktop applications are."""

MOST_VIEWERS = 16
MOST_CHANNELS = 4000
KEPT_S = 60.0
"""A channel that was used this recently does not make room for a new one."""
LATCHED_BYTES = 4096
"""The last message of each channel goes to a new subscriber, if it is no longer: much is sent on change only."""

ROOM_BYTES = 8_000_000
"""Messages that wait for one client at most."""
CONTROL_BYTES = 32_000_000
"""Announcements that wait for one client at most: all channels once take less."""
STALLED_S = 10.0
"""A client that takes nothing for this long is closed."""
NOTICE_S = 5.0
"""From one notice about lost messages to the next."""
RATE_HZ, BURST = 50.0, MOST_CHANNELS + 1000.0
"""Of what a client asks for: subscriptions that it begins or ends, and other frames."""
LOGGED_ORIGINS = 32

TOO_MANY, POLICY = 1013, 1008
"""Closing codes: try again later, and a limit that was exceeded (RFC 6455 and its registry)."""
MESSAGE_DATA = struct.Struct("<BIQ")
"""Operation 1, subscription, nanoseconds since 1970; the message follows."""
WARNING, ERROR = 1, 2

Id = Annotated[int, Meta(ge=0, le=0xFFFFFFFF)]


class _Subscription(msgspec.Struct, frozen=True, rename="camel"):
    id: Id
    channel_id: Id


class _Subscribe(msgspec.Struct, frozen=True, tag_field="op", tag="subscribe"):
    subscriptions: Annotated[tuple[_Subscription, ...], Meta(max_length=MOST_CHANNELS)]


class _Unsubscribe(msgspec.Struct, frozen=True, tag_field="op", tag="unsubscribe", rename="camel"):
    subscription_ids: Annotated[tuple[Id, ...], Meta(max_length=MOST_CHANNELS)]


_decoder: msgspec.json.Decoder[_Subscribe | _Unsubscribe] = msgspec.json.Decoder(_Subscribe | _Unsubscribe)


@dataclass(slots=True)
class Channel:
    """A topic with one schema."""

    id: int
    announcement: dict[str, object]
    used_s: float
    last: tuple[int, bytes] | None = None  # time in ns, message


class Outbox:
    """Frames that wait for one client, from the recorder's callbacks to the task that sends.

    Attributes
    ----------
    overrun : the client is too slow, nothing more is kept for it
    lost : messages that were dropped because others waited
    sending_s : since when the present frame waits for the client to take it; None: none does
    """

    def __init__(self, now_s: Callable[[], float]) -> None:
        self.overrun, self.lost = False, 0
        self.sending_s: float | None = None
        self._now_s, self._noticed_s = now_s, -NOTICE_S
        self._control: deque[str] = deque()
        self._data: deque[bytes] = deque()
        self._control_bytes = self._data_bytes = 0
        self._wake = asyncio.Event()

    def control(self, frame: Mapping[str, object]) -> None:
        """Keep a frame that must not be lost."""
        if self.overrun:
            return
        text = json.dumps(frame, separators=(",", ":"))
        self._control.append(text)
        self._control_bytes += len(text)
        if self._control_bytes > CONTROL_BYTES:
            self.overrun = True
            self._control.clear()
            self._data.clear()
        self._wake.set()

    def data(self, frame: bytes) -> None:
        """Keep a message; the oldest ones make room."""
        if self.overrun:
            return
        self._data.append(frame)
        self._data_bytes += len(frame)
        lost = self.lost
        while self._data_bytes > ROOM_BYTES:
            self._data_bytes -= len(self._data.popleft())
            self.lost += 1
        now_s = self._now_s()
        if self.lost > lost and now_s - self._noticed_s >= NOTICE_S:
            self._noticed_s = now_s
            self.control(status(WARNING, "Send buffer limit reached"))  # Lichtblick explains just these words
        self._wake.set()

    async def run(self, websocket: WebSocket) -> None:
        """Send until the client is too slow."""
        while not self.overrun:
            if self._control:
                text = self._control.popleft()
                self._control_bytes -= len(text)
                await self._sent(websocket.send_text(text))
            elif self._data:
                frame = self._data.popleft()
                self._data_bytes -= len(frame)
                await self._sent(websocket.send_bytes(frame))
            else:
                self._wake.clear()
                await self._wake.wait()

    async def _sent(self, sending: Any) -> None:
        self.sending_s = self._now_s()
        await sending
        self.sending_s = None


class Viewer:
    """One client: what it has subscribed to."""

    def __init__(self, outbox: Outbox) -> None:
        self.outbox = outbox
        self._by_channel: dict[int, int] = {}  # channel → subscription
        self._by_subscription: dict[int, int] = {}

    def wants(self, channel: int) -> int | None:
        """Return its subscription to a channel."""
        return self._by_channel.get(channel)

    def subscribe(self, subscription: int, channel: int) -> str:
        """Begin a subscription; return why not: a channel has one, and a subscription one channel."""
        if channel in self._by_channel:
            return f"channel {channel} is subscribed already"
        if subscription in self._by_subscription:
            return f"subscription {subscription} is in use"
        self._by_channel[channel], self._by_subscription[subscription] = subscription, channel
        return ""

    def unsubscribe(self, subscription: int) -> None:
        """End a subscription; one that is none is ignored."""
        self._by_channel.pop(self._by_subscription.pop(subscription, -1), None)

    def forget(self, channel: int) -> None:
        """End the subscription to a channel that is closed."""
        self._by_subscription.pop(self._by_channel.pop(channel, -1), None)


class Channels:
    """The channels of a live swarm and the clients that subscribe: a recorder writes into it as into a recording.

    A topic that several processes publish is one channel here, because Lichtblick shows one channel of each topic.

    Parameters
    ----------
    session : names this start of the server, so that clients forget what an earlier one sent

    Attributes
    ----------
    refused : messages for which there was no more channel
    viewers : the clients
    """

    def __init__(self, name: str, session: str, now_s: Callable[[], float]) -> None:
        self.refused = 0
        self.viewers: list[Viewer] = []
        self._now_s, self._numbers = now_s, iter(range(1, 0xFFFFFFFF))
        self._info = {"op": "serverInfo", "name": name, "capabilities": [], "metadata": {}, "sessionId": session}
        self._by_key: OrderedDict[tuple[str, str], Channel] = OrderedDict()  # by topic and schema, the newest last
        self._by_id: dict[int, Channel] = {}

    def join(self, viewer: Viewer) -> None:
        """Greet a client and announce all channels."""
        viewer.outbox.control(self._info)
        for some in _batches([each.announcement for each in self._by_key.values()]):
            viewer.outbox.control({"op": "advertise", "channels": some})
        self.viewers.append(viewer)

    def leave(self, viewer: Viewer) -> None:
        """Forget a client."""
        self.viewers.remove(viewer)

    def handle(self, viewer: Viewer, text: str | bytes) -> int:
        """Carry out what a client sends; return how many things that were.

        What is none of a subscriber's operations is answered with an error, as is the first of subscriptions that
        cannot be.
        """
        try:
            found = _decoder.decode(text) if isinstance(text, str) else None
        except (msgspec.DecodeError, UnicodeError):
            found = None
        if found is None:
            viewer.outbox.control(status(ERROR, "this server is read-only: it takes subscribe and unsubscribe"))
            return 1
        if isinstance(found, _Unsubscribe):
            for each in found.subscription_ids:
                viewer.unsubscribe(each)
            return len(found.subscription_ids)
        problems = [problem for each in found.subscriptions if (problem := self._subscribe(viewer, each))]
        if problems:
            more = f", and {len(problems) - 1} more that cannot be" if len(problems) > 1 else ""
            viewer.outbox.control(status(ERROR, problems[0] + more))
        return len(found.subscriptions)

    def _subscribe(self, viewer: Viewer, wanted: _Subscription) -> str:
        channel = self._by_id.get(wanted.channel_id)
        if channel is None:
            return f"there is no channel {wanted.channel_id}"
        problem = viewer.subscribe(wanted.id, channel.id)
        if not problem and channel.last is not None:
            viewer.outbox.data(MESSAGE_DATA.pack(1, wanted.id, channel.last[0]) + channel.last[1])
        return problem

    # ------------------------------------------------------------------ as a recorder's sink
    def write(self, topic: str, _sender: str, schema: Schema, time_ns: int, data: bytes) -> None:
        """Send a message to the clients that have subscribed to its channel."""
        channel = self._by_key.get((topic, schema.name))
        if channel is None:
            channel = self._open(topic, schema)
            if channel is None:
                self.refused += 1
                return
        else:
            self._by_key.move_to_end((topic, schema.name))
        channel.used_s = self._now_s()
        channel.last = (time_ns, data) if len(data) <= LATCHED_BYTES else None
        for viewer in self.viewers:
            subscription = viewer.wants(channel.id)
            if subscription is not None:
                viewer.outbox.data(MESSAGE_DATA.pack(1, subscription, time_ns) + data)

    def flush(self) -> None:
        """Do nothing: frames are sent as the clients take them."""

    def attach(self, name: str, media_type: str, time_ns: int, data: bytes) -> None:
        """Do nothing: viewers have no attachments."""

    def note(self, name: str, values: Mapping[str, str]) -> None:
        """Log what an end says."""
        log.info("the view has ended", what=name, **values)

    def close(self) -> None:
        """Do nothing: the server closes its connections."""

    def abandon(self) -> None:
        """Do nothing: there is no file."""

    def _open(self, topic: str, schema: Schema) -> Channel | None:
        if len(self._by_key) >= MOST_CHANNELS and not self._make_room():
            return None
        number = next(self._numbers)
        text = base64.b64encode(schema.data) if schema.encoding == "protobuf" else schema.data
        announcement = {
            "id": number, "topic": topic, "encoding": schema.messages, "schemaName": schema.name,
            "schemaEncoding": schema.encoding, "schema": text.decode(),
        }  # fmt: skip
        channel = Channel(number, announcement, self._now_s())
        self._by_key[topic, schema.name] = self._by_id[number] = channel
        for viewer in self.viewers:
            viewer.outbox.control({"op": "advertise", "channels": [announcement]})
        return channel

    def _make_room(self) -> bool:
        key, oldest = next(iter(self._by_key.items()))
        if self._now_s() - oldest.used_s < KEPT_S:
            return False
        del self._by_key[key], self._by_id[oldest.id]
        for viewer in self.viewers:
            viewer.forget(oldest.id)
            viewer.outbox.control({"op": "unadvertise", "channelIds": [oldest.id]})
        return True


def status(level: int, text: str) -> dict[str, object]:
    """Return a message about the connection itself."""
    return {"op": "status", "level": level, "message": text}


def _batches(channels: list[dict[str, object]], most: int = 100) -> Iterator[list[dict[str, object]]]:
    for start in range(0, len(channels), most):
        yield channels[start : start + most]


# ---------------------------------------------------------------- the server
@dataclass(slots=True)
class Web:
    """Serves the clients.

    Parameters
    ----------
    origins : of web pages that may connect, beside Foxglove's own, this computer's and files
    """

    channels: Channels
    now_s: Callable[[], float]
    origins: frozenset[str] = frozenset()
    stalled_s: float = STALLED_S
    _refused: set[str] = field(default_factory=set)

    def app(self) -> Starlette:
        """Return the ASGI application."""
        return Starlette(routes=[Route("/", self._page), WebSocketRoute("/", self.socket)])

    async def _page(self, _request: Request) -> Response:
        return PlainTextResponse("This is a Foxglove WebSocket: open its address in Foxglove or Lichtblick.\n", 426)

    async def socket(self, websocket: WebSocket) -> None:
        """Serve one client until it leaves."""
        offered = websocket.scope["subprotocols"]
        chosen = next((each for each in SUBPROTOCOLS if each in offered), None)
        reason = self._refuses(websocket.headers.getlist("origin"))
        if reason or chosen is None:
            text = reason or f"expected one of the subprotocols {', '.join(SUBPROTOCOLS)}"
            await websocket.send_denial_response(PlainTextResponse(text, 403 if reason else 400))
            return
        await websocket.accept(subprotocol=chosen)
        with contextlib.suppress(WebSocketDisconnect):
            if len(self.channels.viewers) >= MOST_VIEWERS:
                await websocket.close(TOO_MANY, "too many viewers are connected")
                return
            websocket.state.admission.leave()
            await self._serve(websocket)

    def _refuses(self, origins: list[str]) -> str:
        """Return why a page of this origin may not connect: else every web page could read the swarm."""
        if not origins:  # no browser
            return ""
        origin = origins[0].lower()
        with contextlib.suppress(ValueError):
            if len(origins) == 1 and (
                origin in (FOXGLOVE, DESKTOP) or origin in self.origins or is_loopback(urlsplit(origin).hostname or "")
            ):
                return ""
        if origin not in self._refused and len(self._refused) < LOGGED_ORIGINS:
            self._refused.add(origin)
            log.warning("refused a web page", origin=origin[:200], remedy="--allow-origin, if it is your viewer")
        return "Forbidden: a page of this origin may not connect; allow it with --allow-origin"

    async def _serve(self, websocket: WebSocket) -> None:
        outbox = Outbox(self.now_s)
        viewer = Viewer(outbox)
        self.channels.join(viewer)
        tasks = {
            asyncio.create_task(outbox.run(websocket)),
            asyncio.create_task(self._listen(websocket, viewer)),
            asyncio.create_task(self._stalls(outbox)),
        }
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self.channels.leave(viewer)
            for task in tasks:
                task.cancel()
            results = await asyncio.gather(*tasks, return_exceptions=True)
        if outbox.sending_s is not None or outbox.overrun:
            websocket.state.admission.cut()  # a frame that says why would wait behind what it does not take
        ended = websocket.application_state is not WebSocketState.CONNECTED
        for result in results:
            # Sending what still waited after the closing is no error.
            if isinstance(result, Exception) and not isinstance(result, WebSocketDisconnect) and not ended:
                raise result

    async def _listen(self, websocket: WebSocket, viewer: Viewer) -> None:
        """Carry out a client's frames until it leaves or sends too many."""
        bucket = Bucket(RATE_HZ, BURST)
        while True:
            message = await websocket.receive()
            if message["type"] == "websocket.disconnect":
                raise WebSocketDisconnect(message.get("code", 1005))
            text = message.get("text")
            count = self.channels.handle(viewer, message["bytes"] if text is None else text)
            if not all(bucket.take(self.now_s()) for _ in range(max(1, count))):
                await _close(websocket, POLICY, "too many frames")
                return

    async def _stalls(self, outbox: Outbox) -> None:
        """Return when the client has taken nothing for too long."""
        while outbox.sending_s is None or self.now_s() - outbox.sending_s < self.stalled_s:
            await asyncio.sleep(self.stalled_s / 5.0)


async def _close(websocket: WebSocket, code: int, reason: str) -> None:
    if websocket.application_state is WebSocketState.CONNECTED:
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):  # closed by the client meanwhile
            await websocket.close(code, reason)
