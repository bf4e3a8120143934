"""Hands robots over from the operator who holds them to another one: an offer, and one press of the other.

Until the other operator accepts, nothing changes. Then the leases move at the core in one step, and only if the giver
still holds them. What robots were asked for goes on, as the offer said; what the giver drives by hand is stopped first,
since no robot may move by the stick of a person who no longer holds it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from fullswarm.errors import did_you_mean
from fullswarm.operator.client import short_id
from fullswarm.operator.console import frames
from fullswarm.operator.console.log import named
from fullswarm.operator.console.sessions import OperatorSession

OFFER_S = 30.0
"""An offer that is not accepted by then is void."""
MOST_OFFERS, MOST_OF_ONE = 32, 4
"""Open offers of all operators, and of one."""

GONE = "this offer has ended: nothing has changed"
Made = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Offer:
    """Robots that one operator offers to another; `runs` is what they do, in words."""

    id: str
    giver: str
    taker: str
    robots: tuple[str, ...]
    runs: str
    until_s: float


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What offers are judged by, and who is told.

    Attributes
    ----------
    now_s : the clock of the scheduler
    sessions : returns the sessions of this console
    holders : returns robot → operator, as the core reports; nothing while it does not
    runs : returns what robots were asked for, in words; empty: nothing
    note : writes a line of the log: text, operator, robots
    moves : called with giver, taker and robots before their leases move
    """

    now_s: Callable[[], float]
    sessions: Callable[[], Iterable[OperatorSession]]
    holders: Callable[[], Mapping[str, str]]
    runs: Callable[[tuple[str, ...]], str]
    note: Callable[[str, str, tuple[str, ...]], None]
    moves: Callable[[str, str, tuple[str, ...]], None]


class HandOvers:
    """The open offers of one console.

    An offer ends when it is accepted, declined or withdrawn, after `OFFER_S`, when the giver no longer holds all its
    robots, and when one of the two has no page open any more.
    """

    def __init__(self, around: Surroundings) -> None:
        self._around = around
        self._offers: dict[str, Offer] = {}

    def handle(self, command: frames.HandOver, session: OperatorSession) -> str:
        """Carry out a frame of `session`; return why not."""
        self.check()
        if command.op == "offer":
            return self._offer(command, session)
        offer = self._offers.get(command.id)
        party = "giver" if command.op == "withdraw" else "taker"
        if offer is None or getattr(offer, party) != session.name:
            return GONE
        match command.op:
            case "accept":
                self._accept(offer, session)
            case "decline":
                words = f"{offer.taker} declines {named(offer.robots)}: you still hold {_them(offer)}"
                self._end(offer, "declined", giver=words)
            case _:
                self._end(offer, "withdrawn", taker=f"{offer.giver} withdraws the offer of {named(offer.robots)}")
        return ""

    def check(self) -> None:
        """End offers that are too old, or that can no longer be accepted."""
        if not self._offers:
            return
        here = {session.name for session in self._around.sessions() if session.listeners}
        holders = self._around.holders()
        for offer in tuple(self._offers.values()):
            robots = named(offer.robots)
            if self._around.now_s() >= offer.until_s:
                words = f"{offer.taker} has not answered within {OFFER_S:g} s: you still hold {robots}"
                self._end(offer, "expired", giver=words, taker=f"the offer of {robots} by {offer.giver} has expired")
            elif gone := [name for name in (offer.giver, offer.taker) if name not in here]:
                words = f"{gone[0]} has left: {robots} are not handed over"
                self._end(offer, "ended", giver=words, taker=words)
            elif lost := [robot for robot in offer.robots if holders.get(robot) != offer.giver]:
                words = f"{named(lost)} no longer held by {offer.giver}: the offer has ended"
                self._end(offer, "ended", giver=words, taker=words)

    def shown(self, session: OperatorSession) -> Made:
        """Return the frame ``offers``: those that an operator has made or can accept."""
        now_s = self._around.now_s()
        return {
            "t": "offers",
            "offers": [
                {
                    "id": each.id,
                    "from": each.giver,
                    "to": each.taker,
                    "robots": each.robots,
                    "runs": each.runs,
                    "left_s": round(each.until_s - now_s, 1),
                    "mine": each.giver == session.name,
                }
                for each in self._offers.values()
                if session.name in (each.giver, each.taker)
            ],
        }

    # ---------------------------------------------------------------- one offer
    def _offer(self, command: frames.HandOver, session: OperatorSession) -> str:
        robots = tuple(dict.fromkeys(command.robots))
        if reason := self._refusal(robots, command.to, session):
            return reason
        until_s = self._around.now_s() + OFFER_S
        offer = Offer(short_id(), session.name, command.to, robots, self._around.runs(robots), until_s)
        self._offers[offer.id] = offer
        self._around.note(f"{offer.giver} offers {named(robots)} to {offer.taker}", offer.giver, robots)
        self._tell(offer)
        return ""

    def _refusal(self, robots: tuple[str, ...], to: str, session: OperatorSession) -> str:
        holders = self._around.holders()
        if not robots:
            return "a hand-over needs robots: select some that you hold"
        if foreign := [robot for robot in robots if holders.get(robot) != session.name]:
            return f"you do not hold {named(foreign)}: only what you hold can be handed over"
        if to == session.name:
            return "these robots are yours already"
        roles = {each.name: each.role for each in self._around.sessions() if each.listeners}
        if to not in roles:
            return f"no operator '{to:.64}' has this console open ({did_you_mean(to, list(roles))})"
        if roles[to] == "observer":
            return f"{to} is an observer, who commands no robots"
        mine = [each for each in self._offers.values() if each.giver == session.name]
        if taken := [robot for each in mine for robot in each.robots if robot in robots]:
            return f"{named(taken)} offered already: withdraw that offer first"
        if len(mine) >= MOST_OF_ONE or len(self._offers) >= MOST_OFFERS:
            return "too many offers are open: withdraw one, or wait until it expires"
        return ""

    def _accept(self, offer: Offer, session: OperatorSession) -> None:
        driven: set[str] = set()
        for each in tuple(self._around.sessions()):
            if each.name == offer.giver:  # all their pages
                driven |= each.give(offer.robots, offer.taker)
        self._around.moves(offer.giver, offer.taker, offer.robots)
        session.take_in(offer.robots, offer.giver)
        stopped = f"; {named(sorted(driven))} driven by hand: stopped" if driven else ""
        goes_on = f", which go on with {offer.runs}" if offer.runs else ""
        robots = named(offer.robots)
        self._end(
            offer, "accepted", giver=f"{offer.taker} accepts {robots}: you no longer hold {_them(offer)}{stopped}",
            taker=f"{offer.giver} hands over {robots}{goes_on}{stopped}",
        )  # fmt: skip

    def _end(self, offer: Offer, outcome: str, *, giver: str = "", taker: str = "") -> None:
        """Forget an offer, and tell both why; with an empty text nothing more is said."""
        del self._offers[offer.id]
        if outcome != "accepted":  # then the lines about the leases say it
            about = f"{offer.giver} offered {named(offer.robots)} to {offer.taker}: {outcome}"
            self._around.note(about, offer.giver, offer.robots)
        self._tell(offer)
        for name, words in ((offer.giver, giver), (offer.taker, taker)):
            for session in self._sessions_of(name) if words else ():
                session.send("handover", {"t": "handover", "outcome": outcome, "words": words})

    def _tell(self, offer: Offer) -> None:
        for name in (offer.giver, offer.taker):
            for session in self._sessions_of(name):
                session.send("offers", self.shown(session))

    def _sessions_of(self, name: str) -> list[OperatorSession]:
        return [each for each in self._around.sessions() if each.name == name]


def _them(offer: Offer) -> str:
    return "it" if len(offer.robots) == 1 else "them"
