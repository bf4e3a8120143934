"""COMMAND_LONG and COMMAND_INT: what each does and the result it is answered with, as measured."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.codec import dialect
from fullswarm.emulators.mavlink.rover.channel import Channel
from fullswarm.emulators.mavlink.rover.chart import Chart
from fullswarm.emulators.mavlink.rover.setpoints import Target

RTL, CHANGE_SPEED, SET_HOME, REPOSITION, SET_REVERSE = 20, 178, 179, 192, 194
CALIBRATE, GET_HOME, GET_INTERVAL, CAPABILITIES = 241, 410, 510, 520
FORCE_ARM, FORCE_DISARM = 2989.0, 21196.0
SWITCH_MODE = 1  # a flag of REPOSITION
HOME_MESSAGE = 242
Values = Sequence[float]


class Autopilot(Protocol):
    """What commands act upon."""

    mode: int
    armed: bool
    target: Target | None
    chart: Chart

    def request_mode(self, mode: int, now_s: float) -> p.Result:
        """Change the mode as somebody asks, if it can be."""
        ...

    def arm_problem(self, now_s: float) -> str:
        """Return why arming is refused; empty: it is not."""
        ...

    def positioned(self, now_s: float) -> bool:
        """Whether the position filter has a position."""
        ...

    def aim(self, target: Target, now_s: float) -> None:
        """Take a target."""
        ...

    def text(self, text: str, severity: int = 4) -> None:
        """Send a line of text on all ports."""
        ...

    def reboot_soon(self, now_s: float) -> None:
        """Restart after the links had time to say so."""
        ...

    def abort(self) -> None:
        """Die of a floating-point exception, if the simulator's trap is on."""
        ...


@dataclass(frozen=True, slots=True)
class Call:
    """One command: its seven parameters, where it came from, and whether it came as COMMAND_INT."""

    values: Values
    channel: Channel
    now_s: float
    place_deg: tuple[float, float] | None = None  # COMMAND_INT's x and y


def run(autopilot: Autopilot, message: Any, channel: Channel, now_s: float) -> Any:
    """Obey a command and return its COMMAND_ACK, which goes to the sender's port alone."""
    whole = message.get_type() == "COMMAND_INT"
    values = [getattr(message, f"param{index}") for index in range(1, 5 if whole else 8)]
    if whole:
        values += [message.x, message.y, message.z]
    place = (message.x / 1e7, message.y / 1e7) if whole else None
    handler = _HANDLERS.get(message.command)
    call = Call(values, channel, now_s, place)
    result = p.Result.UNSUPPORTED if handler is None else handler(autopilot, call)
    return dialect().MAVLink_command_ack_message(
        message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
    )


def _set_mode(autopilot: Autopilot, call: Call) -> p.Result:
    if not _whole(call.values[0]) & p.BASE_MODE_CUSTOM:
        return p.Result.DENIED
    return autopilot.request_mode(_whole(call.values[1]), call.now_s)


def _arm(autopilot: Autopilot, call: Call) -> p.Result:
    """Disarming has no check, not even at speed; arming has many, unless forced."""
    if call.values[0] not in (0.0, 1.0):
        return p.Result.UNSUPPORTED
    if call.values[0] == 0.0:
        return _armed(autopilot, False)
    problem = "" if autopilot.armed or call.values[1] == FORCE_ARM else autopilot.arm_problem(call.now_s)
    if problem:
        autopilot.text(f"Arm: {problem}", severity=2)
        return p.Result.FAILED
    return _armed(autopilot, True)


def _armed(autopilot: Autopilot, armed: bool) -> p.Result:
    if autopilot.armed != armed:
        autopilot.armed = armed
        autopilot.text("Throttle armed" if armed else "Throttle disarmed", severity=6)
    return p.Result.ACCEPTED


def _interval(autopilot: Autopilot, call: Call) -> p.Result:
    streams = call.channel.streams
    if math.isnan(call.values[2]):
        autopilot.abort()
    if streams is None or not all(map(math.isfinite, call.values[:3])) or call.values[2] != 0.0:
        return p.Result.DENIED
    reason = streams.set_interval(_whole(call.values[0]), call.values[1], call.now_s)
    if reason:
        autopilot.text(reason)
    return p.Result.DENIED if reason else p.Result.ACCEPTED


def _get_interval(_: Autopilot, call: Call) -> p.Result:
    number = _whole(call.values[0])
    if not 0 <= number <= 0xFFFF:
        return p.Result.DENIED
    interval = call.channel.streams.interval_us(number) if call.channel.streams else None
    call.channel.send(dialect().MAVLink_message_interval_message(number, interval or 0), call.now_s)
    return p.Result.FAILED if interval is None else p.Result.ACCEPTED


def _request(_: Autopilot, call: Call) -> p.Result:
    return _send(call, _whole(call.values[0]))


def _send(call: Call, number: int) -> p.Result:
    messages = call.channel.streams.make(number, call.now_s) if call.channel.streams else []
    for message in messages:
        call.channel.send(message, call.now_s)
    return p.Result.ACCEPTED if messages else p.Result.FAILED


def _capabilities(_: Autopilot, call: Call) -> p.Result:
    return _send(call, p.MESSAGE_VERSION) if call.values[0] == 1.0 else p.Result.FAILED


def _get_home(_: Autopilot, call: Call) -> p.Result:
    return _send(call, HOME_MESSAGE)


def _set_home(autopilot: Autopilot, call: Call) -> p.Result:
    return p.Result.ACCEPTED if autopilot.positioned(call.now_s) else p.Result.FAILED


def _reboot(autopilot: Autopilot, call: Call) -> p.Result:
    if autopilot.armed:
        return p.Result.FAILED
    if call.values[0] == 1.0:
        autopilot.reboot_soon(call.now_s)
    return p.Result.ACCEPTED


def _calibrate(autopilot: Autopilot, _: Call) -> p.Result:
    return p.Result.FAILED if autopilot.armed else p.Result.ACCEPTED


def _reposition(autopilot: Autopilot, call: Call) -> p.Result:
    if call.place_deg is None:
        return p.Result.UNSUPPORTED
    switch = _whole(call.values[1]) & SWITCH_MODE
    guided = autopilot.mode == p.Mode.GUIDED
    if not guided and not (switch and autopilot.request_mode(p.Mode.GUIDED, call.now_s) is p.Result.ACCEPTED):
        return p.Result.DENIED
    autopilot.aim(Target(place_m=autopilot.chart.place(*call.place_deg)), call.now_s)
    return p.Result.ACCEPTED


def _change_speed(autopilot: Autopilot, call: Call) -> p.Result:
    """Works on the way to a place only."""
    target = autopilot.target
    if autopilot.mode != p.Mode.GUIDED or target is None or target.place_m is None or not call.values[1] > 0.0:
        return p.Result.FAILED
    autopilot.aim(replace(target, speed_m_s=call.values[1]), call.now_s)
    return p.Result.ACCEPTED


def _home_again(autopilot: Autopilot, call: Call) -> p.Result:
    return autopilot.request_mode(p.Mode.RTL, call.now_s)


def _whole(value: float) -> int:
    """Return a parameter as the number it stands for; 0 if it is none."""
    return int(value) if math.isfinite(value) else 0


def _accept(_: Autopilot, __: Call) -> p.Result:
    return p.Result.ACCEPTED


_HANDLERS: dict[int, Callable[[Autopilot, Call], p.Result]] = {
    RTL: _home_again,
    p.COMMAND_SET_MODE: _set_mode,
    CHANGE_SPEED: _change_speed,
    SET_HOME: _set_home,
    REPOSITION: _reposition,
    SET_REVERSE: _accept,
    CALIBRATE: _calibrate,
    p.COMMAND_REBOOT: _reboot,
    p.COMMAND_ARM: _arm,
    GET_HOME: _get_home,
    GET_INTERVAL: _get_interval,
    p.COMMAND_MESSAGE_INTERVAL: _interval,
    p.COMMAND_REQUEST_MESSAGE: _request,
    CAPABILITIES: _capabilities,
}
