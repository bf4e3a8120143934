"""fullswarm: from a swarm algorithm to robots that move, and a number for how well they did.

Four layers, left to right: ``operator`` asks, ``core`` decides, ``agent`` drives one robot,
``drivers`` speak to its wheels. ``perf`` measures. Read :mod:`fullswarm.messages` and
:mod:`fullswarm.keys` first: they are everything that crosses a process border.
"""

__version__ = "0.1.0"
