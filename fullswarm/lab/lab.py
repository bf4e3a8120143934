"""A laboratory: a swarm on a simulated clock in this process, moved by calls of a Python program.

    from fullswarm import Lab

    with Lab(robots=6, bounds=(0, 0, 8, 8), seed=7) as lab:
        lab.request("move_to_goal_bc", goal=[6, 6])
        lab.run(10)
        print(lab.poses, lab.metrics)
        lab.animate().save("swarm.gif")

Core, agents, safety filter and world are those of every other swarm (``launch/lockstep.py``); the same seed gives the
same result to the byte. Several laboratories may be open at once.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fullswarm import registry
from fullswarm.agent.node import AgentNode
from fullswarm.agent.view import RequestsDiffer
from fullswarm.bus.base import OPERATOR
from fullswarm.core.behaviours import PREFIX, make_record
from fullswarm.errors import BehaviourFailed, ConfigError, RequestRefused, did_you_mean
from fullswarm.evaluate.pictures import Film
from fullswarm.evaluate.swarm import Summaries
from fullswarm.evaluate.trial_folder import Trajectory
from fullswarm.fitness import needs_of
from fullswarm.kernels import Array, Index
from fullswarm.lab.commanded import Commanded
from fullswarm.lab.functions import Given, Source, behaviour_of, plain
from fullswarm.lab.pictures import Animation, Picture, film_for
from fullswarm.lab.recording import Recording
from fullswarm.lab.request import LabRequest
from fullswarm.lab.settings import from_arguments, from_file
from fullswarm.launch.lockstep import Lockstep
from fullswarm.logs import quiet
from fullswarm.operator.client import Operator
from fullswarm.perf.truth import Truth

if TYPE_CHECKING:
    from pandas import DataFrame

    from fullswarm.config import SwarmConfig

READY_S = 0.49
"""Until all nodes have discovered each other. Between two ticks, so that a step is one tick of each."""
LONGEST_S = 1e6

_numbers = itertools.count(1)


class Lab:
    """A swarm that moves when :meth:`step` or :meth:`run` is called.

    Parameters
    ----------
    fleet : a fleet file, or settings; None: `robots`, `starts`, `bounds`, `obstacles` say what there is
    robots : how many, named r1, r2, ..., or their names; None: one per row of `starts`
    starts : (n, 3) x, y in m and heading in rad, or (n, 2); None: free places chosen by the seed
    bounds : x_min, y_min, x_max, y_max of the arena in m; default: 20 m by 20 m
    obstacles : boxes: centre x, y, size x, y in m, and yaw in rad if it is turned
    engine : "kinematic" (default without a file), "drivetrain", "pybullet" or "pybullet-wheels"
    seed : of noise, of start places, and of random numbers of behaviours
    settings : more of what a fleet file may hold: ``{"agent.sensing_radius_m": 2.0}``
    record_period_s : between two rows of the record

    Raises
    ------
    ConfigError
        What is wrong with the file or with an argument, in a sentence.
    """

    def __init__(
        self,
        fleet: Path | str | SwarmConfig | None = None,
        *,
        robots: int | Sequence[str] | None = None,
        starts: Sequence[Sequence[float]] | Array | None = None,
        bounds: Sequence[float] | None = None,
        obstacles: Iterable[Sequence[float]] = (),
        engine: str | None = None,
        seed: int = 0,
        settings: Mapping[str, object] | None = None,
        record_period_s: float = 0.1,
    ) -> None:
        boxes, more = list(obstacles), dict(settings or {})
        if fleet is None:
            config = from_arguments(robots, starts, bounds, boxes, engine, more, seed)
        else:
            if robots is not None or starts is not None or bounds is not None or boxes:
                raise ConfigError(
                    "gives a fleet file and robots, starts, bounds or obstacles", where="Lab",
                    hint="change the file, or name single settings: settings={'world.engine': 'kinematic'}",
                )  # fmt: skip
            config = from_file(fleet, {**more, **({"world.engine": engine} if engine else {})}, seed)
        if not record_period_s > 0.0:
            raise ConfigError(f"record_period_s = {record_period_s} is not positive", where="Lab")
        quiet()
        self._lockstep = lockstep = Lockstep(config)
        self._number, self._closed = next(_numbers), False
        self._given: dict[str, tuple[object, Given, str]] = {}  # by behaviour: what it was made of, and its law's name
        names = itertools.count(1)
        self._operator = Operator(
            lockstep.bus_of(OPERATOR), lockstep.keys, lockstep.runtime, "lab", new_id=lambda: f"lab-{next(names)}"
        )  # fmt: skip
        self._summaries = Summaries(lockstep.bus, lockstep.keys)
        each_own = len(lockstep.agents) > 1  # on a bad network
        self._rows: dict[str, tuple[AgentNode, int]] = {
            robot: (lockstep.agents[row], 0) if each_own else (lockstep.agent, row)
            for robot, row in lockstep.world.rows.items()
        }
        self._period_s = 1.0 / lockstep.config.agent.control_rate_hz
        lockstep.run(READY_S)
        self._began_s, self._passed_s = lockstep.runtime.now_s(), 0.0
        world = lockstep.world
        unknown = np.full((len(world.ids), 2), math.nan)
        cell_m = lockstep.config.performance.coverage_cell_m
        self._truth = Truth(world.ids, world.radius_m, unknown, 0.1, world.config.bounds_m, cell_m)
        self._recording = Recording(world, record_period_s, self._now_s, self._behaviours)
        world.watchers.append(self._on_step)
        self._commanded: dict[str, Commanded] = {}
        self._error: Exception | None = None

    # ------------------------------------------------------------------ what there is
    @property
    def robots(self) -> tuple[str, ...]:
        """Names of the robots, in the order of all arrays."""
        return self._lockstep.world.ids

    @property
    def time_s(self) -> float:
        """Simulated time since the laboratory was opened, s."""
        return round(self._now_s(), 6)

    @property
    def period_s(self) -> float:
        """Control period: what :meth:`step` lets pass, s."""
        return self._period_s

    @property
    def poses(self) -> Array:
        """True poses, (n, 3) m, m, rad."""
        return self._lockstep.world.pose.copy()

    @property
    def twists(self) -> Array:
        """Measured speeds and turn rates, (n, 2) m/s, rad/s."""
        return self._lockstep.world.twist.copy()

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """The arena: x_min, y_min, x_max, y_max in m."""
        return self._lockstep.world.config.bounds_m

    @property
    def limits(self) -> Array:
        """Greatest speed and turn rate of each robot, (n, 2) m/s, rad/s."""
        return self._lockstep.world.limits[:, :2].copy()

    @property
    def contacts(self) -> Index:
        """How many bodies and obstacles each robot touches now, (n,)."""
        return self._lockstep.world.contacts.astype(np.int64)

    @property
    def contact_events(self) -> Index:
        """How often each robot has begun to touch a body or an obstacle, (n,)."""
        return self._truth.events.copy()

    @property
    def interventions(self) -> Array:
        """How far the safety filter changed the desired velocity of each robot in the last control period, (n,) m/s."""
        return np.array([agent.filter.deviation_m_s[row] for agent, row in self._rows.values()])

    @property
    def config(self) -> SwarmConfig:
        """All settings."""
        return self._lockstep.config

    def rows(self, robots: Iterable[str] | str | None = None) -> Index:
        """Return the rows of some robots in the arrays; None: all.

        Raises
        ------
        ConfigError
            There is no such robot.
        """
        return np.array([self._lockstep.world.rows[name] for name in self._names(robots)], np.int64)

    # ------------------------------------------------------------------ requests
    def request(
        self,
        behaviour: str | Source,
        *,
        robots: Iterable[str] | str | None = None,
        filtered: bool | None = None,
        twist: bool = False,
        team: str = "",
        needs: Mapping[str, Any] | None = None,
        roles: Mapping[str, Iterable[str]] | None = None,
        **parameters: Any,
    ) -> LabRequest:
        """Request a behaviour; it begins with the next step.

        Parameters
        ----------
        behaviour : its name; or what makes one: a function ``f(view, params)``, a module, the path of a Python file,
            a trained policy (``fullswarm.envs.policy``)
        robots : names; None: all
        filtered : whether a function, a module or a file runs behind the safety filter (default: it does). A named
            behaviour says it by its name: ``flocking_bc`` is filtered
        twist : a function returns speed and turn rate instead of a planar velocity
        team : which robots its control law counts as neighbours: "request", "group", "@name" or "swarm"; default: as
            its record says
        needs : what robots must be able to do: ``{"capabilities": ["gripper"], "speed_m_s": 0.3}``
        roles : role → robots, "@groups", "+capabilities"
        parameters : of the behaviour

        Raises
        ------
        RequestRefused
            No such behaviour, or a parameter is unknown or out of range; says which.
        ConfigError
            No such robot, or what is given cannot be a behaviour.
        """
        self._open()
        chosen = self._names(robots)
        values = {name: plain(value) for name, value in parameters.items()}
        if isinstance(behaviour, str) and not behaviour.endswith(".py"):
            if filtered is not None or twist:
                raise ConfigError(
                    f"filtered and twist are for functions, and '{behaviour}' is a name", where="request",
                    hint="a name says itself whether it is filtered: names ending in _bc are",
                )  # fmt: skip
            name = behaviour
        else:
            name = self._give(behaviour, values, filtered is not False, twist)
        pending = self._operator.request(name, chosen, values, team=team, needs=needs_of(needs or {}), roles=roles)
        self._lockstep.runtime.mailbox.drain()
        request = LabRequest(pending, name, chosen, values, self._cancel)
        self._refuse(request)
        return request

    def stop(self, robots: Iterable[str] | str | None = None) -> None:
        """Stop robots; None: all. They decelerate while time passes."""
        self._open()
        self._operator.stop(self._names(robots) if robots is not None else ())
        self._lockstep.runtime.mailbox.drain()

    def set_velocities(
        self,
        robots: Iterable[str] | str | None,
        velocities: Sequence[Sequence[float]] | Array,
        *,
        filtered: bool = True,
        planar: bool = False,
    ) -> None:
        """Command robots directly, until the next call or the next request for them.

        Parameters
        ----------
        robots : names; None: all
        velocities : (k, 2) speed and turn rate in m/s and rad/s, or with `planar` m/s east and north
        filtered : behind the safety filter, which lets a command pass that is safe and changes it otherwise

        Raises
        ------
        ConfigError
            No such robot, another shape, or a number that is not finite.
        """
        self._open()
        chosen = self._names(robots)
        try:
            values = np.array(velocities, float)
        except (TypeError, ValueError):
            values = np.empty(0)
        if values.shape != (len(chosen), 2):
            raise ConfigError(
                f"velocities have shape {values.shape}, expected ({len(chosen)}, 2)", where="set_velocities",
                hint="one row per robot: speed and turn rate",
            )  # fmt: skip
        if not np.isfinite(values).all():
            raise ConfigError("velocities are not finite", where="set_velocities")
        name = f"commanded{'_planar' if planar else ''}{'_bc' if filtered else ''}"
        if name not in self._commanded:
            commanded = Commanded(self._lockstep.world.rows)
            record = {"summary": "Commanded by a program", "filtered": filtered, "parameters": {}}
            self._install(name, Given(name, commanded.law(planar=planar), record), name)
            self._commanded[name] = commanded
        self._commanded[name].value[[self._lockstep.world.rows[robot] for robot in chosen]] = values
        others = tuple(robot for robot in chosen if self._runs(robot) != name)
        if others:
            pending = self._operator.request(name, others, {})
            self._lockstep.runtime.mailbox.drain()
            self._refuse(LabRequest(pending, name, others, {}, self._cancel))

    def _cancel(self, request: LabRequest) -> None:
        if self._closed:
            return
        running = [name for name in request.robots if self._request_id(name) == request.id]
        if running:
            self.stop(running)

    def _refuse(self, request: LabRequest) -> None:
        status = request.status
        if status is not None and status.phase == "refused":
            raise RequestRefused(status.reason, code=status.code, parameters=status.parameters)

    # ------------------------------------------------------------------ behaviours that the program gives
    def _note_error(self, error: Exception) -> None:
        if not isinstance(error, RequestsDiffer):  # which the agent answers by calling the law again
            self._error = error

    def _give(self, source: Source, values: Mapping[str, Any], filtered: bool, twist: bool) -> str:
        """Make a behaviour known and return its name; one that is known already is made again if it differs."""
        made = behaviour_of(source, values, self._note_error, filtered=filtered, twist=twist)
        for name, (known, given, _) in self._given.items():
            same = known is source and given.record == {**made.record, "law": given.record["law"]}
            if same and not isinstance(source, str | Path):
                return name
        taken = {each.key.removeprefix(PREFIX) for each in self._lockstep.store.list(PREFIX)}
        name = next(each for each in _free(made.name) if each not in taken)
        self._install(name, made, source)
        return name

    def _install(self, name: str, given: Given, source: object) -> None:
        law = f"lab{self._number}_{name}"
        record = {**given.record, "law": law}
        make_record(name, {name: record})
        registry.give_law(law, given.law)
        self._lockstep.store.set(PREFIX + name, record, "lab")
        self._given[name] = source, Given(name, given.law, record), law

    # ------------------------------------------------------------------ time
    def step(self, count: int = 1) -> None:
        """Let `count` control periods pass.

        Raises
        ------
        BehaviourFailed
            A control law raised an error or returned something else than velocities; its robots are stopped.
        """
        self.run(count * self._period_s)

    def run(self, duration_s: float, until: Callable[[Lab], bool] | None = None) -> float:
        """Let simulated time pass; return how much has.

        Parameters
        ----------
        until : called after each control period; True ends the run

        Raises
        ------
        BehaviourFailed
            As for :meth:`step`.
        ConfigError
            The duration is negative or not finite.
        """
        self._open()
        if not 0.0 <= duration_s <= LONGEST_S:
            raise ConfigError(f"cannot run for {duration_s} s", where="run", hint=f"0 to {LONGEST_S:g} s")
        before_s = self._passed_s
        end_s = before_s + duration_s
        while self._passed_s < end_s - 1e-9:
            self._passed_s = due_s = min(end_s, self._passed_s + self._period_s)
            self._lockstep.run(max(0.0, self._began_s + due_s - self._lockstep.runtime.now_s()))
            self._raise_failures()
            if until is not None and until(self):
                break
        return self._passed_s - before_s

    def _raise_failures(self) -> None:
        if not any(agent.controller.law_failed.any() for agent in self._lockstep.agents):
            return
        failed: dict[str, list[str]] = {}
        for name, (agent, row) in self._rows.items():
            if agent.controller.law_failed[row] and agent.tasks.of[row] is not None and agent.desired.law_error[row]:
                failed.setdefault(agent.desired.law_error[row].text, []).append(name)
        if failed:
            text = "; ".join(f"{', '.join(names)}: {why}" for why, names in failed.items())
            cause, self._error = self._error, None
            raise BehaviourFailed(text, hint="the robots are stopped; request another behaviour for them") from cause

    # ------------------------------------------------------------------ measurements
    @property
    def metrics(self) -> dict[str, float]:
        """Metrics until now, by names like ``work.total_m``: as the true bodies moved, else as the robots report."""
        self._open()
        self._lockstep.report()
        return {**self._summaries.onboard(), **self._truth.values()}

    @property
    def record(self) -> Trajectory:
        """Where all robots were, one row each `record_period_s`."""
        goals = np.full((len(self.robots), 2), math.nan)
        reach_m = 0.0
        for index, (agent, row) in enumerate(self._rows[name] for name in self.robots):
            goals[index] = agent.tasks.goal_m[row]
            reach_m = max(reach_m, float(agent.tasks.reach_m[row]))
        return self._recording.trajectory(goals, reach_m)

    def to_dataframe(self) -> DataFrame:
        """Return the record as a table of pandas: one row per robot and sample."""
        return self._recording.to_dataframe()

    def plot(self, caption: str = "", *, width_px: int = 720, from_s: float | None = None) -> Picture:
        """Return a picture of the robots and their ways since `from_s`; a notebook shows it, `save` writes it."""
        return Picture(self.record, caption, width_px, from_s)

    def animate(
        self,
        caption: str = "",
        *,
        speed: float = 0.0,
        fps: float = 10.0,
        from_s: float | None = None,
        until_s: float | None = None,
        width_px: int = 480,
    ) -> Animation:
        """Return a film of what has happened; a notebook plays it, ``save`` writes a .gif or .mp4.

        Parameters
        ----------
        speed : simulated seconds in one second of the film; 0: what lets it fit into 15 s
        """
        film = Film(speed=speed, fps=fps, from_s=from_s, until_s=until_s, width_px=width_px, caption=caption)
        duration_s = (self.time_s if until_s is None else until_s) - (from_s or 0.0)
        return Animation(self.record, film_for(duration_s, film))

    # ------------------------------------------------------------------ the end
    def close(self) -> None:
        """End all nodes and the world; closing twice is fine. What was recorded can still be drawn."""
        if self._closed:
            return
        self._closed = True
        self._summaries.close()
        self._operator.close()
        self._lockstep.close()
        for _, _, law in self._given.values():
            registry.take_law(law)

    def __enter__(self) -> Lab:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Lab {len(self.robots)} robots, {self.time_s:g} s{', closed' if self._closed else ''}>"

    # ------------------------------------------------------------------ what the parts need
    def _now_s(self) -> float:
        return self._lockstep.runtime.now_s() - self._began_s

    def _on_step(self) -> None:
        world = self._lockstep.world
        self._truth.sample(self._now_s(), world.pose, world.twist, world.dt_s, world.contacts)
        self._recording.on_step()

    def _behaviours(self) -> tuple[str, ...]:
        return tuple(self._runs(name) for name in self.robots)

    def _runs(self, robot: str) -> str:
        """Return the behaviour that a robot runs; empty: none."""
        agent, row = self._rows[robot]
        task = agent.tasks.of[row]
        return task.request.behaviour if task is not None else ""

    def _request_id(self, robot: str) -> str:
        agent, row = self._rows[robot]
        task = agent.tasks.of[row]
        return task.request.request_id if task is not None else ""

    def _names(self, robots: Iterable[str] | str | None) -> tuple[str, ...]:
        if robots is None:
            return self.robots
        names = (robots,) if isinstance(robots, str) else tuple(robots)
        known = self._lockstep.world.rows
        for name in names:
            if name not in known:
                raise ConfigError(f"no robot '{name}'", where="robots", hint=did_you_mean(str(name), known))
        if len(set(names)) < len(names):
            raise ConfigError("a robot is named twice", where="robots")
        if not names:
            raise ConfigError("no robot is named", where="robots", hint="leave it out to mean all")
        return names

    def _open(self) -> None:
        if self._closed:
            raise ConfigError("the laboratory is closed", where="Lab", hint="open another one")


def _free(name: str) -> Iterable[str]:
    yield name
    for number in itertools.count(2):
        yield f"{name}_{number}"
