"""Keeping a Create awake. In Passive mode it falls asleep after five minutes, and its serial port with it.

Only a low pulse at its BRC pin (pin 5 of the connector) wakes it again; many cables do not have that line, and a
pseudo-terminal has none. So the line is a function that somebody else provides, for a GPIO, an RTS line or a test.
"""

from __future__ import annotations

import math
from collections.abc import Callable

Brc = Callable[[bool], None]
"""Called with True to pull the BRC pin low, with False to let go. Must return at once: the link waits for it."""

PULSE_S = 0.7
"""Longer than 0.5 s: three pulses of 0.05 to 0.5 s after power-on switch the robot to 19200 baud."""
REPEAT_S = 5.0
KEEP_S = 60.0
NUDGE_S = 240.0
"""Without a line: so often Safe mode, with the wheels at zero, for some 30 ms. Not documented by the maker."""


class Waking:
    """Says when to pulse, or to nudge where there is no line.

    Parameters
    ----------
    brc
        None: this robot cannot be woken.
    """

    def __init__(self, brc: Brc | None) -> None:
        self._brc = brc
        self._low = False
        self._pulsed_s = -math.inf
        self._active_s = -math.inf

    @property
    def can_wake(self) -> bool:
        """There is a line."""
        return self._brc is not None

    def active(self, now_s: float) -> None:
        """Take note that the robot was out of Passive mode, or has just answered: five minutes begin anew."""
        self._active_s = now_s

    def tick(self, now_s: float, asleep: bool) -> bool:
        """Do what is due on the line; `asleep`: it does not answer. Return whether to nudge the robot instead."""
        if self._brc is None:
            return not asleep and now_s - self._active_s > NUDGE_S
        if self._low:
            if now_s - self._pulsed_s >= PULSE_S:
                self.release()
        elif now_s - self._pulsed_s >= REPEAT_S if asleep else now_s - max(self._pulsed_s, self._active_s) >= KEEP_S:
            self._low, self._pulsed_s = True, now_s
            self._brc(True)
        return False

    def release(self) -> None:
        """Let the line go."""
        if self._low and self._brc is not None:
            self._low = False
            self._brc(False)
