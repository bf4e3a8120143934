"""Robots that drive to their goals, a core with missions, and an operator, on a simulated clock."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fullswarm.config.mission_file import parse_mission
from fullswarm.core.missions import Missions
from fullswarm.messages import MissionReply, MissionRequest, MissionStatus, RobotStates, StepStatus
from fullswarm.store import Store, Stored
from tests.unit.core_swarm import KEYS, Swarm

SPEED_M_S = 2.0
STATES_HZ = 10.0
FIVE = """
name = "five"

[tracks.west]
robots = ["r0", "r1"]
[[tracks.west.steps]]
name = "out"
behaviour = "move_to_goal_bc"
parameters = { goal = [2.0, 0.0] }
done = { arrived = "all" }
[[tracks.west.steps]]
name = "look"
behaviour = "flocking_bc"
done = { time_s = 0.8 }
[[tracks.west.steps]]
name = "home"
behaviour = "move_to_goal_bc"
parameters = { goal = [0.0, 0.0] }
done = { arrived = "all" }

[tracks.east]
robots = ["r2"]
[[tracks.east.steps]]
name = "wait"
done = { time_s = 0.5 }
[[tracks.east.steps]]
name = "follow"
behaviour = "move_to_goal_bc"
parameters = { goal = [3.0, 0.0] }
after = ["west/out"]
done = { arrived = "all" }
"""


class Killed(BaseException):
    """The core's process died at this instruction."""


class MortalStore(Store):
    """A database whose process may die before or after any write."""

    def __init__(self, path: Path, writes: Callable[[str], None]) -> None:
        super().__init__(path)
        self._writes = writes

    def set_many(self, values: Any, author: str) -> Any:
        self._writes("before")
        entries = super().set_many(values, author)
        self._writes("after")
        return entries


class MissionLab:
    """A swarm of `core_swarm` whose robots have places and go to the goals of their tasks."""

    def __init__(self, path: Path, count: int = 3) -> None:
        self.path, self.places = path, {f"r{k}": (0.0, 0.0) for k in range(count)}
        self.swarm = Swarm(count=count, store=Store(path))
        self.replies: list[MissionReply] = []
        self.status: MissionStatus | None = None
        self.phases: list[str] = []
        self.numbers = 0
        self.swarm.bus.subscribe(KEYS.mission_reply(), MissionReply, self.replies.append)
        self.swarm.bus.subscribe(KEYS.mission_status, MissionStatus, self._on_status)
        self.swarm.runtime.every(1.0 / STATES_HZ, self._move)
        self.swarm.run(0.6)

    def _on_status(self, status: MissionStatus) -> None:
        self.status = status
        if not self.phases or self.phases[-1] != status.phase:
            self.phases.append(status.phase)

    def _move(self) -> None:
        for name, robot in self.swarm.robots.items():
            goal = robot.task.parameters.get("goal") if robot.task and robot.alive and not robot.estop else None
            x, y = self.places[name]
            if isinstance(goal, list):
                far = math.dist((x, y), (float(goal[0]), float(goal[1])))  # type: ignore[arg-type]  # a point
                share = min(1.0, SPEED_M_S / STATES_HZ / far) if far else 0.0
                x, y = x + share * (float(goal[0]) - x), y + share * (float(goal[1]) - y)  # type: ignore[arg-type]
                self.places[name] = x, y
            if robot.alive:
                states = RobotStates(
                    host=name, sequence=1, stamp_s=0.0, robots=(name,), x_m=(x,), y_m=(y,), heading_rad=(0.0,),
                    speed_m_s=(0.0,), turn_rad_s=(0.0,), radius_m=(0.1,),
                )  # fmt: skip
                self.swarm.bus.publish(KEYS.state("all", name), states)

    @property
    def missions(self) -> Missions:
        return self.swarm.core.missions

    def ask(self, op: str, text: str = "", *, operator: str = "anna", **more: Any) -> MissionReply:
        """Send a request and return the answer."""
        self.numbers += 1
        plan = parse_mission(text, "mission.toml", "mission").plan if text else None
        request = MissionRequest(
            id=more.pop("id", f"ask{self.numbers}"), op=op, plan=plan, operator=operator, source=operator,  # type: ignore[arg-type]
            stamp_s=self.swarm.runtime.now_s(), clock="lab", **more,
        )  # fmt: skip
        self.swarm.bus.publish(KEYS.mission_request, request)
        self.swarm.runtime.mailbox.drain()
        return next(each for each in reversed(self.replies) if each.id == request.id)

    def step(self, track: str, name: str) -> StepStatus:
        assert self.status is not None
        steps = next(each.steps for each in self.status.tracks if each.name == track)
        return next(each for each in steps if each.name == name)

    def run(self, seconds: float) -> None:
        self.swarm.run(seconds)

    def until(self, phase: str, within_s: float = 30.0) -> None:
        began_s = self.swarm.runtime.now_s()
        while (self.status is None or self.status.phase != phase) and self.swarm.runtime.now_s() - began_s < within_s:
            self.run(0.1)
        assert self.status is not None
        assert self.status.phase == phase, self.status

    def kill_core(self, store: Store | None = None, away_s: float = 0.4) -> None:
        """Let the core die without any last act, and another one start on what it has written."""
        self.swarm.core.close()
        self.swarm.store.close()
        self.run(away_s)
        self.swarm.start_core(store or Store(self.path))

    def started(self) -> list[tuple[str, str]]:
        """Return (robot, request) for each time that a robot was told to begin."""
        return [
            (name, request_id)
            for name, robot in self.swarm.robots.items()
            for act, _, request_id in robot.log
            if act == "on"
        ]

    def close(self) -> None:
        self.swarm.close()


def stored(lab: MissionLab, key: str) -> Stored:
    return lab.swarm.store.get(key)
