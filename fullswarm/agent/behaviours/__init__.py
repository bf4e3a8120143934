"""The control laws: one function per file, from a :class:`~fullswarm.agent.view.View` and parameters to velocity.

A control law is a module with ``velocity(view, params) -> (n, 2)`` desired planar velocities, world frame (m/s), or,
where body motion is meant, ``twist(view, params) -> (n, 2)`` speed (m/s) and turn rate (rad/s). It does no I/O, reads
no clock and keeps no state but what it declares as ``Memory`` (``fullswarm/memory.py``). ``params.name`` is a column
(n, 1) for numbers and (n, 2) for points, one row per robot. ``core/behaviours.toml`` defines the parameters; ``_bc`` is
a field of that record, not a control law.

The paper prints the update as ``v_{k+1} = v_k + dv``. Taken literally, that integrates the error and orbits the goal;
the control laws here take ``dv`` as the desired velocity itself, as in the differential equations next to it.

Files:

``aggregation.py``        Aggregation: search for the others at random and join them, as cockroaches do
``area_sweep.py``         Area sweep: a rectangle in lanes, each robot its part of them
``average_consensus.py``  Average consensus: the exact mean of what all have measured, whatever is lost
``consensus.py``          Consensus: agree on a meeting point by broadcasts
``cyclic_pursuit.py``     Cyclic pursuit: all on one circle at equal distances
``dispersion.py``         Dispersion: springs that only push
``docking.py``            Docking: straight into a dock and backwards out of it, a part of charging
``drive.py``              Teleoperation in the robot's own frame: a stick for speed, one for turning
``exploration.py``        Exploration: frontiers of a grid that all robots join
``flocking.py``           Flocking: separation, alignment and cohesion, each within its radius (paper III.A.2,
                          Reynolds' boids)
``flocking_adaptive.py``  Flocking with a pull that grows towards the edge of the range, so that no robot is lost
``flocking_velocity.py``  Flocking by velocity matching: a lattice that moves to a point
``formation.py``          Formation: each robot has its own target (paper III.A.4), ``ṗ_i = -K (p_i - E_i)``
``leader_follower.py``    Leader and followers: places in the leader's frame, or its successor's
``move.py``               Teleoperated moves (paper II.B): ``move_left`` and so on, with a magnitude from the stick
``move_to_goal.py``       Move to goal: a proportional control law (paper III.A.1)
``navigate.py``           Navigate: to a goal around the known obstacles, at which a proportional control law gets
                          stuck (paper IV.A, scenario 4)
``navigate_each.py``      Navigate, each robot to its own target
``paper_bc.py``           Move to goal behind the paper's own filter, which lets unicycles collide: for comparison, on
                          simulated robots only
``patrol.py``             Patrol: the places that have waited longest
``pattern.py``            Pattern: the dark parts of a picture, one place per robot
``perimeter.py``          Perimeter: equal distances along a closed line
``pursuit_evasion.py``    Pursuit and evasion: along the borders of Voronoi cells
``rendezvous.py``         Rendezvous: meet at a common point (paper III.A.3)
``stop.py``               Stop: zero velocity
``task_auction.py``       Task allocation by auction: bids in the shared table, tasks of lost robots offered again
``voronoi_coverage.py``   Voronoi static coverage: Lloyd's law on exact bounded cells (paper III.A.5)
"""
