"""The agent: what runs on board of a robot (paper II.D). In: control requests, commands, neighbours' states.

Out: twists to the driver, states, health and measurements. One node object carries n robots as arrays: n is 1 on
board and the whole swarm in a lockstep trial, so both run the same laws, filter and controller.

========================  ==================================================================
``node.py``               wiring: bus, timers, the tick
``tasks.py``              which robot runs what, with which parameters
``view.py``               what a law may know
``behaviours/``           one pure law per file
``safety/``               the barrier filter
``robot_controller.py``   the last word: limits, time-to-live, latched e-stop, reasons to stand
``neighbours.py``         states heard from others, with age
``estimator.py``          where am I; ``track.py``, ``belief.py``, ``ekf.py`` do the sums
``fixes.py``              where others see me
``standstill.py``         whether each robot stands, by its make's noise
========================  ==================================================================
"""
