"""Connects a swarm to any number of pages: encodes each message once for all, and opens operator sessions."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import structlog

from fullswarm.bus.base import Bus
from fullswarm.clock import clock_id
from fullswarm.keys import Keys
from fullswarm.messages import (
    BehaviourRequest,
    CameraPicture,
    CoverageMeasurement,
    EStop,
    EStopReceipt,
    FileReload,
    Interventions,
    Leases,
    MissionStatus,
    RequestStatus,
    SeenObstacles,
    StopRequest,
    WorldHold,
)
from fullswarm.operator.client import Operator
from fullswarm.operator.console import fleet, frames
from fullswarm.operator.console.cameras import Cameras
from fullswarm.operator.console.charts import ChartDesk
from fullswarm.operator.console.clips import Download
from fullswarm.operator.console.detail import Details
from fullswarm.operator.console.experiments import ExperimentOptions, Experiments
from fullswarm.operator.console.handover import HandOvers, Surroundings
from fullswarm.operator.console.history import History
from fullswarm.operator.console.log import ChangeLog, Entry, EventLog, RequestLog, named
from fullswarm.operator.console.map import TRAIL_RATE_HZ, Coverage, Goals, HeldBack, Obstacles, Trails
from fullswarm.operator.console.missions import MissionBoard
from fullswarm.operator.console.presence import Presence
from fullswarm.operator.console.samples import SAMPLE_HZ, Samples
from fullswarm.operator.console.scans import Scans
from fullswarm.operator.console.sessions import ConsoleContext, Listener, OperatorSession
from fullswarm.operator.console.stops import EStopTracker, StopTracker
from fullswarm.operator.console.study import PLAN, StudyDesk, Swarm, TrialPlan, read_plan
from fullswarm.operator.console.timeline import About, Timeline
from fullswarm.operator.console.tokens import Role
from fullswarm.operator.console.undo import Asked, Known
from fullswarm.operator.console.world import World
from fullswarm.operator.missions import MissionClient
from fullswarm.operator.view import LEASES_S, FleetView
from fullswarm.runtime import Scheduler

STATE_HZ, CHANGES_HZ, FLEET_HZ, MAP_HZ = 20.0, 10.0, 4.0, 1.0
KEPT_S = 10.0
"""A page that is reloaded within this time finds its session, with the robots it holds."""
MOST_SESSIONS = 64
DESK_S, HOLD_S = 0.05, 0.5
"""How often a study is looked at, and how often a hold of the world is repeated."""

_log = structlog.get_logger()

Made = dict[str, Any]
StampedTrails = Callable[[], dict[str, list[list[float]]]]


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity of this console."""

    host: str
    process: str  # unlike any other's
    version: str
    read_only: bool = False
    icons: Mapping[str, tuple[str, str]] = field(default_factory=dict)  # URL scheme → outline and letter of its make
    study: Path | None = None  # folder of a trial with its plan; None: no study
    recording: Callable[[], Path | None] = lambda: None  # the recording that is made of the swarm now, on this machine
    experiments: ExperimentOptions | None = None  # where experiments are; None: pages are offered none


class Gateway:
    """The console's node. A page enters by :meth:`join`, and gets all frames by its listener.

    Parameters
    ----------
    new_history : makes the history of what pages are shown, given the present trails
    samples : where the numbers are kept that charts are made of

    Attributes
    ----------
    undrawn : how often each kind of frame or message could not be shown
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        scheduler: Scheduler,
        identity: Identity,
        wall_s: Callable[[], float],
        new_history: Callable[[StampedTrails], History] = History,
        samples: Samples | None = None,
    ) -> None:
        self._keys, self._scheduler, self._identity = keys, scheduler, identity
        self._sessions: dict[str, OperatorSession] = {}
        self._left_s: dict[str, float] = {}
        self._changed: set[str] = set()
        self._states_sent = self._opened = 0
        self._held = False  # the study holds the simulated world still
        self._quiet: frozenset[str] = frozenset()
        self.undrawn: dict[str, int] = {}
        self._trails, self._goals = Trails(), Goals()
        self.samples = samples or Samples()
        self._charts = ChartDesk(self.samples, scheduler)
        self.view = FleetView(bus, keys, scheduler)
        self.timeline = Timeline(
            new_history(self._trails.stamped), scheduler, scheduler.now_s, wall_s, self._send,
            About(offered=identity.study is None, file=identity.recording),
        )  # fmt: skip
        self._world = World(
            bus,
            keys,
            scheduler,
            identity.process,
            on_world=lambda: self._changed.add("world"),
            on_orders=lambda _: self._changed.add("goals"),
        )
        self.experiments = None if identity.experiments is None or identity.study is not None else Experiments(
            identity.experiments, scheduler, identity.process, wall_s, self._send, self._note
        )  # fmt: skip
        self._scans = Scans(bus, keys, scheduler, identity.process, self._drawing)
        self._context = ConsoleContext(
            bus, keys, scheduler, self._world, self.view.present, self._end_estops, identity.read_only,
            self._new_desk(bus, wall_s), self.timeline.handle, self._charts.handle,
            Known(self._asked, self._world.orders, self._world.record, self._world.title), self._note,
            lambda command, session: self._hand_overs.handle(command, session),
            self.experiments, self._scans,
        )  # fmt: skip
        self._desk = self._context.study
        self._presence = Presence(self._sessions.values, self._holders, wall_s)
        self._hand_overs = HandOvers(
            Surroundings(
                scheduler.now_s, self._sessions.values, self._holders, self._runs, self._note_lease,
                lambda giver, taker, robots: self._changes.hands_over(giver, taker, robots),
            )
        )  # fmt: skip
        self._log_entries = EventLog(wall_s, self._send_entry)
        self._requests = RequestLog(self._log_entries, self._world.expires, self._world.title)
        self._details = Details(wall_s)
        self._changes = ChangeLog(self._log_entries)
        self._coverage, self._obstacles, self._held_back = Coverage(), Obstacles(), HeldBack()
        self._estops, self._stops = EStopTracker(scheduler, self.view.present, self._name_of), StopTracker()
        self._leases, self._leases_s, self._missions = Leases(leases=()), -math.inf, MissionBoard()
        self._cameras = Cameras()
        self._subscriptions = [
            bus.subscribe(keys.behaviour_request, BehaviourRequest, self._on_request),
            bus.subscribe(keys.behaviour_status, RequestStatus, self._on_status),
            bus.subscribe(keys.stop, StopRequest, self._on_stop),
            bus.subscribe(keys.estop, EStop, self._on_estop),
            bus.subscribe(keys.estop_receipt(), EStopReceipt, self._on_receipt),
            bus.subscribe(keys.leases, Leases, self._on_leases),
            bus.subscribe(keys.mission_status, MissionStatus, self._on_mission),
            bus.subscribe(keys.camera(), CameraPicture, self._on_camera, latest=True),
            bus.subscribe(keys.reload(), FileReload, self._on_reload),
            bus.subscribe(keys.intervention(), Interventions, self._on_intervention, latest=True),
            bus.subscribe(keys.obstacles(), SeenObstacles, self._on_obstacles, latest=True),
            bus.subscribe(keys.measurement("coverage"), CoverageMeasurement, self._on_coverage, latest=True),
        ]
        self._timers = [
            scheduler.every(1.0 / STATE_HZ, self._send_states),
            scheduler.every(1.0 / CHANGES_HZ, self._send_changes),
            scheduler.every(1.0 / FLEET_HZ, self._send_fleet, first_s=0.0),
            scheduler.every(1.0 / TRAIL_RATE_HZ, self._sample_trails),
            scheduler.every(1.0 / MAP_HZ, self._send_map),
            scheduler.every(1.0 / SAMPLE_HZ, self._sample),
        ]
        if self._desk is not None:
            self._timers.append(scheduler.every(DESK_S, self._tick_desk))

    @property
    def context(self) -> ConsoleContext:
        """What all sessions share; programs share it too."""
        return self._context

    def log_entries(self) -> tuple[Entry, ...]:
        """Return the lines of the log, the oldest first."""
        return tuple(self._log_entries.entries)

    def missions(self) -> tuple[MissionStatus, ...]:
        """Return the newest status of each mission."""
        return self._missions.statuses()

    # ---------------------------------------------------------------- pages
    def join(
        self, key: str, name: str, listener: Listener, *, named: bool = False, role: Role = "operator"
    ) -> OperatorSession:
        """Add a page to its session, a new one or the one it left, and send it all there is.

        Parameters
        ----------
        named : the operator's name comes from the token; else the page states it, and it is not taken for the name
        role : what the page may do
        """
        host = self._identity.host
        title = f"console {name}@{host} {key[:4]}" if name else f"console@{host} {key[:4]}"
        if named:
            title, key = name, f"{name}/{role}/{key}"
        session = self._sessions.get(key)
        if session is not None and session.name != title and not session.listeners:
            self._close_session(key)
            session = None
        if session is None:
            self._make_room()
            self._opened += 1
            source = f"{self._identity.process}/{self._opened}"
            source += f":{name}" if named else ""  # stops have no operator: their source has to say whose they are
            session = self._sessions[key] = OperatorSession(self._context, key, source, title, role=role)
        for kind, make in self._initial_frames(session).items():
            with self._drawing(kind):
                if (frame := make()) is not None:
                    listener.put(kind, frames.encode(frame))
        session.listeners.append(listener)
        return session

    def leave(self, session: OperatorSession, listener: Listener) -> None:
        """Remove a page; its session is kept for a while, what it drove stops at once."""
        session.leave(listener)
        self.timeline.leave(listener)
        self._charts.leave(listener)
        self._left_s[session.key] = self._scheduler.now_s()

    def download(self, key: str) -> Download | None:
        """Return a clip by the key that its page got; None: there is none."""
        return self.timeline.clips.download(key)

    def close(self) -> None:
        """Release all robots and unsubscribe."""
        for key in list(self._sessions):
            self._close_session(key)
        for timer in self._timers:
            timer.cancel()
        for subscription in self._subscriptions:
            subscription.close()
        if self._desk is not None:
            self._desk.close()
        if self.experiments is not None:
            self.experiments.close()
        self.timeline.close()
        self._charts.close()
        self._scans.close()
        self._world.close()
        self.view.close()

    def _close_session(self, key: str) -> None:
        self._sessions.pop(key).close()
        self._left_s.pop(key, None)

    def _make_room(self) -> None:
        """Close the sessions that were left longest ago: a client may use a new key each time."""
        empty = sorted((at_s, key) for key, at_s in self._left_s.items() if not self._sessions[key].listeners)
        for _, key in empty[: max(0, len(self._sessions) + 1 - MOST_SESSIONS)]:
            self._close_session(key)

    def _forget_sessions(self, now_s: float) -> None:
        for key, left_s in list(self._left_s.items()):
            if self._sessions[key].listeners:
                del self._left_s[key]
            elif now_s - left_s >= KEPT_S:
                self._close_session(key)

    # ---------------------------------------------------------------- frames
    @contextlib.contextmanager
    def _drawing(self, what: str) -> Iterator[None]:
        """Leave out what cannot be shown, and log it once: this process also carries the stop buttons."""
        try:
            yield
        except Exception as error:  # any kind: none of them may end the process
            self.undrawn[what] = self.undrawn.get(what, 0) + 1
            if self.undrawn[what] == 1:
                _log.error("the console cannot show something", what=what, error=repr(error), exc_info=True)
                text = f"the console cannot show all of '{what}' ({error}); stop and e-stop work"
                self._log_entries.add(self._scheduler.now_s(), "fault", text)

    def _initial_frames(self, session: OperatorSession) -> dict[str, Callable[[], Made | None]]:
        """Return how to make each frame that a page must have to start with, the greeting first."""
        now_s = self._scheduler.now_s()
        return {
            "hello": lambda: self._hello(session, now_s),
            "fleet": lambda: fleet.fleet(self.view.snapshot(), now_s),
            "state": lambda: self._states_frame(now_s),
            "goals": self._goals_frame,
            "leases": lambda: self._leases_frame(session.name),
            "obstacles": self._obstacles.shown,
            "filter": lambda: self._held_back.shown(now_s),
            "coverage": self._coverage.shown,
            "missions": lambda: self._missions.shown(now_s),
            "cameras": self._cameras.shown,
            "estop": self._estops.shown,
            "study": lambda: self._study_frame(session),
            "undo": session.undo.shown,
            "presence": lambda: None if self._desk is not None else self._presence.shown(),
            "offers": lambda: self._hand_overs.shown(session),
            "events": self.timeline.events,
            "timeline": self.timeline.shown,
            "bookmarks": self.timeline.bookmarks,
            "catalogue": self._charts.catalogue,
            "experiments": lambda: None if self.experiments is None else self.experiments.shown(),
        }

    def _hello(self, session: OperatorSession, now_s: float) -> Made:
        hello: Made = {
            "t": "hello",
            "swarm": self._keys.swarm,
            "version": self._identity.version,
            "read_only": self._identity.read_only or session.role == "observer",
            "operator": session.name,
            "icons": dict(self._identity.icons),
        }
        # Encoded here already: without a greeting the page shows nothing, whatever else could be shown.
        with self._drawing("world"):
            frames.encode(world := self._world_frame())
            hello |= world
        with self._drawing("history"):
            history = {
                "trails": self._trails.shown(now_s),
                "log": [entry.shown(session.name) for entry in self._log_entries.entries],
            }
            frames.encode(history)
            hello["history"] = history
        return hello

    def _states_frame(self, now_s: float) -> Made:
        return {"t": "state", "at": round(now_s, 3), "robots": fleet.states(self.view.poses())}

    def _goals_frame(self) -> Made:
        return {"t": "goals", "robots": self._goals.shown(self._world.orders())}

    def _leases_frame(self, reader: str) -> Made:
        leases = [
            {
                "robot": lease.robot,
                "operator": lease.operator,
                "age_s": round(lease.age_s, 1),
                "taken_from": lease.taken_from,
                "mine": lease.operator == reader,
            }
            for lease in self._leases.leases
        ]
        return {"t": "leases", "leases": leases}

    def _send(self, frame: Made) -> None:
        """Send a frame to all pages, encoded once, and keep it in the history."""
        now_s = self._scheduler.now_s()
        kept = self.timeline.history.wants(frame["t"], now_s)
        if self._sessions or kept:
            text = frames.encode(frame)
            if kept:
                self.timeline.history.add(frame["t"], text, now_s)
            for session in self._sessions.values():
                for listener in tuple(session.listeners):
                    listener.put(frame["t"], text)

    def _send_each(self, make: Callable[[OperatorSession], Made]) -> None:
        """Send each session a frame of its own."""
        for session in self._sessions.values():
            if session.listeners:
                frame = make(session)
                session.send(frame["t"], frame)

    def _send_entry(self, entry: Entry) -> None:
        self.timeline.add_entry(entry)
        self._send_each(lambda session: {"t": "log", "entry": entry.shown(session.name)})

    # ---------------------------------------------------------------- sent at a rate
    def _send_states(self) -> None:
        if self.view.states_received != self._states_sent:
            self._states_sent = self.view.states_received
            if self._sessions or self.timeline.history.wants("state", self._scheduler.now_s()):
                with self._drawing("state"):
                    self._send(self._states_frame(self._scheduler.now_s()))

    def _send_changes(self) -> None:
        now_s = self._scheduler.now_s()
        changed, self._changed = self._changed, set()
        if (quiet := self.view.quiet()) != self._quiet:
            self._quiet = quiet
            self._send_fleet()  # what has fallen silent is told at once
        with self._drawing("estop"):
            if frame := self._estops.changed_frame():
                self._send(frame)
        with self._drawing("stop"):
            if self._stops.order is not None and (frame := self._stops.changed_frame(self.view.snapshot(), now_s)):
                self._send(frame)
        if self._missions.changed:
            self._missions.changed = False
            with self._drawing("missions"):
                self._send(self._missions.shown(now_s))
        if self._cameras.changed:
            self._cameras.changed = False
            with self._drawing("cameras"):
                self._send(self._cameras.shown())
        with self._drawing("offers"):
            self._hand_overs.check()
        if "world" in changed:
            with self._drawing("world"):
                self._send({"t": "world", **self._world_frame()})
        if "goals" in changed:
            with self._drawing("goals"):
                self._send(self._goals_frame())
            for session in self._sessions.values():
                session.send_undo()
        if self._held_back.changed or self._held_back.expired(now_s):
            self._held_back.changed = False
            with self._drawing("filter"):
                self._send(self._held_back.shown(now_s))

    def _send_fleet(self) -> None:
        now_s, seen = self._scheduler.now_s(), self.view.snapshot()
        with self._drawing("log"):
            self._changes.update(seen, now_s)
        if self._sessions or self.timeline.history.wants("fleet", now_s):
            with self._drawing("fleet"):
                self._send(fleet.fleet(seen, now_s))
        if self._sessions and self._desk is None:
            with self._drawing("presence"):
                if frame := self._presence.changed_frame():
                    self._send(frame)

    def _sample_trails(self) -> None:
        with self._drawing("trails"):
            self._trails.add(self.view.poses(), self._scheduler.now_s())

    def _send_map(self) -> None:
        self._forget_sessions(self._scheduler.now_s())
        self._missions.expire(self._scheduler.now_s())
        self._obstacles.sweep(self._scheduler.now_s())
        self._cameras.expire(self._scheduler.now_s())
        if self._sessions:
            self._send(self.timeline.shown())
            self.timeline.send_bookmarks()
        if self._obstacles.changed:
            self._obstacles.changed = False
            with self._drawing("obstacles"):
                self._send(self._obstacles.shown())
        if self._coverage.changed:
            self._coverage.changed = False
            with self._drawing("coverage"):
                if frame := self._coverage.shown():
                    self._send(frame)

    # ---------------------------------------------------------------- samples: charts, details of a robot
    def _sample(self) -> None:
        """Sample all robots, and send the charts and details that pages show: one snapshot for both."""
        now_s, seen = self._scheduler.now_s(), self.view.snapshot()
        with self._drawing("charts"):
            known = len(self.samples.names)
            self.samples.add(seen.robots, seen.summaries, now_s)
            if len(self.samples.names) != known:
                self._send(self._charts.catalogue())
            self._charts.send_new()
        with self._drawing("detail"):
            self._details.sample(seen, now_s)
            rows = {row.robot: row for row in seen.robots}
            texts: dict[str, str] = {}
            for session in self._sessions.values():
                for listener, robot in session.inspected.items():
                    if robot in rows and robot not in texts:
                        frame = self._details.shown(rows[robot], now_s, self._known_of(robot))
                        texts[robot] = frames.encode(frame)
                    if robot in texts:
                        listener.put("detail", texts[robot])

    def _known_of(self, robot: str) -> Made:
        order = self._world.orders().get(robot)
        asked = self._requests.operator_of(str(order.get("request_id", ""))) if order else ""
        shown = {name: order.get(name) for name in ("behaviour", "parameters", "request_id")} if order else None
        return {
            "order": None if shown is None else {**shown, "operator": asked},
            "requests": self._requests.of_robot(robot),
        }

    def _asked(self, request_id: str) -> Asked | None:
        """Return a request for a plan that undoes another one."""
        asked = self._requests.asked(request_id)
        if asked is None:
            return None
        return Asked(asked.request, () if asked.status is None else asked.status.robots)

    def _note(self, text: str, by: str) -> None:
        self._log_entries.add(self._scheduler.now_s(), "request", text, by=by)

    # ---------------------------------------------------------------- operators and hand-over
    def _holders(self) -> Mapping[str, str]:
        """Return robot → operator; nothing while the core does not report."""
        if self._scheduler.now_s() - self._leases_s > LEASES_S:
            return {}
        return {lease.robot: lease.operator for lease in self._leases.leases}

    def _runs(self, robots: tuple[str, ...]) -> str:
        """Return the titles of what robots were asked for."""
        orders = self._world.orders()
        keys = dict.fromkeys(str(orders[robot].get("behaviour", "")) for robot in robots if robot in orders)
        return ", ".join(self._world.title(key) for key in keys if key)

    def _note_lease(self, text: str, by: str, robots: tuple[str, ...]) -> None:
        self._log_entries.add(self._scheduler.now_s(), "lease", text, robots, by=by)

    # ---------------------------------------------------------------- a study
    def _new_desk(self, bus: Bus, wall_s: Callable[[], float]) -> StudyDesk | None:
        """Return what conducts a trial of a study, if this console is in one."""
        folder = self._identity.study
        if folder is None:
            return None
        source = f"{self._identity.process}/study"
        operator = Operator(bus, self._keys, self._scheduler, source, name="study", clock=clock_id())
        missions = MissionClient(
            bus, self._keys, self._scheduler, source, name="study", clock=clock_id(), watch=False
        )  # fmt: skip

        def begin(plan: TrialPlan) -> None:
            if plan.request is not None:
                operator.request(plan.request.behaviour, plan.request.robots, plan.request.parameters)
            if plan.mission is not None:
                missions.ask("start", plan=plan.mission)

        def hold(held: bool) -> None:
            self._held = held
            message = WorldHold(held=held, source=source, stamp_s=self._scheduler.now_s())
            bus.publish(self._keys.world_hold, message)
            if held:
                self._scheduler.after(HOLD_S, repeat)

        def repeat() -> None:
            if self._held:
                hold(True)

        def expand(robots: Iterable[str]) -> tuple[str, ...]:
            members = ((self._world.group(each[1:]) or ()) if each.startswith("@") else (each,) for each in robots)
            return tuple(dict.fromkeys(robot for group in members for robot in group))

        swarm = Swarm(
            self.view.snapshot, lambda: self._world.known, expand, begin, lambda: self._stop_all(operator), hold
        )  # fmt: skip
        return StudyDesk(
            read_plan(folder / PLAN), folder, self._scheduler, swarm, wall_s, self._identity.version, self._send_study
        )

    def _tick_desk(self) -> None:
        with self._drawing("study"):
            if self._desk is not None:
                self._desk.tick()

    def _stop_all(self, operator: Operator) -> None:
        self._block_driving(())
        operator.stop()

    def _study_frame(self, session: OperatorSession) -> Made | None:
        """Return the frame ``study``; if the page that began the trial is gone, another one takes its place."""
        if self._desk is None:
            return None
        owner = self._sessions.get(self._desk.owner)
        return self._desk.shown(mine=owner is None or owner is session or not owner.listeners)

    def _send_study(self) -> None:
        self._send_each(lambda session: self._study_frame(session) or {})

    def _world_frame(self) -> Made:
        return self._world.shown() if self._desk is None else self._desk.offered(self._world.shown())

    # ---------------------------------------------------------------- received
    def _on_request(self, request: BehaviourRequest) -> None:
        with self._drawing("request"):
            self._requests.add_request(request, self._scheduler.now_s())
            if not self._world.expires(request.behaviour):
                self._goals.add(request)

    def _on_status(self, status: RequestStatus) -> None:
        with self._drawing("request"):
            if self._requests.add_status(status, self._scheduler.now_s()):
                self._send_status(status)

    def _send_status(self, status: RequestStatus) -> None:
        operator = self._requests.operator_of(status.request_id)
        frame = {
            "t": "request",
            "request_id": status.request_id,
            "behaviour": status.behaviour,
            "phase": status.phase,
            "reason": self._requests.readable(status),
            "code": status.code,
            "about": status.parameters,
            "robots": status.robots,
            "running": status.running,
            "missing": status.missing,
            "refused_by": status.refused_by,
            "left_out": status.left_out,
            "roles": status.roles,
            "operator": operator,
        }
        self._send_each(lambda session: {**frame, "mine": operator == session.name})

    def _on_stop(self, order: StopRequest) -> None:
        now_s = self._scheduler.now_s()
        if self._stops.add_order(order, now_s):
            self._block_driving(order.robots)
            with self._drawing("stop"):
                by = self._name_of(order.source)
                self._requests.add_stop(order.id, "the stop", by)
                self._log_entries.add(now_s, "stop", f"{by} stops {named(order.robots)}", order.robots, by=by)

    def _on_estop(self, order: EStop) -> None:
        now_s = self._scheduler.now_s()
        if not self._estops.add_order(order):
            return
        self._block_driving(order.robots)  # by a release too: a stick that is held at that moment must not start them
        if not order.engaged:
            self._end_estops(order.robots)
        with self._drawing("estop"):
            by, reason = self._name_of(order.source), f": {order.reason}" if order.reason else ""
            act = "presses the e-stop of" if order.engaged else "clears the e-stop of"
            text = f"{by} {act} {named(order.robots)}{reason}"
            self._requests.add_stop(order.id, "the e-stop", by)
            self._log_entries.add(now_s, "estop", text, order.robots, request_id=order.id, by=by)

    def _on_receipt(self, receipt: EStopReceipt) -> None:
        with self._drawing("estop"):
            self._estops.add_receipt(receipt)

    def _on_leases(self, leases: Leases) -> None:
        self._leases, self._leases_s = leases, self._scheduler.now_s()
        with self._drawing("leases"):
            now_s = self._scheduler.now_s()
            if self._changes.leased(leases.leases, now_s):
                self._send_each(lambda session: self._leases_frame(session.name))
                self.timeline.history.add("leases", frames.encode(self._leases_frame("")), now_s)

    def _on_mission(self, status: MissionStatus) -> None:
        now_s = self._scheduler.now_s()
        with self._drawing("missions"):
            if text := self._missions.add(status, now_s):
                robots = tuple(
                    dict.fromkeys(robot for track in status.tracks for step in track.steps for robot in step.robots)
                )
                failed = status.phase == "failed"
                self._log_entries.add(
                    now_s, "mission", text, robots, by=status.operator, severity="error" if failed else None
                )

    def _on_camera(self, message: CameraPicture) -> None:
        with self._drawing("camera"):
            frame = self._cameras.add(message, self._scheduler.now_s())
            watchers = [each for session in self._sessions.values() for each in session.watchers]
            if frame is not None and watchers:
                text = frames.encode(frame)
                for listener in watchers:
                    listener.put(f"picture {message.camera}", text)

    def _on_reload(self, message: FileReload) -> None:
        with self._drawing("log"):
            self._changes.reloaded(message, self._scheduler.now_s())

    def _on_intervention(self, message: Interventions) -> None:
        with self._drawing("filter"):
            self._held_back.add(message, self._scheduler.now_s())

    def _on_obstacles(self, message: SeenObstacles) -> None:
        with self._drawing("obstacles"):
            self._obstacles.add(message, self._scheduler.now_s())

    def _on_coverage(self, message: CoverageMeasurement) -> None:
        with self._drawing("coverage"):
            self._coverage.add(message)

    def _block_driving(self, robots: tuple[str, ...]) -> None:
        for session in self._sessions.values():
            session.stopped(robots)

    def _end_estops(self, robots: tuple[str, ...]) -> None:
        for session in self._sessions.values():
            session.end_estops(robots)

    def _name_of(self, source: str) -> str:
        return next((session.name for session in self._sessions.values() if session.source == source), source)
