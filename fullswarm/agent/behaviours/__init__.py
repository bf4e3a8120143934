"""The laws: one pure function per file. In: a :class:`~fullswarm.agent.view.View` and parameters. Out: velocities.

A law is a module with ``velocity(view, params) -> (n, 2)`` desired planar velocities in the world frame (m/s), or,
where body motion is meant, ``twist(view, params) -> (n, 2)`` speed (m/s) and turn rate (rad/s). It does no I/O,
keeps no state and reads no clock. ``params.name`` is a column (n, 1) for numbers and (n, 2) for points, one row per
robot. What the parameters are is said in ``core/behaviours.toml``; ``_bc`` is a field of that record, not a law.

The paper prints the update as ``v_{k+1} = v_k + dv``. Taken to the letter that integrates the error and orbits the
goal; the laws here take ``dv`` as the desired velocity itself, which is what the differential equations beside it say.
"""
