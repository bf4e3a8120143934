"""Tells pages which operators are on this console, since when, and which robots they hold and drive."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from fullswarm.operator.console.sessions import OperatorSession

MOST_SHOWN = 32
"""Operators that are shown; of the others only their number is."""
ROBOTS_SHOWN = 24
LONGEST_NAME = 128
"""Names of operators who are elsewhere come from the bus: they are cut, and what cannot be printed is replaced."""

Made = dict[str, Any]
Sessions = Callable[[], Iterable[OperatorSession]]


@dataclass(slots=True)
class Person:
    """One operator: their open pages, and robots by what they do with them."""

    name: str
    role: str = ""
    pages: int = 0
    clock: str = ""  # since when; empty: they are not on this console
    holds: list[str] = field(default_factory=list)
    drives: set[str] = field(default_factory=set)

    def shown(self) -> Made:
        """Return it as pages get it."""
        return {
            "name": printable(self.name),
            "role": self.role,
            "pages": self.pages,
            "clock": self.clock,
            "holds": sorted(self.holds)[:ROBOTS_SHOWN],
            "holding": len(self.holds),
            "drives": sorted(self.drives)[:ROBOTS_SHOWN],
        }


class Presence:
    """Who is here. Several pages of one name are one operator with a number of pages.

    Parameters
    ----------
    sessions : returns the sessions of this console
    holders : returns robot → operator, as the core reports
    wall_s : seconds since 1970, for people only
    """

    def __init__(
        self, sessions: Sessions, holders: Callable[[], Mapping[str, str]], wall_s: Callable[[], float]
    ) -> None:
        self._sessions, self._holders, self._wall_s = sessions, holders, wall_s
        self._since: dict[str, str] = {}  # operator → time of day
        self._sent: Made | None = None

    def shown(self) -> Made:
        """Return the frame ``presence``: those of this console first, by name, then holders who are elsewhere."""
        people: dict[str, Person] = {}
        for session in self._sessions():
            if session.listeners:
                person = people.setdefault(session.name, Person(session.name, session.role))
                person.pages += len(session.listeners)
                person.drives |= session.driven()
        self._note(people)
        for robot, operator in self._holders().items():
            people.setdefault(operator, Person(operator)).holds.append(robot)
        ordered = sorted(people.values(), key=lambda each: (each.pages == 0, each.name))
        return {
            "t": "presence",
            "people": [each.shown() for each in ordered[:MOST_SHOWN]],
            "here": sum(each.pages > 0 for each in ordered),
            "more": max(0, len(ordered) - MOST_SHOWN),
        }

    def changed_frame(self) -> Made | None:
        """Return the frame if it differs from the one that was returned last; None: it does not."""
        frame = self.shown()
        if frame == self._sent:
            return None
        self._sent = frame
        return frame

    def _note(self, people: Mapping[str, Person]) -> None:
        """Keep since when each operator is here; a reload is no departure, since the session outlives it."""
        clock = f"{datetime.fromtimestamp(self._wall_s()):%H:%M}"
        known = {session.name for session in self._sessions()}
        self._since = {name: self._since.get(name, clock) for name in known}
        for name, person in people.items():
            person.clock = self._since[name]


def printable(name: str) -> str:
    """Return a name of bounded length, without characters that break a line or turn its direction."""
    return "".join(each if each.isprintable() else "�" for each in name[:LONGEST_NAME])
