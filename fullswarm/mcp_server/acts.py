"""Tools that change what robots do: stop and e-stop for every model; leases and requests if a person allows them.

A model may always stop robots. It never releases an e-stop: whether the surroundings are free is seen by a person. It
requests behaviours behind the safety filter only, and does not write the core's database, which has the filter's
settings.
"""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

import msgspec
from pydantic import Field

from fullswarm.clock import Clock
from fullswarm.config.mission_file import read_mission
from fullswarm.errors import ConfigError, FullswarmError, RequestRefused, TimedOut
from fullswarm.fitness import needs_of
from fullswarm.mcp_server.access import Access
from fullswarm.mcp_server.authority import TOKEN_S, DryRuns, HeldRobots
from fullswarm.mcp_server.limits import RateLimit
from fullswarm.mcp_server.reads import Nothing, summary
from fullswarm.mcp_server.tools import Arguments, Name, Robot, Robots, Tool

LONGEST_LEASE_S, LEASE_S = 600.0, 120.0
REQUESTS_PER_S, REQUESTS_AT_ONCE = 1.0, 4.0
STARTED_S = 2.0
"""For the robots to answer; they do within 0.1 s unless messages are lost."""
SHARED_S = 0.5
"""Stops of the same robots that come so soon after one another are one."""
ESTOP_S = 5.0
MOST_PARAMETERS = 64
MOST_ESTOPS = 16
"""Choices of robots whose e-stop is being repeated; more are refused, all robots together never are."""
URGENT = frozenset({"engage_estop", "stop_robots"})
OVERTAKING = frozenset({"engage_estop"})
"""Carried out before calls that came earlier: robots in e-stop refuse these. A stop waits for its turn, or a request
from before it would start robots again."""
RELEASES = frozenset({"release_estop", "clear_estop", "reset_estop", "disengage_estop"})

Number = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)]
Point = Annotated[list[Number], Field(max_length=3)]
Word = Annotated[str, Field(max_length=200)]
Integer = Annotated[int, Field(ge=-(10**9), le=10**9)]
Value = bool | Integer | Number | Word | Annotated[list[Number | Point], Field(max_length=500)]


class Reason(Arguments):
    """What is latched, and why."""

    robots: Robots = Field([], description="robot ids; empty: all robots")
    reason: Name = Field("", description="for the people who find the robots latched")


class Stopped(Arguments):
    """What is stopped."""

    robots: Robots = Field([], description="robot ids; empty: all robots")


class LeaseTerms(Arguments):
    """What is to be held."""

    robots: Annotated[list[Robot], Field(min_length=1, max_length=1000)]
    seconds: Annotated[float, Field(ge=1.0, le=LONGEST_LEASE_S)] = LEASE_S


class Requested(Arguments):
    """A request."""

    behaviour: Name
    robots: Annotated[list[Robot], Field(min_length=1, max_length=1000)]
    parameters: Annotated[dict[Name, Value], Field(max_length=MOST_PARAMETERS)] = Field({}, description="by name")
    dry_run: bool = Field(True, description="true: check only; false: send, with the token of the dry run")
    token: Name = ""

    @property
    def content(self) -> dict[str, Any]:
        """What must be the same in the dry run and in the call that is carried out."""
        return {"behaviour": self.behaviour, "robots": self.robots, "parameters": self.parameters}


class Stops:
    """The tools that stop robots; a model always has them."""

    def __init__(self, access: Access, clock: Clock) -> None:
        self._access, self._clock = access, clock
        self._under_way: dict[tuple[str, tuple[str, ...]], tuple[float, asyncio.Future[dict[str, Any]]]] = {}

    def tools(self) -> list[Tool]:
        """Return them."""
        return [
            Tool("engage_estop", "stop", ESTOP, Reason, self._estop),
            Tool("stop_robots", "stop", STOP, Stopped, self._stop),
        ]

    async def _estop(self, given: Reason) -> dict[str, Any]:
        robots = await self._known(given.robots)
        return await self._shared("estop", robots, self._engage(robots, given.reason))

    async def _engage(self, robots: tuple[str, ...], reason: str) -> dict[str, Any]:
        receipts = await asyncio.wrap_future(self._access.client.estop(True, robots, reason, ESTOP_S))
        return {
            "latched": {
                robot: {"standing": each.standing, "rolled_m": each.rolled_m} for robot, each in receipts.items()
            },
            "next": "a person releases it: fullswarm estop --clear",
        }

    async def _stop(self, given: Stopped) -> dict[str, Any]:
        robots = await self._known(given.robots)
        return await self._shared("stop", robots, self._send_stop(robots))

    async def _send_stop(self, robots: tuple[str, ...]) -> dict[str, Any]:
        await asyncio.wrap_future(self._access.client.stop(robots))
        return {"stop_sent_to": robots or "all robots", "next": "swarm_status shows whether they stand"}

    async def _known(self, given: list[str]) -> tuple[str, ...]:
        """Return the robots, none: all. Unknown names are refused: their stop would be repeated without an end."""
        if not given:
            return ()
        try:
            return tuple(sorted(row.robot for row in await self._access.rows(given)))
        except ConfigError as error:
            hint = f"{error.hint}; robots = [] stops all robots"
            raise ConfigError(error.what, where=error.where, hint=hint) from None

    async def _shared(self, kind: str, robots: tuple[str, ...], work: Any) -> dict[str, Any]:
        """Do the work, or wait for what does the same since a moment ago."""
        now_s = self._clock.now_s()
        for key in [key for key, (_, each) in self._under_way.items() if each.done()]:
            del self._under_way[key]
        began_s, running = self._under_way.get((kind, robots), (-1e9, None))
        if running is None or now_s - began_s > SHARED_S:
            if robots and len(self._under_way) >= MOST_ESTOPS:
                work.close()
                raise RequestRefused(
                    f"{MOST_ESTOPS} stops are under way", where=kind, hint="robots = [] stops all robots"
                )
            running = asyncio.ensure_future(work)
            running.add_done_callback(_observed)
            self._under_way[kind, robots] = now_s, running
        else:
            work.close()
        return await asyncio.shield(running)


def _observed(work: asyncio.Future[Any]) -> None:
    """Note the error of a stop whose caller has cancelled it, so that the loop does not report it as unnoticed."""
    if not work.cancelled():
        work.exception()


class Acts:
    """The tools that move robots, for a model that is allowed to."""

    def __init__(self, access: Access, held: HeldRobots, clock: Clock) -> None:
        self._access, self._held, self._dry_runs = access, held, DryRuns(clock)
        self._rate = RateLimit(clock, REQUESTS_PER_S, REQUESTS_AT_ONCE)

    def tools(self) -> list[Tool]:
        """Return them."""
        return [
            Tool("take_lease", "hold", TAKE, LeaseTerms, self._take),
            Tool("release_lease", "hold", "Release all robots that you hold. They go on with what they do.", Nothing,
                 self._release),
            Tool("request_behaviour", "move", REQUEST, Requested, self._request),
        ]  # fmt: skip

    async def _take(self, given: LeaseTerms) -> dict[str, Any]:
        await self._access.rows(given.robots)
        with self._access.waiting():
            held = await self._held.take(given.robots, given.seconds)
        return {"held": held, "operator": self._access.client.name, "ends_in_s": round(self._held.left_s, 1)}

    async def _release(self, _: Nothing) -> dict[str, Any]:
        with self._access.waiting():
            return {"released": await self._held.release()}

    async def _request(self, given: Requested) -> dict[str, Any]:
        with self._access.waiting():
            self._check_lease(given.robots)
            await self._check_behaviour(given.behaviour)
            if given.dry_run:
                return await self._check(given)
            self._dry_runs.redeem(given.token, given.content)
            if not self._rate.admit():
                text = f"more than {REQUESTS_PER_S:g} requests per second"
                raise RequestRefused(text, where="request_behaviour", hint="wait, then begin with a dry run")
            return await self._send(given)

    def _check_lease(self, robots: list[str]) -> None:
        free = sorted(set(robots).difference(self._held.robots()))
        if free:
            hint = "take_lease first; it ends by itself, and other operators may have taken robots over"
            raise RequestRefused(f"you do not hold {', '.join(free[:20])}", where="lease", hint=hint)

    async def _check_behaviour(self, name: str) -> None:
        """Refuse what runs without the safety filter: only it keeps a model's mistakes from becoming contacts."""
        record = await self._access.record(name)
        stands = not record.get("law") and not record.get("centralised")
        if not record.get("filtered") and not stands:
            records = await self._access.records()
            near = f"{name}_bc"
            hint = f"request {near}" if near in records else "list_behaviours shows those with the safety filter"
            raise RequestRefused(f"'{name}' runs without the safety filter", where="behaviour", hint=hint)

    async def _check(self, given: Requested) -> dict[str, Any]:
        """Return what would be sent and what the core says of it, with a token if nothing is wrong."""
        problem = ""
        try:
            await asyncio.wrap_future(self._access.client.mission("check", read_mission(_as_mission(given))))
        except ConfigError as error:
            problem = error.what
        snapshot = await self._access.snapshot()
        rows = [summary(row, snapshot) for row in await self._access.rows(given.robots)]
        latched = [row["robot"] for row in rows if row.get("estop")]
        found: dict[str, Any] = {
            "would_send": {**given.content, "operator": self._access.client.name},
            "core_accepts": not problem, "problems": [_of_request(line) for line in problem.splitlines()],
            "robots_now": rows, "latched_robots_refuse": latched, "dry_run": True,
        }  # fmt: skip
        if not problem:
            found |= {"token": self._dry_runs.issue(given.content), "token_valid_s": TOKEN_S}
        return found

    async def _send(self, given: Requested) -> dict[str, Any]:
        client = self._access.client
        asked = client.request(
            given.behaviour, tuple(given.robots), False, parameters=given.parameters, team="", needs=needs_of({}),
            roles=None,
        )  # fmt: skip
        pending = await asyncio.wrap_future(asked)
        note = ""
        try:
            await asyncio.wrap_future(client.started(pending, STARTED_S))
        except TimedOut as error:
            note = str(error)
        except FullswarmError as error:
            raise type(error)(error.what, where=error.where, hint="see swarm_status", code=error.code) from None
        return {"dry_run": False, "status": msgspec.to_builtins(pending.status), "note": note}


def _as_mission(given: Requested) -> dict[str, Any]:
    """Return a mission of one step: the core checks missions without starting them, by the checks of requests."""
    step = {"name": "request", "behaviour": given.behaviour, "robots": given.robots, "parameters": given.parameters}
    return {"name": "check", "steps": [step | {"done": {"time_s": 1.0}}]}


def _of_request(problem: str) -> str:
    """Return a problem of that mission as one of the request: without the place in the mission."""
    return problem.rpartition("steps[0].")[2] or problem


def refusal_of(name: str) -> RequestRefused | None:
    """Return the refusal of a tool that is never offered; None: it is another one."""
    if name not in RELEASES:
        return None
    hint = "a person looks at the robots, then runs `fullswarm estop --clear`"
    return RequestRefused("a model cannot release an e-stop", where=name[:64], hint=hint)


ESTOP = (
    "Latch the e-stop of robots: they stand at once and stay so until a PERSON releases it. Always allowed; use it "
    "whenever something may be hurt. Repeated until all have confirmed their standstill."
)
STOP = "Stop robots, whatever they do, whoever asked for it. Not latched: the next request starts them again."
TAKE = (
    "Hold robots for some seconds: requests of other operators do not move them, yours may. Refused while another one "
    "holds one. Call it again to hold longer."
)
REQUEST = (
    "Have robots that you hold run a behaviour. First with dry_run = true: the answer says what would be sent and what "
    "the core says of it, and has a token. Then with dry_run = false, the token, and the same content."
)
