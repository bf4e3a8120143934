"""Typed settings → TOML: what a supervisor hands to its processes, and what stands beside a result."""

from __future__ import annotations

from pathlib import Path

import tomlkit

from fullswarm.config.models import SwarmConfig


def write_swarm(config: SwarmConfig, path: Path) -> None:
    """Write all settings in force, defaults included, as a fleet file that `load_swarm` reads back equal."""
    values = config.model_dump(mode="json", exclude_none=True)
    path.write_text(tomlkit.dumps(values), encoding="utf-8")
