"""`fullswarm demo`: eight simulated robots drive to a goal, flock and meet, then belong to the operator.

``run.py``      settings, the run in lockstep; ``demo.toml`` and ``mixed.toml``: its fleets
``live.py``     the run in real time with a live table and the web console
``show.py``     what is asked of the robots, one act after the other
``summary.py``  what is printed at the end
"""
