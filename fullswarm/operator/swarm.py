"""A live swarm in a Python program: ``from fullswarm import Swarm``, and `AsyncSwarm` for asyncio.

Both are thin: what is the same stands in :class:`Client`, which runs on a thread of its own. It keeps leases, repeats a
stop and collects states while the program computes or sleeps. Each operation is a future there; `Swarm` waits for it,
`AsyncSwarm` awaits it.

What ends with the client: its leases and what it still repeats. What goes on without it: the behaviours that it has
requested, as with the command line.
"""

from __future__ import annotations

import asyncio
import atexit
import itertools
import math
import os
import socket
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, InvalidStateError
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

from fullswarm.bus.base import OPERATOR, NamedBus
from fullswarm.bus.endpoint import DEFAULT_HUB
from fullswarm.bus.renewal import renew_later
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock, clock_id
from fullswarm.config.mission_file import MissionFile, load_mission, read_mission
from fullswarm.errors import ConfigError, FullswarmError, RequestRefused, TimedOut, Unreachable
from fullswarm.fitness import needs_of
from fullswarm.keys import Keys
from fullswarm.logs import quiet
from fullswarm.messages import (
    EStopReceipt,
    MissionOp,
    MissionReply,
    MissionStatus,
    ParamEntry,
    ParamReply,
    RequestStatus,
    Result,
    Value,
)
from fullswarm.operator.client import Operator, PendingRequest
from fullswarm.operator.estop import LISTEN_S, EStopOrder
from fullswarm.operator.leases import GROUP, LeaseHolder
from fullswarm.operator.missions import ENDED, SILENT_S, MissionClient, PendingMissionRequest, waiting_steps
from fullswarm.operator.missions import refusal as mission_refusal
from fullswarm.operator.outcome import ended, refusal, settled
from fullswarm.operator.params import ParamClient
from fullswarm.operator.scans import DEFAULT_HZ, MOST_HZ, Scan, ScanFeed
from fullswarm.operator.session import operator_name, own_credentials, usual_name
from fullswarm.operator.view import FleetView, RobotRow, Snapshot
from fullswarm.parameters import goals_of
from fullswarm.reasons import Code
from fullswarm.recent import Recent
from fullswarm.runtime import Runtime, RuntimeThread, Timer

T = TypeVar("T")

CONNECT_S, ANSWER_S, ESTOP_S = 3.0, 5.0, 5.0
REMEMBERED = 1024
CORE_S = 1.0
CHECK_S = 0.01
"""What is waited for is checked this often."""
RELEASE_S = 1.0
"""A core that does not report a release within this time is not waited for: the lease ends without being renewed."""
ASK_S = 2.0
"""While the end of a request is waited for, its status is asked for this often: it may have come without a hub."""
IDLE_S = 1.0
"""`states` yields at least so often: the ages grow although nothing is received."""
NEAR_M = 0.15
"""A robot that is so near to its goal counts as arrived."""
Names = Iterable[str] | str | None
MissionSource = str | os.PathLike[str] | Mapping[str, Any]
"""The path of a mission file, or its tables as a dict."""

_numbers = itertools.count(1)


# ---------------------------------------------------------------- what both kinds share
class Request:
    """A request to a live swarm. Its properties never wait: they say what the core has said last.

    Attributes
    ----------
    behaviour : as requested
    """

    def __init__(self, client: Client, pending: PendingRequest) -> None:
        self._client, self._pending = client, pending
        self.behaviour = pending.request.behaviour

    @property
    def id(self) -> str:
        """The id of the request."""
        return self._pending.request.id

    @property
    def status(self) -> RequestStatus | None:
        """The newest status that the core has sent; None: it has not answered yet."""
        return self._pending.status

    @property
    def robots(self) -> tuple[str, ...]:
        """The robots that are to run it."""
        return self.status.robots if self.status is not None else self._pending.request.robots

    @property
    def phase(self) -> str:
        """Where the request is: pending, scheduled, accepted, running, ended, superseded, refused."""
        return self.status.phase if self.status is not None else "pending"

    @property
    def running(self) -> bool:
        """Whether some robot may still run it."""
        return self.status is None or not ended(self.status)

    @property
    def reason(self) -> str:
        """Why it has ended, or why robots refused it; empty: nothing is to be said."""
        return self.status.reason if self.status is not None else ""

    @property
    def result(self) -> dict[str, Result]:
        """How the behaviour has ended itself, by robot: ``outcome``, "arrived" or "failed", and ``text``."""
        return {each.robot: each for each in self.status.results} if self.status is not None else {}

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.behaviour}: {self.phase}; {', '.join(self.robots) or 'all robots'}>"


class MissionHandle:
    """A mission of a live swarm. Its properties never wait: they say what the core has said last.

    Attributes
    ----------
    id : the mission's id
    """

    def __init__(self, client: Client, mission: str) -> None:
        self._client, self.id = client, mission

    @property
    def status(self) -> MissionStatus:
        """All that the core says of it: ``tracks`` with their ``steps``, each with its ``phase`` and ``waits_for``."""
        return self._client.missions[self.id]

    @property
    def name(self) -> str:
        """The name in its file."""
        return self.status.name

    @property
    def phase(self) -> str:
        """Where it is: running, paused, done, failed, aborted."""
        return self.status.phase

    @property
    def ended(self) -> bool:
        """Whether it is done, failed or aborted."""
        return self.phase in ENDED

    @property
    def reason(self) -> str:
        """Why it is paused, failed or aborted; empty: it is not."""
        return self.status.reason

    @property
    def questions(self) -> dict[str, str]:
        """What is to be confirmed now: ``{"track/step": text}``."""
        return {f"{track}/{step.name}": step.confirm for track, step in waiting_steps(self.status)}

    def __repr__(self) -> str:
        running = [
            f"{each.name}/{step.name}" for each in self.status.tracks for step in each.steps if step.phase == "running"
        ]
        return f"<{type(self).__name__} {self.name}: {self.phase}; {', '.join(running) or 'no step runs'}>"


@dataclass(slots=True)
class Held:
    """Robots that a program holds: what ``with swarm.lease(...)`` gives.

    Attributes
    ----------
    robots : those that are held; groups are replaced by their robots
    lost : robot → operator that has taken it over since
    """

    robots: tuple[str, ...] = ()
    lost: dict[str, str] = field(default_factory=dict)


class Client:
    """A connection to a swarm on a thread of its own; all methods may be called on any thread.

    Raises
    ------
    ConfigError
        The hub's address, the swarm's or the operator's name is malformed.
    """

    def __init__(self, hub: str | None, swarm: str, operator: str) -> None:
        quiet()
        self.hub, self.keys = hub or os.environ.get("FULLSWARM_HUB") or DEFAULT_HUB, Keys(swarm)
        self.name = operator_name(operator) if operator else usual_name()
        self.source = f"python@{socket.gethostname()}:{os.getpid()}/{next(_numbers)}"
        self._waiting: dict[Future[Any], Callable[[], None]] = {}
        self._timer: Timer | None = None
        self._leases: list[Held] = []
        self._answered: Recent[str, tuple[str, float]] = Recent(REMEMBERED)  # request → the core that did, when asked
        self._refused: dict[str, str] = {}  # robot → operator that holds it
        self._engaged: dict[tuple[str, ...], EStopOrder] = {}  # repeated until confirmed; none of all robots: ()
        self._thread = RuntimeThread(MonotonicClock(), "fullswarm-swarm", self._end_waiting)
        try:
            self._thread.call(lambda: self._build(self._thread.runtime)).result()
        except BaseException:
            self._thread.close(lambda: None)
            raise
        atexit.register(self.close)

    def _build(self, runtime: Runtime) -> None:
        credentials = own_credentials(self.hub, self.keys.swarm, self.name)
        self._bus = ZenohBus(runtime.mailbox, hub=self.hub, credentials=credentials)
        bus = NamedBus(self._bus, OPERATOR)
        renew_later(bus, runtime, self.keys, credentials)
        self._runtime = runtime
        self._operator = Operator(bus, self.keys, runtime, self.source, name=self.name, clock=clock_id())
        self._view = FleetView(bus, self.keys, runtime)
        self._missions = MissionClient(bus, self.keys, runtime, self.source, name=self.name, clock=clock_id())
        self._params = ParamClient(bus, self.keys, runtime, self.source)
        self._holder = LeaseHolder(
            bus, self.keys, runtime, self.name, on_lost=self._lost, on_refused=self._note_refused
        )  # fmt: skip

    def close(self) -> None:
        """Release the leases, stop repeating and leave the hub. Behaviours go on. Closing twice is fine."""
        atexit.unregister(self.close)
        self._thread.close(self._end)

    def _end(self) -> None:
        self._holder.close()
        self._operator.close()
        self._missions.close()
        self._view.close()
        self._bus.close()

    def _end_waiting(self) -> None:
        for future in list(self._waiting):
            _fail(future, self._closed())
        self._waiting.clear()

    def _closed(self) -> FullswarmError:
        return FullswarmError("this swarm is closed", where=self.hub, hint="open another one: Swarm()")

    def call(self, function: Callable[[], T]) -> Future[T]:
        """Have `function` called on the client's thread."""
        try:
            return self._thread.call(function)
        except RuntimeError as error:
            raise self._closed() from error

    # ------------------------------------------------------------ waiting
    def until(self, ready: Callable[[], T | None], timeout_s: float | None, late: Callable[[], Exception]) -> Future[T]:
        """Return the first value of `ready` that is not None, to come; it is called on the client's thread.

        What `ready` raises fails the future, and so does `late` when the time is over. A future that is cancelled is
        forgotten.
        """
        found: Future[T] = Future()
        end_s = math.inf

        def check() -> None:
            try:
                value = ready()
            except Exception as error:  # whatever it raises is raised where the answer is awaited
                _fail(found, error)
                return
            if value is not None:
                with suppress(InvalidStateError):
                    found.set_result(value)
            elif self._runtime.now_s() >= end_s:
                _fail(found, late())

        def begin() -> None:
            nonlocal end_s
            end_s = math.inf if timeout_s is None else self._runtime.now_s() + timeout_s
            self._waiting[found] = check
            self._check()
            if self._waiting and self._timer is None:
                self._timer = self._runtime.every(CHECK_S, self._check)

        self.call(begin)
        return found

    def _check(self) -> None:
        for future, check in list(self._waiting.items()):
            if not future.done():
                check()
            if future.done():
                self._waiting.pop(future, None)
        if not self._waiting and self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def connected(self) -> Future[bool]:
        """Wait for the hub, and then until each robot has had the time to report."""

        def late() -> Exception:
            hint = "start a swarm with `fullswarm up FLEET.toml`, or give the address of its hub: Swarm('tcp/...')"
            return Unreachable("no hub answers", where=self.hub, hint=hint)

        since_s: list[float] = []

        def ready() -> bool | None:
            if not self._bus.connected():
                since_s.clear()
                return None
            since_s.append(self._runtime.now_s())
            return self._runtime.now_s() - since_s[0] >= LISTEN_S or None

        return self.until(ready, CONNECT_S + LISTEN_S, late)

    # ------------------------------------------------------------ reading
    def watch_scans(self, robots: tuple[str, ...], rate_hz: float) -> ScanFeed:
        """Ask for scans from now on."""
        if not 0.0 < rate_hz <= MOST_HZ:
            raise ValueError(f"rate_hz is {rate_hz}; it must be above 0 and {MOST_HZ:g} at most")
        source = f"{self.source}/{next(_numbers)}"
        bus = NamedBus(self._bus, OPERATOR)
        return self.call(lambda: ScanFeed(bus, self.keys, self._runtime, source, robots, rate_hz)).result()

    def scans(self, feed: ScanFeed) -> Future[list[Scan]]:
        """Wait for the next scans."""
        return self.until(feed.take, None, self._closed)

    def end_scans(self, feed: ScanFeed) -> None:
        """Ask for them no more."""
        with suppress(FullswarmError):  # a closed client asks for nothing any more
            self.call(feed.close)

    def robots(self) -> tuple[str, ...]:
        """Return the robots that have been received so far, by id."""
        return self.call(self._view.robots).result()

    def state(self) -> Snapshot:
        """Return the newest of everything."""
        return self.call(self._view.snapshot).result()

    def newer(self, seen: int, at_s: float) -> Future[tuple[int, float, Snapshot]]:
        """Wait for a state that is newer than message number `seen`, at most `IDLE_S` after `at_s`."""

        def ready() -> tuple[int, float, Snapshot] | None:
            number, now_s = self._view.states_received, self._runtime.now_s()
            if number == seen and now_s - at_s < IDLE_S:
                return None
            return number, now_s, self._view.snapshot()

        return self.until(ready, None, self._closed)

    # ------------------------------------------------------------ requests
    def request(self, behaviour: str, robots: tuple[str, ...], take: bool, **more: Any) -> Future[PendingRequest]:
        """Send a request until the core has answered it; fails with what the core or all robots refused."""
        asked: list[PendingRequest] = []

        def ready() -> PendingRequest | None:
            if not asked:
                asked.append(self._operator.request(behaviour, robots, take=take, **more))
            status = asked[0].status
            if status is not None and status.phase == "refused":
                raise refusal(status)
            if status is not None:
                self._answered[asked[0].request.id] = self._core(), self._runtime.now_s()
            return asked[0] if status is not None else None

        def late() -> Exception:
            self._operator.forget(asked[0])  # it must not start robots later, when it is not expected any more
            return self._no_core()

        found = self.until(ready, ANSWER_S, late)
        found.add_done_callback(lambda future: self._forget(asked) if future.cancelled() else None)
        return found

    def _forget(self, asked: list[PendingRequest]) -> None:
        """Do not repeat a request whose caller was interrupted."""
        with suppress(FullswarmError):
            self.call(lambda: self._withdraw(asked))

    def _withdraw(self, asked: list[PendingRequest]) -> None:
        for pending in asked:
            if pending.status is None:
                self._operator.forget(pending)

    def _no_core(self) -> Unreachable:
        return Unreachable(
            f"the core of swarm '{self.keys.swarm}' did not answer within {ANSWER_S:g} s", where=self.hub,
            hint="is it running? start it with `fullswarm core`, or name the swarm: Swarm(swarm='...')",
        )  # fmt: skip

    def _core(self) -> str:
        """Return which start of the core is there; empty: none that is known."""
        nodes = self._view.snapshot().nodes
        return next((node.process for node in nodes if node.node == "core" and node.age_s < CORE_S), "")

    def _refresh(self, pending: PendingRequest) -> None:
        """Ask for the status of a request now and then, of the core that has answered it."""
        core, asked_s = self._answered.get(pending.request.id, ("", 0.0))
        now_s = self._runtime.now_s()
        if core and now_s - asked_s >= ASK_S:
            self._answered[pending.request.id] = core, now_s
            if core == self._core():
                self._operator.ask_again(pending)

    def started(self, pending: PendingRequest, timeout_s: float | None) -> Future[RequestStatus]:
        """Wait until each robot that is present has answered."""

        def ready() -> RequestStatus | None:
            status = pending.status
            if status is None or not settled(status):
                return None
            if status.refused_by and not status.running:
                raise refusal(status)
            return status

        return self.until(ready, timeout_s, lambda: _late(pending, "has not been confirmed by all robots", timeout_s))

    def ended(self, pending: PendingRequest, timeout_s: float | None) -> Future[RequestStatus]:
        """Wait until no robot runs it any more."""

        def ready() -> RequestStatus | None:
            if pending.status is not None and ended(pending.status):
                return pending.status
            self._refresh(pending)
            return None

        return self.until(ready, timeout_s, lambda: _late(pending, "has not ended", timeout_s))

    def arrived(self, pending: PendingRequest, within_m: float, timeout_s: float | None) -> Future[tuple[str, ...]]:
        """Wait until all robots of a request are at its goal, settled near it, or have ended it with "arrived"."""
        goals = goals_of(pending.request.parameters)
        if not goals:
            hint = "wait for a condition of swarm.states(), or for its end: wait()"
            raise ConfigError(f"'{pending.request.behaviour}' was given no goal or target", hint=hint)

        def there(row: RobotRow) -> bool:
            runs = row.health is not None and row.health.request_id == pending.request.id
            settled = row.health is not None and row.health.stop_code == Code.SETTLED
            return runs and (settled or any(math.dist((row.x_m, row.y_m), goal) <= within_m for goal in goals))

        def ready() -> tuple[str, ...] | None:
            status = pending.status
            if status is None:
                return None
            found = {each.robot for each in status.results if each.outcome == "arrived"}
            found.update(row.robot for row in self._view.snapshot().robots if there(row))
            if found.issuperset(status.robots):
                return status.robots
            if ended(status):
                raise FullswarmError(f"it ended before its robots arrived: {status.reason}", where=status.behaviour)
            self._refresh(pending)
            return None

        return self.until(ready, timeout_s, lambda: _late(pending, "has not brought all robots to its goal", timeout_s))

    def cancel(self, pending: PendingRequest) -> Future[bool]:
        """Stop the robots that still run a request."""

        def begin() -> tuple[str, ...]:
            self._withdraw([pending])
            status = pending.status
            if status is None or ended(status):
                return ()
            # The core's word, since reports of robots may be older than a newer request that must go on.
            return status.running if status.phase == "running" else status.robots

        running = self.call(begin).result()
        return self.stop(running) if running else self.until(lambda: True, None, self._closed)

    def stop(self, robots: tuple[str, ...]) -> Future[bool]:
        """Stop robots; wait until the stop has been sent five times."""
        burst = self.call(lambda: self._operator.stop(robots)).result()

        def late() -> Exception:
            hint = "robots that lost the hub stop by themselves; stop again"
            return Unreachable("the hub was lost before the stop was sent", where=self.hub, hint=hint)

        return self.until(lambda: burst.done or None, ANSWER_S * 2.0, late)

    def estop(
        self, engaged: bool, robots: tuple[str, ...], reason: str, timeout_s: float
    ) -> Future[dict[str, EStopReceipt]]:
        """Engage or release the e-stop; an engaged one is repeated while the client is open.

        A newer order for the same robots is repeated in place of the older one.
        """

        def begin() -> EStopOrder:
            for done in [names for names, each in self._engaged.items() if each.done]:
                del self._engaged[done]
            if robots in self._engaged:
                self._engaged.pop(robots).close()
            made = self._operator.estop(
                engaged, robots, reason, known=self._view.present, deadline_s=math.inf if engaged else timeout_s
            )
            if engaged:
                self._engaged[robots] = made
            return made

        order = self.call(begin).result()

        def ready() -> dict[str, EStopReceipt] | None:
            if order.overruled_by:
                raise RequestRefused(f"{order.overruled_by} was latched again by another operator", where="e-stop")
            return dict(order.receipts) if order.confirmed() else None

        def late() -> Exception:
            robots = ", ".join(order.unconfirmed()) or "any robot"
            hint = "it is repeated until the swarm is closed" if engaged else "release it again"
            return Unreachable(f"no confirmation of the e-stop from {robots}", where=self.hub, hint=hint)

        return self.until(ready, timeout_s, late)

    # ------------------------------------------------------------ database
    def parameters(self, key: str) -> Future[tuple[ParamEntry, ...]]:
        """Read what the core's database has under a key, or under all that begin with it up to its ``*``.

        Fails with what the core refuses, or with `Unreachable` after 5 s.
        """
        replies: list[ParamReply] = []
        withdraw: list[Callable[[], None]] = []

        def ready() -> tuple[ParamEntry, ...] | None:
            if not withdraw:
                withdraw.append(self._params.ask("get", key, replies.append))
            if replies and not replies[0].ok:
                raise ConfigError(replies[0].reason or "refused without a reason", where=key)
            return replies[0].entries if replies else None

        def end() -> None:
            for each in withdraw:
                each()

        def ask_no_more(_: object) -> None:
            with suppress(FullswarmError):
                self.call(end)

        found = self.until(ready, ANSWER_S, self._no_core)
        found.add_done_callback(ask_no_more)
        return found

    # ------------------------------------------------------------ missions
    @property
    def missions(self) -> Mapping[str, MissionStatus]:
        """The newest status of each mission that has been received, by its id."""
        return self._missions.missions

    def mission(self, op: MissionOp, file: MissionFile | None = None, **more: Any) -> Future[MissionReply]:
        """Ask the core, until it has answered; fails with what it refuses.

        The answer comes when the status of its mission, if it names one, has been received.
        """
        asked: list[PendingMissionRequest] = []

        def ready() -> MissionReply | None:
            if not asked:
                asked.append(self._missions.ask(op, plan=file.plan if file is not None else None, **more))
            reply = asked[0].reply
            if reply is not None and not reply.ok:
                raise mission_refusal(reply, file)
            return reply if reply is not None and (not reply.mission or reply.mission in self.missions) else None

        found = self.until(ready, ANSWER_S, self._no_core)
        found.add_done_callback(lambda _: self._forget_missions(asked))
        return found

    def confirm(self, mission: str, path: str) -> Future[MissionReply]:
        """Confirm a step, "track/step" or its name; empty: the only one that waits."""
        track, _, step = path.rpartition("/")
        return self.mission("confirm", mission=mission, track=track, step=step)

    def reached(
        self, mission: str, look: Callable[[MissionStatus], T | None], what: str, timeout_s: float | None
    ) -> Future[T]:
        """Wait until `look` finds something in a mission's status; the core is asked for it when it falls silent."""
        asked: list[PendingMissionRequest] = []
        newest, since_s = self.missions[mission], self.call(self._runtime.now_s).result()

        def ready() -> T | None:
            nonlocal newest, since_s
            status, now_s = self.missions[mission], self._runtime.now_s()
            found = look(status)
            if found is None and status is not newest:
                newest, since_s = status, now_s
                asked.clear()
            elif found is None and now_s - since_s >= SILENT_S:
                if not asked:
                    asked.append(self._missions.ask("show"))
                elif asked[0].reply is None:
                    since_s = now_s - SILENT_S
                elif now_s - since_s >= SILENT_S + CORE_S:
                    hint = "a core keeps missions over a restart if it has a database: [core] store in the fleet file"
                    raise FullswarmError("the core does not know this mission any more", where=status.name, hint=hint)
            return found

        def late() -> Exception:
            status = self.missions[mission]
            why = f" ({status.reason})" if status.reason else ""
            return TimedOut(
                f"the mission {what} within {timeout_s:g} s: it is {status.phase}{why}", where=status.name,
                hint="it goes on; end it with pause() or abort()",
            )  # fmt: skip

        found = self.until(ready, timeout_s, late)
        found.add_done_callback(lambda _: self._forget_missions(asked))
        return found

    def mission_ended(self, mission: str, timeout_s: float | None) -> Future[MissionStatus]:
        """Wait until a mission has ended."""
        return self.reached(
            mission, lambda status: status if status.phase in ENDED else None, "has not ended", timeout_s
        )

    def mission_asks(self, mission: str, timeout_s: float | None) -> Future[MissionStatus]:
        """Wait until a step of a mission is to be confirmed."""

        def look(status: MissionStatus) -> MissionStatus | None:
            if status.phase in ENDED:
                why = f": {status.reason}" if status.reason else ""
                raise FullswarmError(f"the mission is {status.phase} and asks nothing{why}", where=status.name)
            return status if waiting_steps(status) else None

        return self.reached(mission, look, "has asked nothing", timeout_s)

    def _forget_missions(self, asked: list[PendingMissionRequest]) -> None:
        """Do not repeat what is not waited for any more: it must not start robots later."""

        def act() -> None:
            for each in asked:
                self._missions.forget(each)

        with suppress(FullswarmError):
            self.call(act)

    # ------------------------------------------------------------ leases
    def hold(self, robots: tuple[str, ...], take: bool) -> Future[Held]:
        """Hold robots; fails with the operator that holds one."""
        held = Held(robots)
        begun = False

        def ready() -> Held | None:
            nonlocal begun
            if not begun:
                begun = True
                for robot in robots:
                    self._refused.pop(robot, None)
                self._holder.hold(robots, take=take)
            refused = {robot: by for robot, by in self._refused.items() if robot in robots}
            if refused:
                self._release(robots)
                text = "; ".join(f"{robot} is held by {by}" for robot, by in sorted(refused.items()))
                raise RequestRefused(text, where="lease", hint="take=True takes it over", code="held")
            mine, wanted = self._holder.held(), self._holder.wanted()
            if any(robot.startswith(GROUP) for robot in wanted) or not set(_plain(robots)) <= set(mine):
                return None
            held.robots = tuple(robot for robot in mine if robot in robots or len(_plain(robots)) < len(robots))
            self._leases.append(held)
            return held

        def late() -> Exception:
            self._release(robots)
            return self._no_core()

        return self.until(ready, ANSWER_S, late)

    def release(self, held: Held) -> Future[bool]:
        """Release what no other lease of this program holds, and wait until the core has reported it.

        What another operator requests after this is not refused. A core that is silent for `RELEASE_S` fails it; a
        lease that is not renewed then ends by itself.
        """
        begun = False

        def ready() -> bool | None:
            nonlocal begun
            kept = {robot for each in self._leases if each is not held for robot in each.robots}
            robots = tuple(robot for robot in held.robots if robot not in kept)
            if not begun:
                begun = True
                if held in self._leases:
                    self._leases.remove(held)
                self._release(robots)
            return True if set(robots).isdisjoint(self._holder.held()) else None

        return self.until(ready, RELEASE_S, self._no_core)

    def _release(self, robots: tuple[str, ...]) -> None:
        if robots:
            self._holder.release(robots)

    def _lost(self, robots: tuple[str, ...], operator: str) -> None:
        for held in self._leases:
            held.lost |= {robot: operator for robot in robots if robot in held.robots}

    def _note_refused(self, robots: tuple[str, ...], operator: str) -> None:
        self._refused |= dict.fromkeys(robots, operator)


def _fail(future: Future[Any], error: Exception) -> None:
    with suppress(InvalidStateError):  # it was cancelled just now
        future.set_exception(error)


def _late(pending: PendingRequest, what: str, timeout_s: float | None) -> TimedOut:
    status = pending.status
    rest = f"{len(status.running)} of {len(status.robots)} robots run it" if status is not None else "no answer"
    return TimedOut(
        f"the request {what} within {timeout_s:g} s: {rest}", where=pending.request.behaviour,
        hint="the robots go on; stop them with cancel() or stop()",
    )  # fmt: skip


def _names(robots: Names) -> tuple[str, ...]:
    return () if robots is None else (robots,) if isinstance(robots, str) else tuple(robots)


def _mission_file(source: MissionSource) -> MissionFile:
    return read_mission(source) if isinstance(source, Mapping) else load_mission(Path(source))


def _plain(robots: Iterable[str]) -> tuple[str, ...]:
    return tuple(robot for robot in robots if not robot.startswith(GROUP))


def _more(
    parameters: Mapping[str, Value], team: str, needs: Mapping[str, Any] | None,
    roles: Mapping[str, Iterable[str]] | None,
) -> dict[str, Any]:  # fmt: skip
    return {"parameters": dict(parameters), "team": team, "needs": needs_of(needs or {}), "roles": roles}


def _wait(future: Future[T]) -> T:
    """Return the result; an interrupt (Ctrl-C) ends the waiting only."""
    try:
        return future.result()
    except BaseException:
        future.cancel()
        raise


# ---------------------------------------------------------------- without asyncio
class SwarmRequest(Request):
    """What :meth:`Swarm.request` returns."""

    def wait(self, timeout_s: float | None = None) -> dict[str, Result]:
        """Wait until the behaviour has ended on all robots; return how, by robot.

        Many behaviours go on until something else is requested, also those that drive to a goal: see
        :meth:`wait_arrived`. Robots that were stopped, or that something else was requested of, have no result: `phase`
        and `reason` say so. Ctrl-C ends the waiting; the robots go on.

        Raises
        ------
        TimedOut
            It has not ended within `timeout_s`. The robots go on.
        """
        _wait(self._client.ended(self._pending, timeout_s))
        return self.result

    def wait_started(self, timeout_s: float | None = ANSWER_S) -> tuple[str, ...]:
        """Wait until each robot that is present has answered; return those that run it.

        Raises
        ------
        TimedOut
            Some robot has not answered within `timeout_s`.
        SafetyStop
            All refused, because of a latched e-stop.
        FullswarmError
            All refused for another reason.
        """
        return _wait(self._client.started(self._pending, timeout_s)).running

    def wait_arrived(self, timeout_s: float | None = None, *, within_m: float = NEAR_M) -> tuple[str, ...]:
        """Wait until its robots are at the goal, target or targets that were requested; return them.

        A robot counts when it is within `within_m`, or has settled as near as there is room.

        Raises
        ------
        TimedOut
            Some have not arrived within `timeout_s`. The robots go on.
        FullswarmError
            It has ended before; says why.
        ConfigError
            It was given no goal.
        """
        return _wait(self._client.arrived(self._pending, within_m, timeout_s))

    def cancel(self) -> None:
        """Stop the robots that still run this request. Those that run something newer go on."""
        _wait(self._client.cancel(self._pending))


class Mission(MissionHandle):
    """What :meth:`Swarm.start_mission` returns."""

    def wait(self, timeout_s: float | None = None) -> MissionStatus:
        """Wait until the mission has ended; return its last status: ``phase`` is "done", "failed" or "aborted".

        A paused mission waits for :meth:`resume`. Ctrl-C ends the waiting; the mission goes on.

        Raises
        ------
        TimedOut
            It has not ended within `timeout_s`. It goes on.
        FullswarmError
            A core that was started again does not know it.
        """
        return _wait(self._client.mission_ended(self.id, timeout_s))

    def wait_question(self, timeout_s: float | None = None) -> dict[str, str]:
        """Wait until a step is to be confirmed; return what is, ``{"track/step": text}``.

        Raises
        ------
        TimedOut
            Nothing is to be confirmed within `timeout_s`.
        FullswarmError
            The mission has ended, or a core that was started again does not know it.
        """
        _wait(self._client.mission_asks(self.id, timeout_s))
        return self.questions

    def confirm(self, step: str = "") -> None:
        """Confirm a step that waits for an operator, "track/step" or its name; empty: the only one that waits.

        Raises
        ------
        RequestRefused
            No such step waits, or several do, or another operator holds its robots.
        Unreachable
            The core does not answer within 5 s.
        """
        _wait(self._client.confirm(self.id, step))

    def pause(self) -> None:
        """Pause it: its robots stop. Raises as :meth:`confirm`, also when it does not run."""
        _wait(self._client.mission("pause", mission=self.id))

    def resume(self, *, take: bool = False) -> None:
        """Request the steps again that it was paused in, with `take` also of robots that another operator holds.

        Raises as :meth:`confirm`, also when it is not paused.
        """
        _wait(self._client.mission("resume", mission=self.id, take=take))

    def abort(self) -> None:
        """Abort it for good: its robots stop. Raises as :meth:`confirm`, also when it has ended."""
        _wait(self._client.mission("abort", mission=self.id))


class Swarm:
    """A live swarm.

    ::

        with Swarm() as swarm:
            run = swarm.request("move_to_goal_bc", robots=["r1"], goal=[5.0, 5.0])
            run.wait_arrived(timeout_s=60.0)

    Closing it releases its leases; the behaviours that it has requested go on.

    Parameters
    ----------
    hub : address, ``tcp/<host>:<port>``; None: ``FULLSWARM_HUB``, else the one on this machine
    swarm : its name
    operator : who requests, for leases; empty: ``FULLSWARM_OPERATOR``, else ``user@host``

    Raises
    ------
    Unreachable
        No hub answers within 3 s.
    ConfigError
        An address or a name is malformed.
    """

    def __init__(self, hub: str | None = None, *, swarm: str = "swarm", operator: str = "") -> None:
        self._client = Client(hub, swarm, operator)
        try:
            _wait(self._client.connected())
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Swarm:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Release the leases and leave the swarm. Closing twice is fine."""
        self._client.close()

    @property
    def robots(self) -> tuple[str, ...]:
        """Names of the robots that have reported so far."""
        return self._client.robots()

    @property
    def state(self) -> Snapshot:
        """The newest of everything: poses, health, processes, metrics, leases."""
        return self._client.state()

    def states(self) -> Iterator[Snapshot]:
        """Yield the swarm as it is now, each time that something has been received, at least each second.

        A slow reader gets the newest state, and what came between is left out. It ends when the swarm is closed.
        """
        seen, at_s = -1, -math.inf
        while True:
            try:
                seen, at_s, snapshot = _wait(self._client.newer(seen, at_s))
            except FullswarmError:
                return
            yield snapshot

    def scans(self, robots: Names = None, *, rate_hz: float = DEFAULT_HZ) -> Iterator[Scan]:
        """Yield the scans of robots' range sensors as they come; robots send them only while this is read.

        A slow reader gets the newest of each robot. It waits while none comes, and ends when the swarm is closed.

        Parameters
        ----------
        robots : whose; None: of all robots
        rate_hz : how often each is asked for, 20 at most; no scan comes twice; more come while others ask more often

        Raises
        ------
        ValueError
            The rate is not above 0, or above 20.
        """
        feed = self._client.watch_scans(_names(robots), rate_hz)
        try:
            while True:
                try:
                    found = _wait(self._client.scans(feed))
                except FullswarmError:
                    return
                yield from found
        finally:
            self._client.end_scans(feed)

    def request(
        self,
        behaviour: str,
        *,
        robots: Names = None,
        take: bool = False,
        team: str = "",
        needs: Mapping[str, Any] | None = None,
        roles: Mapping[str, Iterable[str]] | None = None,
        **parameters: Any,
    ) -> SwarmRequest:
        """Request a behaviour; return when the core has accepted it.

        Parameters
        ----------
        behaviour : its name; ``_bc`` at its end: behind the safety filter
        robots : names and ``@groups``; None: all
        take : take the robots over from an operator that holds them
        team, needs, roles : as in :meth:`Lab.request <fullswarm.Lab.request>`
        parameters : of the behaviour

        Raises
        ------
        RequestRefused
            No such behaviour or robot, a parameter is wrong, another operator holds a robot.
        Unreachable
            The core does not answer within 5 s. The request is withdrawn then.
        """
        more = _more(parameters, team, needs, roles)
        return SwarmRequest(self._client, _wait(self._client.request(behaviour, _names(robots), take, **more)))

    def start_mission(self, mission: MissionSource, *, take: bool = False) -> Mission:
        """Start a mission that the core carries out, also after the program has ended.

        Parameters
        ----------
        mission : the path of a mission file, or its tables as a dict
        take : take its robots over from operators that hold them

        Raises
        ------
        ConfigError
            All that is wrong with the mission or does not fit the swarm, of a file each with its line.
        RequestRefused
            Another operator holds one of its robots.
        Unreachable
            The core does not answer within 5 s. The request is withdrawn then.
        """
        return Mission(self._client, _wait(self._client.mission("start", _mission_file(mission), take=take)).mission)

    def check_mission(self, mission: MissionSource) -> None:
        """Check a mission against this swarm without starting it; raises as :meth:`start_mission`."""
        _wait(self._client.mission("check", _mission_file(mission)))

    def missions(self) -> tuple[Mission, ...]:
        """Ask the core for its missions, whoever has started them, also those that have ended; in any order.

        Raises
        ------
        Unreachable
            The core does not answer within 5 s.
        """
        _wait(self._client.mission("show"))
        return tuple(Mission(self._client, each) for each in list(self._client.missions))

    def stop(self, robots: Names = None) -> None:
        """Stop robots, whatever they do; None: all. They start again on the next request.

        Raises
        ------
        Unreachable
            The hub was lost before it was sent.
        """
        _wait(self._client.stop(_names(robots)))

    def estop(self, robots: Names = None, *, reason: str = "", timeout_s: float = ESTOP_S) -> dict[str, EStopReceipt]:
        """Latch the e-stop of robots, None: all; return their receipts when all have confirmed their standstill.

        It is repeated until all have confirmed or the swarm is closed, also after an error or Ctrl-C.

        Raises
        ------
        Unreachable
            Some robots have not confirmed within `timeout_s`; names them.
        """
        return _wait(self._client.estop(True, _names(robots), reason, timeout_s))

    def clear_estop(self, robots: Names = None, *, timeout_s: float = ESTOP_S) -> dict[str, EStopReceipt]:
        """Release the e-stop of robots; None: all. They stay where they are until something is requested.

        Raises
        ------
        Unreachable
            Some robots have not confirmed within `timeout_s`; names them.
        RequestRefused
            Another operator has latched one again meanwhile.
        """
        return _wait(self._client.estop(False, _names(robots), "", timeout_s))

    @contextmanager
    def lease(self, *robots: str, take: bool = False) -> Iterator[Held]:
        """Hold robots (and ``@groups``) in a ``with`` statement: the requests of other operators are refused meanwhile.

        Raises
        ------
        RequestRefused
            Another operator holds one, and not `take`.
        Unreachable
            The core does not answer.
        """
        held = _wait(self._client.hold(robots, take))
        try:
            yield held
        finally:
            with suppress(FullswarmError):  # it was closed inside, or the core is silent
                _wait(self._client.release(held))


# ---------------------------------------------------------------- with asyncio
class AsyncSwarmRequest(Request):
    """What :meth:`AsyncSwarm.request` returns; see :class:`SwarmRequest`."""

    async def wait(self, timeout_s: float | None = None) -> dict[str, Result]:
        """See :meth:`SwarmRequest.wait`. A task that is cancelled leaves the robots running."""
        await asyncio.wrap_future(self._client.ended(self._pending, timeout_s))
        return self.result

    async def wait_started(self, timeout_s: float | None = ANSWER_S) -> tuple[str, ...]:
        """See :meth:`SwarmRequest.wait_started`."""
        return (await asyncio.wrap_future(self._client.started(self._pending, timeout_s))).running

    async def wait_arrived(self, timeout_s: float | None = None, *, within_m: float = NEAR_M) -> tuple[str, ...]:
        """See :meth:`SwarmRequest.wait_arrived`."""
        return await asyncio.wrap_future(self._client.arrived(self._pending, within_m, timeout_s))

    async def cancel(self) -> None:
        """See :meth:`SwarmRequest.cancel`."""
        await asyncio.wrap_future(self._client.cancel(self._pending))


class AsyncMission(MissionHandle):
    """What :meth:`AsyncSwarm.start_mission` returns; see :class:`Mission`."""

    async def wait(self, timeout_s: float | None = None) -> MissionStatus:
        """See :meth:`Mission.wait`. A task that is cancelled leaves the mission running."""
        return await asyncio.wrap_future(self._client.mission_ended(self.id, timeout_s))

    async def wait_question(self, timeout_s: float | None = None) -> dict[str, str]:
        """See :meth:`Mission.wait_question`."""
        await asyncio.wrap_future(self._client.mission_asks(self.id, timeout_s))
        return self.questions

    async def confirm(self, step: str = "") -> None:
        """See :meth:`Mission.confirm`."""
        await asyncio.wrap_future(self._client.confirm(self.id, step))

    async def pause(self) -> None:
        """See :meth:`Mission.pause`."""
        await asyncio.wrap_future(self._client.mission("pause", mission=self.id))

    async def resume(self, *, take: bool = False) -> None:
        """See :meth:`Mission.resume`."""
        await asyncio.wrap_future(self._client.mission("resume", mission=self.id, take=take))

    async def abort(self) -> None:
        """See :meth:`Mission.abort`."""
        await asyncio.wrap_future(self._client.mission("abort", mission=self.id))


class AsyncSwarm:
    """A live swarm for asyncio: as :class:`Swarm`, with ``await``, ``async with`` and ``async for``.

    ::

        async with AsyncSwarm() as swarm:
            run = await swarm.request("flocking_bc")
            async for state in swarm.states():
                ...

    The constructor does not connect: ``async with`` or :meth:`connect` does.
    """

    def __init__(self, hub: str | None = None, *, swarm: str = "swarm", operator: str = "") -> None:
        self._client = Client(hub, swarm, operator)

    async def connect(self) -> AsyncSwarm:
        """Wait for the hub; raises `Unreachable` when none answers within 3 s."""
        await asyncio.wrap_future(self._client.connected())
        return self

    async def __aenter__(self) -> AsyncSwarm:
        try:
            return await self.connect()
        except BaseException:
            await self.close()
            raise

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Release the leases and leave the swarm. Closing twice is fine."""
        await asyncio.to_thread(self._client.close)

    @property
    def robots(self) -> tuple[str, ...]:
        """Names of the robots that have reported so far."""
        return self._client.robots()

    @property
    def state(self) -> Snapshot:
        """The newest of everything: poses, health, processes, metrics, leases."""
        return self._client.state()

    async def states(self) -> AsyncIterator[Snapshot]:
        """Yield the swarm as it is now; see :meth:`Swarm.states`."""
        seen, at_s = -1, -math.inf
        while True:
            try:
                seen, at_s, snapshot = await asyncio.wrap_future(self._client.newer(seen, at_s))
            except FullswarmError:
                return
            yield snapshot

    async def scans(self, robots: Names = None, *, rate_hz: float = DEFAULT_HZ) -> AsyncIterator[Scan]:
        """Yield the scans of robots' range sensors as they come; see :meth:`Swarm.scans`."""
        feed = await asyncio.to_thread(self._client.watch_scans, _names(robots), rate_hz)
        try:
            while True:
                try:
                    found = await asyncio.wrap_future(self._client.scans(feed))
                except FullswarmError:
                    return
                for scan in found:
                    yield scan
        finally:
            self._client.end_scans(feed)

    async def request(
        self,
        behaviour: str,
        *,
        robots: Names = None,
        take: bool = False,
        team: str = "",
        needs: Mapping[str, Any] | None = None,
        roles: Mapping[str, Iterable[str]] | None = None,
        **parameters: Any,
    ) -> AsyncSwarmRequest:
        """Request a behaviour; see :meth:`Swarm.request`."""
        asked = self._client.request(behaviour, _names(robots), take, **_more(parameters, team, needs, roles))
        return AsyncSwarmRequest(self._client, await asyncio.wrap_future(asked))

    async def start_mission(self, mission: MissionSource, *, take: bool = False) -> AsyncMission:
        """Start a mission; see :meth:`Swarm.start_mission`."""
        asked = self._client.mission("start", _mission_file(mission), take=take)
        return AsyncMission(self._client, (await asyncio.wrap_future(asked)).mission)

    async def check_mission(self, mission: MissionSource) -> None:
        """Check a mission without starting it; see :meth:`Swarm.check_mission`."""
        await asyncio.wrap_future(self._client.mission("check", _mission_file(mission)))

    async def missions(self) -> tuple[AsyncMission, ...]:
        """Ask the core for its missions; see :meth:`Swarm.missions`."""
        await asyncio.wrap_future(self._client.mission("show"))
        return tuple(AsyncMission(self._client, each) for each in list(self._client.missions))

    async def stop(self, robots: Names = None) -> None:
        """Stop robots; see :meth:`Swarm.stop`."""
        await asyncio.wrap_future(self._client.stop(_names(robots)))

    async def estop(
        self, robots: Names = None, *, reason: str = "", timeout_s: float = ESTOP_S
    ) -> dict[str, EStopReceipt]:
        """Latch the e-stop; see :meth:`Swarm.estop`."""
        return await asyncio.wrap_future(self._client.estop(True, _names(robots), reason, timeout_s))

    async def clear_estop(self, robots: Names = None, *, timeout_s: float = ESTOP_S) -> dict[str, EStopReceipt]:
        """Release the e-stop; see :meth:`Swarm.clear_estop`."""
        return await asyncio.wrap_future(self._client.estop(False, _names(robots), "", timeout_s))

    @asynccontextmanager
    async def lease(self, *robots: str, take: bool = False) -> AsyncIterator[Held]:
        """Hold robots in an ``async with`` statement; see :meth:`Swarm.lease`."""
        held = await asyncio.wrap_future(self._client.hold(robots, take))
        try:
            yield held
        finally:
            with suppress(FullswarmError):
                await asyncio.wrap_future(self._client.release(held))
