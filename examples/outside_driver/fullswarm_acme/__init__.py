"""The Acme Scout, a small delivery robot that does not exist, as a package outside of fullswarm.

``MAKE`` is its record, to which the entry point leads. ``protocol`` is bytes only and pure; ``session`` is the
conversation without port, thread or clock; ``driver`` owns the TCP connection and its thread; ``probe`` asks an address
what is there; ``emulator`` is the other end of the wire, over a body that really moves.
"""

from fullswarm.drivers.make import Emulation, Evidence, Icon, Make, Model

MAKE = Make(
    name="acme",
    robots="Acme Scouts",
    schemes=("acme",),
    driver="fullswarm_acme.driver:AcmeDriver",
    example="acme://192.168.7.20:7700",
    limits="line protocol over TCP; cannot reverse",
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
