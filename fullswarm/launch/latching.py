"""Where an agent of this machine keeps its latched e-stop."""

from __future__ import annotations

import os
import re
from pathlib import Path

import platformdirs

from fullswarm.config import RobotConfig, SwarmConfig

RUN = "FULLSWARM_RUN"
"""Folder of the `up` or `demo` that started this process; it ends with the run, as its simulated bodies do."""
STATE = "FULLSWARM_STATE"
"""Folder for what must outlive every process and a power cut; none: the user's state folder."""


def latch_folder(config: SwarmConfig, robot: RobotConfig) -> Path:
    """Return the folder for the latch of `robot`: a latch lives as long as the body that it holds."""
    run = os.environ.get(RUN, "")
    if robot.simulated and run:
        return Path(run) / "estop"
    state = os.environ.get(STATE, "")
    folder = (Path(state) if state else platformdirs.user_state_path("fullswarm")) / "estop" / config.swarm
    if not robot.simulated:
        return folder
    return folder / re.sub(r"[^A-Za-z0-9.-]", "_", config.world_or_default.address)
