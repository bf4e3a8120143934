"""A request of a laboratory: its status, its result, and its end."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from fullswarm.messages import FINAL_PHASES, RequestStatus, Result, Value
from fullswarm.operator.client import PendingRequest


class LabRequest:
    """What :meth:`Lab.request` returns.

    Attributes
    ----------
    behaviour, robots, parameters : as requested
    """

    def __init__(
        self,
        pending: PendingRequest,
        behaviour: str,
        robots: tuple[str, ...],
        parameters: Mapping[str, Value],
        stop: Callable[[LabRequest], None],
    ) -> None:
        self.behaviour, self.robots, self.parameters = behaviour, robots, dict(parameters)
        self._pending, self._stop = pending, stop

    @property
    def id(self) -> str:
        """The id of the request."""
        return self._pending.request.id

    @property
    def status(self) -> RequestStatus | None:
        """The newest status that the core has sent; None: it has not answered yet."""
        return self._pending.status

    @property
    def phase(self) -> str:
        """Where the request is: pending, running, ended, superseded, refused."""
        return self.status.phase if self.status is not None else "pending"

    @property
    def running(self) -> bool:
        """Whether some robot may still run it."""
        return self.phase not in FINAL_PHASES

    @property
    def result(self) -> dict[str, Result]:
        """How the behaviour has ended itself, by robot: ``outcome``, "arrived" or "failed", and ``text``."""
        return {each.robot: each for each in self.status.results} if self.status is not None else {}

    def cancel(self) -> None:
        """Stop the robots that still run this request. Those that run something newer go on."""
        self._stop(self)

    def __repr__(self) -> str:
        who = ", ".join(self.robots[:6]) + (", ..." if len(self.robots) > 6 else "")
        return f"<LabRequest {self.behaviour}: {self.phase}; {who}>"
