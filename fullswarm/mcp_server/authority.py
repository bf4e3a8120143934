"""The leases that the model has taken, each for a limited time, and the tokens of its dry runs."""

from __future__ import annotations

import asyncio
import hashlib
import json
import secrets
from collections.abc import Iterable, Mapping
from typing import Any

from fullswarm.clock import Clock
from fullswarm.errors import RequestRefused
from fullswarm.operator.swarm import Client, Held
from fullswarm.recent import Recent

TOKEN_S = 60.0
"""A dry run is older than the swarm that it describes soon."""
TOKENS = 64


class HeldRobots:
    """The robots that the model holds.

    A lease ends by itself: a model may stop in the middle of a conversation, and robots that it has forgotten must not
    be kept from people.
    """

    def __init__(self, client: Client, clock: Clock) -> None:
        self._client, self._clock = client, clock
        self._held: dict[str, Held] = {}
        self._changing = asyncio.Lock()
        self._end_s = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._ending: asyncio.Future[None] | None = None

    @property
    def left_s(self) -> float:
        """Seconds until the leases end."""
        return max(0.0, self._end_s - self._clock.now_s()) if self._held else 0.0

    def robots(self) -> tuple[str, ...]:
        """Return the robots that are held now, as the core reports."""
        holders = self._client.state().holders
        return tuple(robot for robot in sorted(self._held) if holders.get(robot) == self._client.name)

    async def take(self, robots: Iterable[str], seconds: float) -> tuple[str, ...]:
        """Hold robots, and keep those that are held, for so many seconds from now; return all that are held.

        Raises
        ------
        RequestRefused
            Another operator holds one: nothing is taken over from people, and none of `robots` is held.
        Unreachable
            The core does not answer.
        """
        async with self._changing:
            missing = [robot for robot in dict.fromkeys(robots) if robot not in self.robots()]
            await self._release([robot for robot in missing if robot in self._held])  # lost to another operator
            asked = [asyncio.wrap_future(self._client.hold((robot,), False)) for robot in missing]
            found = await asyncio.gather(*asked, return_exceptions=True)
            granted = {robot: each for robot, each in zip(missing, found, strict=True) if isinstance(each, Held)}
            self._held |= granted
            refused = [each for each in found if isinstance(each, BaseException)]
            if refused:
                await self._release(list(granted))
                raise _refusal(refused)
            self._end_in(seconds)
            return self.robots()

    async def release(self) -> tuple[str, ...]:
        """Release all robots; return which."""
        async with self._changing:
            robots = tuple(sorted(self._held))
            await self._release(list(robots))
            return robots

    async def _release(self, robots: list[str]) -> None:
        asked = [asyncio.wrap_future(self._client.release(self._held.pop(robot))) for robot in robots]
        await asyncio.gather(*asked, return_exceptions=True)  # of a silent core: what is not renewed ends by itself

    def _end_in(self, seconds: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._end_s = self._clock.now_s() + seconds
        self._timer = asyncio.get_running_loop().call_later(seconds, self._begin_end)

    def _begin_end(self) -> None:
        self._ending = asyncio.ensure_future(self._expire())  # kept: the loop has weak references only

    async def _expire(self) -> None:
        if self._clock.now_s() >= self._end_s:
            await self.release()


def _refusal(errors: list[BaseException]) -> BaseException:
    held = [each for each in errors if isinstance(each, RequestRefused)]
    if not held:
        return errors[0]
    hint = "ask that operator; a model cannot take robots over"
    return RequestRefused("; ".join(each.what for each in held), where="lease", hint=hint, code="held")


class DryRuns:
    """The tokens of dry runs: each admits one call with the same content, for a short time."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._issued: Recent[str, tuple[str, float]] = Recent(TOKENS)

    def issue(self, content: Mapping[str, Any]) -> str:
        """Return a token for this content."""
        token = secrets.token_hex(12)
        self._issued[token] = _digest(content), self._clock.now_s() + TOKEN_S
        return token

    def redeem(self, token: str, content: Mapping[str, Any]) -> None:
        """Use a token up.

        Raises
        ------
        RequestRefused
            It is none, is too old, was used, or belongs to another content.
        """
        hint = "call with dry_run = true, read the answer, then call with its token and the same content"
        if not token:
            raise RequestRefused("a request needs the token of its dry run", where="token", hint=hint)
        digest, end_s = self._issued.pop(token, ("", 0.0))
        if not digest or self._clock.now_s() > end_s:
            raise RequestRefused("this token was used, is unknown or too old", where="token", hint=hint)
        if not secrets.compare_digest(digest, _digest(content)):
            raise RequestRefused("this token belongs to another request", where="token", hint=hint)


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
