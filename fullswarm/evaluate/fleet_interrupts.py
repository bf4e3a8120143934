"""Ctrl-C while real robots drive: the first one stops them all, the second one engages their e-stop."""

from __future__ import annotations

import signal
from types import FrameType, TracebackType

from fullswarm import output
from fullswarm.evaluate.live_swarm import LiveSwarm
from fullswarm.operator.estop import EStopOrder

DEADLINE_S = 5.0
SIGNALS = (signal.SIGINT, signal.SIGTERM)
ESTOP, AT_ONCE = 2, 3
"""Which Ctrl-C does what; the third leaves at once, and the robots' agents stop their wheels as they end."""


class Interrupts:
    """Acts on Ctrl-C and SIGTERM while it is entered."""

    def __init__(self, swarm: LiveSwarm) -> None:
        self._swarm = swarm
        self._count = 0
        self._order: EStopOrder | None = None
        self._before: dict[signal.Signals, signal._HANDLER] = {}

    def __enter__(self) -> Interrupts:
        """Take the signals."""
        self._before = {number: signal.signal(number, self._on_signal) for number in SIGNALS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Wait for an e-stop that is under way, then give the signals back."""
        try:
            if self._order is not None:
                self._swarm.serve(lambda: self._order is None or self._order.done, DEADLINE_S)
        finally:
            for number, handler in self._before.items():
                signal.signal(number, handler)

    def stopped(self) -> bool:
        """Tell whether the trial shall end."""
        return self._count > 0

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self._count += 1
        if self._count >= AT_ONCE:
            raise KeyboardInterrupt
        self._swarm.runtime.mailbox.put(self._act, self._count)

    def _act(self, count: int) -> None:
        if count < ESTOP:
            output.progress("stopping all robots; Ctrl-C again engages their e-stop")
            self._swarm.operator.stop()
            return
        output.progress("e-stop for all robots")
        robots = self._swarm.config.robots
        self._order = self._swarm.operator.estop(
            True, robots, "Ctrl-C", deadline_s=DEADLINE_S, on_done=_tell
        )  # fmt: skip


def _tell(order: EStopOrder) -> None:
    missing = order.unconfirmed()
    if missing:
        output.progress(f"NOT confirmed by {', '.join(missing)}: use their switches")
    else:
        output.progress(f"all {len(order.concerned())} robots stand, latched")
