"""Scenarios: arenas for trials, as data. In: a name or a TOML file, a seed. Out: boxes, start poses, goals.

The four of the paper (IV.A): ``empty``, ``empty_dense``, ``uniform``, ``concave``; its unmeasured ``corridor``;
``antipodal``, ``antipodal_table`` for deadlock; ``door_…``, ``opposing_…`` for passages. What the paper leaves open is
stated in each file. A new scenario is one more TOML file here; a new importer one more module in ``importers/``.

``model.py``       the scenario and its file
``placement.py``   the places of boxes and robots for a seed
``commands.py``    what `fullswarm scenario` does: list, show, import and export arenas
``importers/``     other simulators' worlds as scenarios
``export_sdf.py``  a scenario as an SDF 1.9 world for Gazebo
``maps.py``        a scenario or a coverage grid as a map: text, or PGM and YAML for ROS
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
