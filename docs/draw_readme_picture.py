"""Draw the picture of the README: the demo's three acts in lockstep, seen from above.

Needs matplotlib (``pip install matplotlib``), then ``python docs/draw_readme_picture.py``; ``--engine kinematic``
where PyBullet is not installed, ``--out FILE`` to write elsewhere.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")  # before pyplot: no screen is needed

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from fullswarm.config import SwarmConfig, WorldConfig
from fullswarm.demo.run import demo_config
from fullswarm.demo.show import STOP_S, Act, Show
from fullswarm.kernels import Array
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.operator.client import Operator

SECONDS = 45.0
SAMPLE_S = 0.1
# Okabe and Ito's colours without yellow, which is hard to see on white, and black; grey for the eighth.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#000000", "#7A7A7A")
TITLES = {
    "move_to_goal_bc": "1  Drive to a goal",
    "flocking_bc": "2  Flock",
    "rendezvous_bc": "3  Meet, without touching",
}
ENLARGE_BELOW = 0.4
"""An act that needs less than this share of the arena's width is drawn enlarged."""


@dataclass
class Scene:
    """One act: the poses (k, n, 3) of all robots, every `SAMPLE_S`."""

    act: Act
    poses: list[Array] = field(default_factory=list)


def record(config: SwarmConfig, seconds: float) -> tuple[list[Scene], dict[str, object]]:
    """Run the show on a simulated clock; return its acts and its result."""
    lockstep = Lockstep(config)
    numbers = itertools.count(1)
    operator = Operator(
        lockstep.bus, Keys(config.swarm), lockstep.runtime, "picture", new_id=lambda: f"picture-{next(numbers)}"
    )
    show = Show(lockstep.bus, lockstep.runtime, config, operator, seconds)
    scenes = []
    try:
        lockstep.run(1.0)
        show.start()
        for act in show.acts:
            scene = Scene(act, [lockstep.world.pose.copy()])
            for _ in range(round(act.share * (seconds - STOP_S) / SAMPLE_S)):
                lockstep.run(SAMPLE_S)
                scene.poses.append(lockstep.world.pose.copy())
            scenes.append(scene)
        lockstep.run(STOP_S)
        return scenes, show.document(None)
    finally:
        lockstep.close()


def draw_arena(axes: Axes, world: WorldConfig) -> None:
    """Draw the floor and the boxes."""
    x_low, y_low, x_high, y_high = world.bounds_m
    axes.add_patch(Rectangle((x_low, y_low), x_high - x_low, y_high - y_low, fill=False, lw=3, ec="#333333", zorder=1))
    for x, y, size_x, size_y, yaw in world.boxes:
        corner = (x - size_x / 2, y - size_y / 2)
        axes.add_patch(
            Rectangle(
                corner, size_x, size_y, angle=math.degrees(yaw), rotation_point="center",
                fc="#B8B8B8", ec="#333333", hatch="///", lw=1.0, zorder=1,
            )
        )  # fmt: skip


def frame(axes: Axes, poses: Array, world: WorldConfig) -> bool:
    """Show the whole arena, or the part (k, n, 3) where something happens if that is small; tell which."""
    x_low, y_low, x_high, y_high = world.bounds_m
    reach_m = 3.0 * world.radius_m
    low, high = poses[..., :2].min((0, 1)) - reach_m, poses[..., :2].max((0, 1)) + reach_m
    side_m = float((high - low).max())
    enlarged = side_m < ENLARGE_BELOW * (x_high - x_low)
    if enlarged:
        (x_low, y_low), (x_high, y_high) = (low + high - side_m) / 2, (low + high + side_m) / 2
    margin = 0.02 * (x_high - x_low)
    axes.set(xlim=(x_low - margin, x_high + margin), ylim=(y_low - margin, y_high + margin), aspect="equal")
    axes.tick_params(labelsize=11, length=3)
    axes.spines[:].set_visible(enlarged)
    axes.spines[:].set(color="#999999", linestyle=":")
    axes.set_xlabel("x east, m", fontsize=11)
    return enlarged


def draw_robots(axes: Axes, poses: Array, radius_m: float, enlarged: bool) -> None:
    """Draw paths that darken towards the end, rings at their start, and the robots (k, n, 3) at their end."""
    half = len(poses) // 2
    for row in range(poses.shape[1]):
        colour = COLOURS[row % len(COLOURS)]
        path = poses[:, row]
        axes.plot(path[: half + 1, 0], path[: half + 1, 1], color=colour, lw=1.5, alpha=0.5, zorder=2)
        axes.plot(path[half:, 0], path[half:, 1], color=colour, lw=2.0, zorder=2)
        axes.add_patch(Circle((path[0, 0], path[0, 1]), radius_m, fc="white", ec=colour, lw=1.4, zorder=3))
        x, y, heading = path[-1]
        along = np.array([math.cos(heading), math.sin(heading)])
        axes.add_patch(Circle((x, y), radius_m, fc=colour, ec="white", lw=1.0, zorder=5))
        # Small discs wear their nose outside; in the enlarged view it has room inside and hides nobody.
        ends, ink = ([0.1, 0.85], "white") if enlarged else ([1.0, 2.1], "#111111")
        nose = np.array([x, y]) + np.outer(ends, radius_m * along)
        axes.plot(*nose.T, color=ink, lw=2.4, zorder=6)


def draw_goal(axes: Axes, act: Act) -> None:
    """Draw the disc in which a robot has arrived, if the act has a goal."""
    goal, radius = act.parameters.get("goal"), act.parameters.get("arrive_radius_m", 0.1)
    if not isinstance(goal, list) or not isinstance(radius, int | float):
        return
    x, y = (float(each) for each in goal if isinstance(each, int | float))
    axes.add_patch(Circle((x, y), float(radius), fc="#F0E442", alpha=0.35, ec="none", zorder=0))
    axes.add_patch(Circle((x, y), float(radius), fill=False, ec="#7A6A00", ls="--", lw=1.2, zorder=1))
    axes.annotate("goal", (x, y + float(radius) + 0.12), ha="center", fontsize=11, color="#5A4E00")


def main() -> None:
    """Run the show and write the picture."""
    parser = argparse.ArgumentParser(description="Draw the picture of the README.")
    parser.add_argument("--engine", choices=["kinematic", "pybullet"], default="pybullet")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("swarm.png"))
    options = parser.parse_args()
    config = demo_config(None, (f"world.engine={options.engine}",))
    world = config.world_or_default
    scenes, result = record(config, SECONDS)
    figure, panels = plt.subplots(1, len(scenes), figsize=(12.0, 4.8), dpi=100, layout="constrained")
    for axes, scene in zip(panels, scenes, strict=True):
        poses = np.array(scene.poses)
        draw_arena(axes, world)
        draw_goal(axes, scene.act)
        enlarged = frame(axes, poses, world)
        draw_robots(axes, poses, world.radius_m, enlarged)
        title = TITLES.get(scene.act.behaviour, scene.act.behaviour)
        axes.set_title(title + (" (enlarged)" if enlarged else ""), fontsize=13, loc="left")
    panels[0].set_ylabel("y north, m", fontsize=11)
    figure.supxlabel(
        "ring: a robot as the act begins     disc with a nose: as it ends, and its heading     hatched: obstacles",
        fontsize=11, color="#333333",
    )  # fmt: skip
    figure.savefig(options.out)
    sys.stdout.write(f"{options.out}: {result['work_m']} m driven, {result['collisions']} collisions\n")


if __name__ == "__main__":
    main()
