"""The iRobot Create over serial (Open Interface). In: twists. Out: odometry, bumps, cliffs, wheel drops, battery.

``protocol`` is bytes only: commands, generations, sensors, the stream. ``session`` is the whole
conversation with a robot as a state machine without threads or ports, from OPEN to FAULT and back, and keeps a robot
awake; ``odometry`` is its dead reckoning, ``senses`` queries its sensors and evaluates hazards and power, ``panel`` is
its lamps, display and songs as actuators.
``settings`` reads the URL, ``driver`` puts a session on a serial port, ``probe`` asks ports for robots.

The Open Interface has no command timeout: a robot keeps its last drive command forever. Everything here that
sends zero by itself exists for that reason.
"""

from __future__ import annotations

from fullswarm.drivers.make import Emulation, Evidence, Icon, Make, Model

MAKE = Make(
    name="create",
    robots="iRobot Creates and Roombas",
    schemes=("create",),
    driver="fullswarm.drivers.create_oi.driver:CreateDriver",
    claims="fullswarm.drivers.create_oi.settings:claims",
    example="create:///dev/ttyUSB0?model=create2",
    limits="Create 1, Roomba 500, Create 2 over serial; Safe mode; the device has no watchdog; `speed_step=28.5` "
    "reports the wheels' own steps. Three falls in 10 s are a FAULT until it has stood safely for 10 s",
    guarded=True,
    emulation=Emulation(
        start="fullswarm.emulators.create_oi:start",
        models=(
            Model("create2", "create://{port}?model=create2"),
            Model("create1", "create://{port}?model=create1"),
            Model("roomba500", "create://{port}?model=roomba500"),
        ),
        clients="fullswarm.emulators.create_oi:clients",
        mode="fullswarm.emulators.create_oi:mode",
        shows="fullswarm.emulators.create_oi:shows",
    ),
    probe="fullswarm.drivers.create_oi.probe",
    check="Create or Roomba: switched on (press Clean), serial cable plugged in at both ends; off the charger to drive",
    icon=Icon("circle", "C"),
    evidence=(Evidence("emulated", "our emulator, which pycreate2 drives as well", "2026-11-23"),),
)
