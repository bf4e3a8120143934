"""A PettingZoo environment: every robot is an agent, and all act at the same time."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from pettingzoo import ParallelEnv

from fullswarm.envs.episode import Episode, Setup
from fullswarm.envs.single import SEEDS, boxes, checked_mode
from fullswarm.envs.spaces import Observation
from fullswarm.errors import ConfigError


class ParallelSwarmEnv(ParallelEnv[str, Observation, Observation]):  # type: ignore[misc]  # untyped
    """Agents are the robots by name. One that has arrived leaves `agents`; its robot stands at its goal.

    Observations, actions, ``info`` and settings are those of :class:`~fullswarm.envs.single.SwarmEnv`.

    Parameters
    ----------
    render_mode : "rgb_array": :meth:`render` returns a picture from above; None
    settings : those of :class:`~fullswarm.envs.episode.Setup` by name; `others` has no meaning here

    Raises
    ------
    ConfigError
        A setting is wrong; says what.
    """

    def __init__(self, *, render_mode: str | None = None, **settings: Any) -> None:
        self.setup = Setup.of(settings).in_its_arena()
        self.spaces = self.setup.spaces
        self.render_mode = checked_mode(render_mode)
        self.metadata = {
            "name": "fullswarm_go_to_goal_v0",
            "render_modes": ["rgb_array"],
            "render_fps": round(1.0 / self.spaces.period_s),
            "is_parallelizable": True,
        }
        with self.setup.lab(0) as lab:
            self.possible_agents = list(lab.robots)
        self.agents: list[str] = []
        self.observation_spaces: dict[str, Box] = {}
        self.action_spaces: dict[str, Box] = {}
        for name in self.possible_agents:  # of its own each: an agent's action space has a seed
            self.observation_spaces[name], self.action_spaces[name] = boxes(self.spaces)
        self._rows = {name: row for row, name in enumerate(self.possible_agents)}
        self._random: np.random.Generator | None = None
        self._episode: Episode | None = None

    def observation_space(self, agent: str) -> Box:
        """Return the space of an agent's observations."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box:
        """Return the space of an agent's actions."""
        return self.action_spaces[agent]

    @property
    def episode(self) -> Episode:
        """The present episode, with its laboratory and the state of all robots.

        Raises
        ------
        ConfigError
            None has begun.
        """
        if self._episode is None:
            raise ConfigError("no episode has begun", where="ParallelSwarmEnv", hint="call reset() first")
        return self._episode

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Begin an episode with all robots; the seed chooses starts and goals."""
        del options
        if seed is not None or self._random is None:
            self._random, _ = seeding.np_random(seed)
        self.close()
        self._episode = episode = Episode(self.setup, int(self._random.integers(SEEDS)))
        self.agents = list(self.possible_agents)
        return self._observations(self.agents), {name: episode.info(self._rows[name]) for name in self.agents}

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[
        dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
    ]:  # fmt: skip
        """Let one action period pass. An agent without an action stands.

        Raises
        ------
        ConfigError
            An action is of no agent.
        """
        episode, agents = self.episode, self.agents
        commands = np.zeros((len(self.possible_agents), 2))
        for name, action in actions.items():
            if name not in agents:
                raise ConfigError(f"'{name}' is no agent now", where="step", hint=f"agents: {', '.join(agents)}")
            commands[self._rows[name]] = action
        before = episode.state
        after = episode.step(commands)
        rewards, done, over = self.setup.reward(before, after), episode.done(), episode.over
        rows = {name: self._rows[name] for name in agents}
        self.agents = [] if over else [name for name, row in rows.items() if not done[row]]
        return (
            self._observations(agents),
            {name: float(rewards[row]) for name, row in rows.items()},
            {name: bool(done[row]) for name, row in rows.items()},
            dict.fromkeys(rows, over),
            {name: episode.info(row) for name, row in rows.items()},
        )

    def _observations(self, agents: list[str]) -> dict[str, Observation]:
        observation = self.episode.observation
        return {name: observation[self._rows[name]] for name in agents}

    def render(self) -> Any:
        """Return a picture from above (height, width, 3), or None without `render_mode`."""
        return self.episode.frame() if self.render_mode is not None else None

    def close(self) -> None:
        """End the episode; closing twice is fine."""
        if self._episode is not None:
            self._episode.close()
