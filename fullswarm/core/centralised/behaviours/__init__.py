"""The centralised control laws, one file each; found by name through `registry`.

Like a law on board, a module has ``velocity(view, params)``, desired planar velocities (n, 2) in m/s, or
``twist(view, params)``, speeds and turn rates (n, 2), which the joint filter does not take. With a dataclass ``Memory``
of :func:`fullswarm.memory.rows` in the module it gets a third argument, the memory. The n robots are those of the
request whose state is fresh; see :class:`~fullswarm.core.centralised.view.View`.

``formation_assigned.py``   the best assignment of robots to targets (III.A.4)
``voronoi_centralised.py``  coverage on exact cells (III.A.5)
``teleop_centroid.py``      a stick moves the centroid
"""
