"""Transfers on an I2C bus: of the kernel (``/dev/i2c-1``), or over a serial device or TCP, as emulators have it.

Frames of a link, multi-byte numbers little-endian, the sum a CRC-32 (of Ethernet) of all before it::

    request   A7 49  number  address  written  read  data...  sum (4)
    reply     A7 52  number  state  count  data...  sum (4)

`number` is repeated in the reply, `written` and `count` are the bytes of `data`, `read` is how many are to be read with
a repeated start after the write. `state` is 0, or 1 where no device has acknowledged. A frame with a wrong sum is
passed over: no answer is a device that does not answer.
"""

from __future__ import annotations

import errno
import os
import select
import struct
import zlib
from pathlib import Path
from typing import Protocol

from fullswarm.clock import Clock
from fullswarm.drivers.ports import Port, SerialPort, TcpPort
from fullswarm.drivers.tof.settings import Settings
from fullswarm.errors import DriverError, MissingExtra

REPLY_S = 0.05
BAUD = 921_600
REQUEST, REPLY = b"\xa7I", b"\xa7R"
_HEAD = struct.Struct("<2sBBB")
SUM_BYTES = 4
LONGEST = _HEAD.size + 255 + SUM_BYTES
_SET_TIMEOUT = 0x0702
"""Of ``linux/i2c-dev.h``; in 10 ms."""
_REMOTE = getattr(errno, "EREMOTEIO", errno.EIO)  # Linux only, as buses of the kernel are
_NOT_ACKNOWLEDGED = frozenset({errno.ENXIO, _REMOTE, errno.ETIMEDOUT, errno.EAGAIN, errno.EIO})


class NoAnswer(OSError):
    """No device has acknowledged a transfer. The bus itself is there: any other ``OSError`` means that it is gone."""


class Bus(Protocol):
    """An open I2C bus."""

    def transfer(self, address: int, data: bytes, count: int = 0) -> bytes:
        """Write `data` to a device, then read `count` bytes from it; waits up to `REPLY_S`."""
        ...

    def close(self) -> None:
        """Release the bus; closing twice is fine."""
        ...


def open_bus(settings: Settings, clock: Clock) -> Bus:
    """Open the bus that a URL names.

    Raises
    ------
    DriverError
        It cannot be had.
    MissingExtra
        The library for a bus of the kernel is not installed.
    """
    path = settings.path
    if not path:
        return LinkBus(TcpPort(settings.host, settings.port, silence_s=None, clock=clock), clock)
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        raise _cannot_open(path, error) from error
    try:
        is_serial = os.isatty(descriptor)
    finally:
        os.close(descriptor)
    return LinkBus(SerialPort(path, BAUD, clock), clock) if is_serial else KernelBus(path)


class KernelBus:
    """A bus of the kernel, through ``I2C_RDWR``. Raises as :func:`open_bus`."""

    def __init__(self, path: str) -> None:
        try:
            import fcntl

            import smbus2
        except ImportError as error:
            raise MissingExtra("`smbus2` is not installed", hint="pip install 'fullswarm[tof]'") from error
        self._message, self._bus = smbus2.i2c_msg, smbus2.SMBus()
        try:
            self._bus.open(path)
            fcntl.ioctl(self._bus.fd or -1, _SET_TIMEOUT, round(100 * REPLY_S))
        except OSError as error:
            self._bus.close()
            raise _cannot_open(path, error) from error

    def transfer(self, address: int, data: bytes, count: int = 0) -> bytes:
        """Write to a device, then read from it."""
        read = [self._message.read(address, count)] if count else []
        try:
            self._bus.i2c_rdwr(self._message.write(address, data), *read)
        except OSError as error:
            if error.errno in _NOT_ACKNOWLEDGED:
                raise NoAnswer(error.errno, f"no answer from {address:#04x}") from error
            raise
        return bytes(read[0]) if read else b""

    def close(self) -> None:
        """Release the bus."""
        self._bus.close()


class LinkBus:
    """A bus at the other end of a link."""

    def __init__(self, port: Port[bytes], clock: Clock) -> None:
        self._port, self._clock = port, clock
        self._number, self._rest = 0, bytearray()
        self._poll = select.poll()
        self._poll.register(port.fileno() or 0, select.POLLIN)

    def transfer(self, address: int, data: bytes, count: int = 0) -> bytes:
        """Write to a device, then read from it."""
        self._number = number = (self._number + 1) & 0xFF
        frame = _HEAD.pack(REQUEST, number, address, len(data)) + bytes([count]) + data
        self._rest.clear()
        ends_s = self._clock.now_s() + REPLY_S
        if self._port.write(frame + _sum(frame)) is None:
            while (left_s := ends_s - self._clock.now_s()) > 0.0:
                if self._poll.poll(1000.0 * left_s):
                    self._rest += b"".join(self._port.read())
                while (reply := next_reply(self._rest)) is not None:
                    if reply[0] != number:
                        continue  # late
                    if reply[1] == 0 and len(reply[2]) == count:
                        return reply[2]
                    raise NoAnswer(errno.ENXIO, f"no answer from {address:#04x}")
        raise NoAnswer(errno.ETIMEDOUT, f"no reply within {REPLY_S:g} s")

    def close(self) -> None:
        """Release the link."""
        self._port.close()


def next_reply(received: bytearray) -> tuple[int, int, bytes] | None:
    """Take the first whole reply, number, state and data, out of what was received; what is none is dropped."""
    while True:
        at = received.find(REPLY)
        if at < 0:
            del received[: len(received) - received.endswith(REPLY[:1])]
            return None
        del received[:at]
        if len(received) < _HEAD.size:
            return None
        _, number, state, count = _HEAD.unpack_from(received)
        end = _HEAD.size + count
        if len(received) < end + SUM_BYTES:
            return None
        body = bytes(received[:end])
        if _sum(body) == received[end : end + SUM_BYTES]:
            del received[: end + SUM_BYTES]
            return number, state, body[_HEAD.size :]
        del received[:1]


def _sum(body: bytes) -> bytes:
    return zlib.crc32(body).to_bytes(SUM_BYTES, "little")


def _cannot_open(path: str, error: OSError) -> DriverError:
    buses = ", ".join(sorted(str(each) for each in Path("/dev").glob("i2c-*"))) or "none"
    what, hint = {
        errno.ENOENT: ("there is no such bus", f"switch I2C on (raspi-config, or the device tree); buses now: {buses}"),
        errno.EACCES: ("this user may not use the bus", "run 'sudo usermod -aG i2c $USER' and log in again"),
        errno.ENOTTY: ("this is no I2C bus", f"buses now: {buses}"),
    }.get(error.errno or 0, (f"the bus does not open: {error.strerror or error}", f"buses now: {buses}"))
    return DriverError(what, where=path, hint=hint)
