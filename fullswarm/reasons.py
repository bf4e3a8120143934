"""Why robots stand and why requests are refused or superseded: a code for programs, a text for people.

On the wire a code and its parameters stand beside the text. Programs decide by the code (advice, alarms, the question
whether to take robots over, exit codes); the texts of :data:`TEXTS` may be reworded or translated without any effect.
A reader that does not know a code shows the text.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Literal, NamedTuple


class Code(enum.StrEnum):
    """What keeps a robot from motion or a request from being carried out."""

    NONE = ""
    GIVEN = "given"  # a text from outside this table: a driver's, a law's, a library's
    SEVERAL = "several"  # robots refused for different reasons; parameters: robot → code

    # why a robot stands
    ESTOP = "estop"
    DRIVER = "driver"
    READING = "reading"
    HAZARD = "hazard"  # hazards: names, separated by spaces
    LAW = "law"  # law, error
    HUB = "hub"
    CORE = "core"
    EXPIRED = "expired"
    STALE = "stale"
    BATTERY = "battery"
    CLOCK = "clock"
    POSE = "pose"
    GEOFENCE = "fence"
    OVERLAP = "overlap"  # robot: the other one
    FRAME = "frame"
    FOREIGN_FRAME = "foreign_frame"  # host: the one with another origin
    VERSION = "version"  # process, software, own, kinds
    UNSURE = "unsure"
    RANGES = "ranges"
    SETTLED = "settled"
    SILENT = "silent"  # robots: their names
    FLOOD = "flood"  # robot: the sender; per_s
    NO_WAY = "no_way"  # goal, needed_m, widest_m
    GOAL_CLOSED = "goal_closed"  # goal, needed_m, available_m
    STOPPED = "stopped"  # by
    ESTOP_ENGAGED = "estop_engaged"  # by
    ESTOP_RELEASED = "estop_released"  # by
    DRIVER_FAILED = "driver_failed"  # fault
    DRIVER_STOPPED = "driver_stopped"  # cause
    CHARGE_WAITS = "charge_waits"
    CHARGE_GOING = "charge_going"  # dock
    CHARGE_DOCKING = "charge_docking"  # dock
    CHARGING = "charging"  # dock
    DOCKED = "docked"  # dock: no current flows
    CHARGE_LEAVING = "charge_leaving"  # dock
    CHARGE_RETURNS = "charge_returns"  # dock
    ARRIVED = "arrived"  # behaviour, text: what its control law says of it
    FAILED = "failed"  # behaviour, text

    # what a driver reports of its robot
    CLIFF = "cliff"
    WHEEL_DROP = "wheel_drop"
    OVERCURRENT = "overcurrent"
    CHARGER = "charger"
    MOTORS_OFF = "motors_off"
    POSITION = "position"  # its autopilot has no position
    PORT_HELD = "port_held"  # another process uses the port

    ACTUATOR = "actuator"  # name, error: it does not take what a control law asks for

    # why a dock is not used
    DOCK_NO_CURRENT = "dock_no_current"  # robot
    DOCK_NOT_REACHED = "dock_not_reached"  # robot
    DOCK_TAKEN = "dock_taken"  # robot: that stands in it and does not charge
    DOCK_LOST = "dock_lost"  # robot: that fell silent there

    # why a request was refused or ended
    ESTOP_LATCHED = "estop_latched"
    VOIDED = "spent"  # why
    HELD = "held"  # robot → operator
    SUPERSEDED = "superseded"  # by: the id of the other request
    CAME_FIRST = "came_first"  # by: the id of the newer request
    OTHER_CORE = "other_core"
    NOT_REPEATED = "lapsed"  # after_s
    SIMULATED_ONLY = "simulated_only"  # law
    UNFIT = "unfit"  # what
    TOO_SLOW = "too_slow"  # what
    ROLES = "roles"  # a text of the core
    PARAMETERS = "parameters"  # problems; the hint after them lists all parameters


TEXTS: dict[Code, str] = {
    Code.NONE: "",
    Code.ESTOP: "e-stop is latched",
    Code.DRIVER: "the driver is not ready",
    Code.READING: "sensor data is stale",
    Code.LAW: "law '{law}': {error}",
    Code.HUB: "the hub is lost",
    Code.CORE: "the core's heartbeat is silent",
    Code.EXPIRED: "the operator's intent has expired",
    Code.STALE: "no fresh command",
    Code.BATTERY: "the battery is low; charge it, or drive it to its charger by hand",
    Code.CLOCK: "clock jumped (suspend or stall); waiting for fresh data",
    Code.POSE: "the estimator has no pose",
    Code.GEOFENCE: "it would leave the arena",
    Code.OVERLAP: "'{robot}' is reported in the same place, so one position is wrong: check where both robots are, "
    "then drive them apart by hand or correct their poses (`pose` in the fleet file, pose fixes)",
    Code.FRAME: "its position counts from where it was switched on, and other robots are present: write [world] "
    "origin = [latitude, longitude] into the fleet file; until then it can be driven by hand only",
    Code.FOREIGN_FRAME: "the position of '{host}' counts from where it was switched on: write [world] origin = "
    "[latitude, longitude] into its fleet file; until then robots can be driven by hand only",
    Code.VERSION: "'{process}' runs fullswarm {software}, this one {own}, and their messages differ ({kinds})",
    Code.UNSURE: "its position is too uncertain: what measures it (satellite receiver, external poses) is lost; "
    "it continues once that is back",
    Code.RANGES: "its range sensor is silent, so it does not see where it drives; it continues once scans come",
    Code.SETTLED: "arrived as near as possible: the places nearer to its goal are taken, or there is no way to them; "
    "it goes on when there is room",
    Code.SILENT: "waits for robots that are silent: {robots}; it cannot see where they are. Restart or remove them, or "
    "let another robot look at the place",
    Code.FLOOD: "'{robot}' broadcasts {per_s} times a second, which is more than its behaviour may; what is beyond is "
    "dropped",
    Code.NO_WAY: "it knows no way to {goal}: it needs one {needed_m} m wide, and the widest is {widest_m} m; it "
    "continues when it knows a wider one",
    Code.GOAL_CLOSED: "its goal {goal} is {available_m} m from an obstacle, and it needs {needed_m} m",
    Code.ACTUATOR: "the actuator '{name}' is not set: {error}",
    Code.CHARGE_WAITS: "waits for a free dock: its battery is too low to go on",
    Code.CHARGE_GOING: "on its way to {dock} to charge",
    Code.CHARGE_DOCKING: "docking at {dock}",
    Code.CHARGING: "charging at {dock}",
    Code.DOCKED: "at {dock}, no current flows",
    Code.CHARGE_LEAVING: "leaving {dock}",
    Code.CHARGE_RETURNS: "returning from {dock}",
    Code.DOCK_NO_CURRENT: "{robot} stood in it and was not charged: check its contacts and its power",
    Code.DOCK_NOT_REACHED: "{robot} did not get into it: see what stands there, and the dock's pose in the fleet file",
    Code.DOCK_TAKEN: "{robot} stands in it and does not charge: drive it out by hand, or give it a task",
    Code.DOCK_LOST: "{robot} fell silent there: restart or remove it",
    Code.STOPPED: "it was stopped by {by}",
    Code.ESTOP_ENGAGED: "its e-stop was engaged by {by}",
    Code.ESTOP_RELEASED: "its e-stop was released by {by}",
    Code.DRIVER_FAILED: "the driver failed: {fault}",
    Code.DRIVER_STOPPED: "the robot has stopped by itself: {cause}",
    Code.ARRIVED: "{behaviour} has arrived: {text}",
    Code.FAILED: "{behaviour} has failed: {text}",
    Code.ESTOP_LATCHED: "its e-stop is latched",
    Code.VOIDED: "{why}; ask for it again",
    Code.SUPERSEDED: "superseded by {by}",
    Code.CAME_FIRST: "superseded by {by}, which came first",
    Code.OTHER_CORE: "another core commands this robot",
    Code.SIMULATED_ONLY: "the law '{law}' lets robots collide: it runs on simulated robots only; ask for another "
    "behaviour, for example move_to_goal_bc",
    Code.UNFIT: "it cannot take part: {what}",
    Code.TOO_SLOW: "it is too slow: {what}",
    Code.NOT_REPEATED: "the intent expired after {after_s} s without a repetition",
}
"""The texts of this package; all others come with their codes from outside."""

Reader = Literal["shell", "page"]


class Advice(NamedTuple):
    """What to do, for a reader at a shell and for one at the console's page, who has buttons and maybe no shell."""

    shell: str
    page: str


_CLEAR = Advice("clear it with `fullswarm estop --clear`", "clear it with the button 'Clear the e-stop…'")
_BY_HAND = "until then robots can be driven by hand only"
ADVICE: dict[Code, Advice] = {
    Code.ESTOP: _CLEAR,
    Code.ESTOP_LATCHED: _CLEAR,
    Code.VERSION: Advice(
        f"update the older one (a robot with `fullswarm update`); {_BY_HAND}", f"update the older one; {_BY_HAND}"
    ),
}
"""What follows a text of :data:`TEXTS`, where it depends on the reader. On the wire stands the one for a shell."""

BRIEF: dict[str, str] = {
    Code.SILENT: "waits for others", Code.ESTOP: "e-stop", Code.ESTOP_LATCHED: "e-stop",
    Code.DRIVER: "driver not ready",
    Code.READING: "no sensor data", Code.HAZARD: "hazard", Code.LAW: "behaviour failed", Code.HUB: "hub lost",
    Code.CORE: "core silent", Code.STALE: "no commands", Code.BATTERY: "battery low", Code.CLOCK: "clock jumped",
    Code.POSE: "no pose", Code.GEOFENCE: "edge of the arena", Code.OVERLAP: "two in one place",
    Code.FRAME: "no common origin", Code.FOREIGN_FRAME: "no common origin", Code.VERSION: "other version",
    Code.UNSURE: "pose uncertain", Code.RANGES: "range sensor silent", Code.FLOOD: "message flood",
    Code.NO_WAY: "no way", Code.GOAL_CLOSED: "goal blocked", Code.DRIVER_FAILED: "driver failed",
    Code.DRIVER_STOPPED: "stopped by itself", Code.FAILED: "behaviour failed", Code.CLIFF: "cliff",
    Code.WHEEL_DROP: "wheel drop", Code.OVERCURRENT: "overcurrent", Code.CHARGER: "on its charger",
    Code.MOTORS_OFF: "motors off", Code.POSITION: "no position", Code.PORT_HELD: "port in use",
    Code.CHARGE_WAITS: "waits for a dock", Code.DOCKED: "not charged", Code.EXPIRED: "stick released",
    Code.STOPPED: "stopped by an operator", Code.ESTOP_ENGAGED: "stopped by the e-stop",
    Code.ESTOP_RELEASED: "e-stop cleared", Code.ARRIVED: "arrived", Code.HELD: "held by another operator",
    Code.SUPERSEDED: "replaced", Code.CAME_FIRST: "replaced", Code.OTHER_CORE: "other core",
    Code.VOIDED: "ask again", Code.UNFIT: "cannot take part", Code.TOO_SLOW: "too slow",
    Code.SIMULATED_ONLY: "simulated robots only",
}  # fmt: skip
"""Codes in a word or two, where there is no room for their texts."""

CHARGES = frozenset(
    {
        Code.CHARGE_WAITS, Code.CHARGE_GOING, Code.CHARGE_DOCKING, Code.CHARGING, Code.DOCKED, Code.CHARGE_LEAVING,
        Code.CHARGE_RETURNS,
    }
)  # fmt: skip
"""What a robot whose task is interrupted so that it charges is doing."""
DELIBERATE = CHARGES | {Code.STOPPED, Code.ESTOP_ENGAGED, Code.ESTOP_RELEASED, Code.EXPIRED, Code.ARRIVED}
"""A robot without a behaviour that stands for one of these was stopped on request, or is done: no cause for alarm."""
RESULTS = frozenset({Code.ARRIVED, Code.FAILED})
"""With these a behaviour ends itself on a robot."""

NOTHING: Mapping[str, str] = MappingProxyType({})


class Reason(NamedTuple):
    """One reason. False when there is none.

    Attributes
    ----------
    code : a :class:`Code`, or one that only a newer version knows
    text : for people
    parameters : what the text is about, by name
    """

    code: str = Code.NONE
    text: str = ""
    parameters: Mapping[str, str] = NOTHING

    def __bool__(self) -> bool:
        return self.code != "" or self.text != ""

    def __str__(self) -> str:
        return self.text


NONE = Reason()


def reason(code: Code, **parameters: str) -> Reason:
    """Return a reason with the text of the table.

    Raises
    ------
    KeyError
        The code has no text of its own, or a parameter of its text is missing.
    """
    return Reason(code, _worded(code, parameters, "shell"), parameters)


def _worded(code: Code, parameters: Mapping[str, str], reader: Reader) -> str:
    text, advice = TEXTS[code].format_map(parameters), ADVICE.get(code)
    return text if advice is None else f"{text}; {getattr(advice, reader)}"


def worded(why: Reason, reader: Reader, robots: Sequence[str] = ()) -> str:
    """Return a reason as it is on the wire for a reader, with the advice of its code that is meant for that reader.

    Parameters
    ----------
    robots : those that it concerns, if its text names them; the reason of several robots names its own
    """
    if why.code == Code.SEVERAL:
        return _several(why, reader)
    try:
        text = _worded(Code(why.code), why.parameters, reader) if why.code in ADVICE else why.text
    except (KeyError, ValueError):  # a newer version has other parameters: its text says them
        return why.text
    return f"{', '.join(robots)}: {text}" if robots and why.code in ADVICE else text


def _several(why: Reason, reader: Reader) -> str:
    """Return the reason of robots that refuse for different ones; their texts are joined, so codes say it anew."""
    if not any(code in ADVICE for code in why.parameters.values()):
        return why.text
    robots: dict[str, list[str]] = {}
    for robot, code in why.parameters.items():
        robots.setdefault(code, []).append(robot)
    return "; ".join(
        f"{', '.join(names)}: {_brief(code)}" if code not in ADVICE else worded(Reason(code), reader, names)
        for code, names in robots.items()
    )


def _brief(code: str) -> str:
    return BRIEF.get(code, "refused")


def given(text: str, code: str = "", parameters: Mapping[str, str] = NOTHING) -> Reason:
    """Return a reason with a text from outside, e.g. a driver's; an empty text is none."""
    return Reason(code or Code.GIVEN, text, parameters) if text else NONE


def joined(found: Mapping[str, Reason]) -> Reason:
    """Return the reason of several robots, by their names: each text once, and the code if it is the same for all."""
    codes = {robot: why.code for robot, why in found.items()}
    texts = dict.fromkeys(why.text for why in found.values())
    text = "; ".join(f"{', '.join(robot for robot in found if found[robot].text == each)}: {each}" for each in texts)
    if len(set(codes.values())) > 1:
        return Reason(Code.SEVERAL, text, codes)
    merged = {name: value for why in found.values() for name, value in why.parameters.items()}
    return Reason(next(iter(codes.values()), ""), text, merged)


def holds(code: str, parameters: Mapping[str, str], wanted: Code) -> bool:
    """Tell whether a reason as it is on the wire is, or for some robot is, `wanted`."""
    return code == wanted or (code == Code.SEVERAL and wanted in parameters.values())


def voided(why: Reason) -> Reason:
    """Return why a request that was ended for `why` may not start again."""
    return reason(Code.VOIDED, why=why.text)
