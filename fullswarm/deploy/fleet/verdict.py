"""After the switch: healthy and kept, or taken back, over a link that may be gone for a while."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import Literal

from fullswarm.deploy.fleet import steps
from fullswarm.deploy.fleet.facts import Health, facts_of
from fullswarm.deploy.fleet.login import Address, Login
from fullswarm.deploy.fleet.remote import Remote
from fullswarm.errors import FullswarmError, Unreachable

POLL_S = 0.5
STEADY_S = 2.0
"""Healthy for so long in one piece: an agent that comes up and dies again is not."""
FAULT_S = 5.0
"""A fault that stays so long will not go by itself."""
AFTER_GUARD_S = 20.0
"""A robot has gone back by itself so long after its guard fired, restart of the old agent included."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """healthy: committed; back: on the release before; never: it has not switched; lost: unknown yet."""

    state: Literal["healthy", "back", "never", "lost"]
    why: str = ""


@dataclass(slots=True)
class Watch:
    """Polls one robot from its switch on.

    Parameters
    ----------
    guard_s
        When the robot goes back by itself. The base judges a third of that before: it knows why.
    switched
        It has said that it switched; else the link broke, and that must be found out.
    rollback_before
        What the robot said of its last rollback before the switch.
    """

    login: Login
    address: Address
    release: str
    guard_s: float
    switched: bool = False
    rollback_before: str | None = None
    _why: str = field(default="nothing heard yet", init=False)
    _good_since_s: float | None = field(default=None, init=False)
    _fault_since_s: float | None = field(default=None, init=False)

    async def until_settled(self) -> Verdict:
        """Wait until it is healthy, and commit; else take it back; else see whether it has gone back by itself."""
        now = asyncio.get_running_loop().time
        began_s = now()
        while now() < began_s + self.guard_s + AFTER_GUARD_S:
            try:
                async with self.login.connect(self.address) as remote:
                    verdict = await self._over(remote, began_s + self.guard_s * 2 / 3)
                    if verdict is not None:
                        return verdict
            except FullswarmError as error:  # whatever it is: until the guard has fired, there is hope
                self._why, self._good_since_s = error.what, None
            await asyncio.sleep(POLL_S)
        return Verdict("lost", self._why)

    async def _over(self, remote: Remote, judge_s: float) -> Verdict | None:
        """Watch over one connection; None: it was there, and does not say yet."""
        now = asyncio.get_running_loop().time
        gone = await self._elsewhere(remote)
        while gone is None:
            said, why = await steps.health(remote)
            self._note(said, why, now())
            if self._good_since_s is not None and now() - self._good_since_s >= STEADY_S:
                await steps.commit(remote, self.release)
                return Verdict("healthy")
            if said is None or said.release != self.release:
                gone = await self._elsewhere(remote)
            elif self._fault_since_s is not None and now() - self._fault_since_s >= FAULT_S:
                return await self._take_back(remote)
            if gone is None and now() >= judge_s:
                return await self._take_back(remote)
            await asyncio.sleep(POLL_S)
        return gone

    def _note(self, said: Health | None, why: str, now_s: float) -> None:
        mine = said is not None and said.release == self.release
        good = mine and said is not None and said.healthy
        self._good_since_s = (self._good_since_s or now_s) if good else None
        faulty = mine and said is not None and said.lifecycle == "FAULT"
        self._fault_since_s = (self._fault_since_s or now_s) if faulty else None
        if not good:
            self._why = why

    async def _elsewhere(self, remote: Remote) -> Verdict | None:
        """It does not run the release: it went back by itself, or never got there."""
        facts = await facts_of(remote)
        if facts.current == self.release:
            self.switched = True
            # Nothing pending: our commit was heard, and only the answer was lost.
            return None if facts.pending else Verdict("healthy")
        if not self.switched and facts.last_rollback == self.rollback_before:
            return Verdict("never")
        return Verdict("back", f"went back by itself: {facts.back_because or self._why}")

    async def _take_back(self, remote: Remote) -> Verdict:
        try:
            await steps.roll_back(remote, self._why)
        except Unreachable:
            raise
        except FullswarmError as error:
            return Verdict("lost", f"{self._why}; {error.what}")
        return Verdict("back", self._why)
