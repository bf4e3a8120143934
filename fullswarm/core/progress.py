"""One request on its way through the swarm: from the states of its robots to its status."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from fullswarm.core.desired import Desired
from fullswarm.messages import Phase, RequestStatus
from fullswarm.reasons import NONE, Reason, joined


@dataclass(slots=True)
class Progress:
    """A request that some robot still holds."""

    request_id: str
    behaviour: str
    robots: tuple[str, ...]
    ran: bool = False  # all robots present ran it at some time
    reason: Reason = NONE
    left: dict[str, Reason] = field(default_factory=dict)  # robot → why it does not hold the request any more
    beaten: bool = False

    def leave(self, robot: str, reason: Reason, *, beaten: bool) -> None:
        """Note that `robot` does not hold the request any more; `beaten`: by another request."""
        self.left[robot] = reason
        self.reason, self.beaten = reason, beaten

    def join(self, robot: str) -> None:
        """Note that `robot` holds the request, perhaps again."""
        self.left.pop(robot, None)
        if robot not in self.robots:
            self.robots = (*self.robots, robot)

    def holders(self) -> tuple[str, ...]:
        """Return the robots that still hold the request."""
        return tuple(robot for robot in self.robots if robot not in self.left)

    def status(self, desired: Mapping[str, Desired]) -> RequestStatus:
        """Return what to tell the operator now."""
        running: list[str] = []
        missing: list[str] = []
        refused: dict[str, Reason] = {}
        waiting = unsettled = False
        for robot in self.holders():
            state = desired[robot]
            held = state.order is not None and state.order.request_id == self.request_id
            if held and state.refused:
                refused[robot] = state.refused
            elif not state.present:
                missing.append(robot)
            elif held and state.settled:
                running.append(robot)
            else:
                waiting, unsettled = waiting or not held, True
        if running and not unsettled:
            self.ran = True
        why = joined(refused) if refused else self.reason
        return RequestStatus(
            request_id=self.request_id,
            behaviour=self.behaviour,
            phase=self._phase(len(refused), waiting),
            reason=why.text,
            code=why.code,
            parameters=dict(why.parameters),
            robots=self.robots,
            running=tuple(running),
            missing=tuple(missing),
            refused_by=tuple(refused),
        )

    def _phase(self, refused: int, waiting: bool) -> Phase:
        if len(self.left) == len(self.robots):
            return "superseded" if self.beaten and not self.ran else "ended"
        if refused and refused + len(self.left) == len(self.robots):
            return "refused"
        if self.ran:
            return "running"
        return "scheduled" if waiting else "accepted"
