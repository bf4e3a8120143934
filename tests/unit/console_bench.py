"""A console's gateway on a simulated clock, with a small swarm and core played by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from fullswarm.bus import LocalBus
from fullswarm.clock import SimClock
from fullswarm.keys import Keys
from fullswarm.messages import (
    STOP,
    BehaviourRequest,
    HealthReport,
    Heartbeat,
    Lease,
    Leases,
    Message,
    ParamChanged,
    ParamEntry,
    ParamReply,
    ParamRequest,
    RequestStatus,
    RobotHealth,
    RobotStates,
)
from fullswarm.operator.console import frames
from fullswarm.operator.console.experiments import ExperimentOptions
from fullswarm.operator.console.gateway import Gateway, Identity
from fullswarm.operator.console.sessions import OperatorSession
from fullswarm.runtime import Runtime

KEYS = Keys("lab")
DATABASE: dict[str, Any] = {
    "behaviour/move_to_goal_bc": {
        "summary": "Drive there", "filtered": True,
        "parameters": {
            "goal": {"type": "point", "required": True},
            "gain": {"type": "number", "default": 1.0, "default_from": "agent/gain"},
        },
    },
    "behaviour/drive_bc": {"summary": "Two sticks", "expires_s": 0.3, "parameters": {"linear": {"type": "number"}}},
    "group/scouts": {"robots": ["r1", "r2"]},
    "world/bounds": [[0.0, 0.0], [10.0, 8.0]],
    "world/boxes": {"boxes": [[5.0, 5.0, 1.0, 2.0, 0.3]]},
    "agent/sensing_radius_m": 3.0,
    "agent/gain": 2.5,
}  # fmt: skip


def health(robot: str, **fields: Any) -> RobotHealth:
    plain: dict[str, Any] = {
        "robot": robot, "driver": f"sim://{robot}", "make": "sim", "model": "disc", "firmware": "1",
        "lifecycle": "ACTIVE",
    }  # fmt: skip
    return RobotHealth(**{**plain, **fields})


class Page:
    """What a browser would have got."""

    def __init__(self) -> None:
        self.frames: list[dict[str, Any]] = []
        self.ref = 0

    def put(self, kind: str, text: str) -> None:
        frame = json.loads(text)
        assert frame["t"] == kind.partition(" ")[0]  # pictures: of which camera
        self.frames.append(frame)

    def all(self, kind: str) -> list[dict[str, Any]]:
        return [frame for frame in self.frames if frame["t"] == kind]

    def last(self, kind: str) -> dict[str, Any]:
        found = self.all(kind)
        assert found, f"no {kind} among {sorted({frame['t'] for frame in self.frames})}"
        return found[-1]

    def log(self, kind: str) -> list[str]:
        return [frame["entry"]["text"] for frame in self.all("log") if frame["entry"]["kind"] == kind]


class ConsoleBench:
    """The gateway with a bus, a core and pages."""

    def __init__(
        self,
        *,
        read_only: bool = False,
        core: bool = True,
        study: Path | None = None,
        bench: ExperimentOptions | None = None,
    ) -> None:
        self.runtime = Runtime(SimClock(100.0))
        self.bus = LocalBus(self.runtime.mailbox)
        self.database = dict(DATABASE)
        self.core, self.sequence = core, 0
        self.asked: list[ParamRequest] = []
        self.sent: list[Message] = []
        self.bus.subscribe("lab/params/core/request", ParamRequest, self._answer)
        for key in (KEYS.behaviour_request, KEYS.stop, KEYS.estop, KEYS.lease_request):
            self.bus.subscribe(key, Message, self.sent.append)
        self.wall_s = 1_700_000_000.0
        self.gateway = Gateway(
            self.bus, KEYS, self.runtime,
            Identity("base", "console@base:1", "9.9", read_only, study=study, experiments=bench),
            lambda: self.wall_s,
        )  # fmt: skip
        self.run(0.01)

    def _answer(self, request: ParamRequest) -> None:
        self.asked.append(request)
        if self.core:
            entries = tuple(
                ParamEntry(key=key, value=value, author="seed", changed=0.0) for key, value in self.database.items()
            )
            self.bus.publish(KEYS.param_reply("core", request.id), ParamReply(id=request.id, ok=True, entries=entries))

    def run(self, seconds: float) -> None:
        self.runtime.run(seconds)

    def join(self, key: str = "session-1", name: str = "anna") -> tuple[Page, OperatorSession]:
        page = Page()
        return page, self.gateway.join(key, name, page)

    def say(self, session: OperatorSession, page: Page, t: str, **fields: Any) -> dict[str, Any]:
        """Send a frame as a page does; return the answer."""
        page.ref += 1
        command = frames.read_command(json.dumps({"t": t, "ref": page.ref, **fields}))
        answer = command if isinstance(command, frames.Answer) else session.handle(command, page)
        told: dict[str, Any] = json.loads(answer.encoded())
        assert told["t"] == "answer"
        assert told["ref"] == page.ref
        return told

    # ---------------------------------------------------------------- the swarm
    def states(self, *robots: str, x_m: float = 1.0, host: str = "h") -> None:
        ones = (x_m,) * len(robots)
        self.bus.publish(
            KEYS.state("all", host),
            RobotStates(
                host=host, sequence=1, stamp_s=0.0, robots=robots, x_m=ones, y_m=ones, heading_rad=ones,
                speed_m_s=ones, turn_rad_s=ones, radius_m=(0.17,) * len(robots),
            ),
        )  # fmt: skip

    def report(self, *robots: RobotHealth, host: str = "h") -> None:
        self.bus.publish(KEYS.health(host), HealthReport(host=host, process="p", version="1.2", robots=robots))

    def beat(self, process: str = "core-1") -> None:
        self.bus.publish(KEYS.heartbeat("core"), Heartbeat(node="core", process=process, sequence=1))

    def status(self, request_id: str, phase: Any, **fields: Any) -> None:
        behaviour = fields.pop("behaviour", "move_to_goal_bc")
        message = RequestStatus(request_id=request_id, behaviour=behaviour, phase=phase, **fields)
        self.bus.publish(KEYS.behaviour_status, message)

    def leases(self, **holders: str) -> None:
        leases = tuple(Lease(robot=robot, operator=operator, age_s=1.0) for robot, operator in holders.items())
        self.sequence += 1
        self.bus.publish(KEYS.leases, Leases(leases=leases, core="core-1", sequence=self.sequence))

    def change(self, key: str, value: Any) -> None:
        self.database[key] = value
        entry = ParamEntry(key=key, value=value, author="anna", changed=0.0)
        self.bus.publish(KEYS.param_changed("core"), ParamChanged(layer="core", entry=entry))

    def requests(self) -> list[BehaviourRequest]:
        """Return what was asked for; the stops that go to the core beside each `StopRequest` are left out."""
        return [each for each in self.sent if isinstance(each, BehaviourRequest) and each.behaviour != STOP]
