"""Incoming messages of an agent, and the tasks of its robots.

``inbox.py``   Receives requests, commands, stops and heartbeats and answers them; which core is obeyed
``tasks.py``   The task of each robot, checked against its behaviour's record and grouped by control law
``charging.py`` Interrupts tasks so that robots charge: to the dock, into it, out of it, and back
``estops.py``  Latched e-stops: carried out, confirmed at standstill, kept on disk
"""
