"""A base's topics over rosbridge: JSON in the text frames of a websocket (rosbridge protocol 2, ROSBRIDGE_PROTOCOL.md).

The websocket is that of the `websockets` library, without its I/O: bytes in, bytes out. Extra: ``pip install
'fullswarm[ros]'``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec

from fullswarm.drivers.base import STAND, Twist
from fullswarm.drivers.guardian import StopPlan
from fullswarm.drivers.ros import protocol as p
from fullswarm.drivers.ros.settings import Settings
from fullswarm.drivers.ros.zenoh_wire import command_type, subscribed
from fullswarm.errors import LinkLost, MessageError, MissingExtra

STOPS_S = (0.0, 0.05, 0.1, 0.2)
LONGEST_STATUS = 200


class _Incoming(msgspec.Struct):
    op: str
    topic: str = ""
    msg: msgspec.Raw = msgspec.Raw()
    level: str = ""


_decoder = msgspec.json.Decoder(_Incoming)


def library() -> Any:
    """Return the `websockets` package.

    Raises
    ------
    MissingExtra
        It is not installed.
    """
    try:
        import websockets.client
        import websockets.frames
        import websockets.protocol
        import websockets.uri
    except ImportError as error:
        raise MissingExtra(
            "rosbridge needs the package websockets", where="ros://ws", hint="pip install 'fullswarm[ros]'"
        ) from error
    return websockets


class RosbridgeWire:
    """Messages ↔ bytes of the TCP connection to a rosbridge_server."""

    streams = True

    def __init__(self, settings: Settings) -> None:
        self._settings, self._library = settings, library()
        self._kinds = {f"/{name}": kind for name, kind in subscribed(settings)}
        self._command = f"/{settings.topics.cmd}"
        self.trouble = ""
        """What rosbridge has complained about last."""
        frames = self._library.frames
        stop = msgspec.json.encode(self._published(STAND, 0.0 if settings.stamped else None))
        frame = frames.Frame(frames.Opcode.TEXT, stop).serialize(mask=True)
        self.stop_plan = StopPlan(tuple((after_s, frame) for after_s in STOPS_S))
        self.linked()

    def linked(self) -> None:
        """Begin anew: the connection is open; ask for the websocket."""
        websockets = self._library
        uri = websockets.uri.parse_uri(f"ws://{self._settings.host}:{self._settings.port}/")
        self._socket = websockets.client.ClientProtocol(uri, max_size=p.LARGEST_BYTES)
        self._socket.send_request(self._socket.connect())
        self._parts: list[bytes] = []
        self._open, self.trouble = False, ""

    def received(self, chunk: bytes) -> Sequence[p.Report]:
        """Return the reports that are whole now.

        Raises
        ------
        LinkLost
            The other end is no websocket, breaks its protocol, or closes.
        MessageError
            One message is not what its topic's type is; those before it are lost as well.
        """
        websockets = self._library
        self._socket.receive_data(chunk)
        reports: list[p.Report] = []
        for event in self._socket.events_received():
            if not self._open:
                self._greet()
            elif isinstance(event, websockets.frames.Frame):
                reports += self._frame(event)
        if self._socket.parser_exc is not None or self._socket.handshake_exc is not None:
            error = self._socket.handshake_exc or self._socket.parser_exc
            raise LinkLost(f"no rosbridge answers there: {error}", where=self._settings.where)
        return reports

    def _greet(self) -> None:
        """Ask for the topics once the websocket is there."""
        if self._socket.handshake_exc is not None:
            return
        self._open = True
        self._say({"op": "advertise", "topic": self._command, "type": command_type(self._settings), "queue_size": 1})
        for name, kind in self._kinds.items():
            self._say({"op": "subscribe", "topic": name, "type": kind, "queue_length": 1})

    def _frame(self, frame: Any) -> Sequence[p.Report]:
        opcodes = self._library.frames.Opcode
        if frame.opcode is opcodes.CLOSE:
            raise LinkLost("rosbridge closed the connection", where=self._settings.where)
        if frame.opcode not in (opcodes.TEXT, opcodes.CONT):
            return ()
        self._parts.append(bytes(frame.data))
        if not frame.fin:
            if sum(map(len, self._parts)) > p.LARGEST_BYTES:
                raise LinkLost("rosbridge sends a message without end", where=self._settings.where)
            return ()
        text, self._parts = b"".join(self._parts), []
        return self._message(text)

    def _message(self, text: bytes) -> Sequence[p.Report]:
        try:
            message = _decoder.decode(text)
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            raise MessageError(f"no message of rosbridge: {error}") from error
        if message.op == "publish" and message.topic in self._kinds:
            return (p.read_json(self._kinds[message.topic], bytes(message.msg)),)
        if message.op == "status" and message.level in ("error", "warning"):
            self.trouble = bytes(message.msg).decode(errors="replace")[:LONGEST_STATUS]
        return ()

    def outgoing(self) -> Sequence[bytes]:
        """Return what the websocket has to send: its handshake, subscriptions, pongs."""
        return [each for each in self._socket.data_to_send() if each]

    def drive(self, twist: Twist, stamp_s: float | None) -> bytes:
        """Return a command as bytes to send; empty before the websocket is there."""
        if not self._open:
            return b""
        self._say(self._published(twist, stamp_s))
        return b"".join(self._socket.data_to_send())

    def farewell(self) -> Sequence[bytes]:
        """Return what ends the websocket."""
        if self._open and self._socket.state is self._library.protocol.State.OPEN:
            self._socket.send_close(1001)
        return self.outgoing()

    def _published(self, twist: Twist, stamp_s: float | None) -> dict[str, object]:
        return {"op": "publish", "topic": self._command, "msg": p.twist_json(twist, stamp_s)}

    def _say(self, message: dict[str, object]) -> None:
        if self._socket.state is self._library.protocol.State.OPEN:
            self._socket.send_text(msgspec.json.encode(message))
