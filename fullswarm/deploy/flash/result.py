"""Finds out what came of a flashed card: the robot's first health report, or the report that its first boot left."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from fullswarm import output
from fullswarm.deploy.flash import fat
from fullswarm.deploy.flash.fat import boot_volume
from fullswarm.deploy.flash.payload import FOLDER, REPORT
from fullswarm.deploy.flash.write import explain
from fullswarm.errors import ConfigError
from fullswarm.operator import session

if TYPE_CHECKING:
    from fullswarm.operator.session import Session
    from fullswarm.operator.view import RobotRow

LOOK_S = 0.5
CONNECT_S = 5.0
ADVICE = (
    "put its card into this computer and read `fullswarm flash --report /dev/sdX`; does the base's hub listen at "
    "`hub.endpoint`, for other computers too?"
)
OK = ": OK"


@dataclass(frozen=True, slots=True)
class FirstReport:
    """The first health report of a robot."""

    robot: str
    host: str
    version: str
    state: str
    driver: str
    after_s: float


def check_hub_answers(target: session.Target) -> None:
    """Check that the hub answers.

    Raises
    ------
    Unreachable
        It does not answer.
    """
    with session.connect(target, CONNECT_S):
        pass


def wait_for_robots(
    target: session.Target, robots: Sequence[str], minutes: float
) -> tuple[dict[str, FirstReport], list[str]]:
    """Return the robots that were received, printing each on stderr, and those that did not report within `minutes`.

    Raises
    ------
    Unreachable
        No hub answers.
    """
    with session.connect(target, CONNECT_S) as line:
        reports = _listen(line, robots, minutes * 60.0)
    return reports, [robot for robot in robots if robot not in reports]


def _listen(line: Session, robots: Sequence[str], limit_s: float) -> dict[str, FirstReport]:
    from fullswarm.operator.view import FleetView

    view = FleetView(line.bus, line.keys, line.runtime, robots)
    reports: dict[str, FirstReport] = {}
    began_s = line.runtime.now_s()

    def look() -> None:
        for row in view.snapshot().robots:
            if row.robot in robots and row.robot not in reports and row.health is not None:
                reports[row.robot] = report = _first_report(row, line.runtime.now_s() - began_s)
                output.progress(
                    f"{report.robot}: first report from {report.host}, fullswarm {report.version}, {report.state}, "
                    f"{report.driver}, after {report.after_s:.0f} s"
                )
        if len(reports) == len(robots):
            line.finish()

    output.progress(f"waiting for {', '.join(robots)} on {line.hub}, {limit_s / 60:g} minutes at most; Ctrl-C ends it")
    line.runtime.every(LOOK_S, look)
    line.run(limit_s)
    view.close()
    return reports


def _first_report(row: RobotRow, after_s: float) -> FirstReport:
    assert row.health is not None  # noqa: S101  (the caller has looked)
    return FirstReport(row.robot, row.host, row.version, row.health.lifecycle, row.health.driver, after_s)


# ---------------------------------------------------------------- fullswarm flash --report
def print_report(place: Path, *, as_json: bool) -> int:
    """Print the report of a card, an image, or a folder where the boot partition is mounted; 1: it is no success.

    Raises
    ------
    ConfigError
        It cannot be read, or holds no report.
    """
    text = read_report(place)
    good = text.splitlines()[0].endswith(OK) if text else False
    if as_json:
        output.data_json({"place": str(place), "ok": good, "report": text})
    else:
        output.data(text.rstrip())
    return 0 if good else 1


def read_report(place: Path) -> str:
    """Return the report's text.

    Raises
    ------
    ConfigError
        It cannot be read, or holds no report.
    """
    if place.is_dir():
        content, ours = _from_folder(place)
    else:
        content, ours = _from_disk(place)
    if content is None and not ours:
        hint = "is it the right card? `lsblk` shows what is there"
        raise ConfigError("was not written by fullswarm", where=str(place), hint=hint)
    if content is None:
        hint = (
            "power (a good supply, its LED), the right board for this image, the card fully inserted; "
            "a screen shows how far it boots"
        )
        raise ConfigError("no report: the robot did not reach its first boot", where=str(place), hint=hint)
    return content.decode("utf-8", "replace")


def _from_folder(folder: Path) -> tuple[bytes | None, bool]:
    file = folder / REPORT
    return (file.read_bytes() if file.is_file() else None), (folder / FOLDER).is_dir()


def _from_disk(disk: Path) -> tuple[bytes | None, bool]:
    try:
        number = os.open(disk, os.O_RDONLY | os.O_CLOEXEC)
    except OSError as error:
        raise explain(error, disk, 0) from error
    try:
        volume = boot_volume(number, str(disk))
    finally:
        os.close(number)
    return fat.get_file(disk, volume, REPORT), fat.get_file(disk, volume, f"{FOLDER}/card.env") is not None
