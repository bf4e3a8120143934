"""Which message is due when on one port: once a second unless asked otherwise, and never above the cap."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.emulators.mavlink.rover.messages import ASKED_FOR, BY_DEFAULT, MAKERS, Subject

DEFAULT_S = 1.0
LONGEST_MS = 65_535
LOOP_HZ = 50.0
CAP = 0.8  # of the main loop's rate
LEGACY = {  # REQUEST_DATA_STREAM's groups: (messages, parameter)
    1: ((27, 116, 129, 29, 137), "RAW_SENS"), 2: ((1, 125, 152, 42, 24, 62), "EXT_STAT"), 3: ((36, 65), "RC_CHAN"),
    6: ((33, 32), "POSITION"), 10: ((30, 164, 178), "EXTRA1"), 11: ((74,), "EXTRA2"),
    12: ((163, 2, 147, 193, 241), "EXTRA3"),
}  # fmt: skip


@dataclass(slots=True)
class _Stream:
    interval_s: float
    due_s: float


class Streams:
    """The streams of one port; intervals are forgotten at power-on, not at a reconnect."""

    def __init__(self, subject: Subject, first_s: float, loop_hz: float = LOOP_HZ) -> None:
        self._subject, self._loop_hz = subject, loop_hz
        self._streams = {message: _Stream(DEFAULT_S, first_s) for message in BY_DEFAULT}
        self._streams |= {message: _Stream(math.inf, math.inf) for message in ASKED_FOR}

    def set_interval(self, message: int, interval_us: float, now_s: float) -> str:
        """Set a rate; return why it is denied, empty when it is granted."""
        if message not in self._streams:
            return f"No ap_message for mavlink id ({message})"
        if interval_us < -1:
            return "bad interval"
        if 0 < interval_us < 1e6 / (CAP * self._loop_hz):
            return f"Requested rate for message ID {message} too fast. Increase SCHED_LOOP_RATE"
        usual_s = DEFAULT_S if message in BY_DEFAULT else math.inf
        interval_s = {-1: math.inf, 0: usual_s}.get(int(interval_us), min(int(interval_us / 1000), LONGEST_MS) / 1000)
        self._streams[message] = _Stream(interval_s, now_s + interval_s)
        return ""

    def interval_us(self, message: int) -> int | None:
        """Return what MESSAGE_INTERVAL says: -1 off; None: no such stream."""
        stream = self._streams.get(message)
        if stream is None:
            return None
        return round(stream.interval_s * 1e6) if math.isfinite(stream.interval_s) else -1

    def set_group(self, group: int, rate_hz: float, now_s: float) -> list[str]:
        """Serve REQUEST_DATA_STREAM; return the parameters (without their port) that it writes."""
        groups = [LEGACY[group]] if group in LEGACY else list(LEGACY.values()) if group == 0 else []
        for messages, _ in groups:
            for message in messages:
                self.set_interval(message, 1e6 / min(rate_hz, CAP * self._loop_hz) if rate_hz > 0 else -1, now_s)
        return [name for _, name in groups]

    def heartbeat_now(self) -> None:
        """A mode change is told at once; arming is not."""
        self._streams[p.MESSAGE_HEARTBEAT].due_s = -math.inf

    def due(self, now_s: float) -> list[Any]:
        """Return the dialect's messages that are due."""
        messages = []
        for number, stream in self._streams.items():
            if now_s >= stream.due_s:
                late = now_s - stream.due_s > stream.interval_s
                stream.due_s = (now_s if late else stream.due_s) + stream.interval_s
                messages += self.make(number, now_s)
        return messages

    def make(self, number: int, now_s: float) -> list[Any]:
        """Return the message `number` as it is now; empty if it is unknown or there is nothing to tell."""
        maker = MAKERS.get(number)
        message = maker(self._subject, now_s) if maker else None
        return [] if message is None else [message]
