"""Talks to serial ports and TCP addresses with deadlines, so that they can be asked what robot is there."""

from __future__ import annotations

import select
import socket
from dataclasses import dataclass

import serial

from fullswarm.clock import Clock
from fullswarm.drivers.ports import cannot_open, claim

BAUDS = (115200, 57600)
"""Create 2 and autopilots over USB first, then Create 1 and telemetry radios (see ``create_oi/probe.py``)."""

GAP_S = 0.002


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A serial port of this machine."""

    path: str  # by id where there is one: it survives another USB socket
    device: str
    product: str = ""
    vendor: int | None = None


class Line:
    """A claimed serial port, read and written with deadlines; a context manager.

    Raises
    ------
    DriverError
        The port is missing, forbidden, no serial port, or held: names the holder.
    """

    def __init__(self, path: str, clock: Clock) -> None:
        self._port: serial.Serial = claim(path, BAUDS[0])
        self._clock = clock

    def __enter__(self) -> Line:
        return self

    def __exit__(self, *_: object) -> None:
        self._port.close()

    def set_baud(self, baud: int) -> None:
        """Go on at another rate; what waited is forgotten."""
        self._port.baudrate = baud
        self._port.reset_input_buffer()

    def send(self, data: bytes) -> None:
        """Write at once. ``OSError`` when the port is gone."""
        self._port.write(data)

    def spell(self, data: bytes) -> None:
        """Write byte by byte with pauses between."""
        for each in data:
            self._port.write(bytes([each]))
            select.select([], [], [], GAP_S)

    def receive(self, timeout_s: float) -> bytes:
        """Return what is there, waiting up to `timeout_s` for it."""
        ready, _, _ = select.select([self._port.fileno()], [], [], max(0.0, timeout_s))
        return bytes(self._port.read(4096)) if ready else b""

    def gather(self, duration_s: float, size: int | None = None) -> bytes:
        """Return all that comes in `duration_s`, or until `size` bytes are there."""
        received, end_s = b"", self._clock.now_s() + duration_s
        while (left_s := end_s - self._clock.now_s()) > 0 and (size is None or len(received) < size):
            received += self.receive(left_s)
        return received


def exchange(host: str, port: int, question: bytes, duration_s: float, clock: Clock) -> bytes:
    """Connect by TCP, send a question, and return all that comes in `duration_s`.

    Raises
    ------
    DriverError
        Nothing accepts the connection, or it breaks.
    """
    received, end_s = b"", clock.now_s() + duration_s
    try:
        with socket.create_connection((host, port), timeout=duration_s) as link:
            link.sendall(question)
            while (left_s := end_s - clock.now_s()) > 0:
                ready, _, _ = select.select([link], [], [], left_s)
                data = link.recv(4096) if ready else b""
                if not data:
                    break
                received += data
    except OSError as error:
        raise cannot_open(f"tcp {host}:{port}", error) from error
    return received
