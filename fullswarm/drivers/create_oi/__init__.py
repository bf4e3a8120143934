"""The iRobot Create over serial (Open Interface). In: twists. Out: odometry, bumps, cliffs, wheel drops, battery.

``protocol`` (commands, generations) and ``packets`` (sensors, the stream) are bytes only. ``session`` is the whole
conversation with a robot as a state machine without threads or ports, from OPEN to FAULT and back; ``odometry`` is its
dead reckoning, ``senses`` what it asks and hears of hazards and power, ``waking`` how it keeps a robot awake.
``settings`` reads the URL, ``driver`` puts a session on a serial port.

``firmware`` is the robot's end of the conversation, with ``counters`` (encoders, battery), ``panel`` (lamps, songs)
and ``waits`` (Create 1); ``emulator`` puts it on a ``pty_port`` and over a body.

The Open Interface has no command timeout: a robot goes on with its last drive command for ever. Everything here
that sends zero by itself exists for that reason.

Further files:

``surroundings.py``  Holds what an emulated Create's light, infrared and cliff sensors see, and returns their packets'
                     values
"""
