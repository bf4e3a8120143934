"""Between a swarm and any number of pages: hears everything once, says it once to all, hands out desks."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import structlog

from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.messages import (
    BehaviourRequest,
    CoverageMeasurement,
    EStop,
    EStopReceipt,
    Interventions,
    Leases,
    RequestStatus,
    SeenObstacles,
    StopRequest,
)
from fullswarm.operator.console import frames, report
from fullswarm.operator.console.alarms import EStopBoard, StopWatch
from fullswarm.operator.console.desk import Desk, Listener, Place
from fullswarm.operator.console.goals import Goals
from fullswarm.operator.console.ground import Coverage, Holding, Obstacles
from fullswarm.operator.console.history import CHART_NAMES, CHART_RATE_HZ, TRAIL_RATE_HZ, Charts, Entry, Journal, Trails
from fullswarm.operator.console.news import News
from fullswarm.operator.console.requests import RequestBook, for_page, named
from fullswarm.operator.console.world import World
from fullswarm.operator.view import FleetView
from fullswarm.runtime import Scheduler

STATE_HZ, CHANGES_HZ, FLEET_HZ, GROUND_HZ = 20.0, 10.0, 4.0, 1.0
KEPT_S = 10.0
"""A page that is loaded again within it finds its desk, with the robots it holds."""
MOST_DESKS = 64

_log = structlog.get_logger()

Made = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity of this console."""

    host: str
    process: str  # unlike any other's
    version: str
    read_only: bool = False
    icons: Mapping[str, tuple[str, str]] = field(default_factory=dict)  # URL scheme → outline and letter of its make


class Gateway:
    """The console's node. A page comes by :meth:`join`, and hears everything by its listener.

    Attributes
    ----------
    undrawn : how often each kind of frame or message could not be shown
    """

    def __init__(
        self, bus: Bus, keys: Keys, scheduler: Scheduler, identity: Identity, wall_s: Callable[[], float]
    ) -> None:
        self._keys, self._scheduler, self._identity = keys, scheduler, identity
        self._desks: dict[str, Desk] = {}
        self._left_s: dict[str, float] = {}
        self._changed: set[str] = set()
        self._states_told = self._seated = 0
        self.undrawn: dict[str, int] = {}
        self.view = FleetView(bus, keys, scheduler)
        self._world = World(
            bus,
            keys,
            scheduler,
            identity.process,
            on_world=lambda: self._changed.add("world"),
            on_wanted=lambda _: self._changed.add("goals"),
        )
        self._place = Place(
            bus, keys, scheduler, self._world, self.view.present, self._end_presses, identity.read_only
        )  # fmt: skip
        self._journal = Journal(wall_s, self._tell_entry)
        self._requests = RequestBook(self._journal, self._world.lapses)
        self._news = News(self._journal)
        self._trails, self._charts, self._goals = Trails(), Charts(), Goals()
        self._coverage, self._obstacles, self._holding = Coverage(), Obstacles(), Holding()
        self._estops, self._stops = EStopBoard(self.view.present, self._name_of), StopWatch()
        self._leases = Leases(leases=())
        self._subscriptions = [
            bus.subscribe(keys.behaviour_request, BehaviourRequest, self._on_request),
            bus.subscribe(keys.behaviour_status, RequestStatus, self._on_status),
            bus.subscribe(keys.stop, StopRequest, self._on_stop),
            bus.subscribe(keys.estop, EStop, self._on_estop),
            bus.subscribe(keys.estop_receipt(), EStopReceipt, self._on_receipt),
            bus.subscribe(keys.leases, Leases, self._on_leases),
            bus.subscribe(keys.intervention(), Interventions, self._on_intervention, latest=True),
            bus.subscribe(keys.obstacles(), SeenObstacles, self._on_obstacles, latest=True),
            bus.subscribe(keys.measurement("coverage"), CoverageMeasurement, self._on_coverage, latest=True),
        ]
        self._timers = [
            scheduler.every(1.0 / STATE_HZ, self._tell_states),
            scheduler.every(1.0 / CHANGES_HZ, self._tell_changes),
            scheduler.every(1.0 / FLEET_HZ, self._tell_fleet, first_s=0.0),
            scheduler.every(1.0 / TRAIL_RATE_HZ, self._follow),
            scheduler.every(1.0 / CHART_RATE_HZ, self._tell_chart),
            scheduler.every(1.0 / GROUND_HZ, self._tell_ground),
        ]

    # ---------------------------------------------------------------- pages
    def join(self, session: str, name: str, listener: Listener) -> Desk:
        """Seat a page at its desk, a new one or the one it left, and tell it all there is."""
        host = self._identity.host
        title = f"console {name}@{host} {session[:4]}" if name else f"console@{host} {session[:4]}"
        desk = self._desks.get(session)
        if desk is not None and desk.name != title and not desk.listeners:
            self._close_desk(session)
            desk = None
        if desk is None:
            self._make_room()
            self._seated += 1
            source = f"{self._identity.process}/{self._seated}"
            desk = self._desks[session] = Desk(self._place, session, source, title)
        for kind, make in self._standing(desk).items():
            with self._drawing(kind):
                if (frame := make()) is not None:
                    listener.put(kind, frames.encode(frame))
        desk.listeners.append(listener)
        return desk

    def leave(self, desk: Desk, listener: Listener) -> None:
        """Take a page away; its desk is kept for a while, what it drove stops at once."""
        desk.leave(listener)
        self._left_s[desk.session] = self._scheduler.now_s()

    def close(self) -> None:
        """Let all robots go, hear and say nothing more."""
        for session in list(self._desks):
            self._close_desk(session)
        for timer in self._timers:
            timer.cancel()
        for subscription in self._subscriptions:
            subscription.close()
        self._world.close()
        self.view.close()

    def _close_desk(self, session: str) -> None:
        self._desks.pop(session).close()
        self._left_s.pop(session, None)

    def _make_room(self) -> None:
        """Close the desks that were left longest ago: a client may use a new name each time."""
        empty = sorted((at_s, session) for session, at_s in self._left_s.items() if not self._desks[session].listeners)
        for _, session in empty[: max(0, len(self._desks) + 1 - MOST_DESKS)]:
            self._close_desk(session)

    def _forget_desks(self, now_s: float) -> None:
        for session, left_s in list(self._left_s.items()):
            if self._desks[session].listeners:
                del self._left_s[session]
            elif now_s - left_s >= KEPT_S:
                self._close_desk(session)

    # ---------------------------------------------------------------- frames
    @contextlib.contextmanager
    def _drawing(self, what: str) -> Iterator[None]:
        """Leave out what cannot be shown, and say so once: this process carries the stop buttons, too."""
        try:
            yield
        except Exception as error:  # any kind: none of them may end the process
            self.undrawn[what] = self.undrawn.get(what, 0) + 1
            if self.undrawn[what] == 1:
                _log.error("the console cannot show something", what=what, error=repr(error), exc_info=True)
                text = f"the console cannot show all of '{what}' ({error}); stop and e-stop work"
                self._journal.add(self._scheduler.now_s(), "fault", text)

    def _standing(self, desk: Desk) -> dict[str, Callable[[], Made | None]]:
        """Return how to make each frame that a page must have to start with, the greeting first."""
        now_s = self._scheduler.now_s()
        return {
            "hello": lambda: self._hello(desk, now_s),
            "fleet": lambda: report.fleet(self.view.snapshot(), now_s),
            "state": lambda: self._states_frame(now_s),
            "goals": self._goals_frame,
            "leases": lambda: self._leases_frame(desk),
            "obstacles": self._obstacles.shown,
            "filter": lambda: self._holding.shown(now_s),
            "coverage": self._coverage.shown,
            "estop": lambda: self._estops.shown(now_s),
        }

    def _hello(self, desk: Desk, now_s: float) -> Made:
        hello: Made = {
            "t": "hello",
            "swarm": self._keys.swarm,
            "version": self._identity.version,
            "read_only": self._identity.read_only,
            "operator": desk.name,
            "icons": dict(self._identity.icons),
        }
        # Written out here already: without a greeting the page would stay shut, whatever else it could show.
        with self._drawing("world"):
            frames.encode(world := self._world.shown())
            hello |= world
        with self._drawing("history"):
            history = {
                "trails": self._trails.shown(now_s),
                "charts": list(self._charts.rows),
                "chart_names": CHART_NAMES,
                "log": [entry.shown(desk.name) for entry in self._journal.entries],
            }
            frames.encode(history)
            hello["history"] = history
        return hello

    def _states_frame(self, now_s: float) -> Made:
        return {"t": "state", "at": round(now_s, 3), "robots": report.states(self.view.snapshot())}

    def _goals_frame(self) -> Made:
        return {"t": "goals", "robots": self._goals.shown(self._world.wanted())}

    def _leases_frame(self, desk: Desk) -> Made:
        leases = [
            {
                "robot": lease.robot,
                "operator": lease.operator,
                "age_s": round(lease.age_s, 1),
                "taken_from": lease.taken_from,
                "mine": lease.operator == desk.name,
            }
            for lease in self._leases.leases
        ]
        return {"t": "leases", "leases": leases}

    def _tell(self, frame: Made) -> None:
        """Send a frame to all pages, encoded once."""
        if self._desks:
            text = frames.encode(frame)
            for desk in self._desks.values():
                for listener in tuple(desk.listeners):
                    listener.put(frame["t"], text)

    def _tell_each(self, make: Callable[[Desk], Made]) -> None:
        """Send each desk a frame of its own."""
        for desk in self._desks.values():
            if desk.listeners:
                frame = make(desk)
                desk.tell(frame["t"], frame)

    def _tell_entry(self, entry: Entry) -> None:
        self._tell_each(lambda desk: {"t": "log", "entry": entry.shown(desk.name)})

    # ---------------------------------------------------------------- at a rate
    def _tell_states(self) -> None:
        if self.view.states_heard != self._states_told:
            self._states_told = self.view.states_heard
            if self._desks:
                with self._drawing("state"):
                    self._tell(self._states_frame(self._scheduler.now_s()))

    def _tell_changes(self) -> None:
        now_s = self._scheduler.now_s()
        changed, self._changed = self._changed, set()
        with self._drawing("estop"):
            if self._estops.order is not None and (frame := self._estops.news(now_s)):
                self._tell(frame)
        with self._drawing("stop"):
            if self._stops.order is not None and (frame := self._stops.news(self.view.snapshot(), now_s)):
                self._tell(frame)
        if "world" in changed:
            with self._drawing("world"):
                self._tell({"t": "world", **self._world.shown()})
        if "goals" in changed:
            with self._drawing("goals"):
                self._tell(self._goals_frame())
        if self._holding.changed or self._holding.expired(now_s):
            self._holding.changed = False
            with self._drawing("filter"):
                self._tell(self._holding.shown(now_s))

    def _tell_fleet(self) -> None:
        now_s, seen = self._scheduler.now_s(), self.view.snapshot()
        with self._drawing("log"):
            self._news.look(seen, now_s)
        if self._desks:
            with self._drawing("fleet"):
                self._tell(report.fleet(seen, now_s))

    def _follow(self) -> None:
        with self._drawing("trails"):
            self._trails.add(self.view.snapshot(), self._scheduler.now_s())

    def _tell_chart(self) -> None:
        with self._drawing("chart"):
            row = self._charts.add(self.view.snapshot().summaries, self._scheduler.now_s())
            if row is not None:
                self._tell({"t": "chart", "row": row})

    def _tell_ground(self) -> None:
        self._forget_desks(self._scheduler.now_s())
        if self._obstacles.changed:
            self._obstacles.changed = False
            with self._drawing("obstacles"):
                self._tell(self._obstacles.shown())
        if self._coverage.changed:
            self._coverage.changed = False
            with self._drawing("coverage"):
                if frame := self._coverage.shown():
                    self._tell(frame)

    # ---------------------------------------------------------------- as it happens
    def _on_request(self, request: BehaviourRequest) -> None:
        with self._drawing("request"):
            self._requests.asked(request, self._scheduler.now_s())
            if not self._world.lapses(request.behaviour):
                self._goals.heard(request)

    def _on_status(self, status: RequestStatus) -> None:
        with self._drawing("request"):
            if self._requests.said(status, self._scheduler.now_s()):
                self._tell_status(status)

    def _tell_status(self, status: RequestStatus) -> None:
        operator = self._requests.operator_of(status.request_id)
        frame = {
            "t": "request",
            "request_id": status.request_id,
            "behaviour": status.behaviour,
            "phase": status.phase,
            "reason": for_page(status),
            "code": status.code,
            "about": status.parameters,
            "robots": status.robots,
            "running": status.running,
            "missing": status.missing,
            "refused_by": status.refused_by,
            "operator": operator,
        }
        self._tell_each(lambda desk: {**frame, "mine": operator == desk.name})

    def _on_stop(self, order: StopRequest) -> None:
        now_s = self._scheduler.now_s()
        if self._stops.ordered(order, now_s):
            self._block_sticks(order.robots)
            with self._drawing("stop"):
                by = self._name_of(order.source)
                self._requests.stopped(order.id, "the stop", by)
                self._journal.add(now_s, "stop", f"{by} stops {named(order.robots)}", order.robots, by=by)

    def _on_estop(self, order: EStop) -> None:
        now_s = self._scheduler.now_s()
        if not self._estops.ordered(order, now_s):
            return
        self._block_sticks(order.robots)  # by a release too: a stick that is held at that moment must not start them
        if not order.engaged:
            self._end_presses(order.robots)
        with self._drawing("estop"):
            by, reason = self._name_of(order.source), f": {order.reason}" if order.reason else ""
            act = "presses the e-stop of" if order.engaged else "clears the e-stop of"
            text = f"{by} {act} {named(order.robots)}{reason}"
            self._requests.stopped(order.id, "the e-stop", by)
            self._journal.add(now_s, "estop", text, order.robots, request_id=order.id, by=by)

    def _on_receipt(self, receipt: EStopReceipt) -> None:
        with self._drawing("estop"):
            self._estops.confirmed(receipt, self._scheduler.now_s())

    def _on_leases(self, leases: Leases) -> None:
        self._leases = leases
        with self._drawing("leases"):
            if self._news.leased(leases.leases, self._scheduler.now_s()):
                self._tell_each(self._leases_frame)

    def _on_intervention(self, message: Interventions) -> None:
        with self._drawing("filter"):
            self._holding.add(message, self._scheduler.now_s())

    def _on_obstacles(self, message: SeenObstacles) -> None:
        with self._drawing("obstacles"):
            self._obstacles.add(message)

    def _on_coverage(self, message: CoverageMeasurement) -> None:
        with self._drawing("coverage"):
            self._coverage.add(message)

    def _block_sticks(self, robots: tuple[str, ...]) -> None:
        for desk in self._desks.values():
            desk.stopped(robots)

    def _end_presses(self, robots: tuple[str, ...]) -> None:
        for desk in self._desks.values():
            desk.end_presses(robots)

    def _name_of(self, source: str) -> str:
        return next((desk.name for desk in self._desks.values() if desk.source == source), source)
