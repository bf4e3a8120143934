"""Robots that one program drives by twists: each twist has a time to live, after which its robot is stopped.

A twist goes the way of the console's stick: an intent of the behaviour ``drive_bc``, behind the safety filter, which
the robot itself lets expire 0.3 s after the last one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from fullswarm.errors import RequestRefused
from fullswarm.messages import RequestStatus
from fullswarm.operator.client import Operator
from fullswarm.operator.console.api.records import FULL_M_S, FULL_RAD_S
from fullswarm.operator.teleop import Teleop
from fullswarm.recent import Recent
from fullswarm.runtime import Scheduler, Timer

BEHAVIOUR = "drive_bc"
CHECK_S = 0.02
RECENT_S = 1.0
"""A robot that was stopped while it was driven, or so soon after, needs a zero twist before it is driven again, or so
long a pause: twists that are on the way must not start it."""
MOST_REMEMBERED = 1024
MOST_DRIVEN, MOST_DRIVEN_EACH = 16, 8
"""Robots driven by twists, of all programs and of one: the core takes 500 requests a second of one console."""


@dataclass(slots=True)
class Stream:
    """The intents of one driven robot."""

    teleop: Teleop
    owner: object  # of the connection that sends the twists
    until_s: float = 0.0


@dataclass(slots=True)
class Block:
    """Why a robot needs a zero twist first, and when a twist was refused last."""

    why: str
    refused_s: float


class TwistStreams:
    """The robots that a program drives.

    Parameters
    ----------
    admit
        Returns whether one more robot may be driven: the core takes a limited rate of intents of one console.
    """

    def __init__(self, operator: Operator, scheduler: Scheduler, admit: Callable[[], bool]) -> None:
        self._operator, self._scheduler, self._admit = operator, scheduler, admit
        self._streams: dict[str, Stream] = {}
        self._teleops: Recent[str, Teleop] = Recent(MOST_REMEMBERED)
        self._ended_s: dict[str, float] = {}
        self._blocked: Recent[str, Block] = Recent(MOST_REMEMBERED)  # robots that need a zero twist first
        self._timer: Timer | None = None

    def __len__(self) -> int:
        """Count the robots that are driven."""
        return len(self._streams)

    def until_s(self, robot: str) -> float | None:
        """Return until when a robot is driven, on the scheduler's clock; None: it is not."""
        stream = self._streams.get(robot)
        return None if stream is None else stream.until_s

    def drive(self, robot: str, linear_m_s: float, angular_rad_s: float, ttl_s: float, owner: object) -> None:
        """Pass a twist on.

        Raises
        ------
        RequestRefused
            The robot was stopped, or another connection drives it, or too many robots are driven.
        """
        now_s = self._scheduler.now_s()
        self._check_block(robot, moves=bool(linear_m_s or angular_rad_s))
        stream = self._streams.get(robot)
        if stream is not None and stream.owner != owner:
            hint = "end it there, or wait until its twist has ended"
            raise RequestRefused("another connection of yours drives it", where=robot, hint=hint)
        if stream is None:
            if not self._admit():
                hint = f"{MOST_DRIVEN_EACH} of one token, {MOST_DRIVEN} of all; request behaviours for more"
                raise RequestRefused("too many robots are driven by twists", where=robot, hint=hint)
            # The same one as before: a new one would not end the zeros that the old one still sends.
            self._teleops[robot] = self._teleops.get(robot) or self._new_teleop(robot)
            stream = self._streams[robot] = Stream(self._teleops[robot], owner)
        stream.until_s = now_s + ttl_s
        sticks = {"linear": linear_m_s / FULL_M_S, "angular": angular_rad_s / FULL_RAD_S}
        stream.teleop.hold(BEHAVIOUR, sticks, {"speed_m_s": FULL_M_S, "turn_rad_s": FULL_RAD_S})
        if self._timer is None:
            self._timer = self._scheduler.every(CHECK_S, self._check)

    def _check_block(self, robot: str, *, moves: bool) -> None:
        """Refuse a twist for a robot that was stopped while the program goes on sending; else end the block."""
        block = self._blocked.get(robot)
        if block is None:
            return
        now_s = self._scheduler.now_s()
        paused = now_s - block.refused_s > RECENT_S
        if moves and not paused:
            block.refused_s = now_s
            hint = f"once it may move again, send a zero twist, or pause for {RECENT_S:g} s, then drive on"
            raise RequestRefused(block.why, where=robot, hint=hint)
        del self._blocked[robot]

    def release(self, robots: Iterable[str] | None = None, owner: object = None) -> None:
        """Stop driving `robots` (None: all), those of one `owner` or of all."""
        for robot in tuple(self._streams) if robots is None else tuple(robots):
            stream = self._streams.get(robot)
            if stream is not None and owner in (None, stream.owner):
                self._end(robot)

    def block(self, robots: tuple[str, ...], why: str) -> None:
        """Note that `robots` (none: all) were stopped or lost: driving one again needs a zero twist first."""
        now_s = self._scheduler.now_s()
        recent = {robot for robot, ended_s in self._ended_s.items() if now_s - ended_s <= RECENT_S}
        for robot in {*self._streams, *recent}:
            if not robots or robot in robots:
                self._blocked[robot] = Block(why, now_s)
                if robot in self._streams:
                    self._end(robot)

    def unblock(self, robots: Iterable[str]) -> None:
        """Let robots be driven again whatever was before: their lease was just asked for, which is deliberate."""
        for robot in robots:
            self._blocked.pop(robot, None)
            self._ended_s.pop(robot, None)

    def _new_teleop(self, robot: str) -> Teleop:
        def receive(status: RequestStatus) -> None:
            stream = self._streams.get(robot)
            # While it is driven: afterwards it is the answer to the final zeros.
            if status.phase == "refused" and stream is not None:
                self.block((robot,), status.reason or "refused without a reason")

        return Teleop(self._operator, self._scheduler, (robot,), on_status=receive)

    def _end(self, robot: str) -> None:
        now_s = self._scheduler.now_s()
        self._ended_s = {each: at_s for each, at_s in self._ended_s.items() if now_s - at_s <= RECENT_S}
        self._ended_s[robot] = now_s
        self._streams.pop(robot).teleop.release()
        if not self._streams and self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _check(self) -> None:
        now_s = self._scheduler.now_s()
        for robot, stream in tuple(self._streams.items()):
            if now_s >= stream.until_s:
                self._end(robot)
