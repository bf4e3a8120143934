"""A core that dies, and another one that starts on what it has kept."""

from __future__ import annotations

from pathlib import Path

from fullswarm.store import Store
from tests.unit.core_swarm import Swarm


def restart_core(swarm: Swarm, path: Path) -> None:
    """Let the core die and another one start on the same database."""
    swarm.core.close()
    swarm.store.close()
    swarm.run(0.4)
    swarm.start_core(Store(path))
