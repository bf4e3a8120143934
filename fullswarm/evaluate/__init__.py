"""Experiments (paper IV): worlds, trials, how they are run, and what came of them.

``scenarios/``        arenas as data: obstacles, start poses, goals; import and export for other simulators
``experiment/``       an experiment's file, its plan, the run (pool, Dask, shards, resuming), the view while it runs
``results/``          reads a results folder: list, compare, export, report
``pictures/``         pictures and films of a trial; ``replay.py``: the command
``swarm.py``          the port through which a trial uses a swarm; ``lockstep_swarm.py``, ``live_swarm.py``: its two
                      implementations, the live one with simulated, emulated or real robots
``trial.py``          one trial over it, the same steps for all; ``trial_file.py``: its TOML;
                      ``trial_folder.py``: its directory
``live_trial.py``     a trial through real processes
``fleet_trial.py``    a trial on given robots (``fleet_setup.py``, ``fleet_interrupts.py``)
``witness.py``        watches the bodies of a trial; ``summaries.py``: collects what the swarm reports
``approach.py``       how near each pair of robots came
``coverage_map.py``   coverage grids and arenas as maps for ROS's map_server
``provenance.py``     commit, versions and machine that a result comes from
"""
