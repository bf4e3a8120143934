"""What arrives at an agent, and what its robots are to do.

``inbox.py``   Receives requests, commands, stops and heartbeats and answers them; which core is obeyed
``tasks.py``   The task of each robot, checked against its behaviour's record and grouped by control law
``estops.py``  Latched e-stops: carried out, confirmed at standstill, kept on disk
"""
