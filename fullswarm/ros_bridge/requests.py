"""Carries out requests that ROS sends in JSON, as the operator that the bridge names, and answers them in JSON.

A request is an object on the topic ``swarm/request``::

    {"id": "a1", "behaviour": "move_to_goal_bc", "robots": ["r1"], "parameters": {"goal": [5, 5]}}
    {"id": "a2", "op": "stop", "robots": ["r1"]}
    {"id": "a3", "op": "estop"}

Each answer on ``swarm/answer`` repeats ``id``; a behaviour has one answer for each phase of its request. An e-stop is
released nowhere but at the swarm's own tools.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from typing import Annotated, Any, Literal, NamedTuple

import msgspec

from fullswarm.bus.lanes import Bucket
from fullswarm.errors import MessageError
from fullswarm.keys import ROBOT_ID
from fullswarm.messages import FINAL_PHASES, Needs, Parameters, RequestStatus, Roles, TeamName
from fullswarm.operator.client import Operator, PendingRequest
from fullswarm.operator.estop import EStopOrder
from fullswarm.runtime import Scheduler

RATE_HZ = 5.0
"""Requests a second; twice as many may come at once."""
OPEN = 64
"""Requests whose phases are reported; of older ones the newest status is the last answer."""
ANSWER_S = 5.0
"""A request that the core has not answered by then is given up: it must not start robots later."""
ESTOP_S = 5.0
REASON = "requested by ROS"
GATHER_S = 0.1
"""Between two orders to halt that are sent to the swarm."""

Names = Annotated[tuple[Annotated[str, msgspec.Meta(max_length=65)], ...], msgspec.Meta(max_length=1000)]


class RosRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What ROS asks for."""

    id: Annotated[str, msgspec.Meta(max_length=64)] = ""
    op: Literal["request", "stop", "estop"] = "request"
    behaviour: Annotated[str, msgspec.Meta(max_length=64)] = ""
    robots: Names = ()  # none: the whole swarm
    parameters: Parameters = {}
    take: bool = False  # take the robots over from the operator that holds them
    team: TeamName = ""
    needs: Needs = Needs()
    roles: Roles = {}


class Halted(NamedTuple):
    """The result of a stop or an e-stop: robots addressed, none for all; those that confirmed an e-stop or did not."""

    robots: tuple[str, ...]
    confirmed: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()


_decoder = msgspec.json.Decoder(RosRequest)
Answer = Callable[[dict[str, Any]], None]


class Requests:
    """Takes requests, five a second at most, and passes them to the core.

    Parameters
    ----------
    answer
        Publishes an answer.
    present
        Returns the robots that must confirm an e-stop of all.
    first
        Ends the driving of the robots of a request, none for all, and then calls what it is given.
    """

    def __init__(
        self,
        operator: Operator,
        scheduler: Scheduler,
        answer: Answer,
        present: Callable[[], Iterable[str]],
        first: Callable[[tuple[str, ...], Callable[[], None]], None],
    ) -> None:
        self._operator, self._scheduler, self._answer, self._present = operator, scheduler, answer, present
        self._first = first
        self._bucket = Bucket(RATE_HZ, scheduler.now_s())
        self._open: dict[str, PendingRequest] = {}
        self._stops, self._estops = Gathered(scheduler, self._stop), Gathered(scheduler, self._estop)

    def take(self, text: str) -> None:
        """Carry out one request.

        Raises
        ------
        MessageError
            It is no request, or too many came; stops are carried out all the same.
        """
        try:
            asked = _decoder.decode(text)
        except (msgspec.DecodeError, RecursionError) as error:
            raise MessageError(f"a request that cannot be read: {error}") from error
        for name in asked.robots:
            if not ROBOT_ID.match(name.removeprefix("@")):
                raise MessageError(f"'{name:.70}' cannot name a robot")
        if asked.op != "request":
            self.halt(asked.op, _without_groups(asked.robots), functools.partial(self._halted, asked))
        elif not asked.behaviour:
            raise MessageError("a request without a behaviour")
        elif not self._bucket.take(self._scheduler.now_s()):
            raise MessageError(f"more than {RATE_HZ:g} requests a second")
        else:
            self._first(asked.robots, lambda: self._request(asked))

    def _request(self, asked: RosRequest) -> None:
        newest: RequestStatus | None = None

        def receive(status: RequestStatus) -> None:
            nonlocal newest
            changed, newest = newest is None or _undated(newest) != _undated(status), status
            if changed:  # the core repeats what it has said, with a new time
                self._answer({"id": asked.id, "op": asked.op, **msgspec.to_builtins(status)})
            if status.phase in FINAL_PHASES:
                self._open.pop(status.request_id, None)

        def give_up() -> None:
            if pending.status is None:
                self._forget(pending)
                self._answer({"id": asked.id, "op": asked.op, "phase": "refused", "reason": "the core does not answer"})

        if len(self._open) >= OPEN:
            self._forget(next(iter(self._open.values())))
        pending = self._operator.request(
            asked.behaviour, asked.robots, asked.parameters, receive, take=asked.take, team=asked.team,
            needs=asked.needs, roles=asked.roles,
        )  # fmt: skip
        self._open[pending.request.id] = pending
        self._scheduler.after(ANSWER_S, give_up)

    def _halted(self, asked: RosRequest, result: Halted) -> None:
        about: dict[str, Any] = {"robots": list(result.robots)}
        if asked.op == "estop":
            about = {"confirmed": list(result.confirmed), "missing": list(result.missing)}
        self._answer({"id": asked.id, "op": asked.op, **about})

    def _forget(self, pending: PendingRequest) -> None:
        self._operator.forget(pending)
        self._open.pop(pending.request.id, None)

    def halt(self, op: Literal["stop", "estop"], robots: tuple[str, ...], answer: Callable[[Halted], None]) -> None:
        """Stop robots, none for all, or latch their e-stop; `answer` is called with what has come of it."""
        (self._stops if op == "stop" else self._estops).add(robots, answer)

    def _stop(self, robots: tuple[str, ...], answer: Callable[[Halted], None]) -> None:
        self._operator.stop(robots, lambda: answer(Halted(robots)))

    def _estop(self, robots: tuple[str, ...], answer: Callable[[Halted], None]) -> None:
        def done(order: EStopOrder) -> None:
            confirmed = tuple(sorted(order.confirmed_s))
            missing = tuple(sorted({*(robots or self._present())} - {*confirmed}))
            answer(Halted(robots, confirmed, missing))

        self._operator.estop(True, robots, REASON, known=self._present, deadline_s=ESTOP_S, on_done=done)


class Gathered:
    """Joins orders to halt: the first is sent at once, and those that follow within `GATHER_S` as one.

    A flood of them must neither be refused nor reach the swarm as a flood.

    Parameters
    ----------
    send
        Called with the robots, none for all, and with what is to be called with the result.
    """

    def __init__(self, scheduler: Scheduler, send: Callable[[tuple[str, ...], Callable[[Halted], None]], None]) -> None:
        self._scheduler, self._send = scheduler, send
        self._robots: set[str] = set()
        self._answers: list[Callable[[Halted], None]] = []
        self._all = self._gathering = False

    def add(self, robots: tuple[str, ...], answer: Callable[[Halted], None]) -> None:
        """Halt robots; none: all."""
        self._all = self._all or not robots
        if not self._all:
            self._robots |= {*robots}
        if len(self._answers) < OPEN:
            self._answers.append(answer)
        if not self._gathering:
            self._flush()

    def _flush(self) -> None:
        self._gathering = bool(self._answers)
        if not self._answers:
            return
        robots = () if self._all else tuple(sorted(self._robots))
        answers, self._answers = self._answers, []
        self._robots.clear()
        self._all = False
        self._scheduler.after(GATHER_S, self._flush)

        def answer(result: Halted) -> None:
            for each in answers:
                each(result)

        self._send(robots, answer)


def _undated(status: RequestStatus) -> RequestStatus:
    return msgspec.structs.replace(status, stamp_s=0.0)


def _without_groups(robots: tuple[str, ...]) -> tuple[str, ...]:
    """Return the robots; raises `MessageError` for a group, which robots that are addressed directly do not know."""
    for name in robots:
        if name.startswith("@"):
            raise MessageError(f"'{name}' is a group: name the robots to stop, or none to stop all")
    return robots
