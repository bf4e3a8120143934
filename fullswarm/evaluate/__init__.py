"""Experiments (paper IV): scenarios, trials, their execution and their results.

``scenarios/``        arenas as data: obstacles, start poses, goals; a new scenario is a TOML file there
``experiment/``       an experiment's file, its trials, the run (pool, Dask, shards, resuming), the view while it runs
``results/``          reads a results folder: list, compare, export, report with its figures
``pictures/``         pictures and films of a trial
``trial.py``          one trial over any swarm, with the same steps for all
``swarm.py``          the interface through which a trial uses a swarm, and what a swarm reports about itself
``lockstep_swarm.py`` its three implementations, each with the function that runs a trial on it: in one process on a
``live_swarm.py``     simulated clock, with a process per robot in real time,
``fleet_swarm.py``    on the robots of a fleet file, set up and confirmed by a person
``witness.py``        watches the bodies of a trial: contacts, approaches, commands above the limits
``quiet.py``          finds when a trial has come to rest
``trial_folder.py``   the directory of a trial: every file in it, written and read
``provenance.py``     commit, versions and machine that a result comes from
"""
