"""The ports of a process's nodes whose use goes into a journal: bus, scheduler, drivers, disk, loop and time of day.

Each passes everything on; a run with a journal is the run without one.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import astuple
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from fullswarm.bus.base import Delivery, SenderBus, Subscription
from fullswarm.bus.codec import encode
from fullswarm.drivers.base import Description, Fleet, FleetReading, Lifecycle, Pose
from fullswarm.errors import DriverError
from fullswarm.files import Disk
from fullswarm.journal.journal import Journal, Kind
from fullswarm.journal.readings import ReadingCopy
from fullswarm.kernels import Array
from fullswarm.messages import Message
from fullswarm.runtime import LoopStats, Scheduler, Timer

M = TypeVar("M", bound=Message)
R = TypeVar("R")

CONNECTED, LOOP, WALL = "connected", "loop", "wall"
OPEN, LIFECYCLE, FAULT, FAULT_CODE, FIRMWARE = "open", "lifecycle", "fault", "fault_code", "firmware"
LOCATE, SEEK_DOCK, DOCKED, ACTUATE = "locate", "seek_dock", "docked", "actuate"
DISK_READ, DISK_EXISTS, DISK_WRITE, DISK_REPLACE, DISK_REMOVE = (
    "disk read", "disk exists", "disk write", "disk replace", "disk remove",
)  # fmt: skip


class Names:
    """Numbers those of the same name, so that timers and subscriptions are known again in another run."""

    def __init__(self) -> None:
        self._count: dict[str, int] = {}

    def of(self, name: str) -> str:
        """Return ``name`` or ``name #n``, in the order of the calls."""
        number = self._count[name] = self._count.get(name, 0) + 1
        return name if number == 1 else f"{name} #{number}"


def timer_name(callback: Callable[[], None]) -> str:
    """Return the name of what a timer calls."""
    if isinstance(callback, functools.partial):
        callback = callback.func
    return str(getattr(callback, "__qualname__", type(callback).__qualname__))


def subscription_name(expression: str, kind: type[Message]) -> str:
    """Return the name of a subscription."""
    return f"{kind.__name__} on {expression}"


class JournalScheduler:
    """A scheduler whose timers are events."""

    def __init__(self, inner: Scheduler, journal: Journal) -> None:
        self._inner, self._journal, self._names = inner, journal, Names()

    def now_s(self) -> float:
        """Return the inner scheduler's time."""
        now_s = self._inner.now_s()
        if self._journal.inside:
            self._journal.items.append(now_s)
        return now_s

    def every(self, period_s: float, callback: Callable[[], None], *, first_s: float | None = None) -> Timer:
        """Pass on."""
        return self._inner.every(period_s, self._event(callback), first_s=first_s)

    def after(self, delay_s: float, callback: Callable[[], None]) -> Timer:
        """Pass on."""
        return self._inner.after(delay_s, self._event(callback))

    def _event(self, callback: Callable[[], None]) -> Callable[[], None]:
        cause = (Kind.TIMER, self._names.of(timer_name(callback)))
        return lambda: self._journal.run(cause, callback)


class JournalBus:
    """A bus whose deliveries are events."""

    def __init__(self, inner: SenderBus, journal: Journal) -> None:
        self._inner, self._journal, self._names = inner, journal, Names()

    def publish(self, key: str, message: Message, *, sender: str = "") -> None:
        """Pass on."""
        if self._journal.inside:
            self._journal.items.append((Kind.PUBLISH, key, encode(message), sender))
        self._inner.publish(key, message, sender=sender)

    def subscribe(
        self, expression: str, kind: type[M], handler: Callable[[M], None], *, latest: bool = False
    ) -> Subscription:
        """Pass on."""
        name, run = self._names.of(subscription_name(expression, kind)), self._journal.run

        def deliver(message: M) -> None:
            run((Kind.MESSAGE, name, encode(message), None), lambda: handler(message))

        return self._inner.subscribe(expression, kind, deliver, latest=latest)

    def subscribe_with_sender(
        self, expression: str, kind: type[M], handler: Callable[[Delivery[M]], None], *, latest: bool = False
    ) -> Subscription:
        """Pass on."""
        name, run = self._names.of(subscription_name(expression, kind)), self._journal.run

        def deliver(found: Delivery[M]) -> None:
            run((Kind.MESSAGE, name, encode(found.message), found.sender), lambda: handler(found))

        return self._inner.subscribe_with_sender(expression, kind, deliver, latest=latest)

    def connected(self) -> bool:
        """Pass on."""
        found = self._inner.connected()
        self._journal.note((Kind.ANSWER, CONNECTED, found))
        return found

    def close(self) -> None:
        """Close the bus inside."""
        self._inner.close()


class JournalFleet:
    """Drivers whose readings and answers are inputs, and whose commands are outputs."""

    def __init__(self, inner: Fleet, journal: Journal) -> None:
        self._inner, self._journal = inner, journal
        self.ids: tuple[str, ...] = inner.ids
        self.urls: tuple[str, ...] = inner.urls
        self.descriptions: tuple[Description, ...] = inner.descriptions
        self._copy: ReadingCopy | None = None

    def _answered(self, port: str, found: R) -> R:
        self._journal.note((Kind.ANSWER, port, found))
        return found

    def open(self) -> None:
        """Pass on."""
        self._journal.note((Kind.ASK, OPEN, ()))
        self._inner.open()

    def read(self) -> FleetReading:
        """Return a copy of the inner reading, which changes at the next call only."""
        found = self._inner.read()
        if self._copy is None:
            self._copy = ReadingCopy(found)
            self._journal.note((Kind.LAYOUT, self._copy.layout))
        self._journal.note(self._copy.take(found))
        return self._copy.reading

    def command(self, twists: Array, active: NDArray[np.bool_]) -> Array:
        """Pass on."""
        wanted = twists.tobytes(), active.tobytes()
        applied = self._inner.command(twists, active)
        self._journal.note((Kind.COMMAND, *wanted, applied.tobytes()))
        return applied

    def lifecycle(self, row: int) -> Lifecycle:
        """Pass on."""
        return self._answered(LIFECYCLE, self._inner.lifecycle(row))

    def fault(self, row: int) -> str:
        """Pass on."""
        return self._answered(FAULT, self._inner.fault(row))

    def fault_code(self, row: int) -> str:
        """Pass on."""
        return self._answered(FAULT_CODE, self._inner.fault_code(row))

    def firmware(self, row: int) -> str:
        """Pass on."""
        return self._answered(FIRMWARE, self._inner.firmware(row))

    def locate(self, row: int, pose: Pose, position_sigma_m: float, heading_sigma_rad: float) -> None:
        """Pass on."""
        self._journal.note((Kind.ASK, LOCATE, (row, *astuple(pose), position_sigma_m, heading_sigma_rad)))
        self._inner.locate(row, pose, position_sigma_m, heading_sigma_rad)

    def seek_dock(self, row: int) -> bool:
        """Pass on."""
        self._journal.note((Kind.ASK, SEEK_DOCK, (row,)))
        return self._answered(SEEK_DOCK, self._inner.seek_dock(row))

    def docked(self, row: int) -> bool:
        """Pass on."""
        return self._answered(DOCKED, self._inner.docked(row))

    def actuate(self, row: int, name: str, value: object) -> None:
        """Pass on."""
        self._journal.note((Kind.ASK, ACTUATE, (row, name, value)))
        try:
            self._inner.actuate(row, name, value)
        except (ValueError, DriverError) as error:
            self._journal.note((Kind.ANSWER, ACTUATE, [isinstance(error, DriverError), str(error)]))
            raise
        self._journal.note((Kind.ANSWER, ACTUATE, None))

    def close(self) -> None:
        """Pass on."""
        self._inner.close()


class JournalDisk:
    """A disk whose contents and errors are inputs, and whose changes are outputs."""

    def __init__(self, inner: Disk, journal: Journal) -> None:
        self._inner, self._journal = inner, journal

    def _try(self, port: str, call: Callable[[], R]) -> R:
        try:
            found = call()
        except OSError as error:
            self._journal.note((Kind.ANSWER, port, [error.errno, error.strerror or str(error)]))
            raise
        self._journal.note((Kind.ANSWER, port, found))
        return found

    def read(self, file: Path) -> bytes:
        """Pass on."""
        return self._try(DISK_READ, lambda: self._inner.read(file))

    def exists(self, file: Path) -> bool:
        """Pass on."""
        return self._try(DISK_EXISTS, lambda: self._inner.exists(file))

    def write(self, file: Path, content: bytes) -> None:
        """Pass on."""
        self._change(DISK_WRITE, file, content, lambda: self._inner.write(file, content))

    def replace(self, file: Path, content: bytes) -> None:
        """Pass on."""
        self._change(DISK_REPLACE, file, content, lambda: self._inner.replace(file, content))

    def remove(self, file: Path) -> None:
        """Pass on."""
        self._change(DISK_REMOVE, file, b"", lambda: self._inner.remove(file))

    def _change(self, port: str, file: Path, content: bytes, call: Callable[[], None]) -> None:
        self._journal.note((Kind.ASK, port, (file.name, content)))
        self._try(port, call)


def noted_loop(loop: Callable[[], LoopStats], journal: Journal) -> Callable[[], LoopStats]:
    """Return `loop` with what it tells noted."""

    def found() -> LoopStats:
        stats = loop()
        noted = stats.ticks, stats.late, stats.missed, stats.worst_late_s, dict(stats.dropped)
        journal.note((Kind.ANSWER, LOOP, noted))
        return stats

    return found


def noted_wall(wall_s: Callable[[], float], journal: Journal) -> Callable[[], float]:
    """Return `wall_s` with what it tells noted."""

    def found() -> float:
        now_s = wall_s()
        journal.note((Kind.ANSWER, WALL, now_s))
        return now_s

    return found
