"""Finds processes whose messages this one cannot read, or reads otherwise: parts of a swarm on different releases.

A message of another version is dropped like any that does not decode, so its sender would merely seem to be silent: a
robot could not see the other, and an operator would look for a broken link. Every process that drives robots therefore
announces the versions of its messages in one message whose form never changes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from fullswarm import __version__
from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.messages import MOST, Version, versions
from fullswarm.reasons import NONE, Code, Reason, reason
from fullswarm.runtime import Scheduler

PERIOD_S = 1.0
GONE_S = 3.5
"""A process that has not announced itself for so long has ended."""
NAMED = 3
"""Of the messages that differ, so many are named."""


class VersionWatch:
    """Announces this process's messages, and compares them with those of the other processes.

    Parameters
    ----------
    name : of this process: a robot's id, ``core``, …
    on_change : called with the reason why this process and another one cannot work together; false: all can
    spoken : message → version, as this process speaks them
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        scheduler: Scheduler,
        name: str,
        on_change: Callable[[Reason], None],
        spoken: Mapping[str, int] | None = None,
    ) -> None:
        self._bus, self._keys, self._scheduler, self._name = bus, keys, scheduler, name
        self._on_change = on_change
        self._spoken = dict(versions() if spoken is None else spoken)
        self._others: dict[str, tuple[float, Reason]] = {}
        self._reported = NONE
        self._subscription = bus.subscribe(keys.version(), Version, self._on_version, latest=True)
        self._timer = scheduler.every(PERIOD_S, self._announce, first_s=0.0)

    def problem_of(self, name: str) -> Reason:
        """Return why this process and the process `name` cannot work together; false: they can, as far as is known."""
        received_s, why = self._others.get(name, (-math.inf, NONE))
        return why if self._scheduler.now_s() - received_s <= GONE_S else NONE

    def close(self) -> None:
        """Drop the subscription and the timer."""
        self._timer.cancel()
        self._subscription.close()

    def _announce(self) -> None:
        now_s = self._scheduler.now_s()
        message = Version(name=self._name, software=__version__, kinds=self._spoken, stamp_s=now_s)
        self._bus.publish(self._keys.version(self._name), message)
        self._others = {name: each for name, each in self._others.items() if now_s - each[0] <= GONE_S}
        self._report()

    def _on_version(self, message: Version) -> None:
        if message.name == self._name or (message.name not in self._others and len(self._others) >= MOST):
            return
        self._others[message.name] = self._scheduler.now_s(), difference(message, self._spoken)
        self._report()

    def _report(self) -> None:
        found = next((why for _, (_, why) in sorted(self._others.items()) if why), NONE)
        if found != self._reported:
            self._reported = found
            self._on_change(found)


def difference(other: Version, spoken: Mapping[str, int]) -> Reason:
    """Return why a process and one that speaks `spoken` cannot work together; false: they can.

    A message that only one of them knows is no reason: the other takes no part in what it is for.
    """
    differing = [
        f"{kind} {number}, here {spoken[kind]}"
        for kind, number in sorted(other.kinds.items())
        if number != spoken.get(kind, number)
    ]
    if not differing:
        return NONE
    kinds = "; ".join(differing[:NAMED]) + (f"; {len(differing) - NAMED} more" if len(differing) > NAMED else "")
    return reason(Code.VERSION, process=other.name, software=other.software, own=__version__, kinds=kinds)
