"""What arrives at the rover, message by message; those for other systems never get here."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.codec import dialect
from fullswarm.emulators.mavlink.rover import commands, parameters, setpoints
from fullswarm.emulators.mavlink.rover.channel import Channel, KeyRing
from fullswarm.emulators.mavlink.rover.pilot import Sticks
from fullswarm.emulators.mavlink.rover.position import Position
from fullswarm.emulators.mavlink.rover.setpoints import Limits
from fullswarm.simulation.bodies import Body, BodyState

ORIGIN_MESSAGE = 49


@dataclass(frozen=True, slots=True)
class SetpointRecord:
    """A set-point that arrived, whatever became of it; for tests."""

    at_s: float
    armed: bool
    mode: int
    mask: int
    frame: int
    speed_m_s: float
    turn_rad_s: float  # counter-clockwise


class Rover(commands.Autopilot, Protocol):
    """What messages act upon."""

    body: Body
    aborted: bool
    parameters: dict[str, float]
    setpoints: deque[SetpointRecord]
    sticks: Sticks
    position: Position
    keys: KeyRing

    @property
    def limits(self) -> Limits:
        """What bounds a set-point now."""
        ...

    def state(self) -> BodyState:
        """Return where the rover believes the body to be."""
        ...

    def boot_ms(self, now_s: float) -> int:
        """Return milliseconds since power-on."""
        ...

    def station_alive(self, now_s: float) -> None:
        """Take note of a heartbeat of the controlling station."""
        ...

    def tell(self, message: Any) -> None:
        """Send a message on all ports."""
        ...


def take(rover: Rover, message: Any, channel: Channel, now_s: float) -> None:
    """Act on a message that came in by a port; one that the rover does not know is dropped."""
    handler = _HANDLERS.get(message.get_type())
    if handler is not None:
        handler(rover, message, channel, now_s)


def _from_station(rover: Rover, message: Any) -> bool:
    return bool(message.get_srcSystem() == int(rover.parameters["SYSID_MYGCS"]))


def _heartbeat(rover: Rover, message: Any, _: Channel, now_s: float) -> None:
    if _from_station(rover, message):
        rover.station_alive(now_s)


def _command(rover: Rover, message: Any, channel: Channel, now_s: float) -> None:
    """Answer a command on the port it came from."""
    ack = commands.run(rover, message, channel, now_s)
    if not rover.aborted:
        channel.send(ack, now_s)


def _set_mode(rover: Rover, message: Any, _: Channel, now_s: float) -> None:
    """Obey the legacy message, which has no answer."""
    rover.request_mode(message.custom_mode, now_s)


def _parameter(rover: Rover, message: Any, channel: Channel, now_s: float) -> None:
    """Read or set a parameter."""
    deal = parameters.store if message.get_type() == "PARAM_SET" else parameters.answer
    answer = deal(rover.parameters, message)
    if answer is not None:
        channel.send(answer, now_s)


def _parameter_list(rover: Rover, _: Any, channel: Channel, now_s: float) -> None:
    """Send all parameters."""
    for answer in parameters.listing(rover.parameters):
        channel.send(answer, now_s)


def _data_stream(rover: Rover, message: Any, channel: Channel, now_s: float) -> None:
    """Serve the legacy request for rates: no answer, and it writes parameters."""
    rate = message.req_message_rate if message.start_stop else 0
    for name in channel.streams.set_group(message.req_stream_id, rate, now_s) if channel.streams else []:
        rover.parameters[f"SR{channel.number}_{name}"] = float(rate)


def _timesync(rover: Rover, message: Any, channel: Channel, now_s: float) -> None:
    """Answer a request (tc1 = 0) with the time since boot."""
    if message.tc1 == 0:
        stamp_ns = rover.boot_ms(now_s) * 1_000_000
        channel.send(dialect().MAVLink_timesync_message(stamp_ns, message.ts1), now_s)


def _setpoint(rover: Rover, message: Any, _: Channel, now_s: float) -> None:
    """Take a set-point; in GUIDED it is stored even while disarmed: arming then drives off."""
    record = SetpointRecord(
        now_s, rover.armed, rover.mode, message.type_mask, message.coordinate_frame, message.vx, -message.yaw_rate
    )
    rover.setpoints.append(record)
    if rover.mode != p.Mode.GUIDED:
        return
    if setpoints.traps(message):
        rover.abort()
    read = setpoints.from_local if message.get_type().endswith("LOCAL_NED") else setpoints.from_global
    _accept(rover, read(message, rover.state(), rover.limits, rover.chart), now_s)


def _attitude(rover: Rover, message: Any, _: Channel, now_s: float) -> None:
    """Take SET_ATTITUDE_TARGET."""
    if rover.mode == p.Mode.GUIDED:
        _accept(rover, setpoints.from_attitude(message, rover.limits), now_s)


def _accept(rover: Rover, target: setpoints.Target | None, now_s: float) -> None:
    if target is not None and not rover.aborted:
        rover.aim(target, now_s)


def _sticks(rover: Rover, message: Any, _: Channel, now_s: float) -> None:
    """Take a pilot's sticks, the controlling station's only."""
    if _from_station(rover, message):
        whole = message.get_type() == "MANUAL_CONTROL"
        (rover.sticks.manual_control if whole else rover.sticks.override)(message, now_s)


def _pose(rover: Rover, message: Any, _: Channel, now_s: float) -> None:
    """Take a pose that somebody else measured."""
    take = rover.position.odometry if message.get_type() == "ODOMETRY" else rover.position.vision
    take(message, rover.body.state(), now_s)


def _origin(rover: Rover, message: Any, channel: Channel, now_s: float) -> None:
    """Take the origin of the map; it cannot be moved later, nor does it count for one that has GPS."""
    if not rover.position.origin:
        rover.position.given = message.latitude / 1e7, message.longitude / 1e7
    rover.position.origin = True
    for message in channel.streams.make(49, now_s) if channel.streams else []:
        rover.tell(message)


def _signing(rover: Rover, message: Any, _: Channel, now_s: float) -> None:
    """Take a key, or with a zero key and time stamp none; never while armed."""
    if rover.armed:
        rover.text("ERROR: Won't setup signing when armed", severity=2)
    else:
        rover.keys.set_up(bytes(message.secret_key), message.initial_timestamp, now_s)


_HANDLERS: dict[str, Callable[[Rover, Any, Channel, float], None]] = {
    "HEARTBEAT": _heartbeat,
    "COMMAND_LONG": _command,
    "COMMAND_INT": _command,
    "SET_MODE": _set_mode,
    "PARAM_REQUEST_READ": _parameter,
    "PARAM_SET": _parameter,
    "PARAM_REQUEST_LIST": _parameter_list,
    "REQUEST_DATA_STREAM": _data_stream,
    "TIMESYNC": _timesync,
    "SET_POSITION_TARGET_LOCAL_NED": _setpoint,
    "SET_POSITION_TARGET_GLOBAL_INT": _setpoint,
    "SET_ATTITUDE_TARGET": _attitude,
    "MANUAL_CONTROL": _sticks,
    "RC_CHANNELS_OVERRIDE": _sticks,
    "ODOMETRY": _pose,
    "VISION_POSITION_ESTIMATE": _pose,
    "SET_GPS_GLOBAL_ORIGIN": _origin,
    "SETUP_SIGNING": _signing,
}
