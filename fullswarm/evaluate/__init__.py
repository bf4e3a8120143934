"""Experiments (paper IV): worlds, trials, how they are run, and what came of them.

``scenarios/``        arenas as data: obstacles, start poses, goals; import and export for other simulators
``experiment/``       an experiment's file, its plan, the run (pool, Dask, shards, resuming), the view while it runs
``results/``          reads a results folder: list, compare, export, report
``pictures/``         pictures and films of a trial; ``replay.py``: the command
``trial.py``          one trial in lockstep; ``trial_file.py``: its TOML; ``trial_folder.py``: its directory;
                      ``trial_watch.py``: what is recorded of it
``live_trial.py``     the same trial through real processes (``live_swarm.py``, ``live_run.py``, ``live_summaries.py``)
``fleet_trial.py``    the same trial on given robots (``fleet_setup.py``, ``fleet_interrupts.py``)
``witness.py``        the poses by which a live trial is judged
``approach.py``       how near each pair of robots came
``coverage_map.py``   coverage grids and arenas as maps for ROS's map_server
``provenance.py``     commit, versions and machine that a result comes from
"""
