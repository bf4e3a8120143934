"""Lets pages look back: sends them segments of the history at a bounded rate, and says what there is to see."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from fullswarm.operator.console import frames
from fullswarm.operator.console.frames import Answer
from fullswarm.operator.console.history import History, event
from fullswarm.operator.console.log import Entry
from fullswarm.operator.console.sessions import Listener
from fullswarm.runtime import Scheduler

LOOK_S = 0.05
"""One segment is sent at a time, and this long apart: looking back must not delay what is live."""
MOST_EVENTS = 1000
STUDY = "the past is not shown in a study"


@dataclass(frozen=True, slots=True)
class About:
    """What the timeline is of.

    Attributes
    ----------
    recording : name of the recording; empty: a live session
    offered : whether pages may look back
    """

    recording: str = ""
    offered: bool = True


class Timeline:
    """The past of one console, for all its pages.

    Parameters
    ----------
    wall_s : returns seconds since 1970 of the present moment of the history's clock
    send : sends a frame to all pages
    """

    def __init__(
        self,
        history: History,
        scheduler: Scheduler,
        wall_s: Callable[[], float],
        send: Callable[[dict[str, Any]], None],
        about: About | None = None,
    ) -> None:
        self.history = history
        self._scheduler, self._wall_s, self._send = scheduler, wall_s, send
        self._about = about or About()
        self._wanted: OrderedDict[Listener, tuple[float, str]] = OrderedDict()
        self._timer = scheduler.every(LOOK_S, self._serve)

    def close(self) -> None:
        """Send no more."""
        self._timer.cancel()
        self._wanted.clear()

    def handle(self, command: frames.Look, listener: Listener, reader: str) -> Answer:
        """Note which moment a page wants to see; of several the newest one counts."""
        if not self._about.offered:
            return Answer(ref=command.ref, ok=False, reason=STUDY)
        self._wanted[listener] = command.at, reader
        return Answer(ref=command.ref)

    def leave(self, listener: Listener) -> None:
        """Forget a page."""
        self._wanted.pop(listener, None)

    def add_entry(self, entry: Entry) -> None:
        """Keep a line of the log, and mark it on the timeline."""
        self.history.add_entry(entry)
        if self._about.offered:
            self._send({"t": "event", "event": event(entry)})

    def shown(self, now_s: float, read_share: float | None = None) -> dict[str, Any]:
        """Return the frame ``timeline``: what can be looked at.

        Parameters
        ----------
        read_share : how much of a recording has been read, 0 to 1; None: all, or a live session
        """
        clock = datetime.fromtimestamp(self._wall_s())
        return {
            "t": "timeline",
            "at": round(now_s, 3),
            # Of the day here: the log's times are, too, and a browser may be in another time zone.
            "clock_s": round(clock.hour * 3600.0 + clock.minute * 60.0 + clock.second + 1e-6 * clock.microsecond, 3),
            "from": round(self.history.from_s, 3),
            "to": round(self.history.to_s, 3),
            "recording": self._about.recording,
            "offered": self._about.offered,
            "read": read_share,
        }

    def events(self) -> dict[str, Any]:
        """Return the frame ``events`` for a new page: the marks up to now."""
        return {"t": "events", "events": self.history.events(MOST_EVENTS) if self._about.offered else []}

    def _serve(self) -> None:
        if self._wanted:
            listener, (at_s, reader) = self._wanted.popitem(last=False)
            listener.put("history", self.history.segment(at_s, reader))
