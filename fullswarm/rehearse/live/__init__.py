"""Rehearses faults with real processes in real time: `fullswarm rehearse --live`.

In: a seed, a number of robots and minutes. Out: what was tried, how long each kind of fault lasted on, what was wrong.

``plan.py``              which faults happen when
``rehearsal.py``         the swarm, its operators and its faults; the report
``operator_process.py``  an operator process that sends request after request
``judge.py``             what must not be, by requests, reports and the motion of bodies; shares no code with the core
"""
