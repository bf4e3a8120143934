"""Draws behaviours: runs each one's scene in lockstep, and draws starts, trails and ends from above."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from fullswarm.core.behaviours import all_records, make_record
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.evaluate.pictures.scene import check_still, write_still
from fullswarm.evaluate.trial_folder import Trajectory
from fullswarm.lab.lab import Lab
from fullswarm.output import Progress

FILTERED = "_bc"
WIDTH_PX = 640
HEAP_M = 0.55
"""Between the robots of a heap."""
SQUARE = (0.0, 0.0, 10.0, 10.0)
ROOMS = ((4.0, 2.0, 0.3, 4.0), (4.0, 7.5, 0.3, 5.0), (8.0, 6.0, 4.0, 0.3), (7.2, 2.2, 1.4, 1.0))
PLACES = [[1.0, 1.0], [1.0, 9.0], [5.5, 5.0], [5.0, 0.8], [9.0, 4.5], [9.2, 9.2], [6.0, 9.0]]
HEART = [
    [16.0 * math.sin(t) ** 3, 13.0 * math.cos(t) - 5.0 * math.cos(2 * t) - 2.0 * math.cos(3 * t) - math.cos(4 * t)]
    for t in np.linspace(0.0, 2.0 * math.pi, 120, endpoint=False).tolist()
]
CORNERS = [[2.0, 2.0], [8.0, 2.0], [8.0, 6.0], [5.0, 8.0], [2.0, 6.0]]


@dataclass(frozen=True)
class Scene:
    """A world in which a behaviour shows what it does.

    Attributes
    ----------
    heap : the robots start side by side around this point; None: at places that the seed chooses
    seconds : that it runs
    trail_s : how much of the way is drawn; 0: all of it
    """

    robots: int = 8
    seconds: float = 40.0
    trail_s: float = 0.0
    seed: int = 3
    heap: tuple[float, float] | None = None
    bounds: tuple[float, float, float, float] = SQUARE
    obstacles: tuple[tuple[float, ...], ...] = ()
    parameters: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, object] = field(default_factory=dict)


SCENES: dict[str, Scene] = {
    "aggregation": Scene(10, 300.0, trail_s=60.0),
    "area_sweep": Scene(4, 150.0),
    "average_consensus": Scene(8, 20.0),
    "consensus": Scene(8, 30.0),
    "cyclic_pursuit": Scene(6, 150.0, trail_s=110.0),
    "dispersion": Scene(12, 40.0, heap=(4.0, 4.0)),
    "drive": Scene(1, 6.0, parameters={"linear": 0.6, "angular": 0.25}),
    "exploration": Scene(3, 120.0, heap=(1.5, 8.0), obstacles=ROOMS),
    "flocking": Scene(8, 40.0, bounds=(0.0, 0.0, 16.0, 12.0), heap=(4.0, 9.0)),
    "flocking_adaptive": Scene(8, 60.0, bounds=(0.0, 0.0, 16.0, 12.0), heap=(5.0, 5.0)),
    "flocking_velocity": Scene(
        10, 60.0, bounds=(0.0, 0.0, 16.0, 12.0), heap=(3.0, 3.0), parameters={"destination": [12.0, 8.0]}
    ),
    "formation": Scene(9, 25.0, parameters={"shape": "grid", "centre": [5.0, 5.0], "spacing_m": 1.5}),
    "formation_assigned": Scene(9, 25.0, parameters={"shape": "circle", "centre": [5.0, 5.0], "spacing_m": 1.5}),
    "leader_follower": Scene(5, 60.0, heap=(2.0, 2.0), parameters={"leader_goal": [8.0, 7.0]}),
    "move_to_goal": Scene(6, 30.0, parameters={"goal": [5.0, 5.0], "arrive_radius_m": 1.0}),
    "navigate": Scene(
        5, 60.0, heap=(1.5, 8.0), obstacles=ROOMS, parameters={"goal": [8.6, 4.4], "arrive_radius_m": 0.8}
    ),
    "navigate_each": Scene(
        4, 60.0, heap=(1.5, 8.0), obstacles=ROOMS,
        parameters={"targets": [[9.0, 9.0], [9.0, 1.0], [5.0, 1.0], [6.0, 4.5]]},
    ),
    "paper_bc": Scene(6, 30.0, parameters={"goal": [5.0, 5.0], "arrive_radius_m": 1.0}),
    "patrol": Scene(3, 100.0, obstacles=ROOMS, heap=(1.5, 8.0), parameters={"places": PLACES}),
    "pattern": Scene(14, 40.0, parameters={"picture": HEART, "centre": [5.0, 5.0], "width_m": 6.0}),
    "perimeter": Scene(8, 40.0, parameters={"corners": CORNERS}),
    "pursuit_evasion": Scene(4, 40.0),
    "rendezvous": Scene(8, 25.0),
    "stop": Scene(4, 3.0),
    "task_auction": Scene(4, 60.0, parameters={"tasks": PLACES}),
    "teleop_centroid": Scene(5, 8.0, heap=(3.0, 3.0), parameters={"vx": 0.8, "vy": 0.5}),
    "voronoi_centralised": Scene(9, 40.0, heap=(2.0, 2.0)),
    "voronoi_coverage": Scene(9, 40.0, heap=(2.0, 2.0)),
}  # fmt: skip
"""Scenes by behaviour, without the suffix of its filtered variant."""
for _way in ("forward", "backward", "left", "right"):
    SCENES[f"move_{_way}"] = Scene(3, 6.0)


def scene_of(behaviour: str, changes: Mapping[str, Any], parameters: Mapping[str, Any]) -> Scene:
    """Return the scene of a behaviour with other values in place of its own; the usual world if it has none."""
    found = SCENES.get(behaviour) or SCENES.get(behaviour.removesuffix(FILTERED)) or Scene()
    return replace(found, **changes, parameters={**found.parameters, **parameters})


def run(behaviour: str, scene: Scene, tell: Callable[[int, int], None] = lambda _done, _of: None) -> Trajectory:
    """Run a behaviour in lockstep; return where all robots were. `tell` is called with the simulated seconds so far.

    Raises
    ------
    ConfigError
        There is no such behaviour.
    RequestRefused
        It needs parameters that the scene does not give; says which.
    """
    records = all_records()
    if behaviour not in records:
        raise ConfigError(f"no behaviour '{behaviour}'", hint=did_you_mean(behaviour, records))
    starts = None if scene.heap is None else _heap(scene.robots, scene.heap)
    with Lab(
        robots=scene.robots, starts=starts, bounds=scene.bounds, obstacles=scene.obstacles, seed=scene.seed,
        settings=scene.settings, record_period_s=0.1,
    ) as lab:  # fmt: skip
        lab.request(behaviour, **scene.parameters)
        expires_s = make_record(behaviour, records).expires_s
        while lab.time_s < scene.seconds - 1e-6:
            lab.run(min(0.1, scene.seconds - lab.time_s))
            tell(int(lab.time_s), int(scene.seconds))
            if expires_s:  # what a stick sends is repeated
                lab.request(behaviour, **scene.parameters)
        return lab.record


def draw(behaviour: str, scene: Scene, path: Path, width_px: int = WIDTH_PX) -> Trajectory:
    """Run a behaviour and write its picture, a .png or .svg; return where all robots were."""
    check_still(path)  # before minutes of work
    with Progress("simulated seconds") as progress:
        found = run(behaviour, scene, progress.parts)
    from_s = max(0.0, scene.seconds - scene.trail_s) if scene.trail_s else None
    write_still(found, path, caption=behaviour, width_px=width_px, from_s=from_s)
    return found


def _heap(count: int, around: tuple[float, float]) -> np.ndarray[Any, Any]:
    """Return starts on a square grid around a point, headings spread evenly, (n, 3)."""
    side = math.ceil(math.sqrt(count))
    rows = np.arange(count)
    x = around[0] + HEAP_M * (rows % side - 0.5 * (side - 1))
    y = around[1] + HEAP_M * (rows // side - 0.5 * (side - 1))
    return np.stack([x, y, (2.4 * rows + np.pi) % (2.0 * np.pi) - np.pi], axis=1)
