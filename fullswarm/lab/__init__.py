"""A swarm in a Python program or a notebook: ``from fullswarm import Lab``. Runs in lockstep, as fast as it can.

``lab.py``        the laboratory: robots, requests, time, poses, velocities, metrics
``request.py``    a request of a laboratory: its status and its result
``functions.py``  makes a behaviour of a plain function, a module or a file
``commanded.py``  the behaviour of robots that a program commands: twists or velocities from an array
``settings.py``   the settings of a laboratory from its arguments
``recording.py``  records the true poses, as a trajectory and as a table
``gallery.py``    draws behaviours, each in a scene of its own: `fullswarm behaviours picture`
``pictures.py``   pictures and animations that a notebook shows
``tryout.py``     `fullswarm try`: a file as a behaviour, shown, with its metrics
``window.py``     a laboratory in a window while it runs
"""

from __future__ import annotations

from fullswarm.lab.lab import Lab
from fullswarm.lab.request import LabRequest

__all__ = ["Lab", "LabRequest"]
