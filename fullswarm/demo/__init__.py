"""`fullswarm demo`: eight simulated robots drive to a goal, flock and meet, then belong to the operator.

``run.py``   settings, the run in lockstep, the summary; ``demo.toml`` and ``mixed.toml``: its fleets
``live.py``  the run in real time with a live table and the web console
``show.py``  what is requested of the robots, one act after the other
"""
