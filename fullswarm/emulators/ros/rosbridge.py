"""The base behind a rosbridge_server: JSON over a websocket, as ROSBRIDGE_PROTOCOL.md describes it.

The websocket is the server's side of the `websockets` library without I/O, over the TCP port of all emulators.
"""

from __future__ import annotations

import dataclasses
import json
import math
from typing import Any

from fullswarm.emulators.ros.firmware import Base
from fullswarm.errors import MissingExtra


def library() -> Any:
    """Return the `websockets` package; ``MissingExtra`` if it is not installed."""
    try:
        import websockets.frames
        import websockets.http11
        import websockets.protocol
        import websockets.server
    except ImportError as error:
        raise MissingExtra(
            "an emulated rosbridge needs the package websockets", hint="pip install 'fullswarm[ros]'"
        ) from error
    return websockets


class Rosbridge:
    """The base as firmware behind one TCP port."""

    def __init__(self, base: Base) -> None:
        self.base, self._library = base, library()
        self.hung_up(0)

    def hung_up(self, _port: int) -> None:
        """Wait for the next client, who has subscribed to nothing."""
        self._socket = self._library.server.ServerProtocol()
        self._out: list[bytes] = []
        self._subscribed: dict[str, str] = {}
        self._advertised: dict[str, str] = {}
        self._broken = False

    @property
    def next_due_s(self) -> float:
        """When the motors are due."""
        return self.base.due_s

    def receive(self, data: bytes, now_s: float, _port: int) -> None:
        """Take bytes."""
        if self._broken:
            return
        self._socket.receive_data(data)
        for event in self._socket.events_received():
            if isinstance(event, self._library.http11.Request):
                self._socket.send_response(self._socket.accept(event))
            elif event.opcode is self._library.frames.Opcode.TEXT:
                self._operation(bytes(event.data), now_s)
        self._broken = self._socket.parser_exc is not None or self._socket.handshake_exc is not None
        self._flush()

    def _operation(self, text: bytes, now_s: float) -> None:
        try:
            message = json.loads(text)
            getattr(self, f"_op_{message['op']}")(message, now_s)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            self._say({"op": "status", "level": "error", "msg": f"{type(error).__name__}: {error}"})

    def _op_advertise(self, message: dict[str, Any], _now_s: float) -> None:
        self._advertised[message["topic"]] = message["type"]

    def _op_subscribe(self, message: dict[str, Any], _now_s: float) -> None:
        topic = message["topic"]
        kind = self.base.options.published.get(topic.removeprefix("/"))
        if "type" in message and kind is not None and message["type"] != kind:
            raise ValueError(f"Tried to register topic {topic} with type {message['type']} but it is {kind}")
        self._subscribed[topic] = str(message.get("type", kind))

    def _op_publish(self, message: dict[str, Any], now_s: float) -> None:
        options, topic = self.base.options, message["topic"]
        if self._advertised.get(topic) != options.command_type or topic != f"/{options.cmd}":
            return
        types = self.base.store.types
        fields = message["msg"]["twist"] if options.stamped else message["msg"]
        vector = types["geometry_msgs/msg/Vector3"]
        twist = types["geometry_msgs/msg/Twist"](
            linear=vector(**{key: float(value) for key, value in fields["linear"].items()}),
            angular=vector(**{key: float(value) for key, value in fields["angular"].items()}),
        )
        if not options.stamped:
            self.base.command(twist, now_s)
            return
        stamp = message["msg"]["header"].get("stamp", {"sec": 0, "nanosec": 0})  # rosbridge puts its own time in
        header = types["std_msgs/msg/Header"](stamp=types["builtin_interfaces/msg/Time"](**stamp), frame_id="")
        self.base.command(types[options.command_type](header=header, twist=twist), now_s)

    def step(self, now_s: float) -> bool:
        """Go on to `now_s`."""
        for topic, message in self.base.step(now_s):
            if f"/{topic}" in self._subscribed:
                self._say({"op": "publish", "topic": f"/{topic}", "msg": as_json(message)})
                self._flush()
        return False

    def take(self, _port: int) -> list[bytes]:
        """Return the bytes to send, a message each."""
        out, self._out = self._out, []
        return out

    def _say(self, message: dict[str, Any]) -> None:
        if self._socket.state is self._library.protocol.State.OPEN:
            self._socket.send_text(json.dumps(message).encode())

    def _flush(self) -> None:
        self._out += [each for each in self._socket.data_to_send() if each]


def as_json(value: Any) -> Any:
    """Return a message of rosbags as rosbridge's JSON has it; numbers that are not finite become null."""
    if dataclasses.is_dataclass(value):
        return {each.name: as_json(getattr(value, each.name)) for each in dataclasses.fields(value)
                if not each.name.startswith("__")}  # fmt: skip
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if hasattr(value, "tolist"):
        return as_json(value.tolist())
    return [as_json(each) for each in value] if isinstance(value, list) else value
