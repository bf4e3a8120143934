"""Shows a swarm to ROS, and carries out what ROS asks if the operator has allowed that.

In, from the bus: RobotStates, HealthReport, RobotProfiles, SeenObstacles, GridTiles, RangeReport, BehaviourRequest,
Leases. Out, to ROS: the topics of `values.py`; see docs/how-to-ros-bridge.md. In, from ROS, only with commands:
``<robot>/cmd_vel`` and ``swarm/request``.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

import structlog

from fullswarm.bus.base import Bus
from fullswarm.bus.lanes import Bucket
from fullswarm.errors import MessageError
from fullswarm.keys import ROBOT_ID, Keys
from fullswarm.messages import (
    BehaviourRequest,
    EStop,
    GridTiles,
    HealthReport,
    RangeReport,
    RobotStates,
    SeenObstacles,
    StopRequest,
)
from fullswarm.operator.client import Operator
from fullswarm.operator.leases import LeaseHolder
from fullswarm.operator.robot_state import advise, row_state
from fullswarm.operator.scans import DEFAULT_HZ, ScanWatch
from fullswarm.operator.view import FleetView, RobotRow, natural
from fullswarm.recent import Recent
from fullswarm.ros_bridge import codec as types
from fullswarm.ros_bridge import values as v
from fullswarm.ros_bridge.cmd_vel import NO_CORE, Drive, DriveContext, velocity
from fullswarm.ros_bridge.complaints import Complaints
from fullswarm.ros_bridge.control_requests import ControlRequests, SeenRequests
from fullswarm.ros_bridge.grid import JoinedGrid
from fullswarm.ros_bridge.link import Incoming, Link, Topic, Values
from fullswarm.ros_bridge.requests import Halted, Requests
from fullswarm.ros_bridge.scans import ScanTopics
from fullswarm.runtime import Scheduler

log = structlog.get_logger("fullswarm.ros")
POLL_S = 0.02
"""Messages of ROS are taken so often: a flood of them wakes nothing."""
ODOMETRY_HZ = 30.0
"""Of one robot at most: states come 20 times a second, and a network that held some back sends them together."""
DIAGNOSTICS_S, BATTERY_S, MARKERS_S, GRID_S = 1.0, 1.0, 0.5, 2.0
GONE_S = 10.0
"""A robot that has been silent for so long has no topics any more; when it is back, it gets them again."""
MOST_ROBOTS, MOST_HOSTS, MOST_BOXES = 1000, 1000, 5000
"""Robots and hosts that are shown, and obstacles that are drawn, at most."""
FINISH_S, ZEROS_S = 0.5, 0.2
"""Time for the last zeros and the return of the leases, and for the zeros alone."""
_FIRST = re.compile(r"[A-Za-z_]")

TF, TF_STATIC, MAP = Topic("tf", types.TF), Topic("tf_static", types.TF, latched=True), Topic("map", types.GRID, True)
MARKERS, DIAGNOSTICS = Topic("swarm/markers", types.MARKERS), Topic("diagnostics", types.DIAGNOSTICS)
SERVICES: Mapping[str, Literal["stop", "estop"]] = MappingProxyType({"swarm/stop": "stop", "swarm/estop": "estop"})
"""Of the type std_srvs/srv/Trigger, on ROS 2; each halts all robots."""
REQUEST, ANSWER = Topic("swarm/request", types.STRING), Topic("swarm/answer", types.STRING)


def ros_name(robot: str) -> str:
    """Return a robot's id as a name of ROS: ``-`` becomes ``_``, and a letter comes first."""
    name = robot.replace("-", "_")
    return name if _FIRST.match(name) else f"robot_{name}"


@dataclass(slots=True)
class Shown:
    """One robot as ROS has it."""

    name: str
    state: v.RobotState
    arrived_s: float
    bucket: Bucket
    control_requests: ControlRequests
    scans: ScanTopics
    topics: dict[str, Topic] = field(default_factory=dict)  # by their last chunk


@dataclass(frozen=True, slots=True)
class Options:
    """How the bridge shows the swarm.

    Parameters
    ----------
    namespace
        Before the name of every topic; empty: none.
    commands
        Take velocities and requests of ROS.
    scans_hz
        Ask the robots for their range scans so often, 20 times a second at most; 0: do not ask.
    """

    namespace: str = ""
    commands: bool = False
    scans_hz: float = DEFAULT_HZ


class Bridge:
    """The node between the bus and the sides of ROS.

    Parameters
    ----------
    wall_ns
        Returns nanoseconds since 1970: the stamps of ROS.
    """

    def __init__(
        self, bus: Bus, keys: Keys, scheduler: Scheduler, operator: Operator, links: Sequence[Link],
        options: Options, wall_ns: Callable[[], int],
    ) -> None:  # fmt: skip
        self._bus, self._scheduler, self._operator, self._links = bus, scheduler, operator, tuple(links)
        self._options, self._wall_ns = options, wall_ns
        self._view = FleetView(bus, keys, scheduler)
        self._complaints = Complaints()
        self._shown: dict[str, Shown] = {}
        self._names: dict[str, str] = {}  # of ROS → robot
        self._grid = JoinedGrid()
        self._obstacles: Recent[str, SeenObstacles] = Recent(MOST_HOSTS)
        self._requests = SeenRequests()
        self._static: frozenset[str] = frozenset()
        self._mounted = False  # a sensor's frame is new or has moved
        self._scans = ScanWatch(bus, keys, scheduler, operator.source, self._on_scans)
        if options.scans_hz > 0.0:
            self._scans.ask(None, options.scans_hz)
        self._up = {link.where: link.up for link in links}
        self._inputs: dict[str, tuple[str, str]] = {}  # topic → its type, robot
        self._services: dict[str, Literal["stop", "estop"]] = {}  # by full name
        self._drives: dict[str, Drive] = {}
        self._leases = LeaseHolder(
            bus, keys, scheduler, operator.name, on_lost=self._taken_over, on_refused=self._not_granted
        )
        self._context = DriveContext(operator, self._leases, scheduler, bus.connected, self._refused)
        self._asked = Requests(operator, scheduler, self._answer, self._view.present, self._end_driving)
        self._ending = self._closed = False
        self._subscriptions = [
            bus.subscribe(keys.state(), RobotStates, self._on_states),
            bus.subscribe(keys.health(), HealthReport, self._on_health),
            bus.subscribe(keys.obstacles(), SeenObstacles, self._on_obstacles, latest=True),
            bus.subscribe(keys.grid(), GridTiles, self._on_grid),
            bus.subscribe(keys.behaviour_request, BehaviourRequest, self._requests.add),
            bus.subscribe(keys.stop, StopRequest, self._on_stop),
            bus.subscribe(keys.estop, EStop, self._on_estop),
        ]
        for topic in (TF, TF_STATIC, MARKERS, DIAGNOSTICS):
            self._advertise(topic)
        if options.commands:
            self._advertise(ANSWER)
            self._subscribe(REQUEST, "")
            for name, op in SERVICES.items():
                full = self._full(Topic(name, types.TRIGGER)).name
                self._services[full] = op
                for link in links:
                    link.serve(full)
        self._timers = [
            scheduler.every(POLL_S, self._poll),
            scheduler.every(DIAGNOSTICS_S, self._publish_diagnostics),
            scheduler.every(BATTERY_S, self._publish_batteries),
            scheduler.every(MARKERS_S, self._publish_markers),
            scheduler.every(GRID_S, self._publish_grid),
        ]

    # ------------------------------------------------------------ topics
    def _full(self, topic: Topic) -> Topic:
        return topic._replace(name=f"{self._options.namespace}/{topic.name}") if self._options.namespace else topic

    def _advertise(self, topic: Topic) -> None:
        for link in self._links:
            link.advertise(self._full(topic))

    def _subscribe(self, topic: Topic, robot: str) -> None:
        full = self._full(topic)
        self._inputs[full.name] = full.kind, robot
        for link in self._links:
            link.subscribe(full)

    def _withdraw(self, topic: Topic) -> None:
        full = self._full(topic)
        self._inputs.pop(full.name, None)
        for link in self._links:
            link.withdraw(full.name)

    def _publish(self, topic: Topic, values: Values) -> None:
        for link in self._links:
            link.publish(self._full(topic).name, values)

    # ------------------------------------------------------------ robots that come and go
    def _appear(self, robot: str, state: v.RobotState, now_s: float) -> Shown | None:
        """Give a robot its topics; None: it cannot be shown, which is named."""
        name, what = ros_name(robot), ""
        if not ROBOT_ID.match(robot):  # it would become a part of keys
            what = "this is no robot's name"
        elif self._names.get(name, robot) != robot:
            what = f"'{self._names[name]}' has the same name in ROS"
        elif len(self._shown) >= MOST_ROBOTS:
            what = f"{MOST_ROBOTS} robots are shown already"
        if what:
            self._complaints.add(f"{robot:.64}", f"{robot:.64} is not shown: {what}", now_s)
            return None
        self._names[name] = robot
        control_requests = ControlRequests(name, self._advertise, self._withdraw, self._publish)
        scans = ScanTopics(name, self._advertise, self._withdraw, self._publish, now_s)
        found = self._shown[robot] = Shown(name, state, now_s, Bucket(ODOMETRY_HZ, now_s), control_requests, scans)
        self._offer(found, "odom", types.ODOMETRY)
        if self._options.commands:
            topic = found.topics["cmd_vel"] = Topic(f"{name}/cmd_vel", types.TWIST)
            self._subscribe(topic, robot)
            self._drives[robot] = Drive(self._context, robot)
        return found

    def _offer(self, shown: Shown, last: str, kind: str) -> Topic:
        topic = shown.topics[last] = Topic(f"{shown.name}/{last}", kind)
        self._advertise(topic)
        return topic

    def _disappear(self, robot: str) -> None:
        shown = self._shown.pop(robot)
        self._names.pop(shown.name, None)
        drive = self._drives.pop(robot, None)
        if drive is not None:
            drive.release()
        shown.control_requests.close()
        shown.scans.close()
        for topic in shown.topics.values():
            self._withdraw(topic)

    # ------------------------------------------------------------ from the swarm
    def _on_states(self, message: RobotStates) -> None:
        now_s, stamp_ns = self._scheduler.now_s(), self._wall_ns()
        moved = []
        for robot, state in v.states_of(message).items():
            shown = self._shown.get(robot) or self._appear(robot, state, now_s)
            if shown is None:
                continue
            shown.state, shown.arrived_s = state, now_s
            if shown.bucket.take(now_s):
                self._publish(shown.topics["odom"], v.odometry(shown.name, state, stamp_ns))
                moved.append(v.transform(f"{shown.name}/odom", f"{shown.name}/base_link", stamp_ns, state))
        if moved:
            self._publish_static(stamp_ns)
            self._publish(TF, {"transforms": moved})

    def _publish_static(self, stamp_ns: int) -> None:
        """Publish where robots' frames lie in the map, and sensors on their robots, if others than before do."""
        names = frozenset(each.name for each in self._shown.values() if not each.state.own_frame)
        if names != self._static or self._mounted:
            self._static, self._mounted = names, False
            frames = [v.transform(v.MAP, f"{name}/odom", stamp_ns) for name in sorted(names)]
            for shown in self._shown.values():
                for frame, mount in shown.scans.mounts.items():
                    frames.append(v.transform(f"{shown.name}/base_link", frame, stamp_ns, mount))
            self._publish(TF_STATIC, {"transforms": frames})

    def _on_obstacles(self, message: SeenObstacles) -> None:
        self._obstacles[message.host] = message

    def _on_health(self, report: HealthReport) -> None:
        for health in report.robots:
            shown = self._shown.get(health.robot)
            if shown is not None:
                shown.control_requests.update(health, self._requests)

    def _on_scans(self, report: RangeReport) -> None:
        shown = self._shown.get(report.robot)
        if shown is not None:
            stamp_ns = self._wall_ns()
            if shown.scans.update(report, self._scheduler.now_s(), stamp_ns):
                self._mounted = True
                self._publish_static(stamp_ns)

    def _on_grid(self, message: GridTiles) -> None:
        try:
            self._grid.add(message)
        except MessageError as error:
            self._complaints.add(message.host, str(error), self._scheduler.now_s())

    # ------------------------------------------------------------ from ROS
    def _poll(self) -> None:
        for link in self._links:
            for incoming in link.take():
                self._take(link, incoming)
            if link.up != self._up[link.where]:
                self._up[link.where] = link.up
                log.warning("connected again" if link.up else "connection lost", side=link.where)
        for drive in self._drives.values():
            drive.check()

    def _take(self, link: Link, incoming: Incoming) -> None:
        if incoming.reply is not None:
            self._call(self._services[incoming.topic], incoming.reply)
            return
        kind, robot = self._inputs.get(incoming.topic, ("", ""))
        if not kind or self._ending:
            return  # the topic was withdrawn just now, or the bridge ends: nothing may start again
        try:
            if incoming.problem:
                raise MessageError(incoming.problem)
            message = link.decode(kind, incoming.data)
            if robot:
                shown = self._shown.get(robot)
                self._drives[robot].command(*velocity(message), shown.state if shown is not None else None)
            else:
                self._asked.take(message.data)
        except MessageError as error:
            now_s, sender = self._scheduler.now_s(), f"{incoming.sender} on /{incoming.topic}"
            if not robot and self._complaints.answers(sender, now_s):
                self._answer({"id": "", "phase": "refused", "reason": error.what})
            self._complaints.add(sender, error.what, now_s)

    def _call(self, op: Literal["stop", "estop"], reply: Callable[[bool, str], None]) -> None:
        """Halt all robots for a call of a service; the reply says which e-stops are confirmed."""

        def answer(result: Halted) -> None:
            if op == "stop":
                reply(True, "a stop was sent to all robots")
            else:
                missing = f"; not by {', '.join(result.missing)}" if result.missing else ""
                reply(not result.missing, f"confirmed by {', '.join(result.confirmed) or 'no robot'}{missing}")

        self._asked.halt(op, (), answer)

    def _answer(self, answer: Mapping[str, Any]) -> None:
        if not self._closed:
            self._publish(ANSWER, {"data": json.dumps(answer, ensure_ascii=False)})

    # ------------------------------------------------------------ what ends driving
    def _refused(self, robot: str, reason: str) -> None:
        log.warning("cmd_vel is not carried out", robot=robot, reason=reason)
        self._publish_diagnostics()

    def _block(self, robots: Sequence[str], reason: str) -> None:
        """Block robots that are driven; none: all."""
        for robot in robots or tuple(self._drives):
            drive = self._drives.get(robot)
            if drive is not None and drive.driving:
                drive.block(reason)

    def _end_driving(self, robots: tuple[str, ...], then: Callable[[], None]) -> None:
        """End the driving of a request's robots (groups: of all), and then call `then`: zeros would end the request."""
        named = () if any(each.startswith("@") for each in robots) else robots
        driven = [robot for robot, drive in self._drives.items() if drive.driving and (not named or robot in named)]
        if not driven:
            then()
            return
        self._block(driven, "a request came: pause the velocities first")
        self._scheduler.after(ZEROS_S, then)

    def _taken_over(self, robots: tuple[str, ...], operator: str) -> None:
        self._block(robots, f"taken over by {operator}")

    def _not_granted(self, robots: tuple[str, ...], operator: str) -> None:
        self._block(robots, f"held by {operator}")

    def _on_stop(self, order: StopRequest) -> None:
        self._block(order.robots, f"stopped by {order.source or 'an operator'}: pause the velocities first")

    def _on_estop(self, order: EStop) -> None:
        # Also its release: velocities that come at that moment must not start the robots.
        act = "engaged" if order.engaged else "cleared"
        self._block(order.robots, f"e-stop {act} by {order.source or 'an operator'}: pause the velocities first")

    # ------------------------------------------------------------ to ROS, at fixed rates
    def _publish_batteries(self) -> None:
        stamp_ns = self._wall_ns()
        for row in self._view.snapshot().robots:
            shown = self._shown.get(row.robot)
            if shown is None or row.silent or row.health is None or row.health.battery < 0.0:
                continue
            topic = shown.topics.get("battery_state") or self._offer(shown, "battery_state", types.BATTERY)
            self._publish(topic, v.battery(shown.name, row.health, stamp_ns))

    def _publish_markers(self) -> None:
        stamp_ns, now_s = self._wall_ns(), self._scheduler.now_s()
        health = {row.robot: row.health for row in self._view.snapshot().robots}
        drawn: list[dict[str, Any]] = []
        for robot, shown in self._shown.items():
            if now_s - shown.arrived_s <= v.LASTS_S:
                mine = health.get(robot)
                goal = self._goal(shown.state, mine.request_id if mine is not None and mine.behaviour else "")
                drawn += v.robot_markers(robot, shown.name, shown.state, goal, stamp_ns)
        boxes = sorted({row for each in self._obstacles.values() for row in each.rows})[:MOST_BOXES]
        self._publish(MARKERS, {"markers": drawn + v.obstacle_markers(boxes, stamp_ns)})

    def _goal(self, state: v.RobotState, request_id: str) -> Sequence[float] | None:
        """Return where a robot is driving to: its request's goal, else the place that it states itself."""
        goal = self._requests.parameters(request_id).get("goal")
        if isinstance(goal, list) and len(goal) == 2 and all(isinstance(each, int | float) for each in goal):
            return [float(each) for each in goal if not isinstance(each, list)]
        aim = (state.aim_x_m, state.aim_y_m)
        if not request_id or not all(map(math.isfinite, aim)) or aim == (state.x_m, state.y_m):
            return None
        return aim

    def _publish_grid(self) -> None:
        self._forget_silent()
        place = self._grid.place
        if place is not None and self._grid.changed:
            self._advertise(MAP)
            self._publish(MAP, v.occupancy_grid(place, self._grid.cells(), self._wall_ns()))

    def _forget_silent(self) -> None:
        now_s = self._scheduler.now_s()
        for robot in [robot for robot, shown in self._shown.items() if now_s - shown.arrived_s > GONE_S]:
            self._disappear(robot)

    # ------------------------------------------------------------ diagnostics
    def _publish_diagnostics(self) -> None:
        if self._closed:
            return
        seen = self._view.snapshot()
        holders = seen.holders
        rows = sorted(seen.robots, key=lambda row: natural(row.robot))
        entries = [self._bridge_entry(seen.connected)]
        entries += [_robot_entry(row, holders.get(row.robot, "")) for row in rows]
        known = self._leases.received
        entries += [_drive_entry(self._drives[robot], known) for robot in sorted(self._drives, key=natural)]
        self._publish(DIAGNOSTICS, {"header": v.header("", self._wall_ns()), "status": entries})

    def _bridge_entry(self, connected: bool) -> dict[str, Any]:
        newest = self._complaints.newest(self._scheduler.now_s())
        problems = [] if connected else ["the swarm's hub is not connected"]
        problems += [f"{link.where} is not connected" for link in self._links if not link.up]
        problems += [f"{sender}: {each.what}" for sender, each in newest.items()]
        numbers = {
            "robots": str(len(self._shown)), "commands": "allowed" if self._options.commands else "not allowed",
            "operator": self._operator.name if self._options.commands else "",
            "refused or malformed": str(self._complaints.total),
            **{f"dropped, {link.where}": str(link.dropped) for link in self._links},
            **{f"from {sender}": f"{each.times}: {each.what}" for sender, each in newest.items()},
        }  # fmt: skip
        level = v.ERROR if not connected else v.WARN if problems else v.OK
        return v.diagnostic(level, "swarm: bridge", problems[-1] if problems else "connected", numbers)

    # ------------------------------------------------------------ the end
    def finish(self, on_done: Callable[[], None]) -> None:
        """Stop the robots that ROS drives and return their leases; then call `on_done`."""
        self._ending = True
        waits = [drive for drive in self._drives.values() if drive.driving]
        if not waits:
            on_done()
            return
        for drive in waits:
            drive.release()
        self._scheduler.after(FINISH_S, on_done)

    def close(self) -> None:
        """Unsubscribe, return all leases and leave ROS. Closing twice is fine."""
        if self._closed:
            return
        for drive in self._drives.values():
            drive.release()
        self._closed = True
        for timer in self._timers:
            timer.cancel()
        for subscription in self._subscriptions:
            subscription.close()
        self._scans.close()
        self._leases.close()
        self._view.close()
        for link in self._links:
            link.close()


def _robot_entry(row: RobotRow, holder: str) -> dict[str, Any]:
    state, health = row_state(row), row.health
    level = v.OK
    if row.silent or health is None:
        level = v.STALE
    elif health.fault or health.lifecycle == "FAULT" or health.estop:
        level = v.ERROR
    elif state.attention:
        level = v.WARN
    numbers = {"held by": holder, "advice": advise(row), "host": row.host, "software": row.version}
    if health is not None:
        numbers |= {
            "lifecycle": health.lifecycle, "behaviour": health.behaviour, "request": health.request_id,
            "e-stop": str(health.estop), "stop reason": health.stop_reason, "fault": health.fault,
            "battery": f"{health.battery:.2f}" if health.battery >= 0.0 else "", "contacts": str(health.contacts),
            "position sigma, m": f"{health.position_sigma_m:.3f}" if health.position_sigma_m >= 0.0 else "",
            "safety filter": health.filter_note, "driver": health.driver,
        }  # fmt: skip
    hardware = "" if health is None else f"{health.make} {health.model}".strip()
    return v.diagnostic(level, f"swarm: {row.robot}", state.text, numbers, hardware)


def _drive_entry(drive: Drive, core_known: bool) -> dict[str, Any]:
    name = f"swarm: {drive.robot} cmd_vel"
    if not core_known:
        return v.diagnostic(v.WARN, name, NO_CORE, {})
    if drive.refusal:
        return v.diagnostic(v.WARN, name, f"refused: {drive.refusal}", {})
    return v.diagnostic(v.OK, name, "driving" if drive.driving else "idle", {})
