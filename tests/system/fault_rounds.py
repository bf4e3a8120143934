"""Runs the rounds of the fault matrix and measures them."""

from __future__ import annotations

import math
import signal
from dataclasses import dataclass, field
from tempfile import TemporaryDirectory

from fullswarm.messages import Value
from tests.system.fault_matrix import (
    BACKENDS,
    BOX_M,
    CALM_S,
    CRUISE_M_S,
    FAULTS,
    FENCE_M,
    LANE_M,
    LONGEST_S,
    PAUSE_S,
    STOPPED_M_S,
    Fault,
    Result,
    Rig,
    Round,
    config,
)
from tests.system.live import START_S, LiveSwarm

REACH_M = BOX_M - 0.2 - 0.17
"""Where a robot's bumper touches the box."""
READY_S = START_S
"""Agents that were killed start again: as slow as at first."""
SETTLES_S = 30.0
"""No bound of the product: so long a machine with other work may take to bring about what a round begins with."""
AGAIN_S = 1.5
LONG_WAY_S = 12.0
PAUSES = ("clock jump", "frozen simulation clock")
"""They pass by themselves, and the robot would drive on."""
CALLED_OFF_S = 0.15
"""So long it is seen to stand before its task is called off."""


@dataclass(slots=True)
class Watch:
    """What became of one robot since its fault."""

    began_s: float
    from_m: float
    zero_s: float
    rest_s: float
    driven: bool = True
    moving: bool = True
    called_off: bool = False


@dataclass(slots=True)
class Matrix:
    """A swarm that suffers."""

    folder: TemporaryDirectory[str] = field(default_factory=TemporaryDirectory)
    rig: Rig = field(init=False)

    def __post_init__(self) -> None:
        self.rig = Rig(LiveSwarm(config(self.folder.name), watch=True))

    def close(self) -> None:
        """End it."""
        self.rig.swarm.close()
        self.folder.cleanup()

    def run(self, happens: Round) -> list[Result]:
        """Set off, let it happen, measure, mend."""
        groups = {name: [robot for robot in happens if happens[robot] == name] for name in set(happens.values())}
        self._set_off(happens)
        for name, robots in groups.items():
            if name == "clock jump":
                for robot in robots:
                    self.rig.swarm.supervisor.kill(robot, signal.SIGSTOP)
        if "clock jump" in groups:
            self.rig.swarm.rest(PAUSE_S)
        watches: dict[str, Watch] = {}
        for name, robots in groups.items():
            now_s = self.rig.swarm.clock.now_s()  # to kill the processes of one fault takes its time
            FAULTS[name].inject(self.rig, robots)
            for robot in robots:
                watches[robot] = Watch(now_s, self.rig.x_m(robot), now_s, now_s)
        self._observe(happens, watches)
        results = [self._result(FAULTS[happens[robot]], robot, watch) for robot, watch in watches.items()]
        for name, robots in groups.items():
            FAULTS[name].mend(self.rig, robots)
        return results

    # ------------------------------------------------------------------ before
    def _set_off(self, happens: Round) -> None:
        rig, swarm = self.rig, self.rig.swarm
        swarm.until(swarm.ready, READY_S, "all robots are ready")
        # Some tell of their battery once a second: a request that comes before would be refused.
        swarm.until(lambda: all(self._charged(robot) for robot in BACKENDS), SETTLES_S, "all batteries are seen full")
        swarm.operator.stop()
        swarm.until(lambda: all(self._rests(robot) for robot in BACKENDS), SETTLES_S, "all robots stand")
        for robot, name in happens.items():
            rig.place(robot, FAULTS[name].start_m)
        swarm.rest(0.3)  # a few fixes, so that each knows where it is
        asked_s = -math.inf

        def all_drive() -> bool:
            nonlocal asked_s
            if all(self._drives(robot) for robot in happens):
                return True
            if swarm.clock.now_s() - asked_s > AGAIN_S:  # one that has just got over its last fault refuses
                asked_s = swarm.clock.now_s()
                self._ask(happens)
            return False

        swarm.until(all_drive, SETTLES_S, f"{tuple(happens)} drive")

    def _ask(self, happens: Round) -> None:
        operator = self.rig.swarm.operator
        if any(FAULTS[name].centralised for name in happens.values()):
            parameters: dict[str, Value] = {"targets": [[55.0, LANE_M[robot]] for robot in BACKENDS]}
            operator.request("formation_assigned", (), {**parameters, "speed_m_s": CRUISE_M_S})
        else:
            operator.request("flocking", tuple(happens), {"cruise_m_s": CRUISE_M_S})

    def _drives(self, robot: str) -> bool:
        return self.rig.driven(robot) and self.rig.speed_m_s(robot) > 0.7 * CRUISE_M_S

    def _charged(self, robot: str) -> bool:
        health = self.rig.swarm.row(robot).health
        return health is not None and not 0.0 <= health.battery < 0.5

    def _rests(self, robot: str) -> bool:
        return not self.rig.driven(robot) and self.rig.speed_m_s(robot) < STOPPED_M_S

    # ------------------------------------------------------------------ meanwhile
    def _observe(self, happens: Round, watches: dict[str, Watch]) -> None:
        """Sample until all stand, and have done so for a moment, or until it is clear that one does not."""
        swarm = self.rig.swarm
        began_s = swarm.clock.now_s()
        waits = any(FAULTS[name].from_mark for name in happens.values())
        limit_s = LONG_WAY_S if waits else LONGEST_S

        def sample() -> bool:
            now_s = swarm.clock.now_s()
            for robot, watch in watches.items():
                self._look(FAULTS[happens[robot]], robot, watch, now_s)
            still = all(not (each.driven or each.moving) for each in watches.values())
            calm = all(now_s - max(each.zero_s, each.rest_s) > CALM_S for each in watches.values())
            return (still and calm) or now_s - began_s > limit_s

        swarm.until(sample, limit_s + 5.0, "the round is over")

    def _look(self, fault: Fault, robot: str, watch: Watch, now_s: float) -> None:
        rig = self.rig
        if fault.name == "bump" and rig.x_m(robot) < REACH_M - 0.002:
            watch.began_s = now_s
            watch.from_m = rig.x_m(robot)
        if fault.name == "geofence" and rig.driven(robot):
            watch.began_s = now_s
            watch.from_m = FENCE_M
        watch.driven, watch.moving = rig.driven(robot), rig.speed_m_s(robot) >= STOPPED_M_S
        if watch.driven:
            watch.zero_s = now_s
        if watch.moving:
            watch.rest_s = now_s
        if fault.name in PAUSES and not watch.called_off and now_s - watch.zero_s > CALLED_OFF_S:
            # Only a pause: with new messages it would go on, and with right.
            watch.called_off = True
            rig.swarm.operator.stop((robot,))

    # ------------------------------------------------------------------ after
    def _result(self, fault: Fault, robot: str, watch: Watch) -> Result:
        end_m = self.rig.x_m(robot)
        return Result(
            fault.name,
            BACKENDS[robot],
            math.inf if watch.driven else max(0.0, watch.zero_s - watch.began_s),
            math.inf if watch.moving else max(0.0, watch.rest_s - watch.began_s),
            max(0.0, end_m - watch.from_m),
            fault.bound(robot),
            fault.notes.get(robot, ""),
        )
