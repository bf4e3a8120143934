"""The Acme Scout, a small delivery robot that does not exist, as a package outside of fullswarm.

``MAKE`` is its record, which the entry point names. ``protocol`` converts between bytes and values and is pure;
``session`` is a state machine without port, thread or clock; ``driver`` gives that session and a TCP port to a
`LinkedDriver`, which owns the connection and its thread; ``probe`` checks whether a Scout is at an address;
``emulator`` is the robot's firmware behind a TCP port, with a simulated body.
"""

from fullswarm.drivers.make import Emulation, Evidence, Icon, Make, Model

MAKE = Make(
    name="acme",
    robots="Acme Scouts",
    schemes=("acme",),
    driver="fullswarm_acme.driver:AcmeDriver",
    example="acme://192.168.7.20:7700",
    limits="JSON lines over TCP; cannot reverse",
    guarded=True,
    emulation=Emulation(
        start="fullswarm_acme.emulator:start",
        models=(Model("scout", "acme://127.0.0.1:{port}", place="tcp", first_port=7700),),
    ),
    probe="fullswarm_acme.probe",
    check="Acme Scout: switched on, in your network",
    icon=Icon("circle", "A"),
    evidence=(Evidence("emulated", "its own emulator", "2026-11-23"),),
)
