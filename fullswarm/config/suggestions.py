"""Says what to write in place of an unknown key, or of a number in another unit than the file's.

A key is looked up by what people usually write for it, then by its spelling, then in the other tables of the file.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from fullswarm.errors import nearest
from fullswarm.units import unit_of

MOST_LISTED = 4
"""Keys of a table that are all named; of more the nearest three are."""
NEAREST = 3


class Meant(NamedTuple):
    """The key that is meant, and how it is written."""

    key: str
    example: str


_POSE = Meant("pose", "pose = [x, y, heading] in m, m and rad")
_DRIVER = Meant("driver", 'driver = "create:///dev/ttyUSB0"; `fullswarm robots find` lists the URLs of robots here')
_EVERY_SPEED = Meant(
    "agent.speed_limit_m_s", "[agent] speed_limit_m_s = 0.3, or [world.bodies.ID] for one simulated body"
)
_BODY_RADIUS = Meant("world.bodies.ID.radius_m", "[world.bodies.ID] radius_m = 0.17")
_ROBOTS = Meant("robot", "[[robot]] for each robot, or [fleet] count = 4 for several alike")
_COUNT = Meant("count", "count = 4")
_BOUNDS = Meant("bounds_m", "bounds_m = [x_min, y_min, x_max, y_max] in m")
_BOXES = Meant("boxes", "boxes = [[x, y, size_x, size_y, yaw]] in m and rad")
_SENSING = Meant("sensing_radius_m", "sensing_radius_m = 3.0")
_RATE = Meant("control_rate_hz", "control_rate_hz = 50.0")
_ENDPOINT = Meant("endpoint", 'endpoint = "tcp/127.0.0.1:7447"')
_NO_BEHAVIOUR = Meant("fullswarm request", "`fullswarm request NAME` in a shell: a fleet file starts no behaviour")


def _each(names: str, meant: Meant) -> dict[str, Meant]:
    return dict.fromkeys(names.split(), meant)


CONFUSED: Mapping[str, Mapping[str, Meant]] = {
    "SwarmConfig": {
        **_each("robots agents drones vehicles units", _ROBOTS),
        **_each("name id lab project", Meant("swarm", 'swarm = "lab"')),
        **_each("docks charger chargers station stations", Meant("dock", "[[dock]] for each dock")),
        **_each("cameras", Meant("camera", "[[camera]] for each camera")),
        **_each("group teams team", Meant("groups", '[groups] scouts = ["r1", "r2"]')),
        **_each("arena bounds size", Meant("world.bounds_m", "[world] bounds_m = [x_min, y_min, x_max, y_max] in m")),
        **_each("obstacles boxes walls", Meant("world.boxes", "[world] boxes = [[x, y, size_x, size_y, yaw]]")),
        **_each("sim simulation simulator physics", Meant("world", "[world]")),
        **_each("broker server router", Meant("hub", '[hub] endpoint = "tcp/127.0.0.1:7447"')),
        **_each("behaviour behavior behaviours behaviors mission task", _NO_BEHAVIOUR),
        **_each("count", Meant("fleet.count", "[fleet] count = 4")),
    },
    "FleetShorthand": {
        **_each("number n robots size amount how_many", _COUNT),
        **_each("name names id ids", Meant("prefix", 'prefix = "r"')),
        **_each("type make model port url kind", Meant("driver", 'driver = "sim", or a URL with {id} or {n} in it')),
    },
    "RobotConfig": {
        **_each("start starts start_pose initial_pose position pos place location spawn x y heading", _POSE),
        **_each("heading_rad x_m y_m yaw theta origin", _POSE),
        **_each("name robot robot_id", Meant("id", 'id = "r1"')),
        **_each("port device dev serial type make model kind url uri address interface link baud", _DRIVER),
        **_each("speed speed_m_s max_speed max_speed_m_s speed_limit speed_limit_m_s velocity", _EVERY_SPEED),
        **_each("radius radius_m size footprint", _BODY_RADIUS),
        **_each("ip hostname computer", Meant("host", 'host = "r1.local"')),
        **_each("user username login", Meant("ssh_user", 'ssh_user = "pi"')),
        **_each("simulate simulated emulated emulator", Meant("emulate", 'emulate = "create2"')),
        **_each("lidar laser scanner range", Meant("ranges", 'ranges = "ld19:///dev/ttyUSB1"')),
        **_each("gps gnss uwb", Meant("fixes", 'fixes = "gnss:///dev/ttyACM0"')),
        **_each("abilities skills tools features", Meant("capabilities", 'capabilities = ["carry"]')),
        **_each("group groups team", Meant("groups", '[groups] scouts = ["r1", "r2"]')),
        **_each("behaviour behavior mission task", _NO_BEHAVIOUR),
    },
    "AgentConfig": {
        **_each("speed speed_m_s max_speed max_speed_m_s speed_limit velocity",
                Meant("speed_limit_m_s", "speed_limit_m_s = 0.3")),
        **_each("turn_limit max_turn omega", Meant("turn_limit_rad_s", "turn_limit_rad_s = 2.0")),
        **_each("range radius sensing sensing_range view vision", _SENSING),
        **_each("rate hz frequency period dt rate_hz", _RATE),
        **_each("margin safety", Meant("safety_margin_m", "safety_margin_m = 0.03")),
        **_each("bounds arena fence geofence", _BOUNDS),
        **_each("behaviour behavior mission task", _NO_BEHAVIOUR),
    },
    "WorldConfig": {
        **_each("size arena bounds width height length extent dimensions", _BOUNDS),
        **_each("obstacles obstacle box rectangles blocks", _BOXES),
        **_each("speed speed_m_s max_speed", Meant("speed_limit_m_s", "speed_limit_m_s = 0.5")),
        **_each("radius robot_radius", Meant("radius_m", "radius_m = 0.17")),
        **_each("mass", Meant("mass_kg", "mass_kg = 3.6")),
        **_each("physics simulator backend", Meant("engine", 'engine = "pybullet"')),
        **_each("dt step timestep hz rate", Meant("rate_hz", "rate_hz = 50.0")),
        **_each("gps datum latitude longitude", Meant("origin", "origin = [latitude, longitude] in degrees")),
        **_each("port listen", Meant("address", 'address = "127.0.0.1:7450"')),
        **_each("robots robot", _ROBOTS),
        **_each("people persons carts", Meant("movers", "[[world.movers]] waypoints = [[1, 1], [5, 1]]")),
    },
    "HubConfig": _each("port address url listen host ip server", _ENDPOINT),
    "DockConfig": {
        **_each("name", Meant("id", 'id = "d1"')),
        **_each("position pos place location x y heading", _POSE),
        **_each("count number places", Meant("slots", "slots = 2")),
        **_each("robot", Meant("robots", 'robots = ["r1"]')),
    },
    "CameraConfig": {
        **_each("id", Meant("name", 'name = "ceiling"')),
        **_each("url device port", Meant("source", 'source = "v4l2:///dev/video0"')),
    },
    "StepSection": {
        **_each("behavior law action do task", Meant("behaviour", 'behaviour = "move_to_goal_bc"')),
        **_each("params settings set arguments args", Meant("parameters", "parameters = {goal = [5, 5]}")),
        **_each("id", Meant("name", 'name = "gather"')),
        **_each("until when timeout duration time", Meant("done", "done = {time_s = 30}, or {arrived = \"all\"}")),
        **_each("robot", Meant("robots", 'robots = ["r1"]')),
    },
    "MissionSection": {
        **_each("step", Meant("steps", "[[steps]] for each step")),
        **_each("track", Meant("tracks", "[[tracks.NAME.steps]] for each step")),
        **_each("mission id", Meant("name", 'name = "patrol"')),
    },
    "Scenario": {
        **_each("size arena bounds", _BOUNDS),
        **_each("obstacles box", _BOXES),
        **_each("start starts", Meant("spawn", "[spawn] region_m = [x_min, y_min, x_max, y_max]")),
        **_each("target", Meant("goal", "[goal] centre_m = [x, y] and radius_m")),
        **_each("timeout duration time_limit limit_s", Meant("time_limit_s", "time_limit_s = 60.0")),
    },
    "Experiment": {
        **_each("group", Meant("groups", "[[groups]] for each group of cells")),
        **_each("seed", Meant("seeds", 'seeds = "0-19"')),
        **_each("limit", Meant("limits", "[limits.NAME]")),
    },
    "Group": {
        **_each("scenario world worlds", Meant("scenarios", 'scenarios = ["concave"]')),
        **_each("behaviour behavior", Meant("behaviours", "[[groups.behaviours]] for each")),
        **_each("engine", Meant("engines", 'engines = ["kinematic"]')),
    },
    "MoverConfig": {
        **_each("path way route points", Meant("waypoints", "waypoints = [[1, 1], [5, 1]] in m")),
        **_each("speed", Meant("speed_m_s", "speed_m_s = 1.0")),
        **_each("radius", Meant("radius_m", "radius_m = 0.25")),
    },
}  # fmt: skip
"""By the name of the table's schema: what people write, and what is meant."""


def unknown_key(name: str, known: Iterable[str], schema: str = "", elsewhere: str = "") -> str:
    """Return what is wrong with a key that a table does not have, and what to write.

    Parameters
    ----------
    known : the table's keys
    schema : name of the table's schema, for :data:`CONFUSED`
    elsewhere : table that has this key; empty: none
    """
    keys = sorted(known)
    meant = CONFUSED.get(schema, {}).get(name.lower().replace("-", "_"))
    if meant is not None:
        return f"unknown key, did you mean '{meant.key}'? write {meant.example}"
    if near := nearest(name, keys):
        return f"unknown key, did you mean '{near}'?"
    if elsewhere:
        return f"unknown key here, it belongs in [{elsewhere}]"
    if not keys:
        return "unknown key: this table is empty"
    if len(keys) <= MOST_LISTED:
        return f"unknown key, known: {', '.join(keys)}"
    close = difflib.get_close_matches(name, keys, n=NEAREST, cutoff=0.0)
    return f"unknown key, the nearest of {len(keys)}: {', '.join(close)}"


# ---------------------------------------------------------------- numbers in another unit
_THOUSANDTHS = {"m": "mm", "m/s": "mm/s", "m/s²": "mm/s²", "s": "ms", "kg": "g"}
_DEGREES = {"rad": "degrees", "rad/s": "degrees per second", "rad/s²": "degrees per second squared"}
_STARTS_WITH_NUMBER = re.compile(r"\s*([-+]?\d+(?:[.,]\d+)?)\s*(%?)")
MOST_PERCENT = 100.0


def other_unit(name: str, value: float, most: float) -> str:
    """Return in which unit a number may be that is above its limit `most`, and what it is in the file's; or nothing."""
    unit = unit_of(name)
    if unit in _THOUSANDTHS and 0.0 < value / 1000.0 <= most:
        return f"if these are {_THOUSANDTHS[unit]}, write {value / 1000.0:g}"
    if unit in _DEGREES and 0.0 < math.radians(value) <= most:
        return f"if these are {_DEGREES[unit]}, write {math.radians(value):.4g}"
    if not unit and most == 1.0 and 1.0 < value <= MOST_PERCENT:
        return f"a share of 1: {value:g} % is {value / 100.0:g}"
    return ""


def period(name: str, value: float, least: float) -> str:
    """Return the rate of a period that was written in place of it, where the rate is at least `least`; or nothing."""
    if unit_of(name) == "Hz" and 0.0 < value < 1.0 and 1.0 / value >= least:
        return f"if this is a period in s, write {1.0 / value:g}"
    return ""


def number_in(name: str, text: str) -> str:
    """Return how a number is written that stands in quotes, perhaps with its unit; or nothing."""
    found = _STARTS_WITH_NUMBER.match(text)
    if found is None:
        return ""
    value = float(found[1].replace(",", ".")) / (100.0 if found[2] else 1.0)
    unit = unit_of(name)
    return f"write {value:g}, without quotes" + (f", in {unit}" if unit else "")


def radians(value: float) -> str:
    """Return what is wrong with an angle beyond a whole turn, which was meant in degrees; or nothing."""
    if abs(value) <= 2.0 * math.pi + 0.01:
        return ""
    return f"{value:g} is more than a turn: angles are in rad, {value:g} degrees are {math.radians(value):.4g}"
