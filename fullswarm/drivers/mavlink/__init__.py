"""MAVLink ground rovers: ArduPilot Rover (GUIDED) and PX4 (OFFBOARD). Extra: ``pip install 'fullswarm[mavlink]'``.

::

    driver.py        MavlinkDriver: a session on UDP, TCP or a serial port
    settings.py      the options and the port of the URL
    probe.py         identifies the vehicle on a port without moving it
      session.py     the conversation as a state machine; no I/O, no clock of its own
        autopilot.py what differs between autopilots; ArduPilot's Rover
        px4.py       PX4's: velocity vectors that lead the heading
        startup.py   version, message rates, failsafe, position: what READY needs
        arming.py    into motion (driving mode, armed) and out of it (zero, hold, disarmed), confirmed by state
        frame.py     from the vehicle's own map to the swarm's frame
          maps.py    how each autopilot converts degrees to metres
        external.py  poses measured from outside, for the vehicle's position filter
        requests.py  commands and parameters, repeated until answered
        vehicle.py   the vehicle's reported state, and whether its position is still measured
      signing.py     MAVLink 2 signing: key, timestamps over restarts, which frames to accept
      codec.py       bytes ↔ messages (pymavlink's dialect); a tolerant parser
      protocol.py    our own message types, numbers of the protocol, NED/FRD ↔ ENU/FLU

Set-points (twists) and poses from outside flow in, readings (pose, twist, battery, hazards) flow out.
"""

from __future__ import annotations

from fullswarm.drivers.make import Emulation, Evidence, Icon, Make, Model

MAKE = Make(
    name="mavlink",
    robots="MAVLink rovers",
    schemes=("mavlink+udp", "mavlink+udpout", "mavlink+tcp", "mavlink+serial"),
    driver="fullswarm.drivers.mavlink.driver:MavlinkDriver",
    claims="fullswarm.drivers.mavlink.settings:claims",
    example="mavlink+udp://127.0.0.1:14550",
    limits="ArduRover in GUIDED, PX4 in OFFBOARD (`autopilot=px4`); signing; takes pose fixes (`pose=external`); "
    "`origin=lat,lon` puts its own position into the swarm's frame (added from `[world] origin`); NED and FRD end in "
    "`protocol.py`",
    extra="mavlink",
    guarded=True,
    emulation=Emulation(
        start="fullswarm.emulators.mavlink:start",
        models=(
            Model(
                "rover",
                "mavlink+udp://127.0.0.1:{port}?speed=0.5&turn=2.0&radius=0.17",
                place="udp",
                first_port=14550,  # as ArduPilot's own simulator numbers its instances
                port_step=10,
            ),
            Model("px4"),
        ),
        bench="fullswarm.emulators.mavlink:on_bench",
        listens=True,
        clients="fullswarm.emulators.mavlink:clients",
        mode="fullswarm.emulators.mavlink:mode",
    ),
    probe="fullswarm.drivers.mavlink.probe",
    check="rover over USB or radio: powered; over UDP: it sends to this machine and port (--udp 0.0.0.0:14550: from "
    "other machines)",
    icon=Icon("square", "M"),
    evidence=(
        Evidence("emulated", "our emulators of ArduPilot Rover 4.6 and PX4 1.16, which MAVLink clients drive as well",
                 "2026-11-23"),
        Evidence("recording", "a drive of ArduPilot Rover 4.6.3; not of PX4", "2026-11-21"),
        Evidence("real firmware", "ArduPilot Rover 4.6.3 in its own simulator; not PX4", "2026-11-23"),
    ),
)  # fmt: skip
