"""Scenarios: arenas for trials, as data. In: a name or a TOML file, a seed. Out: boxes, start poses, goals.

The four of the paper (IV.A): ``empty``, ``empty_dense``, ``uniform``, ``concave``; its unmeasured ``corridor``;
and ``antipodal``, ``antipodal_table`` for deadlock. What the paper leaves open is stated in each file.

Files:

``commands.py``     What `fullswarm scenario` does: list, show, import and export arenas
``export_sdf.py``   A scenario as an SDF 1.9 world for Gazebo: floor, light, boxes and walls, the goal, robots at
                    their starts
``files.py``        Files that come with the package, by name; or the user's own, by path
``importers/``      Other simulators' worlds as scenarios
``model.py``        What a scenario is, and how its file is read
``placement.py``    Where boxes and robots stand for a seed
``text_map.py``     A scenario as text: what stands where, one character for a cell
``toml_writer.py``  A scenario as TOML, which `load_scenario` reads back equal
"""

from fullswarm.evaluate.scenarios.model import (
    MINIMUM_SPACING_M,
    Box,
    Goal,
    RandomBoxes,
    Scenario,
    Spawn,
    load_scenario,
    parse_scenario,
    scenario_names,
)
from fullswarm.evaluate.scenarios.placement import boxes_for, distance_to_box, goals_for, spawn, world_config

__all__ = [
    "MINIMUM_SPACING_M",
    "Box",
    "Goal",
    "RandomBoxes",
    "Scenario",
    "Spawn",
    "boxes_for",
    "distance_to_box",
    "goals_for",
    "load_scenario",
    "parse_scenario",
    "scenario_names",
    "spawn",
    "world_config",
]
