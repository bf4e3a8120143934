"""Lets pages look back: sends them segments of the history at a bounded rate, and says what there is to see."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from fullswarm.operator.console import frames
from fullswarm.operator.console.bookmarks import Bookmarks
from fullswarm.operator.console.clips import Clips
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
    file : returns the recording that is shown, or is made of a live session; None: there is none
    """

    recording: str = ""
    offered: bool = True
    file: Callable[[], Path | None] = lambda: None


class Timeline:
    """The past of one console, for all its pages.

    Parameters
    ----------
    now_s, wall_s : return the same moment, on the clock of the frames and in seconds since 1970
    send : sends a frame to all pages
    """

    def __init__(
        self,
        history: History,
        scheduler: Scheduler,
        now_s: Callable[[], float],
        wall_s: Callable[[], float],
        send: Callable[[dict[str, Any]], None],
        about: About | None = None,
    ) -> None:
        self.history = history
        self._now_s, self._wall_s, self._send = now_s, wall_s, send
        self._about = about or About()
        self._wanted: OrderedDict[Listener, tuple[float, str]] = OrderedDict()
        self._bookmarks = Bookmarks(self._about.file)
        self.clips = Clips(self._about.file, scheduler)
        self._timer = scheduler.every(LOOK_S, self._serve)

    def close(self) -> None:
        """Send no more."""
        self._timer.cancel()
        self._wanted.clear()
        self.clips.close()

    def handle(self, command: frames.Past, listener: Listener, reader: str) -> Answer:
        """Carry out what a page wants of the past. Of moments to look at the newest one counts."""
        if not self._about.offered:
            return Answer(ref=command.ref, ok=False, reason=STUDY)
        match command:
            case frames.Look():
                self._wanted[listener] = command.at, reader
                reason = ""
            case frames.Mark():
                reason = self._mark(command, reader)
            case frames.Clip():
                reason = self._clip(command, listener)
        return Answer(ref=command.ref, ok=not reason, reason=reason)

    def _mark(self, command: frames.Mark, reader: str) -> str:
        name = " ".join(command.name.split())
        if command.op == "delete":
            reason = self._bookmarks.delete(command.id)
        elif not name or not name.isprintable():
            return "a bookmark needs a name"
        else:
            reason = self._bookmarks.add(self._time_s(command.at), name, reader)
        self.send_bookmarks()
        return reason

    def _clip(self, command: frames.Clip, listener: Listener) -> str:
        if command.begin >= command.end:
            return "a clip ends after its beginning: set both again"
        return self.clips.make(self._time_s(command.begin), self._time_s(command.end), command.kind, listener)

    def _time_s(self, at_s: float) -> float:
        """Return seconds since 1970 of a moment on the clock of the frames."""
        return self._wall_s() + at_s - self._now_s()

    def bookmarks(self) -> dict[str, Any]:
        """Return the frame ``bookmarks``."""
        marks = self._bookmarks.shown(self._now_s(), self._wall_s()) if self._about.offered else []
        return {"t": "bookmarks", "bookmarks": marks, "clips": self.clips.refusal()}

    def send_bookmarks(self) -> None:
        """Send all pages the bookmarks, and whether there can be clips."""
        self._send(self.bookmarks())

    def leave(self, listener: Listener) -> None:
        """Forget a page."""
        self._wanted.pop(listener, None)

    def add_entry(self, entry: Entry) -> None:
        """Keep a line of the log, and mark it on the timeline."""
        self.history.add_entry(entry)
        if self._about.offered and entry.count == 1:
            self._send({"t": "event", "event": event(entry)})

    def shown(self, read_share: float | None = None) -> dict[str, Any]:
        """Return the frame ``timeline``: what can be looked at.

        Parameters
        ----------
        read_share : how much of a recording has been read, 0 to 1; None: all, or a live session
        """
        clock = datetime.fromtimestamp(self._wall_s())
        return {
            "t": "timeline",
            "at": round(self._now_s(), 3),
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
