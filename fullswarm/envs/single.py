"""A Gymnasium environment: one robot learns to reach its goal among others."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from fullswarm.envs.episode import Episode, Setup
from fullswarm.envs.spaces import Observation, Spaces
from fullswarm.errors import ConfigError

SEEDS = 2**31


def boxes(spaces: Spaces) -> tuple[Any, Any]:
    """Return the spaces of observation and action as Gymnasium has them."""
    high, most = spaces.observation_high, spaces.action_high
    return Box(-high, high, dtype=np.float32), Box(-most, most, dtype=np.float32)


class SwarmEnv(gymnasium.Env[Observation, Observation]):
    """One robot, the first, obeys the actions; the others run ``Setup.others``. Registered as "fullswarm/GoToGoal-v0".

    An episode terminates when the robot arrives (with `contact_ends`: or touches something) and is truncated at the
    time limit. Observation and action are described in :class:`~fullswarm.envs.spaces.Spaces`. ``info`` holds the true
    ``pose``, ``goal``, ``distance_m``, ``arrived``, ``touched``, ``time_s`` and, in ``changed_m_s``, how far the safety
    filter changed the robot's desired velocity.

    Parameters
    ----------
    render_mode : "rgb_array": :meth:`render` returns a picture from above; None
    settings : those of :class:`~fullswarm.envs.episode.Setup` by name

    Attributes
    ----------
    setup, spaces : what it is made of; a policy that was trained here runs with ``policy(act, env.unwrapped.spaces)``

    Raises
    ------
    ConfigError
        A setting is wrong; says what.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  (as Gymnasium declares it)

    def __init__(self, *, render_mode: str | None = None, **settings: Any) -> None:
        self.setup = Setup.of(settings).in_its_arena()
        self.spaces = self.setup.spaces
        self.render_mode = checked_mode(render_mode)
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.spaces.period_s)}
        self.observation_space, self.action_space = boxes(self.spaces)
        self._episode: Episode | None = None

    @property
    def episode(self) -> Episode:
        """The present episode, with its laboratory and the state of all robots.

        Raises
        ------
        ConfigError
            None has begun.
        """
        if self._episode is None:
            raise ConfigError("no episode has begun", where="SwarmEnv", hint="call reset() first")
        return self._episode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; the seed chooses starts and goals."""
        super().reset(seed=seed, options=options)
        self.close()
        self._episode = episode = Episode(self.setup, int(self.np_random.integers(SEEDS)), driven=1)
        return episode.observation[0], episode.info(0)

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Let one action period pass.

        Parameters
        ----------
        action : (2,), see :class:`~fullswarm.envs.spaces.Spaces`
        """
        episode = self.episode
        before = episode.state
        after = episode.step(np.asarray(action, float)[None])
        reward = float(self.setup.reward(before, after)[0])
        return episode.observation[0], reward, bool(episode.done()[0]), episode.over, episode.info(0)

    def render(self) -> Any:
        """Return a picture from above (height, width, 3), or None without `render_mode`."""
        return self.episode.frame() if self.render_mode is not None else None

    def close(self) -> None:
        """End the episode; closing twice is fine."""
        if self._episode is not None:
            self._episode.close()


def checked_mode(render_mode: str | None) -> str | None:
    """Return the mode.

    Raises
    ------
    ConfigError
        There is no such mode.
    """
    if render_mode not in (None, "rgb_array"):
        raise ConfigError(f"render_mode = {render_mode!r} does not exist", hint='"rgb_array" or None')
    return render_mode
