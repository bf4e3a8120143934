"""Composition for the fourth verb of the paper: experiments, their trials and results, worlds of other simulators.

``experiment*.py``  all trials of an experiment: pool or Dask, shards, retries, resuming, the table
``trial*.py``       one trial in lockstep; its file, its directory, what is recorded
``live_*.py``       the same trial through real processes; ``fleet_*.py`` on given robots, with a pause for setting up
``watch*.py``       how an experiment goes; ``replay.py`` pictures and films of a trial
``results*.py``     list, show, export, compare, report; ``scenario_*.py`` bring worlds along
``*_cli.py``        the commands; they import the rest when they run
"""
