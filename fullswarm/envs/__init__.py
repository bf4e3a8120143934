"""Learning: environments for Gymnasium and PettingZoo over a lockstep swarm, and trained policies as behaviours.

    import gymnasium
    import fullswarm.envs

    env = gymnasium.make("fullswarm/GoToGoal-v0", robots=4)
    lab.request(fullswarm.envs.policy("net.onnx", env.unwrapped.spaces), goal=[5, 5])

The environments need Gymnasium and PettingZoo (extra ``lab``). A policy needs neither: it runs on robots.

``spaces.py``    what a policy is given and what it commands: names, units, ranges
``policies.py``  makes a behaviour of a trained policy: a callable, or a file in the ONNX format
``episode.py``   an episode: robots, goals, and the swarm's real stack
``state.py``     the state of its robots after a step
``rewards.py``   what is rewarded; any function may take its place
``single.py``    Gymnasium: one robot learns among others
``parallel.py``  PettingZoo: every robot is an agent
"""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fullswarm.envs.episode import Setup as Setup
    from fullswarm.envs.parallel import ParallelSwarmEnv as ParallelSwarmEnv
    from fullswarm.envs.policies import policy as policy
    from fullswarm.envs.rewards import to_goal as to_goal
    from fullswarm.envs.single import SwarmEnv as SwarmEnv
    from fullswarm.envs.spaces import Spaces as Spaces
    from fullswarm.envs.state import State as State

__all__ = ["ID", "ParallelSwarmEnv", "Setup", "Spaces", "State", "SwarmEnv", "policy", "register", "to_goal"]
_LAZY = {
    "ParallelSwarmEnv": "parallel",
    "Setup": "episode",
    "Spaces": "spaces",
    "State": "state",
    "SwarmEnv": "single",
    "policy": "policies",
    "to_goal": "rewards",
}
"""Exported names by the module that has them: imported when first used, because a robot needs a policy alone."""

ID = "fullswarm/GoToGoal-v0"


def __getattr__(name: str) -> object:
    """Import an exported name (PEP 562)."""
    if name not in _LAZY:
        raise AttributeError(f"module 'fullswarm.envs' has no attribute '{name}'")
    return getattr(importlib.import_module(f"fullswarm.envs.{_LAZY[name]}"), name)


def __dir__() -> list[str]:
    """Return what can be imported from here."""
    return sorted({*globals(), *_LAZY})


def register() -> None:
    """Make the environment known to Gymnasium, where that is installed; importing this package does it."""
    if importlib.util.find_spec("gymnasium") is None:
        return
    import gymnasium

    if ID not in gymnasium.registry:
        gymnasium.register(ID, entry_point="fullswarm.envs.single:SwarmEnv")


register()
