"""The guardian's own process: stops the robot of a driver that is silent or has died.

Run as a file by :mod:`.guardian` with nothing but Python's own modules, so that it starts in about 20 ms and takes
10 MB. It serves in one of two ways, with two open file descriptors, the port and the link to the driver:

``relay PORT LINK SILENCE PARK``
    Holds the port alone and passes bytes on; `PARK` are the bytes that stop the robot, in hexadecimal.
``watch PORT LINK SILENCE``
    Holds a duplicate of a port (serial, UDP, TCP, CAN) that the driver itself uses, and writes to it only when the
    driver is silent or has died: the frames that the driver has left here beforehand.

`SILENCE` is after how many seconds the driver counts as silent. `LINK` is one end of a packet socket. Each packet
begins with a kind: 0 a sign of life, 1 bytes for or from the robot, 2 the driver ends on purpose (from the driver),
3 the port is gone, and why (from here), 4 the frames that stop the robot (from the driver, see :func:`plan`), 5 the
robot is being stopped (from here).
"""

from __future__ import annotations

import _socket  # the module `socket` without its wrapper, which takes as long to import as all the rest
import errno
import os
import select
import signal
import sys
import time

ALIVE, BYTES, BYE, GONE, PLAN, STOPPED = b"\0", b"\1", b"\2", b"\3", b"\4", b"\5"
BEAT_S = 0.05
STUCK_S = 0.25
"""A port that takes no byte for so long is lost."""
REPEATS, REPEAT_S = 3, 0.05
"""The stop is sent so often: the first may fall into a command that was cut in two."""
DRAIN_S = 0.5
"""At most, for the final stop to leave."""
CHUNK = 512
PACKET = 65536

Frames = tuple[tuple[float, bytes], ...]
"""When each frame is due, in seconds, and its bytes."""


class Relay:
    """Forwards between a port and a driver; see the module."""

    def __init__(self, port: int, link: int, park: bytes, silence_s: float) -> None:
        self._port, self._link, self._park, self._silence_s = port, link, park, silence_s
        self._outbox = bytearray()
        self._received_s = self._moved_s = time.monotonic()
        self._beat_s = -1.0
        self._parks = 0  # sent in this silence
        self._park_s = 0.0
        self._driver = True  # it is at the other end of the socket
        os.set_blocking(port, False)
        os.set_blocking(link, False)

    def run(self) -> None:
        """Serve until the driver or the port is gone."""
        try:
            while self._driver:
                self._turn()
            self._drain()
        except OSError as error:
            send(self._link, GONE + (error.strerror or str(error)).encode())

    def _turn(self) -> None:
        poll = select.poll()
        poll.register(self._port, select.POLLIN | (select.POLLOUT if self._outbox else 0))
        poll.register(self._link, select.POLLIN)
        left_s = self._received_s + self._silence_s - time.monotonic()
        wait_s = min(left_s, BEAT_S) if left_s > 0.0 else REPEAT_S
        events = dict(poll.poll(max(1.0, wait_s * 1000.0)))
        if self._link in events:
            self._receive()
        now_s = time.monotonic()
        silent = now_s - self._received_s >= self._silence_s
        if events.get(self._port, 0) & ~select.POLLOUT:
            self._read(forward=not silent)
        if silent:
            self._stop(now_s)
        if now_s - self._beat_s >= BEAT_S:
            self._beat_s = now_s
            send(self._link, ALIVE)
        self._write()

    def _receive(self) -> None:
        """Take what the driver sends; a driver that has died has closed its end."""
        packet = take(self._link)
        if packet is None:
            return
        if not packet or packet[:1] == BYE:
            self._driver = False
            self._parks = REPEATS - 1 if packet else 0
            return
        self._received_s, self._parks = time.monotonic(), 0
        if packet[:1] == BYTES:
            self._outbox += packet[1:]

    def _read(self, *, forward: bool) -> None:
        """Pass on what the robot sends; a driver that goes on after a pause must not take old data for new."""
        try:
            data = os.read(self._port, CHUNK)
        except BlockingIOError:
            return
        if not data:
            raise OSError(errno.EIO, "hung up")
        if forward:
            send(self._link, BYTES + data)

    def _stop(self, now_s: float) -> None:
        """Send the stop, behind whatever is still on its way."""
        if self._parks < REPEATS and now_s - self._park_s >= REPEAT_S:
            self._parks += 1
            self._park_s = now_s
            self._outbox += self._park

    def _write(self) -> None:
        """Write what goes; raise ``OSError`` when the port is gone or takes nothing any more."""
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

    def _drain(self) -> None:
        """Stop the robot for good, as far as the port still takes it."""
        end_s = time.monotonic() + DRAIN_S
        poll = select.poll()
        poll.register(self._port, select.POLLOUT)
        while time.monotonic() < end_s and (self._parks < REPEATS or self._outbox or self._waiting()):
            self._stop(time.monotonic())
            self._write()
            poll.poll(5.0 if self._outbox else 0.0)
            time.sleep(0.002)  # the port takes more at once, and gives no sign when its own buffer has drained

    def _waiting(self) -> bool:
        """Return whether bytes are still in the port's own buffer."""
        import fcntl  # here, because a driver imports this file too, also where there is no such module
        import termios

        return any(fcntl.ioctl(self._port, termios.TIOCOUTQ, bytes(4)))


class Watcher:
    """Writes to a duplicate of a driver's port when that driver is silent or has died; see the module.

    It changes nothing about the port: whether it blocks, for example, belongs to the driver as well.
    """

    def __init__(self, port: int, link: int, silence_s: float) -> None:
        self._port, self._link, self._silence_s = port, link, silence_s
        self._stop: Frames = ()
        self._leave: Frames = ()
        self._to: tuple[str, int] | None = None
        self._socket: _socket.socket | None = None  # the port, where frames need an address
        self._due: list[tuple[float, bytes]] = []
        self._stopping = False
        self._received_s, self._beat_s = time.monotonic(), -1.0
        os.set_blocking(link, False)

    def run(self) -> None:
        """Serve until the driver ends; stop the robot if it has died, and release the port."""
        died = None
        while died is None:
            died = self._turn()
        if died:
            self._begin(self._stop + self._leave)
        while died and self._due:
            wait_s = self._due[0][0] - time.monotonic()
            if wait_s > 0.0:
                time.sleep(wait_s)
            self._send()

    def _turn(self) -> bool | None:
        """Wait and act once; return whether the driver has died (True) or ended on purpose (False)."""
        now_s = time.monotonic()
        next_s = now_s + BEAT_S if self._stopping else min(now_s + BEAT_S, self._received_s + self._silence_s)
        next_s = min(next_s, self._due[0][0]) if self._due else next_s
        poll = select.poll()
        poll.register(self._link, select.POLLIN)
        if poll.poll(max(1.0, (next_s - now_s) * 1000.0)):
            packet = take(self._link)
            if packet is not None and packet[:1] in (b"", BYE):
                return not packet
            if packet is not None:
                self._take(packet)
        now_s = time.monotonic()
        if self._stop and not self._stopping and now_s - self._received_s >= self._silence_s:
            self._stopping = True
            send(self._link, STOPPED)
            self._begin(self._stop)
        self._send()
        if now_s - self._beat_s >= BEAT_S:
            self._beat_s = now_s
            send(self._link, ALIVE)
        return None

    def _take(self, packet: bytes) -> None:
        """Take a packet of a driver that runs: it is in charge again."""
        self._received_s, self._stopping = time.monotonic(), False
        self._due.clear()
        if packet[:1] == PLAN:
            self._stop, self._leave, self._to = unpacked(packet)
            if self._to is not None and self._socket is None:
                self._socket = _socket.socket(fileno=self._port)

    def _begin(self, frames: Frames) -> None:
        now_s = time.monotonic()
        self._due = [(now_s + after_s, data) for after_s, data in frames]

    def _send(self) -> None:
        """Write the frames that are due; one that the port does not take now is not waited for."""
        poll = select.poll()
        poll.register(self._port, select.POLLOUT)
        while self._due and self._due[0][0] <= time.monotonic():
            _, data = self._due.pop(0)
            try:
                if not any(ready & select.POLLOUT for _, ready in poll.poll(0.0)):
                    continue
                if self._socket is not None and self._to is not None:
                    self._socket.sendto(data, self._to)
                else:
                    left = os.write(self._port, data)
                    if left < len(data):
                        self._due.insert(0, (0.0, data[left:]))
            except OSError:
                continue  # a refused datagram, or a port that is gone: the next frame will show


def plan(stop: Frames, leave: Frames = (), to: tuple[str, int] | None = None) -> bytes:
    """Return the packet that leaves frames with a watcher.

    Parameters
    ----------
    stop
        What stops the robot: sent when the driver is silent or has died.
    leave
        What follows if it has died.
    to
        Host and port, for a socket that is not connected.
    """
    address = b"" if to is None else f"{to[1]} {to[0]}".encode()
    packet = PLAN + bytes([len(address)]) + address
    for kind, frames in enumerate((stop, leave)):
        for after_s, data in frames:
            packet += bytes([kind]) + round(after_s * 1000.0).to_bytes(2) + len(data).to_bytes(2) + data
    return packet


def unpacked(packet: bytes) -> tuple[Frames, Frames, tuple[str, int] | None]:
    """Return what :func:`plan` has packed."""
    start = 2 + packet[1]
    port, _, host = packet[2:start].decode().partition(" ")
    frames: tuple[list[tuple[float, bytes]], list[tuple[float, bytes]]] = ([], [])
    while start < len(packet):
        after_s, size = int.from_bytes(packet[start + 1 : start + 3]) / 1000.0, packet[start + 3 : start + 5]
        end = start + 5 + int.from_bytes(size)
        frames[packet[start]].append((after_s, packet[start + 5 : end]))
        start = end
    return tuple(frames[0]), tuple(frames[1]), (host, int(port)) if host else None


def take(link: int) -> bytes | None:
    """Return the driver's next packet: empty when it has died, None when there is none."""
    try:
        return os.read(link, PACKET)
    except BlockingIOError:
        return None
    except ConnectionError:
        return b""


def send(link: int, packet: bytes) -> None:
    """Send the driver a packet."""
    try:
        os.write(link, packet)
    except (BlockingIOError, ConnectionError):
        return  # it is late or has died, which shows when its packets are read


def main(arguments: list[str]) -> None:
    """Serve; only the driver ends it, not a signal to its process group."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    way, port, link, silence_s, *park = arguments
    if way == "watch":
        Watcher(int(port), int(link), float(silence_s)).run()
    else:
        Relay(int(port), int(link), bytes.fromhex(park[0]), float(silence_s)).run()


if __name__ == "__main__":
    main(sys.argv[1:])
