"""Simulates a process: a runtime with a mailbox of its own on its computer's clock, which can die, freeze and be slow.

The runtime is the one of the live processes (:meth:`~fullswarm.runtime.Runtime.serve_due`): messages first, then due
timers, and ticks that were missed are skipped. It is woken by timers of the simulation.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from fullswarm.runtime import Mailbox, Runtime, Timer

ROUNDING_S = 1e-9


class InjectedCrash(Exception):
    """Raised by an injected fault inside a node, to end its process as a real error would."""


class HostClock:
    """The monotonic clock of one computer: it starts anywhere, runs a little fast or slow, and may jump ahead.

    Parameters
    ----------
    true_s : returns the simulated time
    name : unique per start of the computer, as :func:`~fullswarm.clock.clock_id`
    """

    def __init__(self, true_s: Callable[[], float], name: str, origin_s: float) -> None:
        self._true_s, self._host = true_s, name
        self._base_s, self._since_s, self._rate, self._boots = origin_s, true_s(), 1.0, 0

    @property
    def name(self) -> str:
        """The clock's name; another one after each start of the computer."""
        return f"{self._host}/{self._boots}"

    def now_s(self) -> float:
        """Return this clock's seconds."""
        return self._base_s + self._rate * (self._true_s() - self._since_s)

    def run_at(self, rate: float) -> None:
        """Run at `rate` seconds per true second from now on."""
        self._base_s, self._since_s, self._rate = self.now_s(), self._true_s(), rate

    def jump(self, by_s: float) -> None:
        """Leap ahead, as after a suspend of the computer."""
        self._base_s += by_s

    def reboot(self) -> None:
        """Count from zero under another name."""
        self._base_s, self._since_s, self._boots = 0.0, self._true_s(), self._boots + 1

    def true_wait_s(self, own_s: float) -> float:
        """Return the true seconds in which this clock advances by `own_s`."""
        return own_s / self._rate


class Node(Protocol):
    """Anything with an end."""

    def close(self) -> None:
        """End it in order."""
        ...


@dataclass(frozen=True, slots=True)
class Raised:
    """An error that a node raised; it ended its process."""

    process: str
    at_s: float
    text: str


class SimProcess:
    """One process of the swarm.

    Parameters
    ----------
    simulation : the runtime of the simulated time
    build : makes its nodes at each start; gets this process
    on_raised : called with (process, error) when a node has raised one

    Attributes
    ----------
    runtime : of the present start
    starts : how often it was started
    alive : it has been started and has not died
    lag_s : it serves this much later than it should
    frozen_until_s : true time until which it does nothing
    """

    def __init__(
        self, name: str, host: HostClock, simulation: Runtime, build: Callable[[SimProcess], None],
        on_raised: Callable[[SimProcess, Exception], None],
    ) -> None:  # fmt: skip
        self.name, self.host = name, host
        self._simulation, self._build, self._on_raised = simulation, build, on_raised
        self.starts, self.alive, self.lag_s, self.frozen_until_s = 0, False, 0.0, -math.inf
        self.started_s = self.busy_until_s = -math.inf
        self.runtime = Runtime(host, Mailbox())
        self._arriving: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._timer: Timer | None = None
        self._wake_s = math.inf
        self._serving = False
        self.on_death: Callable[[], None] = lambda: None

    @property
    def process_id(self) -> str:
        """A name that no other start of this process has."""
        return f"{self.name}-{self.starts}"

    @property
    def frozen(self) -> bool:
        """Whether it does nothing now."""
        return self.alive and self._simulation.now_s() < max(self.frozen_until_s, self.busy_until_s)

    def start(self) -> None:
        """Start it: build its nodes, as its disk is."""
        self.starts += 1
        self.alive, self.runtime, self.started_s = True, Runtime(self.host, Mailbox()), self._simulation.now_s()
        self.frozen_until_s = self.busy_until_s = -math.inf
        try:
            self._build(self)
        except Exception as error:
            self.kill()
            self._on_raised(self, error)
            return
        self.wake(0.0)

    def kill(self) -> None:
        """End it as SIGKILL does: nothing of it runs any more, and nothing that it held is closed in order."""
        if not self.alive:
            return
        self.alive = False
        self._arriving.clear()
        self._set_timer(math.inf)
        self.on_death()
        self.runtime = Runtime(self.host, Mailbox())

    def freeze(self, for_s: float) -> None:
        """Do nothing for so long, then serve all that has come."""
        self.frozen_until_s = max(self.frozen_until_s, self._simulation.now_s() + for_s)

    def stall(self, for_s: float) -> None:
        """Be busy for so long from now on: the present handler waits for a disk."""
        self.busy_until_s = max(self.busy_until_s, self._simulation.now_s()) + for_s

    def arrive(self, at_s: float, deliver: Callable[[], None]) -> None:
        """Have `deliver` put a message into the mailbox at true time `at_s`, or when the process serves after that."""
        if self.alive:
            heapq.heappush(self._arriving, (at_s, next(self._order), deliver))
            self._wake_at(at_s)

    def wake(self, after_s: float) -> None:
        """Serve in so many true seconds at the latest."""
        self._wake_at(self._simulation.now_s() + after_s)

    def _wake_at(self, at_s: float) -> None:
        if not self._serving:
            at_s = max(at_s + self.lag_s, self.frozen_until_s, self.busy_until_s)
            if at_s < self._wake_s:
                self._set_timer(at_s)

    def _set_timer(self, at_s: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._wake_s = at_s
        if at_s < math.inf:
            self._timer = self._simulation.after(max(0.0, at_s - self._simulation.now_s()), self._serve)

    def _serve(self) -> None:
        self._timer, self._wake_s = None, math.inf
        now_s = self._simulation.now_s()
        until_s = max(self.frozen_until_s, self.busy_until_s)
        if now_s < until_s:
            self._set_timer(until_s)
            return
        self._serving = True
        try:
            while self._arriving and self._arriving[0][0] <= now_s:
                heapq.heappop(self._arriving)[2]()
            wait_s = self.runtime.serve_due()
            while wait_s <= 0.0 and now_s >= self.busy_until_s:
                wait_s = self.runtime.serve_due()
        except Exception as error:
            self._serving = False
            if self.alive:
                self.kill()
            self._on_raised(self, error)
            return
        self._serving = False
        if self.alive:
            next_s = now_s + self.host.true_wait_s(wait_s) + ROUNDING_S
            if self._arriving:
                next_s = min(next_s, self._arriving[0][0])
            self._wake_at(next_s)
