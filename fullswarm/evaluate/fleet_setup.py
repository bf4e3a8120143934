"""Setting up a trial on hardware: which trials fit a fleet, where robots and boxes must stand, whether they do."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from fullswarm.config import AgentConfig, SwarmConfig
from fullswarm.evaluate.experiment.plan import Cell, Trial, scenario_of, world_of
from fullswarm.evaluate.scenarios import Scenario, distance_to_box, goals_for, spawn, world_config
from fullswarm.geometry import wrap
from fullswarm.kernels import Array

NEAR_M, NEAR_RAD = 0.2, 0.3
"""So far from its place a robot may stand at the start."""
MAP_COLUMNS, MOST_ROWS = 60, 30
CHARACTER = 2.0
"""A character is so many times higher than wide."""
NAMES = "123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ"
BOX, GOAL, FREE = "#", "+", "."


# ---------------------------------------------------------------------------------------------------- which trials
def choose(trials: Sequence[Trial], fleet: SwarmConfig) -> tuple[list[Trial], dict[Cell, str]]:
    """Return the trials that this fleet can run, and for each cell that is left out the reason."""
    fits, left_out = list[Trial](), dict[Cell, str]()
    engines: dict[Cell, str] = {}
    for trial in trials:
        cell = trial.cell
        reason = left_out.get(cell) or _obstacle(trial, fleet)
        if not reason and not any(each.simulated for each in fleet.robot):
            first = engines.setdefault(_without_engine(cell), cell.engine)
            reason = "" if first == cell.engine else f"real robots have no engine: it is the same as '{first}'"
        if reason:
            left_out[cell] = reason
        else:
            fits.append(trial)
    return fits, left_out


def _obstacle(trial: Trial, fleet: SwarmConfig) -> str:
    """Return why a trial is not for this fleet; empty: it is."""
    cell, have = trial.cell, len(fleet.robot)
    if cell.robots > have:
        return f"it needs {cell.robots} robots, the fleet file has {have}"
    if (cell.noise_m or cell.noise_rad) and not all(each.simulated for each in fleet.robot):
        return "its noise is that of simulated sensors, and the fleet has real ones"
    fence = fleet.agent.bounds_m
    if fence is not None:
        left, low, right, high = scenario_of(trial).bounds_m
        if left < fence[0] or low < fence[1] or right > fence[2] or high > fence[3]:
            return "its arena reaches out of the fleet file's agent.bounds_m"
    return ""


def _without_engine(cell: Cell) -> Cell:
    fields = {name: getattr(cell, name) for name in cell.__slots__}
    return Cell(**{**fields, "engine": ""})


# ---------------------------------------------------------------------------------------------------- settings
def fit(trial: Trial, scenario: Scenario, fleet: SwarmConfig) -> tuple[SwarmConfig, Array]:
    """Return the fleet as a trial uses it, and the goals (n, 2): its first robots, each on its start pose.

    The scenario's boxes are in the settings as in a simulated trial: agents have them as the map. Of two limits of
    the speed the lower one holds, of two margins the wider one.

    Raises
    ------
    ConfigError
        So many robots do not fit into the scenario.
    """
    base = world_of(trial).model_copy(update={"address": fleet.world_or_default.address})
    world = world_config(scenario, trial.seed, base)
    poses = spawn(scenario, trial.cell.robots, trial.seed, world.radius_m)
    robots = tuple(
        robot.model_copy(update={"pose": (x_m, y_m, heading_rad)})
        for robot, (x_m, y_m, heading_rad) in zip(fleet.robot, poses.tolist(), strict=False)
    )
    network = fleet.network
    if trial.cell.network:
        network = network.model_copy(update={"conditions": trial.cell.network, "seed": trial.seed})
    values = {
        **fleet.model_dump(),
        "world": world.model_dump(),
        "robot": [each.model_dump() for each in robots],
        "agent": _agent(trial, fleet.agent).model_dump(),
        "performance": dict(trial.stop),
        "network": network.model_dump(),
    }
    return SwarmConfig.model_validate(values), goals_for(scenario, poses)


def _agent(trial: Trial, ours: AgentConfig) -> AgentConfig:
    body, theirs = dict(trial.body), AgentConfig.model_validate(dict(trial.agent))
    limits = {
        name: min(float(each) for each in (body[name], getattr(ours, name), getattr(theirs, name)) if each is not None)
        for name in ("speed_limit_m_s", "turn_limit_rad_s")
    }
    margin_m = max(ours.safety_margin_m, theirs.safety_margin_m)
    wanted = {**dict(trial.agent), **limits, "safety_margin_m": margin_m, "bounds_m": None}  # the scenario's bounds
    return AgentConfig.model_validate({**ours.model_dump(), **wanted})


# ---------------------------------------------------------------------------------------------------- telling
def off(ids: Iterable[str], poses: Array, starts: Array) -> list[str]:
    """Return in words which robots stand elsewhere than they should, poses and starts (n, 3); NaN: not known."""
    found = []
    for robot, (x_m, y_m, heading_rad), (at_x, at_y, at_rad) in zip(ids, poses.tolist(), starts.tolist(), strict=True):
        apart_m, turned_rad = math.hypot(x_m - at_x, y_m - at_y), abs(wrap(heading_rad - at_rad))
        if apart_m > NEAR_M or turned_rad > NEAR_RAD:
            found.append(f"{robot} stands {apart_m:.2f} m and {math.degrees(turned_rad):.0f}° from its place")
    return found


def starts_of(config: SwarmConfig) -> Array:
    """Return where the robots of a trial begin, (n, 3)."""
    return np.array([each.pose or (math.nan,) * 3 for each in config.robot], float).reshape(-1, 3)


def instructions(config: SwarmConfig, scenario: Scenario, goals: Array, spare: Sequence[str] = ()) -> str:
    """Return what somebody in the room must do before the trial: robots, boxes, a map."""
    lines = ["robot             x m      y m  heading"]
    for name, robot in zip(names(len(config.robot)), config.robot, strict=True):
        x_m, y_m, heading_rad = robot.pose or (math.nan,) * 3
        place = f"{x_m:8.2f} {y_m:8.2f} {math.degrees(heading_rad):7.0f}°"
        lines.append(f"{name} {robot.id:10} {place}{'  (simulated)' if robot.simulated else ''}".rstrip())
    boxes = config.world_or_default.boxes
    if boxes:
        lines.append("boxes, centre x, y, size x, y in m and turned by:")
        lines += [f"  {x:6.2f} {y:6.2f}  {wide:5.2f} x {deep:5.2f}  {math.degrees(yaw):4.0f}°"
                  for x, y, wide, deep, yaw in boxes]  # fmt: skip
    if spare:
        lines.append(f"out of the arena: {', '.join(spare)}")
    return "\n".join([*lines, *drawing(config, scenario, goals)])


def names(count: int) -> list[str]:
    """Return what the robots are called on the map."""
    return [NAMES[row] if row < len(NAMES) else "*" for row in range(count)]


def drawing(config: SwarmConfig, scenario: Scenario, goals: Array) -> list[str]:
    """Return the arena from above, north up: robots by their names, boxes ``#``, the goal ``+``."""
    left, low, right, high = scenario.bounds_m
    cell_m = max((right - left) / MAP_COLUMNS, (high - low) / (CHARACTER * MOST_ROWS))
    columns = max(1, round((right - left) / cell_m))
    rows = max(1, round((high - low) / (CHARACTER * cell_m)))
    grid = [[FREE] * columns for _ in range(rows)]
    for row in range(rows):
        for column in range(columns):
            x_m = left + (column + 0.5) * (right - left) / columns
            y_m = low + (row + 0.5) * (high - low) / rows
            if any(distance_to_box(x_m, y_m, box) == 0.0 for box in config.world_or_default.boxes):
                grid[row][column] = BOX
            elif (np.hypot(goals[:, 0] - x_m, goals[:, 1] - y_m) <= scenario.goal.radius_m).any():
                grid[row][column] = GOAL
    for name, (x_m, y_m, _) in zip(names(len(config.robot)), starts_of(config).tolist(), strict=True):
        column = min(columns - 1, max(0, int((x_m - left) / (right - left) * columns)))
        row = min(rows - 1, max(0, int((y_m - low) / (high - low) * rows)))
        grid[row][column] = name
    scale = f"{left:g}, {low:g} m at the lower left, {right:g}, {high:g} m at the upper right"
    return [*("".join(line) for line in reversed(grid)), scale]
