"""Experiments: behaviours x scenarios x sizes x seeds x engines x limits, as data (paper IV). In: TOML. Out: a table.

``model.py``     an experiment's file (``paper.toml``, ``safety.toml``)
``plan.py``      its cells and their trials
``run.py``       `fullswarm experiment run`: all trials, distributed, stored, resumed; `trial`: one again, from its file
``pool.py``      processes that run trials, one each at a time, with a time limit, replaced when they die
``dask.py``      the same on more than one machine
``outcomes.py``  outcomes of trials, joined by cell, and their table
``listing.py``   `fullswarm experiment list`: what can be run, and how far each one is
``watch.py``     `fullswarm experiment watch`: the progress, from the results folder
"""

from fullswarm.evaluate.experiment.model import (
    Experiment,
    experiment_names,
    load_experiment,
    parse_experiment,
    parse_seeds,
)
from fullswarm.evaluate.experiment.outcomes import CellResult, Outcome, Report, TrialResult, summarise
from fullswarm.evaluate.experiment.plan import Cell, Trial, arena_of, on_network, plan, scenario_of, world_of

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
