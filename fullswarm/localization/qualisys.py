"""Qualisys Track Manager's real-time protocol as a source, through Qualisys' own package `qtm-rt`."""

from __future__ import annotations

import asyncio
import importlib.util
import logging
import math
import struct
import threading
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit
from xml.etree.ElementTree import ParseError, fromstring

from fullswarm.clock import Clock
from fullswarm.errors import MissingExtra
from fullswarm.localization.links import CONNECT_S, RETRY_S
from fullswarm.localization.sighting import Body, Frame, Refused
from fullswarm.localization.source import Receiver, Seen

if TYPE_CHECKING:
    from qtm_rt import QRTConnection, QRTPacket

PORT = 22223
"""QTM's base port is 22222; little-endian clients use the next one."""
VERSION = "1.22"
SETTINGS_CHANGED = "EventCameraSettingsChanged"
"""What QTM sends when bodies were added or renamed."""


class QualisysSource:
    """``qualisys://HOST[:22223]``.

    Raises
    ------
    MissingExtra
        `qtm-rt` is not installed.
    """

    sensor = "mocap qualisys"
    hint = "does QTM measure or play with real-time output, and are there 6DOF bodies?"

    def __init__(self, url: str, clock: Clock) -> None:
        if importlib.util.find_spec("qtm_rt") is None:
            raise MissingExtra("`qtm-rt` is not installed", hint="pip install 'fullswarm[mocap]'")
        parts = urlsplit(url)
        self._host, self._port = parts.hostname or "", parts.port or PORT
        self.address = url
        self._clock = clock
        self._loop = asyncio.new_event_loop()
        self._closing: asyncio.Event | None = None
        self._thread: threading.Thread | None = None

    def start(self, receiver: Receiver) -> None:
        """Deliver to `receiver` from now on."""
        logging.getLogger("qtm_rt").setLevel(logging.CRITICAL)  # the node reports troubles itself
        self._closing = asyncio.Event()
        self._thread = threading.Thread(target=self._run, args=(receiver, self._closing), name="fixes", daemon=True)
        self._thread.start()

    def _run(self, receiver: Receiver, closing: asyncio.Event) -> None:
        self._loop.set_exception_handler(lambda *_: None)  # a stream that qtm-rt cannot read; it is opened again
        self._loop.run_until_complete(self._keep(receiver, closing))
        self._loop.close()

    async def _keep(self, receiver: Receiver, closing: asyncio.Event) -> None:
        import qtm_rt
        from qtm_rt.protocol import QRTCommandException

        while not closing.is_set():
            lost = asyncio.Event()
            lose = _setter(lost)
            why = "no answer"
            connection: QRTConnection | None = None
            try:
                connecting = qtm_rt.connect(
                    self._host, self._port, version=VERSION, timeout=CONNECT_S, on_disconnect=lose, on_event=lose
                )
                connection = await asyncio.wait_for(connecting, 2.0 * CONNECT_S)
                if connection is not None:
                    receiver.report("")
                    await self._stream(connection, receiver, closing, lost)
                    why = "QTM has closed the connection"
            except TimeoutError:
                pass
            except (QRTCommandException, OSError, ParseError, ValueError) as error:
                why = str(error)
            finally:
                if connection is not None and connection.has_transport():
                    connection.disconnect()
            if not closing.is_set():
                receiver.report(f"no connection to {self.address}: {why}")
                await _either(RETRY_S, closing)

    async def _stream(
        self, connection: QRTConnection, receiver: Receiver, closing: asyncio.Event, lost: asyncio.Event
    ) -> None:
        names = parse_names(await connection.get_parameters(parameters=["6d"]))

        def on_packet(packet: QRTPacket) -> None:
            receiver.arrive(self._clock.now_s(), self._host, read_packet(packet, names))

        await connection.stream_frames(components=["6dres"], on_packet=on_packet)
        await _either(math.inf, closing, lost)

    def read(self, content: bytes) -> Iterable[Seen]:
        """Parse nothing: the link delivers frames."""
        del content
        return ()

    def close(self) -> None:
        """Stop delivering."""
        if self._thread is not None and self._closing is not None:
            self._loop.call_soon_threadsafe(self._closing.set)
            self._thread.join()
        elif not self._loop.is_closed():
            self._loop.close()


def _setter(event: asyncio.Event) -> Callable[[Any], None]:
    """Return what sets an event at the end of a connection, and when QTM's settings have changed."""

    def lose(why: Any) -> None:
        if getattr(why, "name", SETTINGS_CHANGED) == SETTINGS_CHANGED:
            event.set()

    return lose


async def _either(longest_s: float, *events: asyncio.Event) -> None:
    """Wait until one of the events is set, or for a time."""
    waiting = [asyncio.ensure_future(each.wait()) for each in events]
    timeout = None if math.isinf(longest_s) else longest_s
    _, pending = await asyncio.wait(waiting, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
    for each in pending:
        each.cancel()


def parse_names(parameters: bytes) -> list[str]:
    """Return the names of the bodies that are enabled, in their order, from QTM's parameters.

    Raises
    ------
    ParseError, ValueError
        They are no XML, or XML with definitions of its own.
    """
    if b"<!" in parameters:
        raise ValueError("QTM's parameters have definitions of their own")
    bodies = fromstring(parameters).iter("Body")  # noqa: S314  (without definitions it is harmless)
    return [
        (body.findtext("Name") or "").strip()
        for body in bodies
        if (body.findtext("Enabled") or "true").strip().lower() != "false"
    ]


def read_packet(packet: Any, names: list[str]) -> Frame | Refused:
    """Return a packet of `qtm-rt` as a frame; a body that is not seen has numbers that are none."""
    try:
        _, bodies = packet.get_6d_residual()
        time_s = packet.timestamp / 1e6
    except (AttributeError, ValueError, TypeError, struct.error) as error:
        return Refused("a packet without bodies", str(error))
    if len(bodies) != len(names):
        return Refused("a packet with other bodies than QTM's settings", f"{len(bodies)}, not {len(names)}")
    return Frame(tuple(_body(name, *each) for name, each in zip(names, bodies, strict=True)), time_s)


def _body(name: str, place: Any, rotation: Any, residual: Any) -> Body:
    if math.isnan(place.x):
        return Body(name, 0.0, 0.0, 0.0, tracked=False)
    return Body(name, place.x, place.y, place.z, quaternion_of(rotation.matrix), error=residual.residual)


def quaternion_of(columns: tuple[float, ...]) -> tuple[float, float, float, float]:
    """Return x, y, z, w of a rotation matrix, given column by column as QTM does; after Shepperd."""
    m00, m10, m20, m01, m11, m21, m02, m12, m22 = columns
    trace = m00 + m11 + m22
    if trace > 0.0:
        s = 2.0 * math.sqrt(1.0 + trace)
        return (m21 - m12) / s, (m02 - m20) / s, (m10 - m01) / s, 0.25 * s
    if m00 >= m11 and m00 >= m22:
        s = 2.0 * math.sqrt(max(0.0, 1.0 + m00 - m11 - m22)) or math.nan
        return 0.25 * s, (m01 + m10) / s, (m02 + m20) / s, (m21 - m12) / s
    if m11 >= m22:
        s = 2.0 * math.sqrt(max(0.0, 1.0 - m00 + m11 - m22)) or math.nan
        return (m01 + m10) / s, 0.25 * s, (m12 + m21) / s, (m02 - m20) / s
    s = 2.0 * math.sqrt(max(0.0, 1.0 - m00 - m11 + m22)) or math.nan
    return (m02 + m20) / s, (m12 + m21) / s, 0.25 * s, (m10 - m01) / s
