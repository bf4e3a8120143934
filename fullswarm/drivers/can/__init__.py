"""A differential base with one motor controller per wheel on a CAN bus: ODrive (CANSimple) or VESC.

Twists go in, scaled to what both wheels can do, and leave as one set-point frame per wheel; heartbeats and
encoder estimates come back and leave as readings.

- ``protocol.py``: what the two controllers share; ``layout.py``: how messages lie in bytes; ``odrive.py``, ``vesc.py``:
  all messages, both ways, and one wheel's controller as a codec; ``slcan.py``: frames as text. Bytes only, pure
- ``kinematics.py``: two wheels ↔ one body, odometry
- ``session.py``: the conversation as a state machine, without input or output
- ``settings.py``: the URL, checked; ``driver.py``: the session on a bus
- ``port.py``: a bus of python-can as a port; ``slcan_bus.py``: its serial adapters, apart because python-can is
  imported only when a bus is opened
- ``probe.py``: identifies the robots on a bus without moving them

This folder is called ``can`` as well: inside it ``import can`` is absolute and means python-can.
"""

from __future__ import annotations

from fullswarm.drivers.make import Emulation, Evidence, Icon, Make, Model

_CHECK = "CAN: interface up (ip link set can0 up type can bitrate 250000), controllers powered; other buses: --can"
_PROVEN = (
    Evidence("emulated", "our emulators on slcan and UDP multicast, which python-can drives as well", "2026-11-23"),
)
_BODY = "interface=slcan&left=1&right=2&wheel_radius=0.05&base=0.3&radius=0.17"


def _base(controller: str, needed: str, options: str) -> Make:
    return Make(
        name=controller,
        robots="CAN bases",
        schemes=(f"can+{controller}",),
        driver="fullswarm.drivers.can.driver:CanBaseDriver",
        claims="fullswarm.drivers.can.settings:claims",
        example=f"can+{controller}://can0?left=1&right=2&wheel_radius=0.05&base=0.3{needed}",
        limits="two motor controllers, differential drive",
        extra="can",
        guarded=True,
        emulation=Emulation(
            start="fullswarm.emulators.can:start",
            models=(Model(controller, f"can+{controller}://{{port}}?{_BODY}&{options}"),),
            bench=f"fullswarm.emulators.can:{controller}_on_bench",
            clients="fullswarm.emulators.can:clients",
        ),
        probe="fullswarm.drivers.can.probe",
        check=_CHECK,
        icon=Icon("hexagon", "B"),
        evidence=_PROVEN,
    )


ODRIVE = _base("odrive", "", "watchdog=0.5&volts_empty=21&volts_full=29.4")
VESC = _base("vesc", "&pole_pairs=7&gear=10", "pole_pairs=7&gear=10")
