"""An emulated CAN adapter on a pseudo terminal: other processes open it as they open ``/dev/ttyACM0``."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import tty
from pathlib import Path

from fullswarm.drivers.can.protocol import Frame
from fullswarm.drivers.can.slcan import END, LONGEST, Adapter
from fullswarm.emulators.faults import BadLink, LinkFaults
from fullswarm.errors import DriverError

CHUNK = 4096
BACKLOG = 64 * LONGEST
"""Bytes that wait for a reader who is late; further frames are lost, as in an adapter."""


class PtyWire:
    """A :class:`~fullswarm.emulators.can.wire.Wire` with a serial port at `path`, a symbolic link to the pty.

    Closing its master is unplugging: whoever has the port open gets an error; the link goes first, because the
    kernel gives the pty's number to whoever asks next. No slave is kept open here, so that the adapter notices when
    its computer lets go of the port.

    Raises
    ------
    DriverError
        Something that is not an emulator's link is at `path`, or it may not be written there.
    """

    def __init__(self, path: str, bitrate: int, faults: LinkFaults) -> None:
        self._path = Path(path)
        self._adapter = Adapter(bitrate)
        self._out, self._in = BadLink(faults, 1), BadLink(faults, 2)
        self._master: int | None = None
        self._backlog = bytearray()
        self._partial = bytearray()
        self._pause = threading.Event()  # never set: an interruptible nap while nobody has the port open
        self.lost = 0  # frames that no reader took
        if self._path.exists() and not self._path.is_symlink():
            raise DriverError("something else is there", where=path, hint="name a path that is free")
        self.replug()

    def send(self, frame: Frame, now_s: float) -> None:
        """Put `frame` on its way, if the computer has opened the channel."""
        self._out.put(self._adapter.deliver(frame), now_s)

    def exchange(self, timeout_s: float, now_s: float) -> list[Frame]:
        """Write what is due, read what is there, obey it."""
        for data in self._out.due(now_s):
            if len(self._backlog) > BACKLOG:
                self.lost += 1
            else:
                self._backlog += data
        self._write()
        self._read(timeout_s, now_s)
        frames: list[Frame] = []
        for data in self._in.due(now_s):
            answers, heard = self._adapter.receive(data)
            self._backlog += answers
            frames += heard
        self._write()
        return frames

    def unplug(self) -> None:
        """Pull the adapter out of the computer."""
        self._path.unlink(missing_ok=True)
        master, self._master = self._master, None
        if master is not None:
            os.close(master)
        self._hung_up()

    def replug(self) -> None:
        """Put it in again: a new pty at the same path."""
        if self._master is not None:
            return
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        fresh = self._path.with_name(f".{self._path.name}.{os.getpid()}")
        try:
            fresh.unlink(missing_ok=True)
            fresh.symlink_to(os.ttyname(slave))
            fresh.replace(self._path)
        except OSError as error:
            os.close(master)
            hint = "name a path in a folder that exists and that you may write to"
            raise DriverError(f"cannot make the port: {error.strerror}", where=str(self._path), hint=hint) from error
        finally:
            os.close(slave)
        self._master = master

    def close(self) -> None:
        """Remove the port."""
        self.unplug()

    def _read(self, timeout_s: float, now_s: float) -> None:
        master = self._master
        if master is None:
            self._pause.wait(max(0.0, timeout_s))
            return
        poll = select.poll()
        poll.register(master, select.POLLIN)
        events = poll.poll(max(0.0, timeout_s) * 1000.0)
        if not events:
            return
        try:
            data = os.read(master, CHUNK)
        except BlockingIOError:
            return
        except OSError:  # nobody has the port open
            self._hung_up()
            self._pause.wait(max(0.0, timeout_s))
            return
        # A bad link loses and mangles whole lines, whatever pieces the kernel makes of them.
        *lines, rest = (bytes(self._partial) + data).split(END)
        self._partial[:] = rest[-CHUNK:]
        for line in lines:
            self._in.put(line + END, now_s)

    def _write(self) -> None:
        if self._master is None or not self._backlog:
            return
        with contextlib.suppress(BlockingIOError):
            count = os.write(self._master, self._backlog)
            del self._backlog[:count]

    def _hung_up(self) -> None:
        self._adapter.restart()
        self._backlog.clear()
        self._partial.clear()
        self._out.clear()
        self._in.clear()
