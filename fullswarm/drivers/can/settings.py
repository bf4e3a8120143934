"""The URL of a CAN base, checked: ``can+odrive://vcan0?left=1&right=2&wheel_radius=0.05&base=0.3``.

The part after ``://`` is python-can's channel:

======================================  ==============================================================
``can+odrive://vcan0?…``                ``socketcan``, the default: a kernel interface, real or virtual
``can+odrive:///dev/ttyACM0?…``         with ``interface=slcan``: a serial adapter, or an emulated base's pty
``can+odrive://239.74.163.2?…``         with ``interface=udp_multicast``: emulators in other processes
``can+odrive://word?…``                 with ``interface=virtual``: emulators in this process
======================================  ==============================================================

``guardian=0`` and ``guardian=1`` decide whether a process of its own stops the wheels when this one is paused or
killed; agents and `robots test` have one for controllers without a watchdog of 0.5 s or less. Not with ``virtual``,
which no other process can reach.

Multicast stays on this machine (hop limit 0) but needs a route: a machine without any network has none until
``ip route add 239.0.0.0/8 dev lo``. Any program on the machine may send on it; a pty has one owner.
"""

from __future__ import annotations

import math
from typing import Any, Literal
from urllib.parse import parse_qsl, urlsplit

from pydantic import Field, PositiveFloat, ValidationError

from fullswarm.config import Section
from fullswarm.drivers.base import Description, Limits
from fullswarm.drivers.can import odrive, vesc
from fullswarm.drivers.can.odrive import OdriveCodec
from fullswarm.drivers.can.protocol import Wheel, WheelCodec
from fullswarm.drivers.can.vesc import VescCodec
from fullswarm.drivers.make import Claim, device_claim
from fullswarm.errors import ConfigError, did_you_mean

Sign = Literal["1", "-1"]


class BusOptions(Section):
    """How python-can reaches the bus.

    ``udp_multicast`` is for emulators: python-can listens on all addresses, so any computer on the network could
    send on such a bus. Its frames do not leave the machine unless `hop_limit` allows it.
    """

    interface: Literal["socketcan", "slcan", "virtual", "udp_multicast"] = "socketcan"
    bitrate: int | None = Field(None, gt=0)  # slcan only; None: the maker's default
    settle: float = Field(0.1, ge=0.0, le=5.0)  # slcan only: seconds that the adapter needs after opening
    tty_baud: int = Field(115_200, gt=0)  # slcan only, and of no meaning to a USB adapter
    port: int = Field(43113, gt=0, le=65535)  # udp_multicast only
    hop_limit: int = Field(0, ge=0, le=255)  # udp_multicast only; 0: frames do not leave this machine
    guardian: Literal["0", "1"] | None = None  # None: the opener of the driver decides


class BaseOptions(Section):
    """The body; lengths in m, speeds in m/s."""

    left: int = Field(ge=0)  # node of the left wheel
    right: int = Field(ge=0)
    wheel_radius: PositiveFloat
    base: PositiveFloat  # distance between the wheels
    gear: PositiveFloat = 1.0  # motor turns per wheel turn
    left_sign: Sign = "1"
    right_sign: Sign = "1"
    speed: PositiveFloat = 0.5  # of a wheel, at most
    accel: PositiveFloat = 1.0
    radius: PositiveFloat | None = None  # of the footprint; None: wheels at the rim
    volts_empty: PositiveFloat | None = None  # of the battery; without both there is no battery reading
    volts_full: PositiveFloat | None = None

    @property
    def volts(self) -> tuple[float, float] | None:
        """Return the voltages of the empty and the full battery; None: not given."""
        if self.volts_empty is None or self.volts_full is None:
            return None
        return self.volts_empty, self.volts_full

    def wheel(self, side: int, pole_pairs: int = 1) -> Wheel:
        """Return the wheel of a side (0 left, 1 right)."""
        sign = int((self.left_sign, self.right_sign)[side])
        return Wheel(self.wheel_radius, self.gear, pole_pairs, sign)


class OdriveOptions(Section):
    """What only an ODrive has."""

    firmware: Literal["0.5", "0.6"] = "0.6"
    vel_limit: PositiveFloat = 2.0  # turn/s, as configured in the axis
    input_mode: Literal["1", "2"] = "1"  # passthrough or velocity ramp
    watchdog: PositiveFloat | None = None  # s, as configured in the axis; None: off

    def codec(self, base: BaseOptions, side: int) -> OdriveCodec:
        """Return the codec of a side."""
        node = (base.left, base.right)[side]
        return OdriveCodec(node, base.wheel(side), self.firmware, self.vel_limit, int(self.input_mode))


class VescOptions(Section):
    """What only a VESC has."""

    pole_pairs: int = Field(ge=1, le=100)
    min_erpm: float = Field(900.0, ge=0.0)
    brake: float = Field(5.0, ge=0.0, le=100.0)  # A
    host: int = Field(253, ge=0, le=vesc.MAX_NODE)  # our own address
    watchdog: PositiveFloat = vesc.FIRMWARE_TIMEOUT_S  # s, its timeout as configured in VESC Tool

    def codec(self, base: BaseOptions, side: int) -> VescCodec:
        """Return the codec of a side."""
        node = (base.left, base.right)[side]
        return VescCodec(node, base.wheel(side, self.pole_pairs), self.host, self.min_erpm, self.brake)


Make = Literal["odrive", "vesc"]
_MAKERS: dict[str, tuple[Make, type[OdriveOptions] | type[VescOptions], int, int]] = {
    # scheme: make, options, greatest node, bitrate
    "can+odrive": ("odrive", OdriveOptions, odrive.MAX_NODE, 250_000),
    "can+vesc": ("vesc", VescOptions, vesc.MAX_NODE, 500_000),
}


class Settings(Section):
    """All options of a URL."""

    url: str
    make: Make
    channel: str
    bus: BusOptions
    base: BaseOptions
    drive: OdriveOptions | VescOptions

    def codecs(self) -> tuple[WheelCodec, WheelCodec]:
        """Return the codecs of the left and the right wheel."""
        return self.drive.codec(self.base, 0), self.drive.codec(self.base, 1)

    @property
    def wheel_limit_m_s(self) -> float:
        """Return how fast a wheel may turn: as the URL asks, or less if the controller allows less."""
        return min(self.base.speed, self.codecs()[0].max_speed_m_s)

    def description(self) -> Description:
        """Return what is known before connecting."""
        base, speed_m_s = self.base, self.wheel_limit_m_s
        limits = Limits(speed_m_s, 2.0 * speed_m_s / base.base, base.accel, 2.0 * base.accel / base.base)
        is_odrive = isinstance(self.drive, OdriveOptions)
        return Description(
            make="ODrive" if is_odrive else "VESC",
            model="differential base",
            radius_m=base.radius or math.hypot(base.base / 2.0, base.wheel_radius),
            limits=limits,
            watchdog_s=self.drive.watchdog,
        )

    @property
    def warning(self) -> str:
        """Return what an operator must know before this base drives; empty: nothing."""
        if self.drive.watchdog is not None:
            return ""
        return (
            "should this computer die, the wheels go on turning: an ODrive's watchdog is off as delivered and no"
            " CANSimple message switches it on. Do it once over USB (axis0.config.watchdog_timeout = 0.5,"
            " enable_watchdog = True, save_configuration()) and add watchdog=0.5 to the URL"
        )

    @property
    def bitrate(self) -> int:
        """Return the bus' speed."""
        return self.bus.bitrate or _MAKERS[f"can+{self.make}"][3]


def parse(url: str) -> Settings:
    """Return the options of `url`.

    Raises
    ------
    ConfigError
        All that is wrong at once: unknown, missing, repeated and impossible options.
    """
    parts = urlsplit(url)
    if parts.scheme not in _MAKERS:
        raise ConfigError(f"'{parts.scheme}' is not a CAN base", where=url, hint=did_you_mean(parts.scheme, _MAKERS))
    make, drive_options, greatest_node, bitrate = _MAKERS[parts.scheme]
    pairs = parse_qsl(parts.query, keep_blank_values=True)
    query = dict(pairs)
    problems = [f"'{key}' is given twice" for key in query if sum(key == other for other, _ in pairs) > 1]
    sections: tuple[type[Section], ...] = (BusOptions, BaseOptions, drive_options)
    known = {name for section in sections for name in section.model_fields}
    problems += [f"no option '{key}', {did_you_mean(key, known)}" for key in query if key not in known]
    if not (channel := parts.netloc + parts.path):
        problems.append(f"the channel is missing: {parts.scheme}://vcan0?… or {parts.scheme}:///dev/ttyACM0?…")
    found: list[Any] = [_section(each, query, problems) for each in sections]
    if not problems:
        bus, base, drive = found
        problems += _impossible(base, drive, greatest_node)
    if problems:
        raise ConfigError("; ".join(problems), where=url, hint="needed: left, right, wheel_radius, base")
    if bus.bitrate is None:
        bus = bus.model_copy(update={"bitrate": bitrate})
    return Settings(url=url, make=make, channel=channel, bus=bus, base=base, drive=drive)


def _section(section: type[Section], query: dict[str, str], problems: list[str]) -> Section | None:
    """Return the options of `section`; what is wrong with them is added to `problems`."""
    try:
        return section.model_validate({key: text for key, text in query.items() if key in section.model_fields})
    except ValidationError as error:
        problems += [f"{each['loc'][0]}: {each['msg'].lower()}" for each in error.errors()]
        return None


def _impossible(base: BaseOptions, drive: OdriveOptions | VescOptions, greatest_node: int) -> list[str]:
    """Return what is wrong with options that are each right by themselves."""
    problems = []
    if base.left == base.right:
        problems.append(f"left and right are the same node {base.left}")
    if (base.volts_empty is None) != (base.volts_full is None):
        problems.append("volts_empty and volts_full go together")
    elif base.volts and base.volts[0] >= base.volts[1]:
        problems.append("volts_empty is not below volts_full")
    if max(base.left, base.right) > greatest_node:
        problems.append(f"nodes go up to {greatest_node}")
    if isinstance(drive, VescOptions):
        if drive.host in (base.left, base.right):
            problems.append(f"host {drive.host} is our own address, not a wheel's")
        slowest = drive.codec(base, 0)
        if slowest.quantised(base.speed) == 0.0:
            erpm = abs(slowest.wheel.erpm(base.speed))
            problems.append(
                f"speed {base.speed} m/s is {erpm:.0f} ERPM, below the {drive.min_erpm:.0f} at which a VESC lets go; "
                "lower s_pid_min_erpm in the VESC and min_erpm here, or check gear and pole_pairs"
            )
    return problems


def claims(url: str, elsewhere: bool) -> tuple[Claim, ...]:
    """Return what only one robot of a computer can have: a serial adapter, or of a bus the nodes of both wheels."""
    parts = urlsplit(url)
    options = dict(parse_qsl(parts.query, keep_blank_values=True))
    channel, interface = parts.netloc + parts.path, options.get("interface", "socketcan")
    if interface == "slcan":
        return (device_claim(channel, elsewhere=elsewhere),)
    bus = (
        f"{channel}:{options.get('port', BusOptions.model_fields['port'].default)}"
        if interface == "udp_multicast"
        else channel
    )
    make = f"({parts.scheme.removeprefix('can+')})"
    nodes = (options.get("left", ""), options.get("right", ""))
    return tuple(
        Claim(("the CAN node", node, "of", bus, make), "give each wheel a node id of its own") for node in nodes
    )
