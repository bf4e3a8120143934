"""Experiments: behaviours x scenarios x sizes x seeds x engines x limits, as data (paper IV). In: TOML. Out: a table.

``model.py`` reads the file, ``plan.py`` makes the trials of it, ``results.py`` joins what came of them. Running a
trial needs robots and so belongs to ``fullswarm.evaluate.trial``.
"""

from fullswarm.evaluate.experiment.model import (
    Experiment,
    experiment_names,
    load_experiment,
    parse_experiment,
    parse_seeds,
)
from fullswarm.evaluate.experiment.plan import Cell, Trial, arena_of, on_network, plan, scenario_of, world_of
from fullswarm.evaluate.experiment.results import CellResult, Outcome, Report, TrialResult, summarise

__all__ = [
    "Cell",
    "CellResult",
    "Experiment",
    "Outcome",
    "Report",
    "Trial",
    "TrialResult",
    "arena_of",
    "experiment_names",
    "load_experiment",
    "on_network",
    "parse_experiment",
    "parse_seeds",
    "plan",
    "scenario_of",
    "summarise",
    "world_of",
]
