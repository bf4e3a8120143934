"""Starts and controls missions: sends each request until the core has answered, and collects the missions' states."""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec

from fullswarm.bus.base import Bus
from fullswarm.config.mission_file import MissionFile
from fullswarm.errors import ConfigError, RequestRefused
from fullswarm.keys import Keys
from fullswarm.messages import (
    MissionOp,
    MissionPhase,
    MissionPlan,
    MissionReply,
    MissionRequest,
    MissionStatus,
    StepStatus,
)
from fullswarm.operator.client import RESEND_S, due, short_id
from fullswarm.recent import Recent
from fullswarm.runtime import Scheduler, Timer

ReplyHandler = Callable[[MissionReply], None]
ENDED: tuple[MissionPhase, ...] = ("done", "failed", "aborted")
MOST_MISSIONS = 256
SILENT_S = 3.0
"""The core repeats the state of each mission that has not ended every second."""


@dataclass(slots=True)
class PendingMissionRequest:
    """A request and its answer, `reply`."""

    request: MissionRequest
    on_reply: ReplyHandler | None
    reply: MissionReply | None = None
    timer: Timer | None = field(default=None, repr=False)

    def close(self) -> None:
        """Do not send it again."""
        if self.timer is not None:
            self.timer.cancel()


class MissionClient:
    """One operator's access to the missions of a swarm.

    Parameters
    ----------
    source, name, clock, new_id
        As in :class:`~fullswarm.operator.client.Operator`.
    on_status
        Called with each status that is received.
    watch
        Receive the missions' states; else only the answers to what is asked.

    Attributes
    ----------
    missions : id → newest status, in the order in which they were first received
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        scheduler: Scheduler,
        source: str,
        *,
        name: str = "",
        clock: str = "",
        on_status: Callable[[MissionStatus], None] | None = None,
        watch: bool = True,
        new_id: Callable[[], str] = short_id,
    ) -> None:
        self._new_id = new_id
        self._bus, self._keys, self._scheduler = bus, keys, scheduler
        self._source, self._name, self._clock, self._on_status = source, name or source, clock, on_status
        self.missions: Recent[str, MissionStatus] = Recent(MOST_MISSIONS)
        self._pending: dict[str, PendingMissionRequest] = {}
        self._subscriptions = [
            bus.subscribe(keys.mission_reply(), MissionReply, self._replied),
            *([bus.subscribe(keys.mission_status, MissionStatus, self._received)] if watch else []),
        ]

    def ask(
        self,
        op: MissionOp,
        on_reply: ReplyHandler | None = None,
        *,
        mission: str = "",
        plan: MissionPlan | None = None,
        track: str = "",
        step: str = "",
        take: bool = False,
    ) -> PendingMissionRequest:
        """Send a request, again every 0.2 s, after 10 s each second, until the core has answered it."""
        request = MissionRequest(
            id=self._new_id(), op=op, mission=mission[:64], plan=plan, track=track[:64], step=step[:64], take=take,
            source=self._source, operator=self._name, clock=self._clock, stamp_s=self._scheduler.now_s(),
        )  # fmt: skip
        pending = PendingMissionRequest(request, on_reply)
        self._pending[request.id] = pending

        ticks, phase = itertools.count(), zlib.crc32(request.id.encode())

        def send() -> None:
            if due(next(ticks), phase):
                self._bus.publish(self._keys.mission_request, request)

        send()
        pending.timer = self._scheduler.every(RESEND_S, send)
        return pending

    def forget(self, pending: PendingMissionRequest) -> None:
        """Do not send a request again, and do not wait for its answer."""
        self._pending.pop(pending.request.id, None)
        pending.close()

    def close(self) -> None:
        """Stop sending and unsubscribe. Missions go on."""
        for pending in self._pending.values():
            pending.close()
        for subscription in self._subscriptions:
            subscription.close()

    def _replied(self, reply: MissionReply) -> None:
        pending = self._pending.pop(reply.id, None)
        if pending is None:
            return
        pending.close()
        pending.reply = reply
        if pending.on_reply is not None:
            pending.on_reply(reply)

    def _received(self, status: MissionStatus) -> None:
        before = self.missions.get(status.mission)
        if before is not None and before.core == status.core and before.sequence >= status.sequence:
            return
        self.missions[status.mission] = status
        if self._on_status is not None:
            self._on_status(status)


def refusal(reply: MissionReply, file: MissionFile | None = None) -> ConfigError:
    """Return the error for a refused request; what is wrong with a plan has the lines of its file."""
    if reply.problems and file is not None:
        return file.errors(reply.problems)
    return RequestRefused(reply.reason or "refused without a reason", code=reply.code)


def waiting_steps(status: MissionStatus) -> list[tuple[str, StepStatus]]:
    """Return (track, step) of those that wait for a confirmation."""
    return [(track.name, step) for track in status.tracks for step in track.steps if step.confirm]


def plain(status: MissionStatus) -> dict[str, object]:
    """Return a status as plain values for JSON."""
    found: dict[str, object] = msgspec.to_builtins(status)
    return found
