"""`fullswarm robots find`: asks every port what robot is there and prints what to write into a fleet file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

from rich.markup import escape

from fullswarm import output
from fullswarm.clock import MonotonicClock
from fullswarm.drivers.make import Scope, make_of, makes
from fullswarm.drivers.probe import ask
from fullswarm.drivers.probe.found import Found
from fullswarm.errors import ConfigError

if TYPE_CHECKING:
    from rich.table import Table

    from fullswarm.drivers.actuators import Actuator
    from fullswarm.drivers.base import Driver


def find(ports: Sequence[str], can: Sequence[str], udp: Sequence[str], *, as_json: bool) -> int:
    """Ask the ports, buses and UDP ports named, or all there are; return 0 when a robot answered, else 1.

    Raises
    ------
    ConfigError
        A bus or a UDP port is malformed.
    MissingExtra
        A bus was named and python-can is not installed.
    """
    answers = []
    for name, question in ask.questions(Scope(tuple(ports), tuple(can), tuple(udp)), MonotonicClock()):
        output.progress(f"asking {name} ...")
        answers.append(question())
    found = [robot for each in answers for robot in each.robots]
    if as_json:
        output.data_json({"robots": [_facts(each) for each in found], "ports": [asdict(each) for each in answers]})
    elif found:
        output.data_table(_table(found))
        output.data(f"\n{fleet_lines(found)}")
        for make in dict.fromkeys(make_of(each.url) for each in found if each.url):
            output.progress(f"what was proven for {make.robots}: {make.proven()}")
        for robot in found:
            if names := ", ".join(part.name for part in _actuators(robot)):
                output.progress(f"actuators of {robot.port}: {names}")
    for each in answers:
        if each.problem:
            product = f" ({each.product})" if each.product else ""
            output.progress(f"{each.port}{product}: {each.problem}")
    if not found:
        output.progress(_checks())
    return 0 if found else 1


def _facts(robot: Found) -> dict[str, object]:
    evidence = make_of(robot.url).evidence if robot.url else ()
    parts = [{"name": each.name, "takes": each.expected(), "doc": each.doc} for each in _actuators(robot)]
    return {**asdict(robot), "evidence": [asdict(each) for each in evidence], "actuators": parts}


def _actuators(robot: Found) -> tuple[Actuator, ...]:
    """Return what a robot has beside wheels; none where no driver fits, or its URL has yet to be completed."""
    try:
        driver: Driver = make_of(robot.url).driver_class()(robot.url)
    except ConfigError:
        return ()
    return driver.description.actuators


def fleet_lines(found: Sequence[Found]) -> str:
    """Return what to copy into a fleet file."""
    drivable = [each for each in found if each.url]
    lines = []
    for number, each in enumerate(drivable, 1):
        if each.advice:
            lines.append(f"# {each.advice}")
        lines += ["[[robot]]", f'id = "r{number}"', f'driver = "{each.url}"', ""]
    return "\n".join(lines) or "no driver fits any of these"


def _checks() -> str:
    """Return what to check when no robot was found."""
    each = dict.fromkeys(make.check for make in makes() if make.check)
    last = "ports that you may not use: `fullswarm doctor` prints the command"
    return "\n- ".join(["no robot found; what to check:", *each, last])


def _table(found: Sequence[Found]) -> Table:
    table = output.plain_table("port", "make", "model", "firmware", "battery", "note")
    for each in found:
        battery = "-" if each.battery is None else f"{each.battery:.0%}"
        note = each.note or (each.advice if not each.url else "")
        table.add_row(*map(escape, (each.port, each.make, each.model, each.firmware or "-", battery, note)))
    return table
