"""What arrives at ArduRover, message by message, and the result each command is answered with, as measured.

Messages for other systems never get here.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.codec import dialect
from fullswarm.emulators.mavlink import driving, parameters
from fullswarm.emulators.mavlink.driving import Limits, Target
from fullswarm.emulators.mavlink.position import Position
from fullswarm.emulators.mavlink.telemetry import Channel, KeyRing, Subject
from fullswarm.simulation.bodies import Body

RTL, CHANGE_SPEED, SET_HOME, REPOSITION, SET_REVERSE = 20, 178, 179, 192, 194
CALIBRATE, GET_HOME, GET_INTERVAL, CAPABILITIES = 241, 410, 510, 520
FORCE_ARM, FORCE_DISARM = 2989.0, 21196.0
SWITCH_MODE = 1  # a flag of REPOSITION
HOME_MESSAGE = 242
Values = Sequence[float]


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


class Rover(Subject, Protocol):
    """What messages and commands act upon, besides what it reports."""

    target: Target | None
    body: Body
    aborted: bool
    parameters: dict[str, float]
    setpoints: deque[SetpointRecord]
    position: Position
    keys: KeyRing

    def request_mode(self, mode: int, now_s: float) -> p.Result:
        """Change the mode as requested, if it can be."""
        ...

    def arm_problem(self, now_s: float) -> str:
        """Return why arming is refused; empty: it is not."""
        ...

    def aim(self, target: Target, now_s: float) -> None:
        """Take a target."""
        ...

    def text(self, text: str, severity: int = 4) -> None:
        """Send a line of text on all ports."""
        ...

    def reboot_soon(self, now_s: float) -> None:
        """Restart after the links had time to send the answer."""
        ...

    def abort(self) -> None:
        """End by a floating-point exception, if the simulator's trap is on."""
        ...

    @property
    def limits(self) -> Limits:
        """What bounds a set-point now."""
        ...

    def station_alive(self, now_s: float) -> None:
        """Note a heartbeat of the controlling station."""
        ...

    def broadcast(self, message: Any) -> None:
        """Send a message on all ports."""
        ...


@dataclass(frozen=True, slots=True)
class Call:
    """One command: its seven parameters, where it came from, and whether it came as COMMAND_INT."""

    values: Values
    channel: Channel
    now_s: float
    place_deg: tuple[float, float] | None = None  # COMMAND_INT's x and y


def run(rover: Rover, message: Any, channel: Channel, now_s: float) -> Any:
    """Obey a command and return its COMMAND_ACK, which goes to the sender's port alone."""
    whole = message.get_type() == "COMMAND_INT"
    values = [getattr(message, f"param{index}") for index in range(1, 5 if whole else 8)]
    if whole:
        values += [message.x, message.y, message.z]
    place = (message.x / 1e7, message.y / 1e7) if whole else None
    handler = _COMMANDS.get(message.command)
    call = Call(values, channel, now_s, place)
    result = p.Result.UNSUPPORTED if handler is None else handler(rover, call)
    return dialect().MAVLink_command_ack_message(
        message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
    )


def _command_mode(rover: Rover, call: Call) -> p.Result:
    if not _whole(call.values[0]) & p.BASE_MODE_CUSTOM:
        return p.Result.DENIED
    return rover.request_mode(_whole(call.values[1]), call.now_s)


def _arm(rover: Rover, call: Call) -> p.Result:
    """Disarming has no check, not even at speed; arming has many, unless forced."""
    if call.values[0] not in (0.0, 1.0):
        return p.Result.UNSUPPORTED
    if call.values[0] == 0.0:
        return _armed(rover, False)
    problem = "" if rover.armed or call.values[1] == FORCE_ARM else rover.arm_problem(call.now_s)
    if problem:
        rover.text(f"Arm: {problem}", severity=2)
        return p.Result.FAILED
    return _armed(rover, True)


def _armed(rover: Rover, armed: bool) -> p.Result:
    if rover.armed != armed:
        rover.armed = armed
        rover.text("Throttle armed" if armed else "Throttle disarmed", severity=6)
    return p.Result.ACCEPTED


def _interval(rover: Rover, call: Call) -> p.Result:
    streams = call.channel.streams
    if math.isnan(call.values[2]):
        rover.abort()
    if streams is None or not all(map(math.isfinite, call.values[:3])) or call.values[2] != 0.0:
        return p.Result.DENIED
    reason = streams.set_interval(_whole(call.values[0]), call.values[1], call.now_s)
    if reason:
        rover.text(reason)
    return p.Result.DENIED if reason else p.Result.ACCEPTED


def _get_interval(_: Rover, call: Call) -> p.Result:
    number = _whole(call.values[0])
    if not 0 <= number <= 0xFFFF:
        return p.Result.DENIED
    interval = call.channel.streams.interval_us(number) if call.channel.streams else None
    call.channel.send(dialect().MAVLink_message_interval_message(number, interval or 0), call.now_s)
    return p.Result.FAILED if interval is None else p.Result.ACCEPTED


def _request(_: Rover, call: Call) -> p.Result:
    return _send(call, _whole(call.values[0]))


def _send(call: Call, number: int) -> p.Result:
    messages = call.channel.streams.make(number, call.now_s) if call.channel.streams else []
    for message in messages:
        call.channel.send(message, call.now_s)
    return p.Result.ACCEPTED if messages else p.Result.FAILED


def _capabilities(_: Rover, call: Call) -> p.Result:
    return _send(call, p.MESSAGE_VERSION) if call.values[0] == 1.0 else p.Result.FAILED


def _get_home(_: Rover, call: Call) -> p.Result:
    return _send(call, HOME_MESSAGE)


def _set_home(rover: Rover, call: Call) -> p.Result:
    return p.Result.ACCEPTED if rover.positioned(call.now_s) else p.Result.FAILED


def _reboot(rover: Rover, call: Call) -> p.Result:
    if rover.armed:
        return p.Result.FAILED
    if call.values[0] == 1.0:
        rover.reboot_soon(call.now_s)
    return p.Result.ACCEPTED


def _calibrate(rover: Rover, _: Call) -> p.Result:
    return p.Result.FAILED if rover.armed else p.Result.ACCEPTED


def _reposition(rover: Rover, call: Call) -> p.Result:
    if call.place_deg is None:
        return p.Result.UNSUPPORTED
    switch = _whole(call.values[1]) & SWITCH_MODE
    guided = rover.mode == p.Mode.GUIDED
    if not guided and not (switch and rover.request_mode(p.Mode.GUIDED, call.now_s) is p.Result.ACCEPTED):
        return p.Result.DENIED
    rover.aim(Target(place_m=rover.chart.place(*call.place_deg)), call.now_s)
    return p.Result.ACCEPTED


def _change_speed(rover: Rover, call: Call) -> p.Result:
    """Works on the way to a place only."""
    target = rover.target
    if rover.mode != p.Mode.GUIDED or target is None or target.place_m is None or not call.values[1] > 0.0:
        return p.Result.FAILED
    rover.aim(replace(target, speed_m_s=call.values[1]), call.now_s)
    return p.Result.ACCEPTED


def _home_again(rover: Rover, call: Call) -> p.Result:
    return rover.request_mode(p.Mode.RTL, call.now_s)


def _whole(value: float) -> int:
    """Return a parameter as the number it stands for; 0 if it is none."""
    return int(value) if math.isfinite(value) else 0


def _accept_always(_: Rover, __: Call) -> p.Result:
    return p.Result.ACCEPTED


_COMMANDS: dict[int, Callable[[Rover, Call], p.Result]] = {
    RTL: _home_again,
    p.COMMAND_SET_MODE: _command_mode,
    CHANGE_SPEED: _change_speed,
    SET_HOME: _set_home,
    REPOSITION: _reposition,
    SET_REVERSE: _accept_always,
    CALIBRATE: _calibrate,
    p.COMMAND_REBOOT: _reboot,
    p.COMMAND_ARM: _arm,
    GET_HOME: _get_home,
    GET_INTERVAL: _get_interval,
    p.COMMAND_MESSAGE_INTERVAL: _interval,
    p.COMMAND_REQUEST_MESSAGE: _request,
    CAPABILITIES: _capabilities,
}


# ---------------------------------------------------------------- messages
def take(rover: Rover, message: Any, channel: Channel, now_s: float) -> None:
    """Act on a message that came in by a port; an unknown one is dropped."""
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
    ack = run(rover, message, channel, now_s)
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
    if driving.traps(message):
        rover.abort()
    read = driving.from_local if message.get_type().endswith("LOCAL_NED") else driving.from_global
    _aim(rover, read(message, rover.state(), rover.limits, rover.chart), now_s)


def _attitude(rover: Rover, message: Any, _: Channel, now_s: float) -> None:
    """Take SET_ATTITUDE_TARGET."""
    if rover.mode == p.Mode.GUIDED:
        _aim(rover, driving.from_attitude(message, rover.limits), now_s)


def _aim(rover: Rover, target: driving.Target | None, now_s: float) -> None:
    if target is not None and not rover.aborted:
        rover.aim(target, now_s)


def _sticks(rover: Rover, message: Any, _: Channel, now_s: float) -> None:
    """Take a pilot's sticks, from the controlling station only."""
    if _from_station(rover, message):
        whole = message.get_type() == "MANUAL_CONTROL"
        (rover.sticks.manual_control if whole else rover.sticks.override)(message, now_s)


def _pose(rover: Rover, message: Any, _: Channel, now_s: float) -> None:
    """Take a pose that was measured from outside."""
    take = rover.position.odometry if message.get_type() == "ODOMETRY" else rover.position.vision
    take(message, rover.body.state(), now_s)


def _origin(rover: Rover, message: Any, channel: Channel, now_s: float) -> None:
    """Take the origin of the map; it cannot be moved later, nor does it count for one that has GPS."""
    if not rover.position.origin:
        rover.position.given = message.latitude / 1e7, message.longitude / 1e7
    rover.position.origin = True
    for message in channel.streams.make(49, now_s) if channel.streams else []:
        rover.broadcast(message)


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
