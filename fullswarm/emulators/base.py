"""The shell of all emulated robots: runs a firmware on a thread, over ports whose links can be faulty.

A make brings its :class:`Firmware` and its ports (:mod:`fullswarm.emulators.ports`), and adds methods for what only
its robots can do. A method of an emulator may be called at any time from any thread: what it changes is changed on the
robot's own thread, between two of its turns.
"""

from __future__ import annotations

import contextlib
import os
import queue
import random
import select
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass
from typing import Protocol, Self, TypeVar

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.emulators.ports import Port, plug
from fullswarm.errors import LinkLost
from fullswarm.portability import need_linux
from fullswarm.simulation.bodies import Body, FreeBody

T = TypeVar("T")
SHORTEST_WAIT_S, LONGEST_WAIT_S = 0.001, 0.02


# ---------------------------------------------------------------- a link and its injected faults
@dataclass(slots=True)
class LinkFaults:
    """The faults of a link now; may be changed at any time. All zero: none."""

    drop: float = 0.0  # share of the chunks (frames, lines, writes) that are lost
    corrupt: float = 0.0  # share of the chunks with one flipped bit
    delay_s: float = 0.0


class FaultyWire:
    """One direction of a link: chunks in, chunks out, in their order; the faults repeat for a seed.

    Parameters
    ----------
    faults
        Read at each chunk, so that a test or a command may change them.
    """

    def __init__(self, faults: LinkFaults, seed: int = 0) -> None:
        self._faults = faults
        self._random = random.Random(seed)  # noqa: S311  (must repeat, keeps no secret)
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._free_s = 0.0  # when the last bit of the last chunk is through

    @property
    def due_s(self) -> float:
        """When the next chunk arrives; infinite when nothing is on the way."""
        return self._waiting[0][0] if self._waiting else float("inf")

    def put(self, data: bytes, now_s: float, baud: int = 0) -> None:
        """Send a chunk; at a rate of `baud` it takes ten bits a byte, after the chunks before it."""
        if not data:
            return
        if baud:
            now_s = self._free_s = max(self._free_s, now_s) + 10.0 * len(data) / baud
        if self._random.random() < self._faults.drop:
            return
        if self._random.random() < self._faults.corrupt:
            mangled = bytearray(data)
            mangled[self._random.randrange(len(mangled))] ^= 1 << self._random.randrange(8)
            data = bytes(mangled)
        self._waiting.append((now_s + self._faults.delay_s, data))

    def due(self, now_s: float) -> list[bytes]:
        """Return the chunks that have arrived by now."""
        arrived = []
        while self._waiting and self._waiting[0][0] <= now_s:
            arrived.append(self._waiting.popleft()[1])
        return arrived

    def clear(self) -> None:
        """Drop what is on the way: the cable was pulled."""
        self._waiting.clear()
        self._free_s = 0.0


class Link:
    """A port with its two directions."""

    def __init__(self, port: Port, faults: LinkFaults, seeds: tuple[int, int]) -> None:
        self.port = port
        self._in, self._out = FaultyWire(faults, seeds[0]), FaultyWire(faults, seeds[1])

    def receive(self, now_s: float) -> list[bytes] | None:
        """Return the chunks that have arrived by now; None when the other side has gone."""
        chunks = self.port.receive()
        if chunks is None:
            self.clear()
            return None
        for chunk in chunks:
            self._in.put(chunk, now_s, self.port.rates[0])
        return self._in.due(now_s)

    def put(self, data: bytes, now_s: float) -> None:
        """Put a chunk on its way to the other side."""
        self._out.put(data, now_s, self.port.rates[1])

    def flush(self, now_s: float) -> None:
        """Send the chunks that are due."""
        for chunk in self._out.due(now_s):
            self.port.send(chunk)

    @property
    def due_s(self) -> float:
        """When the next chunk of either direction arrives."""
        return min(self._in.due_s, self._out.due_s)

    def clear(self) -> None:
        """Drop what is on the way."""
        self._in.clear()
        self._out.clear()


# ---------------------------------------------------------------- the robot
class Firmware(Protocol):
    """What an emulated robot's computer does: chunks and time in, chunks out. No port, no thread, no clock."""

    @property
    def next_due_s(self) -> float:
        """When :meth:`step` has something to do, unless something arrives before."""
        ...

    def receive(self, data: bytes, now_s: float, port: int, /) -> None:
        """Take a chunk from a port."""
        ...

    def step(self, now_s: float) -> bool:
        """Go on to `now_s`; return True for a restart, which ends all connections."""
        ...

    def take(self, port: int, /) -> Sequence[bytes]:
        """Return the chunks for a port, and forget them."""
        ...

    def hung_up(self, port: int, /) -> None:
        """Take note that the other side of a port has gone."""
        ...


class Emulator(ABC):
    """A robot to plug a driver into, from :meth:`start` to :meth:`close`; a context manager.

    Parameters
    ----------
    firmware, ports
        What it runs, and its ports, which are opened here.
    body
        What it drives; alone on an endless floor by default.
    seeds
        Of the faults of the first port's two directions (in, out); each further port has two more.

    Attributes
    ----------
    url : the URL with which a driver opens it
    faults : the faults of all links, both directions
    lacks : commands of `fullswarm emulate` that mean nothing to it, though its body would obey them

    Raises
    ------
    DriverError
        A port cannot be had.
    """

    lacks: tuple[str, ...] = ()

    def __init__(
        self,
        firmware: Firmware,
        ports: Sequence[Port],
        body: Body,
        clock: Clock,
        *,
        faults: LinkFaults | None = None,
        seeds: tuple[int, int] = (0, 1),
    ) -> None:
        self.body, self.faults = body, faults or LinkFaults()
        self._firmware, self._clock = firmware, clock
        self._links = [Link(port, self.faults, (seeds[0] + 2 * k, seeds[1] + 2 * k)) for k, port in enumerate(ports)]
        self._plugged = self._muted = self._cut = self._closed = False
        self._orders: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._stopping = False
        self._waker = -1
        self._thread: threading.Thread | None = None
        try:
            self._plug()
        except BaseException:
            self._close_ports()
            raise

    url: str

    @property
    @abstractmethod
    def motors_on(self) -> bool | None:
        """Whether its motors obey set-points now: armed, in closed loop, in Safe mode. None: nothing decides that."""
        ...

    def start(self) -> Self:
        """Switch it on. Starting twice is fine."""
        if self._thread is None and not self._closed:
            self._power_on(self._clock.now_s())
            need_linux("an emulated robot")
            self._waker = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
            self._thread = threading.Thread(target=self._run, name=f"emulator {self.url}", daemon=True)
            self._thread.start()
        return self

    def close(self) -> None:
        """Switch it off and release its ports. Closing twice is fine."""
        if self._closed:
            return
        self._closed = self._stopping = True
        if self._thread is not None:
            self._wake()
            self._thread.join()
            os.close(self._waker)
            self._thread = None
        self.body.drive(0.0, 0.0)
        self._close_ports()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    # ------------------------------------------------------------ injected faults
    def unplug(self) -> None:
        """Pull the cables: the ports are gone. The robot keeps its power, and goes on by itself."""
        self.do(self._pull)

    def replug(self) -> None:
        """Put the cables back; each port has its old address.

        Raises
        ------
        DriverError
            Another program has taken a port meanwhile.
        """
        self.do(self._plug)

    def mute(self, on: bool = True) -> None:
        """Let it receive but send nothing."""
        self._muted = on

    def garbage(self, data: bytes) -> None:
        """Send bytes that are no message."""

        def send() -> None:
            for link in self._links:
                link.port.send(data)

        self.do(send)

    def cut(self) -> None:
        """Lose the second half of the next chunk that it sends."""
        self._cut = True

    def do(self, action: Callable[[], T]) -> T:
        """Run `action` on the robot's thread, between two turns; return what it returns, raise what it raises."""
        if self._thread is None:
            return action()
        future: Future[T] = Future()

        def run() -> None:
            try:
                future.set_result(action())
            except BaseException as error:
                future.set_exception(error)

        self._orders.put(run)
        self._wake()
        while not wait([future], timeout=0.05).done:
            if not self._thread.is_alive():
                self._obey()
        return future.result()

    def drop(self) -> None:
        """End all connections, as a restart does; the ports stay. For actions of :meth:`do`."""
        for number, link in enumerate(self._links):
            link.port.drop()
            link.clear()
            self._firmware.hung_up(number)

    # ------------------------------------------------------------ the robot's thread
    def _power_on(self, now_s: float) -> None:
        """Start the firmware, where starting does something."""
        del now_s

    def _run(self) -> None:
        try:
            while not self._stopping:
                self._wait()
                self._obey()
                self._turn(self._clock.now_s())
        except LinkLost:  # a bus that is gone takes its robot with it
            self.body.drive(0.0, 0.0)

    def _wait(self) -> None:
        """Wait for a chunk, an order or the time of the next step."""
        poll = select.poll()
        for descriptor in (self._waker, *(link.port.fileno() for link in self._links)):
            if descriptor >= 0:
                poll.register(descriptor, select.POLLIN)
        due_s = min(self._firmware.next_due_s, *(link.due_s for link in self._links))
        left_s = min(max(due_s - self._clock.now_s(), SHORTEST_WAIT_S), LONGEST_WAIT_S)
        poll.poll(1000.0 * left_s)

    def _obey(self) -> None:
        with contextlib.suppress(BlockingIOError, OSError):
            os.eventfd_read(self._waker)
        while not self._orders.empty():
            self._orders.get_nowait()()

    def _turn(self, now_s: float) -> None:
        firmware = self._firmware
        for number, link in enumerate(self._links):
            chunks = link.receive(now_s)
            if chunks is None:
                firmware.hung_up(number)
            for chunk in chunks or ():
                firmware.receive(chunk, now_s, number)
        if firmware.step(now_s):
            self.drop()
        for number, link in enumerate(self._links):
            for chunk in firmware.take(number):
                if self._muted or not self._plugged:
                    continue
                if self._cut and chunk:
                    self._cut, chunk = False, chunk[: len(chunk) // 2]
                link.put(chunk, now_s)
            link.flush(now_s)

    def _wake(self) -> None:
        os.eventfd_write(self._waker, 1)

    def _plug(self) -> None:
        if not self._plugged:
            for link in self._links:
                plug(link.port)
            self._plugged = True

    def _pull(self) -> None:
        self._plugged = False
        for number, link in enumerate(self._links):
            link.port.pull()
            link.clear()
            self._firmware.hung_up(number)

    def _close_ports(self) -> None:
        for link in self._links:
            link.port.close()


def body_and_clock(body: Body | None, clock: Clock | None) -> tuple[Body, Clock]:
    """Return these, or a body alone on an endless floor and the computer's clock."""
    clock = clock or MonotonicClock()
    return body or FreeBody(clock=clock), clock
