"""MAVLink ground rovers (ArduPilot Rover). Extra: ``pip install 'fullswarm[mavlink]'``.

::

    driver.py        MavlinkDriver: the HAL contract; owns the link thread
      link.py        bytes in and out: UDP, TCP, serial port
      session.py     the conversation as a state machine; no I/O, no clock of its own
        startup.py   version, message rates, failsafe, position: what READY needs
        arming.py    into motion (GUIDED, armed) and out of it (zero, HOLD, disarmed), confirmed by state
        requests.py  commands and parameters asked again until answered
        vehicle.py   what the vehicle has told so far, and the reading made of it
      codec.py       frames ↔ messages (pymavlink's dialect), tolerant stream parser
      protocol.py    our own message types, numbers of the protocol, NED/FRD ↔ ENU/FLU
    emulator.py      RoverEmulator: an emulated rover behind a real port
      firmware.py    ArduRover as its wire shows it; no I/O, no clock of its own
      telemetry.py   its streams
      body.py        what it drives

Set-points (twists) flow in, readings (pose, twist, battery, hazards) flow out.
"""
