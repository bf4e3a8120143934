"""An episode: robots with goals of their own, moved by actions through the swarm's real stack."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fullswarm.envs.policies import PolicyLaw
from fullswarm.envs.rewards import Reward, to_goal
from fullswarm.envs.spaces import Observation, Spaces
from fullswarm.envs.state import State
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.evaluate.pictures import Scene, Timeline
from fullswarm.kernels import Array, Flags
from fullswarm.lab import Lab
from fullswarm.lab.functions import Source
from fullswarm.lab.settings import START_GAP_M, free_places

WIDTH_PX = 480
TRAIL_S = 10.0
LONGEST_START_S = 10.0
"""Until all robots have received their request: one control period, or more on a bad network."""


@dataclass(frozen=True)
class Setup:
    """What an environment is made of. All lengths in m, times in s.

    Attributes
    ----------
    robots : how many
    bounds, obstacles, engine, settings, fleet : as for :class:`~fullswarm.lab.Lab`; a fleet file says the first three
    starts, goals : (robots, 3) or (robots, 2), and (robots, 2); None: free places that the seed of a reset chooses
    spaces : what is observed and commanded
    reward : ``reward(before, after)`` returns (robots,) for the states before and after a step
    filtered : actions pass through the safety filter, which changes those that would lead to a contact
    goal_radius_m : a robot so near its goal has arrived, and its episode terminates
    contact_ends : a contact terminates a robot's episode as well
    time_limit_s : of simulated time, after which the episode is truncated
    others : what robots run that are not driven by actions: the name of a behaviour with the parameter ``goal``, or a
        policy

    Raises
    ------
    ConfigError
        A number is out of range.
    """

    robots: int = 4
    bounds: Sequence[float] = (0.0, 0.0, 8.0, 8.0)
    obstacles: Sequence[Sequence[float]] = ()
    starts: Sequence[Sequence[float]] | Array | None = None
    goals: Sequence[Sequence[float]] | Array | None = None
    engine: str | None = None
    settings: Mapping[str, object] = field(default_factory=dict)
    fleet: Path | str | None = None
    spaces: Spaces = field(default_factory=Spaces)
    reward: Reward = to_goal
    filtered: bool = True
    goal_radius_m: float = 0.2
    contact_ends: bool = False
    time_limit_s: float = 60.0
    others: Source = "move_to_goal_bc"

    def __post_init__(self) -> None:
        for name in ("goal_radius_m", "time_limit_s"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ConfigError(f"{name} = {getattr(self, name)} is not positive", where="Setup")

    @staticmethod
    def of(named: Mapping[str, Any]) -> Setup:
        """Return the setup of an environment's keyword arguments.

        Raises
        ------
        ConfigError
            There is no such argument.
        """
        known = {each.name for each in dataclasses.fields(Setup)}
        for name in named:
            if name not in known:
                raise ConfigError(f"an environment takes no '{name}'", hint=did_you_mean(name, known))
        return Setup(**named)

    def in_its_arena(self) -> Setup:
        """Return the setup with the arena in `spaces`, unless they name one, for what ``x`` and ``y`` mean."""
        if self.spaces.bounds_m is not None:
            return self
        with self.lab(0) as lab:
            bounds_m = lab.bounds
        return dataclasses.replace(self, spaces=dataclasses.replace(self.spaces, bounds_m=bounds_m))

    def lab(self, seed: int) -> Lab:
        """Return a new laboratory.

        Raises
        ------
        ConfigError
            The robots do not fit, or a setting is wrong.
        """
        if self.fleet is not None:
            return Lab(self.fleet, seed=seed, engine=self.engine, settings=self.settings)
        return Lab(
            robots=self.robots, starts=self.starts, bounds=self.bounds, obstacles=self.obstacles, engine=self.engine,
            seed=seed, settings=self.settings,
        )  # fmt: skip


class _Remote:
    """A pilot whose decisions come from outside, robots by name.

    Attributes
    ----------
    observation, action : (n, size), (n, 2)
    has_observed : (n,) at least once
    """

    def __init__(self, names: Sequence[str], size: int) -> None:
        self._rows = {name: row for row, name in enumerate(names)}
        self.observation = np.zeros((len(names), size), np.float32)
        self.action = np.zeros((len(names), 2))
        self.has_observed = np.zeros(len(names), bool)

    def observed(self, names: list[str], observation: Observation) -> None:
        """Keep what robots observe."""
        rows = [self._rows[name] for name in names]
        self.observation[rows], self.has_observed[rows] = observation, True

    def decide(self, names: list[str], _observation: Observation) -> Array:
        """Return the actions that were set."""
        found: Array = self.action[[self._rows[name] for name in names]]
        return found


class Episode:
    """One episode. The first `driven` robots obey actions, the rest runs ``Setup.others``.

    Attributes
    ----------
    lab : the laboratory in which it happens
    robots : names of the driven robots
    state : at the end of the last step

    Raises
    ------
    ConfigError
        The setup is wrong; says what.
    """

    def __init__(self, setup: Setup, seed: int, driven: int | None = None) -> None:
        self.lab = lab = setup.lab(seed)
        self.setup, spaces = setup, setup.spaces
        self._ticks = round(spaces.period_s / lab.period_s)
        if self._ticks < 1 or not math.isclose(self._ticks * lab.period_s, spaces.period_s, rel_tol=1e-6):
            lab.close()
            raise ConfigError(
                f"period_s = {spaces.period_s} is no multiple of the control period of {lab.period_s:g} s",
                where="Spaces", hint="e.g. 0.1",
            )  # fmt: skip
        self.robots = lab.robots[:driven]
        self._goal = self._goals(seed)
        self._remote = _Remote(self.robots, spaces.size)
        law = PolicyLaw(self._remote, spaces, "driven", each=True)
        targets = self._goal[: len(self.robots)]
        lab.request(law, robots=self.robots, filtered=setup.filtered, targets=targets)
        for row, robot in list(enumerate(lab.robots))[len(self.robots) :]:
            lab.request(setup.others, robots=robot, goal=self._goal[row])
        self._events = lab.contact_events
        observed = self._remote.has_observed
        lab.run(LONGEST_START_S, until=lambda _: bool(observed.all()))
        if not observed.all():
            lab.close()
            raise ConfigError(
                f"not all robots have begun within {LONGEST_START_S:g} s", where="Setup", hint="is its network too bad?"
            )
        # They have observed for the first time, and stand.
        self._began_s = lab.time_s
        self._scene: Scene | None = None
        self.state = self._now()

    @property
    def observation(self) -> Observation:
        """What the driven robots observe now, (driven, size)."""
        return self._remote.observation.copy()

    def step(self, actions: Array) -> State:
        """Let one action period pass; return the state at its end.

        Parameters
        ----------
        actions : (driven, 2) in the units of `spaces`

        Raises
        ------
        ConfigError
            The actions have another shape or are not finite.
        BehaviourFailed
            What the other robots run raised an error.
        """
        self.setup.spaces.velocities(actions, len(self.robots))  # refused here, not in the middle of a control period
        self._remote.action[:] = actions
        self.lab.step(self._ticks)
        self.state = self._now()
        return self.state

    @property
    def over(self) -> bool:
        """The time limit is reached."""
        return self.state.time_s >= self.setup.time_limit_s - 1e-6

    def done(self) -> Flags:
        """Return which robots' episodes terminate, (n,)."""
        state = self.state
        return state.arrived | state.touched if self.setup.contact_ends else state.arrived

    def info(self, row: int) -> dict[str, Any]:
        """Return what a robot does not observe itself: its true pose, how far the filter intervened and the like."""
        state = self.state
        return {
            "time_s": state.time_s,
            "pose": state.pose[row].copy(),
            "goal": state.goal[row].copy(),
            "distance_m": float(state.distance_m[row]),
            "arrived": bool(state.arrived[row]),
            "touched": bool(state.touched[row]),
            "changed_m_s": float(state.changed_m_s[row]),
        }

    def frame(self) -> NDArray[np.uint8]:
        """Return a picture from above, (height, width, 3)."""
        timeline = Timeline(self.lab.record)
        if self._scene is None:
            self._scene = Scene(timeline, width_px=WIDTH_PX)
        self._scene.follow(timeline)
        self._scene.update(timeline.end_s, trail_s=TRAIL_S)
        return np.ascontiguousarray(self._scene.frame()[..., :3])

    def close(self) -> None:
        """End the laboratory."""
        self.lab.close()

    # ------------------------------------------------------------------ parts
    def _goals(self, seed: int) -> Array:
        count = len(self.lab.robots)
        if self.setup.goals is None:
            places = free_places(
                self.lab.config, np.random.default_rng((seed, 1)), count, apart_m=START_GAP_M + self.setup.goal_radius_m
            )
            if len(places) < count:
                raise ConfigError(
                    "the arena has no room for the goals", where="Setup", hint="enlarge it, or give goals"
                )
            return np.array(places)[:, :2]
        goals = np.array(self.setup.goals, float)
        if goals.shape != (count, 2):
            raise ConfigError(f"goals have shape {goals.shape}, expected ({count}, 2)", where="Setup")
        return goals

    def _now(self) -> State:
        lab = self.lab
        pose, events = lab.poses, lab.contact_events
        distance_m = np.linalg.norm(self._goal - pose[:, :2], axis=1)
        command = np.zeros((len(pose), 2))
        command[: len(self.robots)] = self.setup.spaces.velocities(self._remote.action, len(self.robots))
        touched, self._events = events > self._events, events
        return State(
            time_s=round(lab.time_s - self._began_s, 6),
            pose=pose,
            twist=lab.twists,
            goal=self._goal,
            distance_m=distance_m,
            arrived=distance_m <= self.setup.goal_radius_m,
            touched=touched,
            command=command,
            changed_m_s=lab.interventions,
        )
