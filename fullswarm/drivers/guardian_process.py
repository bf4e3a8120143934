"""The guardian's own process: holds a serial port for a driver and stops the robot when that driver is silent or gone.

Run as a file by :mod:`.guardian` with nothing but Python's own modules, so that it starts in about 20 ms and takes
10 MB: ``python -I -S guardian_process.py PORT LINK PARK SILENCE``, two open file descriptors, the bytes that stop the
robot in hexadecimal, and after how many seconds of silence they are sent.

`LINK` is one end of a packet socket. Each packet begins with a kind: 0 "I am alive", 1 bytes for or from the robot,
2 "I leave" (from the driver), 3 "the port is gone" and why (from here).
"""

from __future__ import annotations

import errno
import fcntl
import os
import select
import signal
import sys
import termios
import time

ALIVE, BYTES, BYE, GONE = b"\0", b"\1", b"\2", b"\3"
BEAT_S = 0.05
STUCK_S = 0.25
"""A port that takes no byte for so long is lost."""
REPEATS, REPEAT_S = 3, 0.05
"""The robot is told so often to stop: the first time may fall into a command that was cut in two."""
FAREWELL_S = 0.5
"""At most, for the last words to leave."""
MOUTHFUL = 512
PACKET = 65536


class Guardian:
    """Forwards between a port and a driver; see the module."""

    def __init__(self, port: int, link: int, park: bytes, silence_s: float) -> None:
        self._port, self._link, self._park, self._silence_s = port, link, park, silence_s
        self._outbox = bytearray()
        self._heard_s = self._moved_s = time.monotonic()
        self._beat_s = -1.0
        self._parks = 0  # sent in this silence
        self._park_s = 0.0
        self._driver = True  # somebody is at the other end
        os.set_blocking(port, False)
        os.set_blocking(link, False)

    def run(self) -> None:
        """Serve until the driver or the port is gone."""
        try:
            while self._driver:
                self._turn()
            self._see_off()
        except OSError as error:
            self._tell(GONE + (error.strerror or str(error)).encode())

    def _turn(self) -> None:
        poll = select.poll()
        poll.register(self._port, select.POLLIN | (select.POLLOUT if self._outbox else 0))
        poll.register(self._link, select.POLLIN)
        left_s = self._heard_s + self._silence_s - time.monotonic()
        wait_s = min(left_s, BEAT_S) if left_s > 0.0 else REPEAT_S
        events = dict(poll.poll(max(1.0, wait_s * 1000.0)))
        if self._link in events:
            self._hear()
        now_s = time.monotonic()
        silent = now_s - self._heard_s >= self._silence_s
        if events.get(self._port, 0) & ~select.POLLOUT:
            self._read(forward=not silent)
        if silent:
            self._stop(now_s)
        if now_s - self._beat_s >= BEAT_S:
            self._beat_s = now_s
            self._tell(ALIVE)
        self._write()

    def _hear(self) -> None:
        """Take what the driver sends; a driver that died has closed its end."""
        try:
            packet = os.read(self._link, PACKET)
        except BlockingIOError:
            return
        except ConnectionError:
            packet = b""
        if not packet or packet[:1] == BYE:
            self._driver = False
            self._parks = REPEATS - 1 if packet else 0
            return
        self._heard_s, self._parks = time.monotonic(), 0
        if packet[:1] == BYTES:
            self._outbox += packet[1:]

    def _read(self, *, forward: bool) -> None:
        """Pass on what the robot says; a driver that wakes up after a silence must not take old words for new."""
        try:
            data = os.read(self._port, MOUTHFUL)
        except BlockingIOError:
            return
        if not data:
            raise OSError(errno.EIO, "hung up")
        if forward:
            self._tell(BYTES + data)

    def _tell(self, packet: bytes) -> None:
        try:
            os.write(self._link, packet)
        except (BlockingIOError, ConnectionError):
            return  # it does not listen: it is late, or gone, which shows when it is heard

    def _stop(self, now_s: float) -> None:
        """Tell the robot to stop, behind whatever is still on its way there."""
        if self._parks < REPEATS and now_s - self._park_s >= REPEAT_S:
            self._parks += 1
            self._park_s = now_s
            self._outbox += self._park

    def _write(self) -> None:
        """Raise ``OSError`` when the port is gone or takes nothing any more."""
        now_s = time.monotonic()
        if self._outbox:
            try:
                count = os.write(self._port, self._outbox)
            except BlockingIOError:
                if now_s - self._moved_s > STUCK_S:
                    raise OSError(errno.ETIMEDOUT, "it takes no bytes") from None
                return
            del self._outbox[:count]
        self._moved_s = now_s

    def _see_off(self) -> None:
        """Stop the robot for good, as far as the port still takes it."""
        end_s = time.monotonic() + FAREWELL_S
        poll = select.poll()
        poll.register(self._port, select.POLLOUT)
        while time.monotonic() < end_s and (self._parks < REPEATS or self._outbox or self._waiting()):
            self._stop(time.monotonic())
            self._write()
            poll.poll(5.0 if self._outbox else 0.0)
            time.sleep(0.002)  # the port takes more at once, and nothing tells when its own buffer has drained

    def _waiting(self) -> bool:
        """Tell whether bytes are still in the port's own buffer."""
        return any(fcntl.ioctl(self._port, termios.TIOCOUTQ, bytes(4)))


def main(arguments: list[str]) -> None:
    """Serve; the driver alone decides when it is over, not who ends a group of processes."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    port, link, park, silence_s = arguments
    Guardian(int(port), int(link), bytes.fromhex(park), float(silence_s)).run()


if __name__ == "__main__":
    main(sys.argv[1:])
