"""Rehearses faults: a whole swarm in one process on a simulated clock, each node a process that may die at any moment.

In: a seed and a number of hours. Out: what was tried, and each invariant that did not hold, with a command that repeats
it.

Files:

``process.py``    a process with its own runtime, mailbox and clock: killed, frozen, slow
``network.py``    the hub and the links to it: cut, lost, late, twice, out of order
``disk.py``       the disk of a computer: full, slow, torn by a power cut
``driver.py``     a simulated robot behind a driver that records what is commanded, and lies
``operators.py``  operators that request, drive, stop, hold robots and run missions, from a seed
``faults.py``     the kinds of faults, and the plan of an episode, from a seed
``swarm.py``      all of these as one swarm; begins and ends each fault
``judge.py``      the invariants and their bounds; shares no code with what it checks
``episode.py``    one episode: faults for some minutes, then quiet, then judged
``rehearsal.py``  many episodes side by side, their sum, and the reduction of a failure
``live/``         the same with real processes in real time
"""
