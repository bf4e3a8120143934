"""Counts and names what ROS sends wrongly: each sender once a second, so that a flood fills neither log nor memory."""

from __future__ import annotations

from typing import NamedTuple

import structlog

from fullswarm.recent import Recent

log = structlog.get_logger("fullswarm.ros")
EACH_S = 1.0
"""One sender is named in the log once in this time."""
SENDERS, LOGGED = 64, 8
"""Senders that are told apart; lines in `EACH_S` of all of them."""
SHOWN_S = 5.0


class Complaint(NamedTuple):
    """The newest thing that a sender did wrongly."""

    times: int  # so far
    what: str
    at_s: float
    logged_s: float


class Complaints:
    """What was wrong, by sender.

    Attributes
    ----------
    total : messages that were refused or could not be read so far
    """

    def __init__(self) -> None:
        self.total = 0
        self._senders: Recent[str, Complaint] = Recent(SENDERS)
        self._lines, self._lines_s = 0, 0.0

    def add(self, sender: str, what: str, now_s: float) -> None:
        """Note something; log it, if this sender and all together have not been logged too often."""
        self.total += 1
        before = self._senders.get(sender)
        logged_s = before.logged_s if before is not None else now_s - EACH_S
        if now_s - self._lines_s >= EACH_S:
            self._lines, self._lines_s = 0, now_s
        times = 1 if before is None else before.times + 1
        if now_s - logged_s >= EACH_S and self._lines < LOGGED:
            self._lines += 1
            logged_s = now_s
            log.warning(what, sender=sender, times=times)
        self._senders[sender] = Complaint(times, what, now_s, logged_s)

    def newest(self, now_s: float) -> dict[str, Complaint]:
        """Return sender → complaint for those of the last seconds, the newest last."""
        return {sender: each for sender, each in self._senders.items() if now_s - each.at_s <= SHOWN_S}

    def answers(self, sender: str, now_s: float) -> bool:
        """Tell whether something wrong of this sender is to be answered now: once in `EACH_S`, as it is logged."""
        before = self._senders.get(sender)
        return before is None or now_s - before.at_s >= EACH_S
