"""Drivers: one contract (:mod:`fullswarm.drivers.base`), one folder per make. In: twists. Out: readings.

Every folder has the same files: ``protocol.py`` (bytes only, pure), ``session.py`` (the conversation as a state
machine), ``driver.py`` (a `LinkedDriver` with that session and a port), ``settings.py`` (the URL) and ``probe.py``.
Emulated robots are in :mod:`fullswarm.emulators`, the simulated world in :mod:`fullswarm.simulation`. See
``fullswarm/drivers/README.md`` for units, frames and signs.

Further files:

``actuators.py``         What a robot has beside its wheels: lamps, displays, speakers, grippers by name and value
``base.py``              The HAL contract: what the agent may ask of any robot
``can/``                 A differential base with one motor controller per wheel on a CAN bus: ODrive (CANSimple) or
                         VESC
``create_oi/``           The iRobot Create over serial (Open Interface)
``fleet.py``             One driver as a fleet of one, so that the agent has a single code path over arrays
``fleet_file.py``        Loads a fleet file and checks what depends on drivers: schemes of URLs, shared ports, frames of
                         positions
``guardian.py``          Starts guardian processes, which stop a robot whose driver has stalled or died (decision 14)
``guardian_process.py``  The guardian's own process: stops the robot of a driver that hangs or has ended
``make.py``              The record of a make, and the lookup of all records
``lidar/``               Lidars on board, beside the driver of a robot of any make
``mavlink/``             MAVLink ground rovers: ArduPilot Rover (GUIDED) and PX4 (OFFBOARD)
``null/``                The null make: ``null://<id>``, a robot without hardware
``probe/``               Identifies the robot on a port without moving it: for `fullswarm robots find` and `fullswarm
                         doctor`
``ranges.py``            Range sensors on board: which kinds there are, and the sensor of a URL
``ros/``                 ROS robots that take ``cmd_vel`` and give ``odom``, over rmw_zenoh, zenoh-bridge-ros2dds or
                         rosbridge
``sim/``                 The simulated make
``tof/``                 Time-of-flight sensors on an I2C bus on board, beside the driver of a robot of any make
``linked.py``            Runs the session with one robot for every make: thread, port, rules of the contract
``ports.py``             Opens serial devices, TCP and UDP, and reports what to do where that fails
"""
