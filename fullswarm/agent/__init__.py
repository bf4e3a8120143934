"""The agent: what runs on board of a robot (paper II.D). In: control requests, commands, neighbours' states.

Out: twists to the driver, states, health and measurements. One node object carries n robots as arrays: n is 1 on
board and the whole swarm in a lockstep trial, so both run the same laws, filter and controller.

=======================  =====================================================================================
``node.py``              wiring: bus, timers, the tick
``state.py``             poses, twists, readings and set-points of the n robots; the node writes them

orders
``inbox.py``             what arrives: requests, commands, stops, heartbeats; ``estops.py``: latched e-stops
``tasks.py``             which robot runs what, with which parameters, held to the ``ranges.py`` of its behaviour
``fence.py``             which core has the word; ``freshness.py``: how late messages of another clock are
``latch_folder.py``      latched e-stops on disk

motion
``behaviours/``          one pure law per file; ``view.py``: what a law may know; ``routes.py``: ways around obstacles
``wishes.py``            evaluates the laws and hands what they want to the filter and the controller
``safety/``              the barrier filter, and what resolves its deadlocks
``reflexes.py``          low battery, lost pose, edge of the arena, a clock that jumped
``robot_controller.py``  the last word: limits, time-to-live, latched e-stop, reasons to stand
``driver_watch.py``      ends the tasks of robots whose driver failed or that met a hazard

pose
``estimator.py``         where am I; ``track.py``, ``belief.py``, ``ekf.py`` do the sums
``fixes.py``             where others see me
``standstill.py``        whether each robot stands, by its make's noise
``pose_conflicts.py``    poses that cannot be right

neighbours
``neighbours.py``        states heard from others, with age; ``pairs.py``: robots near each other, where they may be
``atlas.py``             obstacles that the robots have seen

telemetry
``reports.py``           states and health; ``health_file.py``: the verdict on a new release, on disk
``gauges.py``            what robots measure of themselves
``interventions.py``     what the filter changes, which way, and what it keeps clear of
=======================  =====================================================================================
"""
