"""The status of each request: worked out from its robots, published at each change, kept for a repeated request."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import msgspec

from fullswarm.bus import Bus
from fullswarm.core.desired import Desired, result_reason
from fullswarm.keys import Keys
from fullswarm.messages import FINAL_PHASES, Phase, RequestStatus, Result
from fullswarm.reasons import NONE, Reason, joined
from fullswarm.recent import Recent
from fullswarm.runtime import Scheduler

AGAIN_S, FRESH_S, MANY = 0.5, 3.0, 8
"""The newest `MANY` statuses are repeated at this interval while younger than `FRESH_S`: a message may be lost."""
WHOLE_S = 120.0
"""Of a request that has ended so long ago it is kept how, and no list of its robots: 8192 whole statuses are 15 MB."""
NO_ROLES: dict[str, str] = {}
NO_PARAMETERS: dict[str, str] = {}


@dataclass(slots=True)
class Progress:
    """A request that some robot still holds."""

    request_id: str
    behaviour: str
    robots: tuple[str, ...]
    reason: Reason = NONE
    left_out: tuple[str, ...] = ()  # robots that it means, but that are unfit for it
    roles: Mapping[str, str] = field(default_factory=dict)  # robot → its role, if it has one
    ran: bool = False  # all robots present ran it at some time
    left: dict[str, Reason] = field(default_factory=dict)  # robot → why it does not hold the request any more
    superseded: bool = False
    results: dict[str, Result] = field(default_factory=dict)  # robot → how its behaviour has ended itself

    def finish(self, result: Result) -> None:
        """Note how the behaviour has ended itself on a robot, which leaves the request with that."""
        self.results[result.robot] = result
        self.leave(result.robot, result_reason(result, self.behaviour), superseded=False)
        if len(self.results) > 1:
            self.reason = joined({robot: result_reason(each, self.behaviour) for robot, each in self.results.items()})

    def leave(self, robot: str, reason: Reason, *, superseded: bool) -> None:
        """Note that `robot` does not hold the request any more; `superseded`: by another request."""
        self.left[robot] = reason
        self.reason, self.superseded = reason, superseded

    def join(self, robot: str) -> None:
        """Note that `robot` holds the request, perhaps again."""
        self.left.pop(robot, None)
        self.results.pop(robot, None)
        if robot not in self.robots:
            self.robots = (*self.robots, robot)

    def holders(self) -> tuple[str, ...]:
        """Return the robots that still hold the request."""
        return tuple(robot for robot in self.robots if robot not in self.left)

    def status(self, desired: Mapping[str, Desired]) -> RequestStatus:
        """Return the present status."""
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
            left_out=self.left_out,
            roles=dict(self.roles),
            results=tuple(self.results.values()),
        )

    def _phase(self, refused: int, waiting: bool) -> Phase:
        if len(self.left) == len(self.robots):
            return "superseded" if self.superseded and not self.ran else "ended"
        if refused and refused + len(self.left) == len(self.robots):
            return "refused"
        if self.ran:
            return "running"
        return "scheduled" if waiting else "accepted"


class StatusBoard:
    """The newest status of the last `remember` requests.

    A remembered request is carried out once, although it is sent until it is answered.
    """

    def __init__(self, bus: Bus, keys: Keys, scheduler: Scheduler, remember: int = 8192) -> None:
        self._bus, self._keys, self._scheduler = bus, keys, scheduler
        self._newest: Recent[str, RequestStatus] = Recent(remember)
        self._recent: Recent[str, None] = Recent(MANY)  # published, not only remembered
        self._whole: Recent[str, float] = Recent(remember)  # request → when it changed last, the oldest first
        self._timer = scheduler.every(AGAIN_S, self._tick)

    def close(self) -> None:
        """Stop repeating."""
        self._timer.cancel()

    def _tick(self) -> None:
        self._repeat_recent()
        self._shorten(self._scheduler.now_s() - WHOLE_S)

    def _shorten(self, before_s: float) -> None:
        """Drop the lists of robots of requests that have ended and whose last change is before `before_s`."""
        while self._whole:
            request_id, at_s = next(iter(self._whole.items()))
            if at_s >= before_s:
                return
            del self._whole[request_id]
            status = self._newest.get(request_id)
            if status is not None and status.phase in FINAL_PHASES:
                short = msgspec.structs.replace(
                    status, robots=(), running=(), missing=(), left_out=(), roles=NO_ROLES, parameters=NO_PARAMETERS
                )
                self._newest.update_in_place(request_id, short)

    def _repeat_recent(self) -> None:
        since_s = self._scheduler.now_s() - FRESH_S
        for request_id in tuple(self._recent):
            status = self._newest.get(request_id)
            if status is not None and status.stamp_s >= since_s:
                self._bus.publish(self._keys.behaviour_status, status)

    def get(self, request_id: str) -> RequestStatus | None:
        """Return the newest status of a request; None when it is unknown or forgotten."""
        return self._newest.get(request_id)

    def publish(self, status: RequestStatus) -> None:
        """Send `status` with the present time, unless it equals the last one."""
        old = self._newest.get(status.request_id)
        if old is not None and msgspec.structs.replace(status, stamp_s=old.stamp_s) == old:
            return
        self._recent[status.request_id] = None
        self._bus.publish(self._keys.behaviour_status, self.remember(status))

    def remember(self, status: RequestStatus) -> RequestStatus:
        """Keep `status` without sending it; return it with the present time."""
        stamped = msgspec.structs.replace(status, stamp_s=self._scheduler.now_s())
        self._newest[status.request_id] = stamped
        self._whole[stamped.request_id] = stamped.stamp_s
        return stamped

    def repeat(self, request_id: str) -> bool:
        """Send the newest status of a request again; False when there is none."""
        status = self._newest.get(request_id)
        if status is not None:
            self._bus.publish(self._keys.behaviour_status, status)
        return status is not None
