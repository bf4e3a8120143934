"""Keeps each request with its operator and its outcome; the stream of a stick counts as one."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec

from fullswarm.messages import BehaviourRequest, RequestStatus
from fullswarm.operator.console.history import Journal, LogKind
from fullswarm.reasons import Code

REMEMBERED = 512
STREAM_GAP_S = 2.0
"""A stick that was quiet for so long starts anew in the log."""
NAMES_SHOWN = 6
BEATEN = (Code.SUPERSEDED, Code.CAME_FIRST)
ON_PAGE: dict[str, str] = {Code.ESTOP_LATCHED: "its e-stop is latched; clear it with the button 'Clear the e-stop…'"}
"""Reasons whose texts tell people at a shell what to do; at a browser there is a button instead."""


@dataclass(frozen=True, slots=True)
class Asked:
    """A request that was heard."""

    operator: str
    robots: tuple[str, ...]
    intent: bool
    behaviour: str = ""


@dataclass(slots=True)
class RequestBook:
    """Hears requests and statuses, writes the log, and says which statuses are news.

    Parameters
    ----------
    lapses
        Tells whether a behaviour is an intent.
    """

    journal: Journal
    lapses: Callable[[str], bool]
    _asked: OrderedDict[str, Asked] = field(default_factory=OrderedDict)
    _told: OrderedDict[str, RequestStatus] = field(default_factory=OrderedDict)
    _streams: OrderedDict[tuple[str, ...], float] = field(default_factory=OrderedDict)

    def asked(self, request: BehaviourRequest, now_s: float) -> None:
        """Take a request; copies of it change nothing."""
        if request.id in self._asked:
            return
        operator = request.operator or request.source
        intent = self.lapses(request.behaviour)
        self._asked[request.id] = Asked(operator, request.robots, intent, request.behaviour)
        _bound(self._asked)
        if intent and not self._begins((operator, request.behaviour), now_s):
            return
        text = f"{operator}: {request.behaviour} for {named(request.robots)}"
        request_id = "" if intent else request.id
        self.journal.add(now_s, "request", text, request.robots, request_id=request_id, by=operator)

    def stopped(self, order_id: str, act: str, operator: str) -> None:
        """Take a stop or an e-stop, which ends requests by its id."""
        self._asked[order_id] = Asked(operator, (), False, act)
        _bound(self._asked)

    def operator_of(self, request_id: str) -> str:
        """Return the operator that asked; empty if that was not received."""
        asked = self._asked.get(request_id)
        return asked.operator if asked else ""

    def said(self, status: RequestStatus, now_s: float) -> bool:
        """Take what the core says; True when the page shall hear it. What is said again is no news."""
        asked = self._asked.get(status.request_id)
        if asked is not None and asked.intent:
            # Twenty a second: only that it is refused is worth a word, and not each time.
            stream = (asked.operator, status.behaviour, status.reason)
            if status.phase != "refused" or not self._begins(stream, now_s):
                return False
            self._log(status, asked.operator, now_s)
            return True
        plain, before = msgspec.structs.replace(status, stamp_s=0.0), self._told.get(status.request_id)
        if plain == before:
            return False
        self._told[status.request_id] = plain
        _bound(self._told)
        halted = asked is None and status.behaviour == "stop"  # a stop or an e-stop: the log has it already
        if not halted and (before is None or (before.phase, before.refused_by) != (status.phase, status.refused_by)):
            self._log(status, asked.operator if asked else "", now_s)
        return True

    def _begins(self, stream: tuple[str, ...], now_s: float) -> bool:
        """Tell whether a stream was quiet for a while; it is not from now on."""
        before_s = self._streams.get(stream)
        self._streams[stream] = now_s
        _bound(self._streams)
        return before_s is None or now_s - before_s > STREAM_GAP_S

    def _readable(self, status: RequestStatus) -> str:
        """Return why, with what another request asked for, and in whose name, in place of its id."""
        asked = self._asked.get(status.parameters.get("by", "")) if status.code in BEATEN else None
        return for_page(status) if asked is None else f"superseded by {asked.behaviour} of {asked.operator}"

    def _log(self, status: RequestStatus, operator: str, now_s: float) -> None:
        because = f": {self._readable(status)}" if status.reason else ""
        if status.phase == "refused":
            text = f"{status.behaviour} refused{because}"
        elif status.refused_by:
            text = f"{status.behaviour} refused by {named(status.refused_by)}{because}"
        elif status.phase in ("accepted", "scheduled"):
            return  # the request itself was a line
        elif status.phase == "running":
            text = f"{status.behaviour} runs on {len(status.running)} of {len(status.robots)}"
        elif status.code in BEATEN:
            text = f"{status.behaviour} {because.removeprefix(': ')}"
        else:
            text = f"{status.behaviour} {status.phase}{because}"
        kind: LogKind = "refused" if status.phase == "refused" or status.refused_by else "request"
        self.journal.add(now_s, kind, text, status.robots, request_id=status.request_id, by=operator)


def for_page(status: RequestStatus) -> str:
    """Return why, for people at a browser, who have the page's button and maybe no shell."""
    text = ON_PAGE.get(status.code)
    if text is None:
        return status.reason
    return f"{', '.join(status.refused_by)}: {text}" if status.refused_by else text


def named(robots: Sequence[str]) -> str:
    """Return robots as people read them."""
    if not robots:
        return "the whole swarm"
    more = len(robots) - NAMES_SHOWN
    return ", ".join(robots[:NAMES_SHOWN]) + (f" and {more} more" if more > 0 else "")


def _bound(table: OrderedDict[Any, Any]) -> None:
    while len(table) > REMEMBERED:
        table.popitem(last=False)
