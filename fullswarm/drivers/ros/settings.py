"""What a URL asks of the driver, checked before anything is touched.

URLs::

    ros://tcp/192.168.1.5:7447/turtlebot1?model=turtlebot3&watchdog=0.5    rmw_zenoh: the robot's router
    ros://tcp/192.168.1.5:7447/bot1?rmw=bridge&model=turtlebot4            zenoh-bridge-ros2dds on the robot
    ros://ws/192.168.1.5:9090/bot1?model=turtlebot4                        rosbridge_server on the robot

The path after the address is the ROS namespace; it may be missing. A topic of an option is relative to it unless it
begins with ``/``. Options:

``model=``
    See :mod:`.models`. Without one, ``radius``, ``speed``, ``turn`` and ``watchdog`` must be given.
``cmd=cmd_vel``, ``odom=odom``, ``battery=``, ``hazards=``, ``estop=``
    Topics. ``hazards`` is a HazardDetectionVector of irobot_create_msgs; ``estop`` a Bool that is true while the
    robot's emergency stop is engaged. Empty: there is none; the last three default to what the model has.
``scan=``
    A LaserScan: the robot then knows its surroundings by it. ``scan_at=x,y,heading`` in m and rad says where on the
    robot the sensor is, ``scan_max=`` how far it sees at most, in m; both default to what the model has.
``stamped=1``
    The base takes TwistStamped; its stamps are times of the robot's own clock.
``radius=``, ``speed=``, ``turn=``, ``accel=``, ``turn_accel=``, ``reverse=0|1``
    In m, m/s, rad/s, m/s², rad/s²; they replace those of the model.
``watchdog=``
    After how many seconds without a command the base itself stops; ``none``: never.
``domain=0``
    ROS domain (rmw_zenoh).
``guardian=0``
    No process of its own stops the robot when this one is paused or killed.

A base that never stops by itself drives on when its network is cut. It is refused unless the driver runs on the robot
(its address is of this computer), or ``watchdog=none`` in the URL accepts it.
"""

from __future__ import annotations

import ipaddress
import math
import re
from dataclasses import dataclass, replace
from typing import Literal
from urllib.parse import parse_qsl, urlsplit

from fullswarm.drivers.base import Description, Limits, Pose
from fullswarm.drivers.make import Claim
from fullswarm.drivers.ports import parse_address, parse_mount
from fullswarm.drivers.ros.models import MIDDLE, MODELS, Model
from fullswarm.errors import ConfigError, did_you_mean

Transport = Literal["zenoh", "bridge", "rosbridge"]
NUMBERS = ("radius", "speed", "turn", "accel", "turn_accel")
TOPICS = ("cmd", "odom", "battery", "hazards", "estop", "scan")
OPTIONS = (
    "rmw",
    "model",
    *TOPICS,
    "scan_at",
    "scan_max",
    "stamped",
    *NUMBERS,
    "reverse",
    "watchdog",
    "domain",
    "guardian",
)
EXAMPLE = "ros://tcp/192.168.1.5:7447/turtlebot1?model=turtlebot3&watchdog=0.5"
OTHER = Model("ROS", "base", math.nan, Limits(math.nan, math.nan, 1.0, 4.0), None, battery="")
"""A robot without a record: what is not known must be in the URL."""
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
LAST_DOMAIN = 232
SCAN_SILENCE_S = 1.0
"""Without a scan for so long the lidar is lost: an LDS-01 turns five times a second, and Wi-Fi may lose two."""


@dataclass(frozen=True, slots=True)
class Topics:
    """Full names without the leading slash; empty: there is none."""

    cmd: str
    odom: str
    battery: str
    hazards: str
    estop: str
    scan: str


@dataclass(frozen=True, slots=True)
class Settings:
    """A URL, understood."""

    transport: Transport
    host: str
    port: int
    namespace: str
    topics: Topics
    description: Description
    stamped: bool = False
    domain: int = 0
    guardian: bool | None = None  # None: the opener of the driver decides
    scan_at: Pose = MIDDLE

    @property
    def where(self) -> str:
        """Its address, for people."""
        return f"{'ws' if self.transport == 'rosbridge' else 'tcp'} {self.host}:{self.port}"


def parse_url(url: str) -> Settings:
    """Read a driver's URL.

    Raises
    ------
    ConfigError
        It has another form, an unknown option, a value that does not fit, or names a robot that nothing would stop.
    """
    parts = urlsplit(url)
    address, _, namespace = parts.path.strip("/").partition("/")
    if parts.scheme != "ros" or parts.netloc not in ("tcp", "ws"):
        raise ConfigError("this names no ROS robot", where=url, hint=f"write {EXAMPLE} (rosbridge: ros://ws/host:9090)")
    host, port = parse_address(address, where=url)
    pairs = parse_qsl(parts.query, keep_blank_values=True)
    options = dict(pairs)
    if len(options) != len(pairs):
        raise ConfigError("an option is given twice", where=url)
    for name in options:
        if name not in OPTIONS:
            raise ConfigError(f"unknown option '{name}'", where=url, hint=did_you_mean(name, OPTIONS))
    if namespace and not _NAME.fullmatch(namespace):
        raise ConfigError(f"'{namespace}' is no ROS namespace", where=url, hint="letters, digits, _ and / between")
    model = _model(url, options)
    described = _describe(url, options, model)
    _refuse_unstoppable(url, options, host, described)
    return Settings(
        _transport(url, parts.netloc, options), host, port, namespace,
        Topics(*(_topic(url, name, options, model, namespace) for name in TOPICS)), described,
        stamped=_flag(url, "stamped", options, model.stamped) or False, domain=_domain(url, options),
        guardian=_flag(url, "guardian", options, None),
        scan_at=parse_mount(options["scan_at"], "scan_at", url) if "scan_at" in options else model.scan_at,
    )  # fmt: skip


def _transport(url: str, link: str, options: dict[str, str]) -> Transport:
    fitting: tuple[Transport, ...] = ("rosbridge",) if link == "ws" else ("zenoh", "bridge")
    text = options.get("rmw", fitting[0])
    for each in fitting:
        if text == each:
            return each
    raise ConfigError(f"rmw '{text}' does not fit {link}", where=url, hint=f"one of {', '.join(fitting)}")


def _model(url: str, options: dict[str, str]) -> Model:
    name = options.get("model", "")
    if name and name not in MODELS:
        raise ConfigError(f"unknown model '{name}'", where=url, hint=did_you_mean(name, MODELS))
    missing = [each for each in ("radius", "speed", "turn", "watchdog") if each not in options]
    if not name and missing:
        raise ConfigError(
            f"not known of this robot: {', '.join(missing)}", where=url,
            hint=f"add them to the URL, or model= with one of {', '.join(MODELS)}",
        )  # fmt: skip
    return MODELS[name] if name else OTHER


def _describe(url: str, options: dict[str, str], model: Model) -> Description:
    known = model.limits
    limits = Limits(
        _number(url, "speed", options, known.speed_m_s), _number(url, "turn", options, known.turn_rad_s),
        _number(url, "accel", options, known.accel_m_s2), _number(url, "turn_accel", options, known.turn_accel_rad_s2),
        can_reverse=_flag(url, "reverse", options, known.can_reverse) or False,
    )  # fmt: skip
    watchdog_s = model.watchdog_s
    if "watchdog" in options:
        watchdog_s = None if options["watchdog"] == "none" else _number(url, "watchdog", options, math.nan)
    return Description(
        make=model.make,
        model=model.label,
        radius_m=_number(url, "radius", options, model.radius_m),
        limits=limits,
        senses_bumps=bool(options.get("hazards", model.hazards)),
        watchdog_s=watchdog_s,
        ranges_max_m=_scan_max(url, options, model),
        ranges_timeout_s=SCAN_SILENCE_S,
    )


def _scan_max(url: str, options: dict[str, str], model: Model) -> float:
    if not options.get("scan"):
        for name in ("scan_at", "scan_max"):
            if name in options:
                raise ConfigError(f"{name} without scan", where=url, hint="name the topic of the lidar, e.g. scan=scan")
        return 0.0
    if "scan_max" not in options and not model.scan_max_m:
        raise ConfigError("it is not known how far its lidar sees", where=url, hint="add scan_max=, in m")
    return _number(url, "scan_max", options, model.scan_max_m)


def _refuse_unstoppable(url: str, options: dict[str, str], host: str, description: Description) -> None:
    if description.watchdog_s is None and "watchdog" not in options and not is_here(host):
        raise ConfigError(
            f"a {description.model} keeps its last velocity when the network is cut: nothing would stop it",
            where=url,
            hint="start a velocity smoother on it and write watchdog=0.5, or run its agent on the robot with the "
            "address 127.0.0.1 (docs/how-to-ros-robots.md); watchdog=none accepts it",
        )


def is_here(host: str) -> bool:
    """Tell whether an address is of this computer itself."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _topic(url: str, option: str, options: dict[str, str], model: Model, namespace: str) -> str:
    usual = {"cmd": "cmd_vel", "odom": "odom", "battery": model.battery, "hazards": model.hazards}.get(option, "")
    name = options.get(option, usual)
    if not name and option in ("cmd", "odom"):
        raise ConfigError(f"{option} is empty", where=url, hint=f"the topic's name, e.g. {option}={usual}")
    if not name:
        return ""
    absolute = name.startswith("/")
    full = name[1:] if absolute or not namespace else f"{namespace}/{name}"
    if not _NAME.fullmatch(full):
        raise ConfigError(f"{option} '{name}' is no name of a ROS topic", where=url, hint="letters, digits, _ and /")
    return full


def _number(url: str, name: str, options: dict[str, str], usual: float) -> float:
    if name not in options:
        return usual
    try:
        value = float(options[name])
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise ConfigError(f"{name} '{options[name]}' is not a positive number", where=url)
    return value


def _flag(url: str, name: str, options: dict[str, str], usual: bool | None) -> bool | None:
    if name not in options:
        return usual
    if options[name] not in ("0", "1"):
        raise ConfigError(f"{name} '{options[name]}' is neither 0 nor 1", where=url)
    return options[name] == "1"


def _domain(url: str, options: dict[str, str]) -> int:
    text = options.get("domain", "0")
    if not text.isdecimal() or int(text) > LAST_DOMAIN:
        raise ConfigError(f"domain '{text}' is none", where=url, hint=f"a number from 0 to {LAST_DOMAIN}")
    return int(text)


def claims(url: str, elsewhere: bool) -> tuple[Claim, ...]:
    """Return what only one driver can have: the robot's base, told by address and topic."""
    del elsewhere
    settings = parse_url(url)
    return (Claim(("the base", f"{settings.where} /{settings.topics.cmd}"), "give each robot its namespace"),)


def without_guardian(settings: Settings) -> Settings:
    """Return them for a probe, which never drives."""
    return replace(settings, guardian=False)
