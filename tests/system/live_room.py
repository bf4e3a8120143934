"""A small room for live trials, and who of their processes is still there."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from typing import Any

import psutil

from fullswarm.evaluate.experiment import Trial, load_experiment, plan
from fullswarm.evaluate.scenarios import parse_scenario
from fullswarm.launch.processes import PARENT

ROOM = """
name = "room"
bounds_m = [0.0, 0.0, 4.0, 4.0]
boxes = [[3.4, 0.5, 0.4, 0.4, 0.0]]
time_limit_s = 12.0
[spawn]
region_m = [0.4, 0.8, 1.0, 3.2]
heading_rad = 0.0
[goal]
centre_m = [2.6, 2.0]
radius_m = 1.0
"""
FAR = ROOM.replace("radius_m = 1.0", "radius_m = 0.1").replace("[2.6, 2.0]", "[3.6, 3.6]")
"""A goal that several robots cannot be at together: the trial lasts until its time limit."""


def trial(robots: int, room: str = ROOM, **changes: Any) -> Trial:
    """Return a trial of `robots` in the room."""
    filters = ("behaviour=move_to_goal_bc", "scenario=empty", "robots=4", "engine=kinematic", "limits=create")
    (found,) = plan(load_experiment("safety"), (3,), (*filters, "group=paper"))
    cell = replace(
        found.cell, scenario="room.toml", robots=robots, behaviour=changes.pop("behaviour", "move_to_goal_bc")
    )
    arena = parse_scenario(room, "room").model_dump_json(exclude_none=True)
    return replace(found, cell=cell, arena=arena, **changes)


def processes_of(pid: int) -> dict[int, str]:
    """Return the processes that belong to a swarm that process `pid` started, guardians and zombies too."""
    found = {}
    for process in psutil.process_iter():
        try:
            ours = process.environ().get(PARENT) == str(pid) and process.pid != pid
            if ours:
                found[process.pid] = " ".join(process.cmdline())
        except (psutil.NoSuchProcess, psutil.AccessDenied):
            continue
    return found | {
        each.pid: each.name() for each in psutil.Process(os.getpid()).children(recursive=True) if pid == os.getpid()
    }


def nobody_new(before: dict[int, str], within_s: float = 5.0) -> None:
    """Assert that no process is left that was not there before after a while: a guardian may be parking its robot.

    A guardian whose agent was killed is nobody's child: it says goodbye to the firmware (`FAREWELL_S`), then ends.
    """
    end_s = time.monotonic() + within_s
    while (left := _new(before)) and time.monotonic() < end_s:
        time.sleep(0.02)
    assert not left


def _new(before: dict[int, str]) -> dict[int, str]:
    return {pid: what for pid, what in processes_of(os.getpid()).items() if pid not in before}
