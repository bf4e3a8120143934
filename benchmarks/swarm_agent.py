"""One robot of the swarm benchmark: the agent that ``fullswarm agent`` runs, with a probe beside it.

``python -m benchmarks.swarm_agent <robot> <folder>``. The probe wraps what the agent is given (a scheduler) and what it
passes on (received states); the agent itself is the product's.
"""

from __future__ import annotations

import cProfile
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.swarm_meet import GRACE_S, Meeting, Result, spent_since, threads_cpu_s
from fullswarm.agent.neighbours.estimates import Neighbours
from fullswarm.agent.state import Identity
from fullswarm.bus import Bus
from fullswarm.config import SwarmConfig, load_swarm
from fullswarm.drivers.base import Description, Lifecycle, Limits, Pose, Reading, Twist
from fullswarm.drivers.fleet import OneRobot
from fullswarm.keys import cell_of, cells_within
from fullswarm.launch import nodes, processes
from fullswarm.messages import RobotStates
from fullswarm.runtime import Runtime, Timer

SWAY_M, SWAY_RAD_S = 0.1, 0.5
"""Robots circle slowly around their places, without leaving their grid cell: the senders of each robot stay known."""
READING_S = 0.05
"""A robot's telemetry comes at its own rate; between two of its packets a driver returns the same reading."""
LOOK_S = 0.2


def senders_of(config: SwarmConfig) -> dict[str, set[str]]:
    """Return for each robot whose states it should get, itself left out."""
    cell_m, reach_m = config.state_cell_m, config.agent.sensing_radius_m
    places = {each.id: each.pose or (0.0, 0.0, 0.0) for each in config.robot}
    cells = {robot: cell_of(x_m, y_m, cell_m) for robot, (x_m, y_m, _) in places.items()}
    result = {}
    for robot, (x_m, y_m, _) in places.items():
        wanted = cells_within(x_m, y_m, reach_m, cell_m)
        result[robot] = {other for other, cell in cells.items() if cell in wanted and other != robot}
    return result


class SwayingDriver:
    """A robot that circles around its place whatever it is commanded, and answers at once."""

    fault = firmware = ""
    description = Description("benchmark", "swaying", 0.17, Limits(0.5, 4.25, 2.0, 20.0), senses_pose=True)

    def __init__(self, robot: str, place: tuple[float, float, float]) -> None:
        self.url, self.state = f"null://{robot}", Lifecycle.CLOSED
        self._x_m, self._y_m, self._phase_rad = place
        self._twist = Twist(SWAY_M * SWAY_RAD_S, SWAY_RAD_S)
        self._reading: Reading | None = None

    def open(self) -> None:
        """Be ready at once."""
        self.state = Lifecycle.READY

    def activate(self) -> None:
        """Accept set-points."""
        self.state = Lifecycle.ACTIVE

    def deactivate(self) -> None:
        """Accept none."""
        self.state = Lifecycle.READY

    def read(self) -> Reading:
        """Return where the circle has led."""
        now_s = time.monotonic()
        if self._reading is not None and now_s - self._reading.stamp_s < READING_S:
            return self._reading
        angle = self._phase_rad + SWAY_RAD_S * now_s
        x_m, y_m = self._x_m + SWAY_M * math.cos(angle), self._y_m + SWAY_M * math.sin(angle)
        pose = Pose(x_m, y_m, math.remainder(angle + 0.5 * math.pi, 2.0 * math.pi))
        self._reading = Reading(stamp_s=now_s, odometry=pose, twist=self._twist, pose=pose)
        return self._reading

    def command(self, twist: Twist) -> Twist:
        """Accept anything."""
        return twist

    def close(self) -> None:
        """Close."""
        self.state = Lifecycle.CLOSED


class Probe:
    """A scheduler for the agent that watches its first timer, the control loop; and a record of what it receives."""

    def __init__(
        self, robot: str, runtime: Runtime, meeting: Meeting, expected: set[str], profile: Path | None
    ) -> None:
        self._robot, self._runtime, self._meeting, self._missing = robot, runtime, meeting, set(expected)
        self._control: Timer | None = None
        self._due_s = 0.0
        self._begin_s = self._end_s = math.inf
        self._result = Result()
        self._own: list[int] = []
        self._cpu_s: list[float] = []
        self._late_s: list[float] = []
        self._threads_s: dict[str, float] = {}
        self._profile_path, self._profile = profile, cProfile.Profile(time.thread_time)
        self._look_timer = runtime.every(LOOK_S, self._look)

    def now_s(self) -> float:
        """Return the runtime's time."""
        return self._runtime.now_s()

    def after(self, delay_s: float, callback: Callable[[], None]) -> Timer:
        """Have the runtime call back once."""
        return self._runtime.after(delay_s, callback)

    def every(self, period_s: float, callback: Callable[[], None], *, first_s: float | None = None) -> Timer:
        """Have the runtime call back periodically; the first call is the control loop."""
        if self._control is not None:
            return self._runtime.every(period_s, callback, first_s=first_s)
        self._control = timer = self._runtime.every(period_s, lambda: self._tick(callback), first_s=first_s)
        self._due_s = timer.due_s
        return timer

    def _tick(self, callback: Callable[[], None]) -> None:
        now_s, before_s = time.monotonic(), time.thread_time()
        callback()
        self._cpu_s.append(time.thread_time() - before_s)
        self._late_s.append(round(now_s - self._due_s, 6))
        if self._control is not None:
            self._due_s = self._control.due_s  # the runtime has set the next one before it called

    def received(self, states: RobotStates, now_s: float) -> None:
        """Book the arrival of a state."""
        if not self._begin_s <= states.stamp_s < self._end_s:
            self._missing.discard(states.host)
        elif states.host == self._robot:
            self._own.append(states.sequence)
        else:
            self._result.book(states.host, states.stamp_s, now_s)

    def _look(self) -> None:
        if not self._missing:
            self._meeting.ready()
        window = self._meeting.window()
        if window is None:
            return
        self._look_timer.cancel()
        self._begin_s, self._end_s = window
        now_s = self._runtime.now_s()
        self._runtime.after(self._begin_s - now_s, self._begin)
        self._runtime.after(self._end_s - now_s, self._end)
        self._runtime.after(self._end_s - now_s + GRACE_S, self._report)

    def _missed(self) -> int:
        return self._control.missed if self._control else 0

    def _begin(self) -> None:
        self._late_s.clear()
        self._cpu_s.clear()
        self._result.missed, self._threads_s = -self._missed(), threads_cpu_s()
        if self._profile_path:
            self._profile.enable()

    def _end(self) -> None:
        if self._profile_path:
            self._profile.disable()
            self._profile.dump_stats(self._profile_path)
        result = self._result
        result.threads_cpu_s = spent_since(self._threads_s)
        result.missed += self._missed()
        result.late_s, result.window_s = self._late_s.copy(), self._end_s - self._begin_s
        result.tick_cpu_us = 1e6 * sum(self._cpu_s) / max(len(self._cpu_s), 1)

    def _report(self) -> None:
        # By the numbers, not by counting: the own state comes back through a mailbox that keeps the newest only.
        self._result.sent = max(self._own) - min(self._own) + 1 if self._own else 0
        self._meeting.report(self._result)


class ProbedNeighbours(Neighbours):
    """The agent's own, which also informs the probe."""

    def __init__(self, robot: str, timeout_s: float, probe: Probe) -> None:
        super().__init__((robot,), timeout_s)
        self._probe = probe

    def receive(self, states: RobotStates, now_s: float) -> None:
        """Take in a state."""
        self._probe.received(states, now_s)
        super().receive(states, now_s)


def main() -> None:
    """Run an agent as ``fullswarm agent`` does, with the swaying driver and the probe."""
    robot, folder = sys.argv[1], Path(sys.argv[2])
    config = load_swarm(folder / "fleet.toml")
    place = {each.id: each.pose for each in config.robot}[robot] or (0.0, 0.0, 0.0)
    profile = folder / "agent.prof" if (folder / "profile").exists() and robot == config.robots[0] else None

    def build(bus: Bus, runtime: Runtime) -> list[nodes.Node]:
        probe = Probe(robot, runtime, Meeting(folder, robot), senders_of(config)[robot], profile)
        fleet = OneRobot(robot, SwayingDriver(robot, place))
        identity = Identity(robot, nodes.process_id(robot))
        node = nodes.agent(bus, probe, config, fleet, identity, runtime.stats)
        node.neighbours = ProbedNeighbours(robot, config.agent.neighbour_timeout_s, probe)
        return [node]

    processes.serve_on_bus(config, True, build, robot)


if __name__ == "__main__":
    main()
