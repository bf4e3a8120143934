"""The e-puck2 of GCtronic as a package outside of fullswarm: advanced sercom v2 over Bluetooth or USB.

``MAKE`` is its record, which the entry point names. ``protocol`` converts between bytes and values and is pure;
``session`` is a state machine without port, thread or clock; ``driver`` gives that session a serial port, and a
guardian, because the robot has no watchdog; ``probe`` asks a port whether an e-puck2 is there; ``emulator`` is the
robot's firmware behind a pseudo terminal, with a simulated body.
"""

from fullswarm.drivers.make import Emulation, Evidence, Icon, Make, Model

MAKE = Make(
    name="epuck2",
    robots="e-puck2",
    schemes=("epuck2",),
    driver="fullswarm_epuck2.driver:Epuck2Driver",
    claims="fullswarm_epuck2.driver:claims",
    example="epuck2:///dev/rfcomm0",
    limits="advanced sercom v2, selector at 3 (Bluetooth) or 8 (USB); the device has no watchdog",
    guarded=True,
    emulation=Emulation(
        start="fullswarm_epuck2.emulator:start", models=(Model("epuck2", "epuck2://{port}"),)
    ),
    probe="fullswarm_epuck2.probe",
    check="e-puck2: switched on, selector at 3, paired, and bound with `rfcomm`",
    icon=Icon("circle", "E"),
    evidence=(Evidence("emulated", "its own emulator, after the published firmware", "2026-11-26"),),
)  # fmt: skip
