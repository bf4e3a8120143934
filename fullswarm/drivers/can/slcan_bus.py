"""python-can's slcan bus, reading strictly and by the chunk. Imported only when such a bus is opened.

python-can reads one byte at a time and takes whatever ``int`` takes for an identifier. This one reads what is there
and lets :mod:`~fullswarm.drivers.can.slcan` judge it; opening, bit rates and writing stay python-can's.
"""

from __future__ import annotations

import os
import select
from collections import deque

import can
from can.interfaces.slcan import slcanBus

from fullswarm.drivers.can import slcan
from fullswarm.drivers.can.protocol import Frame

CHUNK = 4096


class SlcanBus(slcanBus):
    """An adapter on a serial port; python-can's parameters."""

    def __init__(self, channel: str, *, bitrate: int, tty_baudrate: int, sleep_after_open: float) -> None:
        self._lines = slcan.Lines()
        self._frames: deque[can.Message] = deque()
        self.refused = 0  # lines that were frames by their letter and none by their rest
        super().__init__(channel, tty_baudrate, bitrate, sleep_after_open=sleep_after_open)
        self.flush()  # what an adapter that was still open has sent meanwhile is old

    def open(self) -> None:
        """Open the channel, without time stamps: some adapters remember that they were once switched on."""
        self._write("Z0")
        super().open()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._frames and select.select([self.fileno()], [], [], timeout)[0]:
            data = os.read(self.fileno(), CHUNK)
            if not data:
                raise can.CanOperationError("the serial port has hung up")
            self._take(data)
        return (self._frames.popleft() if self._frames else None), False

    def _take(self, data: bytes) -> None:
        for line in self._lines.feed(data):
            frame = slcan.decode(line)
            if frame is not None:
                self._frames.append(_message(frame))
            elif line[:1] in b"tTrR":
                self.refused += 1


def _message(frame: Frame) -> can.Message:
    return can.Message(
        arbitration_id=frame.id, is_extended_id=frame.extended, is_remote_frame=frame.remote, data=frame.data
    )
