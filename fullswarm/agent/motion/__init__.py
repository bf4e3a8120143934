"""From desired velocities to the set-points of the drivers.

``desired.py``           Evaluates the control laws and has the safety filter map their velocities to twists
``robot_controller.py``  Decides whether each robot may move, and holds speed and turn rate within their limits
``reflexes.py``          What stops a robot without a message: battery, pose, geofence, clock, driver; standstill
"""
