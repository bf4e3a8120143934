"""Experiments: behaviours x scenarios x sizes x seeds x engines x limits, as data (paper IV). In: TOML. Out: a table.

``model.py`` reads the file, ``plan.py`` makes the trials of it, ``results.py`` joins what came of them. Running a
trial needs robots and so belongs to ``fullswarm.evaluate.trial``.

Further files:

``check.py``         Behaviours of an experiment, asked of the core's own rules before any trial is run: else each
                     trial would say it
``dask.py``          Trials on more than one machine: the function of the pool's workers, run by Dask
``folder.py``        The folder of an experiment: what was asked for, and the trials that are in it already
``one_trial.py``     `fullswarm experiment trial FILE`: one trial again, from its file alone
``pool.py``          Processes that run trials: one trial each at a time, with a hard time limit, replaced when they
                     die
``record.py``        What is kept of one trial: the files of its directory, and what stands in them
``run.py``           `fullswarm experiment run`: all trials of an experiment in worker processes, then a table or JSON
``watch.py``         `fullswarm experiment watch`: look into the folder each second, until all trials have ended
``watch_folder.py``  How a running experiment goes, from what stands in its folder
``watch_view.py``    How a running experiment looks in the terminal
``table.py``         What people see of an experiment at its end
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
