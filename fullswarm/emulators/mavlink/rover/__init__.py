"""ArduRover's insides for the emulator, split by topic; :mod:`fullswarm.emulators.mavlink.firmware` puts them together.

::

    inbox.py       what arrives, message by message
    dynamics.py    how its motors speed up, brake and coast (measured stops)
    setpoints.py   what it makes of a set-point, and how it drives to what it was told
    commands.py    COMMAND_LONG and COMMAND_INT, and how each is answered
    pilot.py       sticks: MANUAL_CONTROL and RC_CHANNELS_OVERRIDE
    position.py    whether it knows where it is: GPS, or poses from outside
    chart.py       where it stands on earth, and on the map that its autopilot began where it was switched on
    noise.py       how far its position filter is off: noise as recorded, drift without GPS
    parameters.py  names and values
    streams.py     which message is due when, and the rate cap
    messages.py    the messages themselves; NED on the wire
    channel.py     one of its ports: frames out, signatures, whom it believes
    ports.py       the ports' real ends: UDP, TCP, pseudo-terminal

Messages of the dialect flow in, frames and the body's speed flow out. Only ports.py does I/O.
"""
