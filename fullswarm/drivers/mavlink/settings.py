"""What a URL asks of the driver, checked before anything is touched.

URLs::

    mavlink+udp://127.0.0.1:14550          listen there for the vehicle
    mavlink+udpout://10.0.0.7:14550        send to it first
    mavlink+tcp://127.0.0.1:5760
    mavlink+serial:///dev/ttyACM0?baud=115200

Options: ``sysid=1`` the vehicle's system id; ``autopilot=ardupilot|px4`` what it must run (default: what its
heartbeat reports; name it, for `description` is read before there is one); ``ekf=ignore`` do not wait for the position
filter's own approval; ``speed=``, ``turn=`` (m/s, rad/s) limits below the vehicle's own; ``radius=`` of the footprint
in metres; ``sign_key=`` the file with the key of MAVLink 2 signing, ``sign_state=`` the file with its timestamps,
``sign_link=0`` the link id; ``pose=external`` hand the poses that `MavlinkDriver.locate` gets to the vehicle,
``origin=lat,lon,alt`` where its local frame begins then (see ``external.py`` for the parameters it needs);
``guardian=0`` or ``1`` whether a process of its own holds and disarms the rover when this one is paused or killed
(agents and `robots test` start one unless it is 0); signed, its frames bear the link id ``sign_link`` + 128.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import parse_qsl, urlsplit

from fullswarm.drivers.base import Description, Limits
from fullswarm.drivers.make import Claim, device_claim
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.autopilot import ArduPilot, Autopilot
from fullswarm.drivers.mavlink.external import parse_origin
from fullswarm.drivers.mavlink.px4 import AUTOPILOTS
from fullswarm.drivers.mavlink.signing import Signing, Timestamps, read_key, state_path
from fullswarm.drivers.mavlink.vehicle import SIGMA_M
from fullswarm.drivers.ports import Port, SerialPort, TcpPort, UdpPort
from fullswarm.errors import ConfigError, did_you_mean

# ArduRover's defaults (ATC_STR_RAT_MAX, ATC_STR_ACC_MAX); the speed is our caution, not WP_SPEED. ATC_ACCEL_MAX is
# 1 m/s², but its brakes answer late: a stop from 0.5 m/s takes 0.17 m, as with 0.7 m/s² at once. The last 0.15 m/s
# decay with a time constant of 0.38 s, which 0.7 m/s² does not cover: 0.066 m instead of 0.016.
LIMITS = Limits(speed_m_s=1.0, turn_rad_s=2.0, accel_m_s2=0.7, turn_accel_rad_s2=2.0, overrun_s=0.45, overrun_m=0.06)
RADIUS_M = 0.35
SCHEMES = ("mavlink+udp", "mavlink+udpout", "mavlink+tcp", "mavlink+serial")
DEFAULT_BAUD = 115200
KNOWN = {
    "autopilot", "ekf", "guardian", "origin", "pose", "radius", "sign_key", "sign_link", "sign_state", "speed", "sysid",
    "turn",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Address:
    """Where the vehicle is: scheme, host and port, or a serial device with its baud rate."""

    scheme: str
    host: str = ""
    port: int = 0
    device: str = ""
    baud: int = DEFAULT_BAUD

    def open(self, accepts: Callable[[bytes], bool]) -> Port[bytes]:
        """Open the port; where it listens, `accepts` decides whether the sender of a datagram is taken for the vehicle.

        Raises
        ------
        DriverError
            The port cannot be opened; the hint is what to do.
        """
        if self.device:
            return SerialPort(self.device, self.baud)
        if self.scheme == "mavlink+tcp":
            return TcpPort(self.host, self.port, silence_s=None)
        return UdpPort(self.host, self.port, accepts=accepts if self.scheme == "mavlink+udp" else None)

    def __str__(self) -> str:
        return self.device or f"{self.scheme.removeprefix('mavlink+')} {self.host}:{self.port}"


def parse_url(url: str) -> tuple[Address, dict[str, str]]:
    """Split a driver URL into its address and its options.

    Raises
    ------
    ConfigError
        Unknown scheme, no port, no device or an option twice.
    """
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port
    except ValueError as error:
        raise ConfigError(f"not a URL: {error}", where=url) from error
    pairs = parse_qsl(parts.query, keep_blank_values=True)
    options = dict(pairs)
    if len(options) != len(pairs):
        raise ConfigError("an option is given twice", where=url)
    if parts.scheme not in SCHEMES:
        raise ConfigError(
            f"'{parts.scheme}' is not a MAVLink link", where=url, hint=did_you_mean(parts.scheme, SCHEMES)
        )
    if parts.scheme == "mavlink+serial":
        if not parts.path.strip("/") or host:
            raise ConfigError("no serial device", where=url, hint="e.g. mavlink+serial:///dev/ttyACM0?baud=115200")
        return Address(parts.scheme, device=parts.path, baud=_baud(options.pop("baud", ""), url)), options
    if not host or not port or parts.path.strip("/"):
        raise ConfigError("host and port are needed", where=url, hint=f"e.g. {parts.scheme}://127.0.0.1:14550")
    return Address(parts.scheme, host=host, port=port), options


def _baud(text: str, url: str) -> int:
    if not text:
        return DEFAULT_BAUD
    if not text.isdecimal() or int(text) <= 0:
        raise ConfigError(f"'{text}' is not a baud rate", where=url, hint="e.g. ?baud=115200")
    return int(text)


@dataclass(frozen=True, slots=True)
class Options:
    """Which vehicle, and what to ask of it."""

    system: int
    limits: Limits
    where: str
    ekf_ignored: bool = False
    autopilot: Autopilot | None = None  # None: that of the heartbeat
    external: bool = False  # poses come from outside
    origin: p.Origin | None = None  # the swarm's; with external poses the vehicle's map begins there


@dataclass(frozen=True, slots=True)
class Settings:
    """A URL's options, understood."""

    description: Description
    options: Options
    key_file: Path | None = None
    state_file: Path | None = None
    link_id: int = 0
    guardian: bool | None = None  # None: the opener of the driver decides

    def signing(self) -> Signing | None:
        """Return what signs, or None; reads the files.

        Raises
        ------
        ConfigError
            The key cannot be used.
        DriverError
            The file of the timestamps cannot be used.
        """
        if self.key_file is None:
            return None
        key = read_key(self.key_file)
        stamps = Timestamps(self.state_file or state_path(key, self.options.system))
        return Signing(key, stamps, self.link_id)


def describe(settings: Settings, autopilot: Autopilot) -> Description:
    """Return the description as the autopilot at the other end makes it."""
    known = settings.description
    if known.make == autopilot.make:
        return known
    limits = replace(known.limits, can_reverse=autopilot.can_reverse)
    return replace(
        known, make=autopilot.make, limits=limits, watchdog_s=autopilot.watchdog_s, standstill=autopilot.standstill
    )


def read_settings(url: str, where: str, options: dict[str, str]) -> Settings:
    """Understand a URL's options.

    Raises
    ------
    ConfigError
        One of them is unknown or wrong.
    """
    for name in options:
        if name in ("key", "sign"):
            raise ConfigError("a key does not belong into a URL", where=url, hint="its file: sign_key=/path/of/the.key")
        if name not in KNOWN:
            raise ConfigError(f"unknown option '{name}'", where=url, hint=did_you_mean(name, KNOWN))
    autopilot = _autopilot(url, options.get("autopilot"))
    limits = replace(
        LIMITS,
        speed_m_s=_positive(url, "speed", options, LIMITS.speed_m_s),
        turn_rad_s=_positive(url, "turn", options, LIMITS.turn_rad_s),
        can_reverse=autopilot is None or autopilot.can_reverse,
    )
    external = _choice(url, "pose", options, "own", "external") == "external"
    origin = parse_origin(options["origin"], url, altitude=external) if "origin" in options else None
    for name in ("sign_state", "sign_link"):
        if name in options and "sign_key" not in options:
            raise ConfigError(f"{name} without a key", where=url, hint="add sign_key=/path/of/the.key")
    first = autopilot or ArduPilot()
    return Settings(
        Description(
            make=first.make, model="Rover", radius_m=_positive(url, "radius", options, RADIUS_M), limits=limits,
            senses_pose=True, watchdog_s=first.watchdog_s, standstill=first.standstill, pose_sigma_m=SIGMA_M,
            own_frame=not external and origin is None,
        ),
        Options(
            _whole(url, "sysid", options, 1, range(1, 255)), limits, where,
            ekf_ignored=_choice(url, "ekf", options, "require", "ignore") == "ignore",
            autopilot=autopilot, external=external,
            origin=origin,
        ),
        _path(options.get("sign_key")), _path(options.get("sign_state")),
        _whole(url, "sign_link", options, 0, range(256)),
        None if "guardian" not in options else _choice(url, "guardian", options, "0", "1") == "1",
    )  # fmt: skip


def _autopilot(url: str, key: str | None) -> Autopilot | None:
    if key is None:
        return None
    by_key = {each.key: each for each in AUTOPILOTS.values()}
    if key not in by_key:
        raise ConfigError(f"autopilot is '{key}'", where=url, hint=did_you_mean(key, by_key))
    return by_key[key]


def _choice(url: str, name: str, options: dict[str, str], default: str, other: str) -> str:
    text = options.get(name, default)
    if text not in (default, other):
        raise ConfigError(f"{name} is '{text}'", where=url, hint=f"{name}={other} or {name}={default}")
    return text


def _whole(url: str, name: str, options: dict[str, str], default: int, allowed: range) -> int:
    text = options.get(name, str(default))
    if not text.isdecimal() or int(text) not in allowed:
        raise ConfigError(f"{name} is '{text}'", where=url, hint=f"a number from {allowed.start} to {allowed[-1]}")
    return int(text)


def _path(text: str | None) -> Path | None:
    return None if text is None else Path(text).expanduser()


def _positive(url: str, name: str, options: dict[str, str], default: float) -> float:
    text = options.get(name)
    if text is None:
        return default
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise ConfigError(f"{name} is '{text}'", where=url, hint=f"a number above 0, e.g. {name}={default:g}")
    return value


def claims(url: str, elsewhere: bool) -> tuple[Claim, ...]:
    """Return what only one robot of a computer can have: a serial device, a UDP port, or a system id at a host."""
    parts = urlsplit(url)
    if parts.scheme == "mavlink+serial":
        return (device_claim(parts.path, elsewhere=elsewhere),)
    try:
        port = str(parts.port)
    except ValueError:  # the driver reports what is wrong with it
        port = parts.netloc
    if parts.scheme == "mavlink+udp":
        # Whoever listens on all addresses listens on each; one socket per port is all that a computer's agents need.
        return (Claim(("the UDP port", port)),)
    system = dict(parse_qsl(parts.query, keep_blank_values=True)).get("sysid", "1")
    where = f"{parts.scheme.removeprefix('mavlink+')} {parts.hostname or ''}:{port}"
    advice = "give each rover a system id of its own (SYSID_THISMAV) and name it with ?sysid="
    return (Claim(("the MAVLink system", system, "at", where), advice),)
