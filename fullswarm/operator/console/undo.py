"""Plans what undoes an operator's newest request: its robots are asked again for what they ran before, or stopped.

It is planned from the requests that this console has received, and carried out as requests like any other: the core
checks them, and leases count. Stops are never undone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from fullswarm.messages import STOP, BehaviourRequest, Value
from fullswarm.operator.console.log import named

TARGETS = "targets"
"""The parameter of a formation that has one place per robot, in the order of the request's robots."""


@dataclass(frozen=True, slots=True)
class Asked:
    """A request that was received, and the robots that it turned out to mean; none: the core has not said yet."""

    request: BehaviourRequest
    robots: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Step:
    """A request that is sent again, to `robots`; without a behaviour: they are stopped."""

    robots: tuple[str, ...]
    behaviour: str = ""
    parameters: Mapping[str, Value] = field(default_factory=dict)
    original: BehaviourRequest | None = None


@dataclass(frozen=True, slots=True)
class Known:
    """What a plan is made from.

    Parameters
    ----------
    asked : returns a request by its id; None: this console has not received it
    orders : returns robot → its present order of the core, see ``World.orders``
    record : returns the record of a behaviour
    title : returns the title of a behaviour
    """

    asked: Callable[[str], Asked | None]
    orders: Callable[[], Mapping[str, Mapping[str, Any]]]
    record: Callable[[str], Mapping[str, Any] | None]
    title: Callable[[str], str]


class UndoPlan:
    """Follows the newest request of one operator, and plans what undoes it."""

    def __init__(self, known: Known) -> None:
        self._known = known
        self._id = self._behaviour = ""
        self._before: dict[str, str] = {}  # robot → id of the request that it ran; empty: none
        self._orders: dict[str, str] = {}  # robot → id of its order then, of a stop or a stick, too
        self._sent: dict[str, dict[str, Mapping[str, Any]]] = {}  # not accepted yet → the orders when it was sent

    def sent(self, request_id: str) -> None:
        """Note that a request goes out: what runs now is what ran before it."""
        self._sent = {request_id: dict(self._known.orders())}  # one without an answer can no longer be undone

    def _to_repeat(self, order: Mapping[str, Any]) -> str:
        """Return the id of the request that an order came from; empty for a stop or a stick: nothing to repeat."""
        behaviour = str(order.get("behaviour", ""))
        return "" if behaviour in ("", STOP) or order.get("expires_s") else str(order.get("request_id", ""))

    def accepted(self, request_id: str, behaviour: str, robots: Iterable[str]) -> None:
        """Note that the core has accepted a request that went out: it is the newest now."""
        before = self._sent.pop(request_id, None)
        if before is None:
            return
        self._id, self._behaviour = request_id, behaviour
        orders = {robot: before.get(robot, {}) for robot in robots}
        self._before = {robot: self._to_repeat(order) for robot, order in orders.items()}
        self._orders = {robot: str(order.get("request_id", "")) for robot, order in orders.items()}

    def stopped(self, robots: Iterable[str]) -> None:
        """Forget the newest request if a stop concerns its robots (none: all): undoing it would start them again."""
        stopped = set(robots)
        if not stopped or not stopped.isdisjoint(self._before) or self._sent:
            self.clear()

    def clear(self) -> None:
        """Forget the newest request."""
        self._id, self._before, self._orders, self._sent = "", {}, {}, {}

    @property
    def id(self) -> str:
        """The id of the request that would be undone; empty: none."""
        return self._id

    def shown(self) -> dict[str, Any]:
        """Return the frame ``undo``: what it would do, in words, or why it is not possible."""
        steps, refusal = self.steps()
        words = "" if refusal or not steps else f"Undo {self._known.title(self._behaviour)}: {self._words(steps)}"
        return {"t": "undo", "id": self._id, "words": words, "refusal": refusal}

    def steps(self) -> tuple[list[Step], str]:
        """Return what is to be requested, and why it is not possible; one of both is empty."""
        if not self._id:
            return [], ""
        orders = self._known.orders()
        # What ran before counts as well: the orders come a little later than the answer to the request.
        other = [
            robot for robot, before in self._orders.items()
            if str(orders.get(robot, {}).get("request_id", self._id)) not in (self._id, before)
        ]  # fmt: skip
        if other:
            return [], f"{named(other)}: another request came since"
        groups: dict[str, list[str]] = {}
        for robot, request_id in self._before.items():
            groups.setdefault(request_id, []).append(robot)
        steps: list[Step] = []
        for request_id, robots in groups.items():
            step, refusal = self._step(request_id, robots)
            if refusal:
                return [], refusal
            steps.append(step)
        return steps, ""

    def _step(self, request_id: str, robots: list[str]) -> tuple[Step, str]:
        if not request_id:
            return Step(tuple(robots)), ""
        asked = self._known.asked(request_id)
        if asked is None:
            return Step(()), f"what {named(robots)} ran before is older than this console knows"
        request, parameters = asked.request, dict(asked.request.parameters)
        all_of_it = set(robots) == set(asked.robots)
        if not all_of_it and (refusal := self._for_some(asked, robots, parameters)):
            return Step(()), refusal
        meant = request.robots if all_of_it else tuple(each for each in asked.robots if each in robots)
        return Step(meant, request.behaviour, parameters, request), ""

    def _for_some(self, asked: Asked, robots: list[str], parameters: dict[str, Value]) -> str:
        """Make the parameters fit some of a request's robots; return why they cannot."""
        record = self._known.record(asked.request.behaviour) or {}
        places = parameters.get(TARGETS)
        if not record.get("formation"):
            return ""
        if record["formation"] == "each" and isinstance(places, list) and len(places) == len(asked.robots):
            parameters[TARGETS] = [
                place for robot, place in zip(asked.robots, places, strict=True) if robot in robots
            ]  # fmt: skip
            return ""
        title = self._known.title(asked.request.behaviour)
        return f"{title} has places for {len(asked.robots)} robots, and {named(robots)} ran it: start it again for all"

    def _words(self, steps: Iterable[Step]) -> str:
        parts = []
        for step in steps:
            robots = step.robots or tuple(self._before)
            if step.behaviour:
                parts.append(f"ask again for {self._known.title(step.behaviour)} for {named(robots)}")
            else:
                parts.append(f"stop {named(robots)}")
        return "; ".join(parts)
