"""Plays an operator: requests, sticks, stops, e-stops, leases and missions at random moments, from a seed."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.messages import MissionOp, MissionPlan, MissionStep, MissionTrack, StepConditions, Value
from fullswarm.operator.client import Operator, PendingRequest
from fullswarm.operator.leases import LeaseHolder
from fullswarm.operator.missions import MissionClient, PendingMissionRequest
from fullswarm.runtime import Scheduler

EVERY_S = 3.0
"""Between two actions of an operator, on average."""
STICK_HZ = 10.0
RELEASE_S = (0.5, 6.0)
"""An e-stop is released after so long by the operator that engaged it, unless it has died."""
ON_THE_BASE = ("voronoi_centralised_bc", "formation_assigned_bc")
FOR_A_GOAL = ("move_to_goal_bc", "formation_bc")
LASTING = (*FOR_A_GOAL, "rendezvous_bc", "dispersion_bc", "flocking_bc", "cyclic_pursuit_bc", *ON_THE_BASE)
STICKS = ("move_forward_bc", "move_left_bc", "drive_bc")
EDGE_M = 1.0
CHANGES: tuple[MissionOp, ...] = ("pause", "resume", "abort")


@dataclass(frozen=True, slots=True)
class Action:
    """What an operator did, in the words of the judge.

    Attributes
    ----------
    kind : request, stick, stop, e-stop, release; mission: one is started or resumed
    id : of the request, the order or the mission
    robots : that it is about, by name
    """

    at_s: float
    operator: str
    kind: str
    id: str
    robots: tuple[str, ...]
    behaviour: str = ""
    take: bool = False


@dataclass(slots=True)
class Life:
    """What outlives the processes of one operator: random numbers, a counter of ids, and all requests made."""

    name: str
    chance: random.Random
    numbers: itertools.count[int] = field(default_factory=lambda: itertools.count(1))
    requests: dict[str, PendingRequest] = field(default_factory=dict)  # of the present start of its process
    missions: dict[str, PendingMissionRequest] = field(default_factory=dict)
    newest: str = ""

    def new_id(self) -> str:
        """Return an id that no other request has, and keep it as the newest."""
        self.newest = f"{self.name}-{next(self.numbers)}"
        return self.newest

    def die(self) -> None:
        """Forget what waits for an answer: the process has ended."""
        self.requests.clear()
        self.missions.clear()


class Player:
    """One start of an operator's process.

    Parameters
    ----------
    true_s : the simulated time
    until_s : true time after which it does nothing new
    on_action : called with everything that it does, before it is sent
    """

    def __init__(
        self, life: Life, bus: Bus, keys: Keys, scheduler: Scheduler, clock: str, robots: Sequence[str],
        bounds_m: tuple[float, float, float, float], true_s: Callable[[], float], until_s: float,
        on_action: Callable[[Action], None],
    ) -> None:  # fmt: skip
        self._life, self._chance, self._scheduler, self._robots = life, life.chance, scheduler, tuple(robots)
        self._bounds_m, self._true_s, self._until_s, self._on_action = bounds_m, true_s, until_s, on_action
        name = life.name
        source = f"{name}-{next(life.numbers)}"
        self._operator = Operator(bus, keys, scheduler, source, name=name, clock=clock, new_id=life.new_id)
        self._leases = LeaseHolder(bus, keys, scheduler, name)
        self._missions = MissionClient(bus, keys, scheduler, source, name=name, clock=clock, new_id=life.new_id)
        self._mission = ""
        self._wait()

    def held(self) -> tuple[str, ...]:
        """Return the robots that this operator holds, as it knows."""
        return self._leases.held()

    def end_leases(self) -> None:
        """Give all leases back."""
        self._leases.release()

    def _wait(self) -> None:
        self._scheduler.after(self._chance.expovariate(1.0 / EVERY_S), self._act)

    def _act(self) -> None:
        if self._true_s() >= self._until_s:
            self._leases.release()
            return
        acts = (
            (self._request, 10), (self._stick, 3), (self._stop, 4), (self._estop, 2), (self._hold, 2), (self._free, 2),
            (self._start_mission, 1), (self._change_mission, 1),
        )  # fmt: skip
        self._chance.choices([each for each, _ in acts], [weight for _, weight in acts])[0]()
        self._wait()

    def _some(self) -> tuple[str, ...]:
        """Draw some robots; all as often as a part."""
        if self._chance.random() < 0.4:
            return ()
        count = self._chance.randint(1, len(self._robots))
        return tuple(sorted(self._chance.sample(self._robots, count)))

    def _note(
        self, kind: str, robots: tuple[str, ...], behaviour: str = "", *, take: bool = False, number: str = ""
    ) -> None:
        number = number or self._life.newest
        meant = robots or self._robots
        self._on_action(Action(self._true_s(), self._life.name, kind, number, meant, behaviour, take))

    def _parameters(self, behaviour: str) -> dict[str, Value]:
        x_low, y_low, x_high, y_high = self._bounds_m
        x = self._chance.uniform(x_low + 2 * EDGE_M, x_high - 2 * EDGE_M)
        y = self._chance.uniform(y_low + 2 * EDGE_M, y_high - 2 * EDGE_M)
        if behaviour == "move_to_goal_bc":
            return {"goal": [round(x, 3), round(y, 3)]}
        if behaviour.startswith("formation"):
            shape = self._chance.choice(("circle", "line", "grid"))
            return {"shape": shape, "centre": [round(x, 3), round(y, 3)], "spacing_m": 0.8}
        return {}

    def _request(self) -> None:
        behaviour, robots = self._chance.choice(LASTING), self._some()
        take = self._chance.random() < 0.3
        pending = self._operator.request(behaviour, robots, self._parameters(behaviour), take=take)
        self._life.requests[pending.request.id] = pending
        self._note("request", robots, behaviour, take=take)

    def _stick(self) -> None:
        behaviour, robots = self._chance.choice(STICKS), (self._chance.choice(self._robots),)
        parameters: dict[str, Value] = {"linear": 0.8, "angular": 0.3} if behaviour == "drive_bc" else {}

        def frame(left: int) -> None:
            self._operator.request(behaviour, robots, parameters, resend=False)
            self._note("stick", robots, behaviour)
            if left > 1:
                self._scheduler.after(1.0 / STICK_HZ, lambda: frame(left - 1))

        frame(self._chance.randint(5, 30))

    def _stop(self) -> None:
        robots = self._some()
        self._operator.stop(robots)
        self._note("stop", robots)

    def _estop(self) -> None:
        robots = self._some()
        meant = robots or self._robots
        self._operator.estop(True, robots, "rehearsed", known=lambda: meant, deadline_s=60.0)
        self._note("e-stop", robots)
        self._scheduler.after(self._chance.uniform(*RELEASE_S), lambda: self._release(robots))

    def _release(self, robots: tuple[str, ...]) -> None:
        meant = robots or self._robots
        self._operator.estop(False, robots, known=lambda: meant, deadline_s=5.0)
        self._note("release", robots)

    def _hold(self) -> None:
        self._leases.hold(self._some() or self._robots, take=self._chance.random() < 0.3)

    def _free(self) -> None:
        self._leases.release()

    def _start_mission(self) -> None:
        robots = self._some() or self._robots
        steps = []
        for place in range(self._chance.randint(1, 3)):
            behaviour = self._chance.choice(FOR_A_GOAL)
            done = StepConditions(time_s=round(self._chance.uniform(2.0, 8.0), 2))
            parameters = self._parameters(behaviour)
            steps.append(
                MissionStep(name=f"s{place}", behaviour=behaviour, robots=robots, parameters=parameters, done=done)
            )
        plan = MissionPlan(name=f"of {self._life.name}", tracks=(MissionTrack(name="t", steps=tuple(steps)),))
        pending = self._missions.ask("start", plan=plan, take=True)
        self._mission = pending.request.id
        self._life.missions[pending.request.id] = pending
        self._note("mission", robots)

    def _change_mission(self) -> None:
        op = self._chance.choice(CHANGES)
        if not self._mission:
            return
        pending = self._missions.ask(op, mission=self._mission, take=True)
        self._life.missions[pending.request.id] = pending
        if op == "resume":
            self._note("mission", self._robots, number=self._mission)
