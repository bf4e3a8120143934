"""The iRobot Create over serial (Open Interface). In: twists. Out: odometry, bumps, cliffs, wheel drops, battery.

``protocol`` (commands, generations) and ``packets`` (sensors, the stream) are bytes only. ``session`` is the whole
conversation with a robot as a state machine without threads or ports; ``odometry`` is its dead reckoning.
``driver`` puts a session on a serial port; ``firmware`` is the robot's end of the conversation, ``emulator`` puts
that on a pseudo-terminal and over a body.

The Open Interface has no command timeout: a robot goes on with its last drive command for ever. Everything here
that sends zero by itself exists for that reason.
"""
