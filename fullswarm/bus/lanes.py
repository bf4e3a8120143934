"""Which messages are delivered first, and how many of one sender are taken in: by key, in one table.

The rates are far beyond any use, so that only a sender that floods meets them. What is over its rate is dropped before
it is decoded. Stops are never refused; copies of one that waits are dropped.
"""

from __future__ import annotations

from typing import NamedTuple

from fullswarm.runtime import Lane

BURST_S = 2.0
"""So much of its rate a sender may save up: what a bad network holds back arrives together."""


class Service(NamedTuple):
    """How the messages of a key are served."""

    lane: Lane
    rate_hz: float  # of one sender on one key
    stops: bool = False  # they stop robots
    polled: bool = False  # a node asks for them when its loop begins, and is not woken by them


STOPS = Service(Lane.ORDERS, 0.0, stops=True)
ORDERS = Service(Lane.ORDERS, 500.0)  # eight sticks of one console send 160 a second
ANSWERS = Service(Lane.ORDERS, 2000.0)  # of the core to all, of a host with many robots
STATES = Service(Lane.STATES, 1000.0)  # twice the greatest rate of states
POSES = STATES._replace(polled=True)  # robots tell several hundred a second, each says when it was measured
READS = Service(Lane.READS, 100.0)  # twice the greatest rate of measurements
CHANGES = Service(Lane.READS, 2000.0)  # of a database: one per robot of a request

_TOPICS = {
    "stop": STOPS, "estop": STOPS, "behaviour": ORDERS, "robot": ORDERS, "heartbeat": ORDERS, "lease": ORDERS,
    "mission": ORDERS, "params": READS, "measurement": READS, "summary": READS, "memory": READS, "actuators": READS,
    "reload": READS, "camera": READS, "intervention": READS, "processes": READS, "identity": READS,
    "charging": READS, "grid": READS, "range": READS, "roster": READS,
    "state": POSES,
}  # fmt: skip
"""By the first part of a key after the swarm; all others carry states."""
_SPECIAL = {
    ("behaviour", "status"): ANSWERS, ("robot", "ack"): ANSWERS, ("robot", "pose_fix"): STATES,
    ("report", "query"): READS, ("params", "changed"): CHANGES,
}  # fmt: skip
"""By the first and the last part."""


def service_of(key: str) -> Service:
    """Return how the messages of a key, or of all that match a key expression, are served."""
    topic, _, rest = key.partition("/")[2].partition("/")
    if topic == "estop" and rest:
        return ANSWERS  # receipts
    return _SPECIAL.get((topic, rest.rpartition("/")[2])) or _TOPICS.get(topic, STATES)


class Bucket:
    """Tokens of one sender: one per message, as many per second as its rate, at most `BURST_S` of it saved up."""

    __slots__ = ("_at_s", "_most", "_rate_hz", "_tokens")

    def __init__(self, rate_hz: float, now_s: float) -> None:
        self._rate_hz, self._most, self._at_s = rate_hz, BURST_S * rate_hz, now_s
        self._tokens = self._most

    def take(self, now_s: float) -> bool:
        """Tell whether one more message may pass at `now_s`."""
        tokens = min(self._most, self._tokens + self._rate_hz * (now_s - self._at_s))
        self._at_s = now_s
        self._tokens = tokens - 1.0 if tokens >= 1.0 else tokens
        return tokens >= 1.0
