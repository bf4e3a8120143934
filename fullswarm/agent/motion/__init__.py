"""From desired velocities to the set-points of the drivers.

``desired.py``           Evaluates the control laws and has the safety filter map their velocities to twists
``coordination.py``      Has robots avoid one another in advance (ORCA), before the filter
``evade.py``             Moves robots out of the way of objects that move and are no robots of the fleet
``actuation.py``         Passes what control laws ask of actuators on to the drivers, after the motion
``settling.py``          Lets robots stand that cannot get nearer to their goals
``robot_controller.py``  Decides whether each robot may move, and holds speed and turn rate within their limits
``reflexes.py``          What stops a robot without a message: battery, pose, geofence, clock, driver; standstill

A reflex on a sensor's bit (bump, cliff, wheel drop) is a member of ``Hazard`` and of ``STOPPING_HAZARDS`` in
``drivers/base.py``, and its words in ``HAZARDS`` of ``robot_controller.py``. A condition that is computed from readings
is a field of ``Reflexes`` in ``reflexes.py``, which ``Doubt`` passes to the controller. Each stop reason is a ``Code``
with its text in :mod:`fullswarm.reasons` and a ``StopReason`` with its entry in ``CODES`` of ``robot_controller.py``.
"""
