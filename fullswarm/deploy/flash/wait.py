"""Waits for the hello of robots whose cards were written: their first health report on the fleet's hub."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fullswarm import output
from fullswarm.operator import session

if TYPE_CHECKING:
    from fullswarm.operator.session import Session
    from fullswarm.operator.view import RobotRow

LOOK_S = 0.5
CONNECT_S = 5.0
ADVICE = (
    "put its card into this computer and read `fullswarm flash --report /dev/sdX`; does the base's hub listen where "
    "`hub.endpoint` says, for others too?"
)


@dataclass(frozen=True, slots=True)
class Hello:
    """What a robot said of itself."""

    robot: str
    host: str
    version: str
    state: str
    driver: str
    after_s: float


def check(target: session.Target) -> None:
    """Look whether there is a hub to wait at.

    Raises
    ------
    Unreachable
        None answers.
    """
    with session.connect(target, CONNECT_S):
        pass


def wait(target: session.Target, robots: Sequence[str], minutes: float) -> tuple[dict[str, Hello], list[str]]:
    """Return the robots that were received, printing each on stderr, and those that were not within `minutes`.

    Raises
    ------
    Unreachable
        No hub answers.
    """
    with session.connect(target, CONNECT_S) as line:
        heard = _listen(line, robots, minutes * 60.0)
    return heard, [robot for robot in robots if robot not in heard]


def _listen(line: Session, robots: Sequence[str], limit_s: float) -> dict[str, Hello]:
    from fullswarm.operator.view import FleetView

    view = FleetView(line.bus, line.keys, line.runtime, robots)
    heard: dict[str, Hello] = {}
    began_s = line.runtime.now_s()

    def look() -> None:
        for row in view.snapshot().robots:
            if row.robot in robots and row.robot not in heard and row.health is not None:
                heard[row.robot] = hello = _hello(row, line.runtime.now_s() - began_s)
                output.progress(
                    f"{hello.robot}: hello from {hello.host}, fullswarm {hello.version}, {hello.state}, "
                    f"{hello.driver}, after {hello.after_s:.0f} s"
                )
        if len(heard) == len(robots):
            line.finish()

    output.progress(f"waiting for {', '.join(robots)} on {line.hub}, {limit_s / 60:g} minutes at most; Ctrl-C ends it")
    line.runtime.every(LOOK_S, look)
    line.run(limit_s)
    view.close()
    return heard


def _hello(row: RobotRow, after_s: float) -> Hello:
    assert row.health is not None  # noqa: S101  (the caller has looked)
    return Hello(row.robot, row.host, row.version, row.health.lifecycle, row.health.driver, after_s)
