"""Which orders an agent must not take any more: of a core that has been replaced, of a request that is spent."""

from __future__ import annotations

import math
from collections import OrderedDict

from fullswarm.reasons import NONE, Reason

REMEMBERED = 64


class Memory(OrderedDict[str, Reason]):
    """The newest `REMEMBERED` names with a reason for each."""

    def note(self, name: str, why: Reason = NONE) -> None:
        """Remember `name`, forgetting the oldest when there are too many."""
        self[name] = why
        self.move_to_end(name)
        while len(self) > REMEMBERED:
            self.popitem(last=False)


class Cores:
    """Core processes by their heartbeats."""

    def __init__(self, silence_s: float) -> None:
        self._silence_s = silence_s
        self._heard_s: OrderedDict[str, float] = OrderedDict()
        self._newest_s = -math.inf

    def hear(self, process: str, now_s: float) -> bool:
        """Take a heartbeat; tell whether it is the first of its process."""
        new = process not in self._heard_s
        self._heard_s[process] = self._newest_s = now_s
        while len(self._heard_s) > REMEMBERED:
            self._heard_s.popitem(last=False)
        return new

    def alive(self, process: str, now_s: float) -> bool:
        """Tell whether the process was heard within the configured silence."""
        return now_s - self._heard_s.get(process, -math.inf) <= self._silence_s

    def any_alive(self, now_s: float) -> bool:
        """Tell whether any core was."""
        return now_s - self._newest_s <= self._silence_s

    def age_s(self, now_s: float) -> float:
        """Return how long ago any core was heard, in seconds; infinity when none ever was."""
        return now_s - self._newest_s


class Fence:
    """What one robot refuses.

    Attributes
    ----------
    spent : request id → why it may not start again
    halted : id of a stop that no core heard, since which nothing was accepted; empty: none
    """

    def __init__(self, cores: Cores) -> None:
        self._cores = cores
        self._core = ""
        self._replaced = Memory()
        self._seen = Memory()
        self.spent = Memory()
        self.halted = ""

    def replaced(self, core: str, now_s: float) -> bool:
        """Tell whether `core` has been replaced by another one, so that its messages are late; else follow it.

        A replaced core is followed again when it alone lives: then the other one was started by mistake.
        """
        if core == self._core:
            return False
        if core in self._replaced and (self._cores.alive(self._core, now_s) or not self._cores.alive(core, now_s)):
            return True
        self._replaced.pop(core, None)
        if self._core:
            self._replaced.note(self._core)
        self._core = core
        return False

    def see(self, request_id: str) -> None:
        """Remember a request that was to start here."""
        self._seen.note(request_id)

    def accept(self) -> None:
        """Something was started: no stop is in force any more."""
        self.halted = ""

    def halt(self, order_id: str, why: Reason) -> None:
        """Spend every request seen so far: a stop overrules also those that are wanted but not running.

        `order_id` is empty when a core was there to hear of it.
        """
        for request_id in self._seen:
            self.spent.note(request_id, why)
        self.halted = self.halted or order_id
