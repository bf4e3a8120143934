"""`fullswarm demo`: eight simulated robots drive to a goal, flock and meet; an operator may then request behaviours.

``run.py``   settings, the run in lockstep, the summary; ``demo.toml`` and ``mixed.toml``: its fleets
``live.py``  the run in real time with a live table and the web console
``show.py``  the sequence of requests of the demonstration
"""
