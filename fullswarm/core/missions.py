"""Missions: steps of behaviours with conditions, kept over restarts of the core (decision 42).

Each change of a mission is written to the local database before anything follows from it. What follows is not a list of
acts but a comparison: a step that is to run and whose request is unknown is requested, and robots that hold the request
of a step that is not to run are stopped. So a core that dies between any two instructions goes on with the same step:
a request that runs is known by its id, and is not sent again.

A mission only requests behaviours and stops robots. It obeys leases as its operator does, never takes a robot over by
itself, and never releases an e-stop; a stop or an e-stop of any of its robots pauses it.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable
from typing import NamedTuple

import msgspec
import structlog

from fullswarm.bus import Bus
from fullswarm.config.mission_file import plan_problems
from fullswarm.core.leases import Authority
from fullswarm.core.main_controller import UNNAMED, Halted, MainController
from fullswarm.core.mission_facts import MissionFacts
from fullswarm.core.mission_places import places_of
from fullswarm.core.mission_state import Mission, MissionState, Running, comparison, open_conditions
from fullswarm.core.request_handler import RequestHandler
from fullswarm.core.request_order import RequestOrder
from fullswarm.core.request_status import StatusBoard
from fullswarm.core.roster import Roster
from fullswarm.errors import RequestRefused, did_you_mean
from fullswarm.keys import ROBOT_ID, Keys
from fullswarm.messages import (
    MOST_PLACES,
    STOP,
    BehaviourRequest,
    MissionPlan,
    MissionProblem,
    MissionReply,
    MissionRequest,
    MissionStatus,
    MissionStep,
    StepPlace,
)
from fullswarm.perf.metrics import METRICS, SHAPE, SHAPE_DOC
from fullswarm.reasons import Code
from fullswarm.recent import Recent
from fullswarm.runtime import Scheduler, Timer
from fullswarm.store import Store, Stored

TICK_S = 0.1
KEEP_S = 1.0
"""The time that a step has run is written this often: a restart forgets no more of it."""
PUBLISH_S = 1.0
SHOWN_S = 30.0
"""The status of a mission that has ended is repeated for so long."""
LOST_S = 5.0
"""A robot that is absent for longer than this fails the step that needs it. It includes the restart of an agent."""
MOST = 16
"""Missions that are remembered; a new one replaces the oldest that has ended."""
STATE, PLAN = "mission/", "mission-plan/"
ELSEWHERE = {"coverage": ("fraction", "cells", "area_m2")}
"""Metrics with a summarizer of their own."""

log = structlog.get_logger()


class PlanRefused(RequestRefused):
    """A plan does not fit this swarm: all its problems."""

    def __init__(self, problems: Iterable[MissionProblem]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(each.text for each in self.problems)[:1000])


class Start(NamedTuple):
    """An operator's request to start or resume a mission, as this core carried it out.

    `at_s` is on this core's clock; `clock` and `sent_s` are the operator's, `clock` is empty if it was not dated.
    """

    at_s: float
    clock: str
    sent_s: float

    def precedes(self, stop: Halted) -> bool:
        """Tell whether a stop is newer: a request that comes late was still sent before it."""
        sent_before = self.clock == stop.clock != "" and self.sent_s < stop.ordered_s
        return sent_before or self.at_s <= stop.at_s


class Missions:
    """Runs missions by requests to the main controller.

    Parameters
    ----------
    process
        Name of this start of the core.
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        scheduler: Scheduler,
        store: Store,
        controller: MainController,
        handler: RequestHandler,
        board: StatusBoard,
        roster: Roster,
        authority: Authority,
        request_order: RequestOrder,
        process: str,
    ) -> None:
        self._bus, self._keys, self._scheduler, self._store = bus, keys, scheduler, store
        self._controller, self._handler, self._board = controller, handler, board
        self._roster, self._authority, self._request_order = roster, authority, request_order
        self._process, self._sequence = process, 0
        self._facts = MissionFacts(bus, keys, scheduler, controller.library, roster)
        # Places of steps, with the robots that they were found for: statuses are made ten times a second.
        self._places: dict[str, dict[str, tuple[tuple[str, ...], tuple[StepPlace, ...]]]] = {}
        self._missions: dict[str, Mission] = {}
        self._slots: dict[str, int] = {}  # keys of the database, used again and again
        self._published: dict[str, tuple[float, MissionStatus]] = {}
        self._ended_s: dict[str, float] = {}
        self._kept_s: dict[str, float] = {}
        self._absent_s: dict[str, float] = {}  # robot → since when, while a step needs it
        self._replies: Recent[str, MissionReply] = Recent(256)
        self._stops: Recent[str, None] = Recent(256)
        self._starts: dict[str, Start] = {}  # of missions that this core started or resumed, the newest
        self._timer: Timer | None = None
        self._ticked_s = scheduler.now_s()
        self._restore()
        self._subscriptions = [
            bus.subscribe(keys.mission_request, MissionRequest, self._requested),
        ]
        controller.watch_stops(self._halted)

    def close(self) -> None:
        """Stop advancing missions; the next start of the core continues them."""
        if self._timer is not None:
            self._timer.cancel()
        for subscription in self._subscriptions:
            subscription.close()
        self._facts.close()

    def statuses(self) -> tuple[MissionStatus, ...]:
        """Return all missions that are remembered, the oldest first."""
        return tuple(self._status(mission) for mission in self._missions.values())

    # ---------------------------------------------------------------- requests of operators
    def _requested(self, request: MissionRequest) -> None:
        if not ROBOT_ID.match(request.id):
            return  # its answer would have no key
        reply = self._replies.get(request.id)
        if reply is None:
            try:
                reply = MissionReply(id=request.id, ok=True, mission=self._carry_out(request))
            except PlanRefused as error:
                reply = MissionReply(id=request.id, ok=False, reason=error.what, problems=error.problems)
            except RequestRefused as error:
                text = f"{error.what} ({error.hint})" if error.hint else error.what
                reply = MissionReply(id=request.id, ok=False, reason=text, code=error.code)
            self._replies[request.id] = reply
        self._bus.publish(self._keys.mission_reply(request.id), reply)

    def _carry_out(self, request: MissionRequest) -> str:
        """Do what is requested, once; return the mission's id."""
        for mission in self._missions.values():
            if request.id in (mission.state.mission, *mission.state.answered):
                return mission.state.mission
        if request.op == "show":
            for mission in self._missions.values():
                self._publish(mission, again=True)
            return ""
        if request.op in ("check", "start"):
            robots = self._checked(request.plan)
            return self._start(request, robots) if request.op == "start" else ""
        mission = self._find(request.mission)
        if request.op == "confirm":
            self._confirm(mission, request)
        elif request.op == "resume":
            self._resume(mission, request)
        elif request.op == "abort":
            if not mission.state.change("abort", f"by {_operator(request)}"):
                raise RequestRefused(f"mission '{mission.plan.name}' has ended already: {mission.state.phase}")
            mission.end()
        elif not mission.pause(f"by {_operator(request)}"):
            raise RequestRefused(f"mission '{mission.plan.name}' does not run: it is {mission.state.phase}")
        mission.state.answer(request.id)
        self._changed(mission)
        self._advance(mission, 0.0)
        return mission.state.mission

    def _start(self, request: MissionRequest, robots: tuple[str, ...]) -> str:
        assert request.plan is not None  # noqa: S101  (checked before)
        self._admit(request, robots)
        slot = self._free_slot()
        number = 1 + max((each.state.number for each in self._missions.values()), default=0)
        mission = Mission.new(request.id, request.plan, _operator(request), number)
        self._missions[request.id], self._slots[request.id] = mission, slot
        self._note_start(request.id, request)
        self._begin_ready(mission)
        self._changed(mission, plan=True)
        self._advance(mission, 0.0)
        self._watch()
        return request.id

    def _resume(self, mission: Mission, request: MissionRequest) -> None:
        if mission.state.phase != "paused":
            raise RequestRefused(f"mission '{mission.plan.name}' is not paused: it is {mission.state.phase}")
        self._admit(request, self._robots(mission))
        mission.state.change("resume")
        self._note_start(mission.state.mission, request)
        mission.state.operator = _operator(request)
        self._absent_s.clear()
        for each in mission.steps():
            if each.state.kept:
                each.state.attempt += 1
        self._begin_ready(mission)

    def _note_start(self, key: str, request: MissionRequest) -> None:
        clock = (request.clock or request.source) if request.stamp_s else ""
        self._starts[key] = Start(self._scheduler.now_s(), clock, request.stamp_s)

    def _confirm(self, mission: Mission, request: MissionRequest) -> None:
        name = mission.plan.name
        if mission.state.phase != "running":
            raise RequestRefused(f"mission '{name}' does not run: it is {mission.state.phase}", hint="resume it first")
        waiting = [each for each in mission.running() if each.step.done.confirm and not each.state.confirmed]
        if request.step or request.track:
            wanted = f"{request.track}/{request.step}" if request.track else request.step
            waiting = [each for each in waiting if wanted in (each.path, each.step.name)]
        if not waiting:
            raise RequestRefused(f"no step of mission '{name}' waits for that confirmation")
        if len(waiting) > 1:
            paths = ", ".join(each.path for each in waiting)
            raise RequestRefused(
                f"several steps of mission '{name}' wait for a confirmation", hint=f"name one: {paths}"
            )
        self._admit(request, waiting[0].state.robots)
        waiting[0].state.confirmed = True

    def _admit(self, request: MissionRequest, robots: Iterable[str]) -> None:
        """Check that the operator may move these robots, and that no stop is newer than the request."""
        robots = tuple(robots)
        self._authority.admit(_operator(request), robots, take=request.take)
        line = _operator(request), request.clock or request.source
        for robot in robots:
            newer = self._request_order.note(robot, request.id, line, request.stamp_s)
            if newer:
                raise RequestRefused(f"a newer request or stop of {robot} came first: {newer}", code=Code.CAME_FIRST)

    def _find(self, wanted: str) -> Mission:
        active = {key: each for key, each in self._missions.items() if not each.state.ended}
        if wanted in self._missions:
            return self._missions[wanted]
        found = [each for each in active.values() if not wanted or each.plan.name == wanted]
        if len(found) == 1:
            return found[0]
        names = {each.plan.name for each in active.values()}
        if len(found) > 1:
            raise RequestRefused("several missions have not ended", hint=f"name one: {', '.join(sorted(active))}")
        if not wanted:
            raise RequestRefused("no mission is running or paused", hint="start one: fullswarm request FILE.toml")
        ended = next((each for each in reversed(self._missions.values()) if each.plan.name == wanted), None)
        if ended is not None:
            raise RequestRefused(f"mission '{wanted:.64}' has ended already: {ended.state.phase}")
        raise RequestRefused(f"no mission '{wanted:.64}' is running or paused", hint=did_you_mean(wanted, names))

    # ---------------------------------------------------------------- checks against this swarm
    def _checked(self, plan: MissionPlan | None) -> tuple[str, ...]:
        """Return the robots of a plan.

        Raises
        ------
        PlanRefused
            All that is wrong with it.
        """
        if plan is None:
            raise RequestRefused("the request has no plan")
        problems = plan_problems(plan)
        if problems:
            raise PlanRefused(problems)
        owner: dict[str, str] = {}  # robot → track
        busy = {
            robot: mission.plan.name
            for mission in self._missions.values()
            if not mission.state.ended
            for robot in self._robots(mission)
        }
        for track in plan.tracks:
            for step in track.steps:
                found: dict[str, str] = {}
                try:
                    robots = self._controller.addressed(step.robots)
                except RequestRefused as error:
                    robots, found["robots"] = (), str(error)
                twice = sorted(robot for robot in robots if owner.setdefault(robot, track.name) != track.name)
                if twice:
                    found["robots"] = (
                        f"{', '.join(twice)}: also in track '{owner[twice[0]]}', which runs at the same time"
                    )
                taken = sorted({busy[robot] for robot in robots if robot in busy})
                if taken:
                    found["robots"] = f"robots of mission '{taken[0]}', which has not ended: abort it first"
                if step.behaviour:
                    try:
                        self._controller.check(_request_of(step), robots)
                    except RequestRefused as error:
                        found["parameters" if error.code == Code.PARAMETERS else "behaviour"] = str(error)
                wanted = comparison(step)
                if wanted is not None and (text := _unknown_metric(wanted.metric, wanted.quantity)):
                    found["done.metric"] = text
                problems += [
                    MissionProblem(track=track.name, step=step.name, key=key, text=text) for key, text in found.items()
                ]
        if problems:
            raise PlanRefused(problems)
        return tuple(owner)

    def _robots(self, mission: Mission) -> tuple[str, ...]:
        """Return the robots of a mission's steps, as far as they exist now."""
        found: dict[str, None] = {}
        for each in mission.steps():
            try:
                found |= dict.fromkeys(each.state.robots or self._controller.addressed(each.step.robots))
            except RequestRefused:
                continue
        return tuple(found)

    # ---------------------------------------------------------------- stops
    def _halted(self, stop: Halted) -> None:
        if stop.id and stop.id in self._stops:
            return  # each stop is sent several times: a late copy must not pause what was resumed since
        self._stops[stop.id] = None
        for key, mission in self._missions.items():
            touched = not stop.robots or not set(stop.robots).isdisjoint(self._robots(mission))
            start = self._starts.get(key)  # what was restored counts as older than any stop
            if touched and (start is None or start.precedes(stop)) and mission.pause(stop.why):
                self._changed(mission)
                self._advance(mission, 0.0)

    # ---------------------------------------------------------------- progress
    def _watch(self) -> None:
        """Check at a rate while there is anything to check."""
        if self._timer is None and self._missions:
            self._ticked_s = self._scheduler.now_s()
            self._timer = self._scheduler.every(TICK_S, self._tick)

    def _tick(self) -> None:
        now_s = self._scheduler.now_s()
        elapsed_s, self._ticked_s = now_s - self._ticked_s, now_s
        going = False
        for key, mission in self._missions.items():
            if not mission.state.ended:
                self._advance(mission, elapsed_s)
            if not mission.state.ended or now_s - self._ended_s.get(key, -math.inf) < SHOWN_S:
                going = True
                self._publish(mission, again=now_s - self._published_s(key) >= PUBLISH_S - 1e-6)
        self._facts.need(each for mission in self._missions.values() for each in mission.running())
        if not going and self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _advance(self, mission: Mission, elapsed_s: float) -> None:
        """Advance a mission by the time that has passed; write what has changed before anything follows from it."""
        changed = False
        if mission.state.phase == "running":
            for each in mission.running():
                each.state.elapsed_s += elapsed_s
            changed = self._examine(mission)
        due = (
            bool(mission.running()) and self._scheduler.now_s() - self._kept_s.get(mission.state.mission, 0.0) >= KEEP_S
        )
        if changed or due:
            self._changed(mission)
        self._reconcile(mission)
        self._publish(mission)

    def _examine(self, mission: Mission) -> bool:
        """Apply all events that are due to a running mission; return whether there were any."""
        changed = False
        for each in mission.steps():
            if each.state.kept and not self._handler.holds(mission.request_id(each)):
                each.state.kept, changed = False, True  # another request followed
        moved = True
        while moved and mission.state.phase == "running":  # a step without a wait is over at once
            moved = False
            for each in mission.running():
                if mission.state.phase == "running" and self._examine_step(mission, each):
                    moved = True
            if mission.state.phase == "running":
                moved |= self._begin_ready(mission)
            changed |= moved
            if not mission.current():
                changed |= mission.state.change("finish")
        return changed

    def _examine_step(self, mission: Mission, each: Running) -> bool:
        """Apply the event that is due to a running step, if any."""
        step, state = each.step, each.state
        request_id = mission.request_id(each)
        changed = bool(step.behaviour) and self._take_results(each, request_id)
        kind, why = self._trouble(each, request_id) if step.behaviour else ("", "")
        if kind == "pause":
            return mission.pause(f"{each.path}: {why}")
        if not kind:
            waits = open_conditions(step, state, self._facts.of(each, request_id))
            if not waits:
                state.change("finish")
                state.kept = step.keep_running
                return True
            if not step.fail_after_s or state.elapsed_s < step.fail_after_s - 1e-6:
                return changed
            why = f"not done within {step.fail_after_s:g} s ({'; '.join(waits)})"
            state.elapsed_s = 0.0  # a resumed step gets its time anew
        return self._fail(mission, each, why)

    def _fail(self, mission: Mission, each: Running, why: str) -> bool:
        text = f"{each.path} failed: {why}"
        if each.step.on_failed == "pause":
            each.state.change("pause", why)
            mission.pause(text)
        else:
            each.state.change("fail", why)
            if each.step.on_failed == "abort":
                mission.state.change("fail", text)
                mission.end()
        return True

    def _begin_ready(self, mission: Mission) -> bool:
        """Begin the steps whose turn it is."""
        begun = False
        for each in mission.ready():
            if mission.state.phase != "running":
                break
            begun = each.state.change("begin")
            try:
                each.state.robots = self._controller.addressed(each.step.robots)
            except RequestRefused as error:
                self._fail(mission, each, str(error))
        return begun

    def _take_results(self, each: Running, request_id: str) -> bool:
        """Note the robots whose behaviour has ended itself by arriving, for good; return whether there are new ones."""
        status = self._board.get(request_id)
        found = {each.robot for each in status.results if each.outcome == "arrived"} if status is not None else set()
        new = tuple(robot for robot in each.state.robots if robot in found and robot not in each.state.arrived)
        each.state.arrived += new
        each.state.over = set(each.state.robots) == set(each.state.arrived) if new else each.state.over
        return bool(new)

    def _trouble(self, each: Running, request_id: str) -> tuple[str, str]:
        """Return what must happen to a running step because of its request, "pause" or "fail", and why."""
        status = self._board.get(request_id)
        if status is None or each.state.over:
            return "", ""
        held = self._handler.holders(request_id)
        if status.phase == "refused" or status.refused_by:
            return "fail", status.reason or "it was refused"
        gone = [robot for robot in each.state.robots if robot not in held and robot not in each.state.arrived]
        if gone:
            taken = status.phase == "superseded" or status.code in (Code.SUPERSEDED, Code.CAME_FIRST)
            return "pause" if taken else "fail", f"{', '.join(gone)}: {status.reason or 'the request has ended'}"
        now_s = self._scheduler.now_s()
        lost = []
        for robot in each.state.robots:
            if self._roster.is_present(robot):
                self._absent_s.pop(robot, None)
            elif now_s - self._absent_s.setdefault(robot, now_s) >= LOST_S:
                lost.append(robot)
        return ("fail", f"lost: {', '.join(lost)}") if lost else ("", "")

    # ---------------------------------------------------------------- what follows from the state
    def _reconcile(self, mission: Mission) -> None:
        """Request what is to run and is unknown; then stop robots that hold what is not to run."""
        stale: list[str] = []
        for each in mission.steps():
            if not each.step.behaviour or not each.state.attempt:
                continue
            request_id = mission.request_id(each)
            if mission.wants(each):
                if not mission.state.ended and not each.state.over and not self._controller.knows(request_id):
                    request = msgspec.structs.replace(_request_of(each.step), robots=each.state.robots)
                    self._request(mission, request_id, request)
            else:
                stale.append(request_id)
        for request_id in stale:
            if held := self._handler.keepers(request_id):  # the requests above may have replaced it
                self._request(mission, f"{request_id}.stop", BehaviourRequest(id="", behaviour=STOP, robots=held))

    def _request(self, mission: Mission, request_id: str, what: BehaviourRequest) -> None:
        request = msgspec.structs.replace(
            what,
            id=request_id,
            source=f"{self._process}/missions",
            operator=mission.state.operator,
            stamp_s=self._scheduler.now_s(),
        )
        self._controller.submit(request)
        self._bus.publish(self._keys.behaviour_request, request)  # for those who watch; to the core it is a repetition

    def _changed(self, mission: Mission, *, plan: bool = False) -> None:
        """Write a mission to the local database."""
        key, now_s = mission.state.mission, self._scheduler.now_s()
        slot = f"{self._slots[key]:02}"
        values: dict[str, Stored] = {STATE + slot: msgspec.to_builtins(mission.state)}
        if plan:
            values[PLAN + slot] = msgspec.to_builtins(mission.plan)
        self._store.keep(values, f"core {self._process}")
        self._kept_s[key] = now_s
        if mission.state.ended:
            self._ended_s.setdefault(key, now_s)

    def _free_slot(self) -> int:
        """Return a key that is free, or that of the oldest mission that has ended, which is forgotten."""
        free = set(range(MOST)).difference(self._slots.values())
        if free:
            return min(free)
        ended = [each.state for each in self._missions.values() if each.state.ended]
        if not ended:
            raise RequestRefused(f"{MOST} missions have not ended", hint="abort one: fullswarm mission abort NAME")
        oldest = min(ended, key=lambda state: state.number).mission
        del self._missions[oldest]
        self._published.pop(oldest, None)
        self._starts.pop(oldest, None)
        self._places.pop(oldest, None)
        return self._slots.pop(oldest)

    def _restore(self) -> None:
        """Restore the missions from before a restart, and compare what they want with what robots hold."""
        found = []
        for entry in self._store.list(STATE):
            slot = entry.key.removeprefix(STATE)
            try:
                state = msgspec.convert(entry.value, MissionState)
                plan = msgspec.convert(self._store.get(PLAN + slot), MissionPlan)
                mission = Mission(plan, state)
                tuple(mission.steps())
                found.append((int(slot), mission))
            except (msgspec.ValidationError, KeyError, ValueError) as error:
                log.error("a mission in the database cannot be read", key=entry.key, error=str(error))
        for number, mission in sorted(found, key=lambda each: each[1].state.number):
            self._missions[mission.state.mission], self._slots[mission.state.mission] = mission, number
            if mission.state.ended:  # perhaps in the last moment of the core before
                self._ended_s[mission.state.mission] = self._scheduler.now_s()
        self._facts.need(each for mission in self._missions.values() for each in mission.running())
        for mission in self._missions.values():
            self._reconcile(mission)
        self._watch()

    # ---------------------------------------------------------------- status
    def _status(self, mission: Mission) -> MissionStatus:
        waits = {
            each.path: open_conditions(each.step, each.state, self._facts.of(each, mission.request_id(each)))
            for each in mission.running()
        }
        for each in mission.current():
            if each.state.phase == "waiting" and each.step.after:
                waits[each.path] = [f"after: {', '.join(each.step.after)}"]
        return mission.status(waits, {each.path: self._places_of(mission, each) for each in mission.steps()})

    def _places_of(self, mission: Mission, each: Running) -> tuple[StepPlace, ...]:
        """Return where a step is on the map; found again when its robots are known."""
        kept = self._places.setdefault(mission.state.mission, {})
        step, robots = each.step, each.state.robots
        if each.path not in kept or kept[each.path][0] != robots:
            found: tuple[StepPlace, ...] = ()
            with contextlib.suppress(RequestRefused):  # a behaviour that there is no more has no place
                record = self._controller.library.get(step.behaviour) if step.behaviour else None
                found = () if record is None else places_of(record, step.parameters, robots or self._meant(step))
            kept[each.path] = robots, found[:MOST_PLACES]
        return kept[each.path][1]

    def _meant(self, step: MissionStep) -> tuple[str, ...]:
        """Return the robots that a step names; none if they are not known yet."""
        try:
            return self._controller.addressed(step.robots)
        except RequestRefused:
            return ()

    def _published_s(self, key: str) -> float:
        return self._published[key][0] if key in self._published else -math.inf

    def _publish(self, mission: Mission, *, again: bool = False) -> None:
        """Send a mission's status where a step or a phase has changed, or `again`."""
        status, key = self._status(mission), mission.state.mission
        if not again and key in self._published and _essence(self._published[key][1]) == _essence(status):
            return
        self._sequence += 1
        now_s = self._scheduler.now_s()
        self._published[key] = now_s, status
        stamped = msgspec.structs.replace(status, core=self._process, sequence=self._sequence, stamp_s=now_s)
        self._bus.publish(self._keys.mission_status, stamped)


def _operator(request: MissionRequest) -> str:
    return request.operator or request.source or UNNAMED


def _essence(status: MissionStatus) -> object:
    """Return what of a status is sent at once when it changes; times and distances wait for the next second."""
    steps = [(step.phase, step.confirm, step.reason) for track in status.tracks for step in track.steps]
    return status.phase, status.reason, steps


def _request_of(step: MissionStep) -> BehaviourRequest:
    """Return what a step requests, for the robots that it names."""
    return BehaviourRequest(
        id="", behaviour=step.behaviour, robots=step.robots, parameters=step.parameters, team=step.team,
        needs=step.needs, roles=step.roles,
    )  # fmt: skip


def _unknown_metric(metric: str, quantity: str) -> str:
    """Return why a metric cannot be compared; empty if it can."""
    if metric not in METRICS and metric not in ELSEWHERE:
        return f"unknown metric '{metric}', {did_you_mean(metric, (*METRICS, *ELSEWHERE))}"
    known = tuple(SHAPE_DOC) if metric == SHAPE else ELSEWHERE.get(metric) or tuple(METRICS[metric].quantities)
    return "" if quantity in (*known, "elapsed_s") else f"{metric} has no '{quantity}', {did_you_mean(quantity, known)}"
