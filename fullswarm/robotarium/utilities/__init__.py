"""What scripts of the Robotarium compute with; each file has the name and the functions of the one in ``rps``.

``transformations.py``        maps between single integrators and unicycles
``controllers.py``            controllers that drive to points and poses
``barrier_certificates.py``   certificates that change velocities as little as safety needs
``barrier_certificates2.py``  the robust certificate under its older name
``graph.py``                  Laplacians of graphs, and neighbours
``misc.py``                   start poses, arrival, sizes of markers and texts
``arguments.py``              checks of arguments
``programme.py``              the quadratic programme behind the certificates

Poses are (3, N): x, y in m and heading in rad, a column per robot; single-integrator velocities (2, N) in m/s;
unicycle velocities (2, N): speed in m/s and turn rate in rad/s. An array of another shape, or an argument out of its
range, raises :class:`~fullswarm.errors.ConfigError`.
"""
