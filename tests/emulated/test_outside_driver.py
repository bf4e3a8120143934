"""The example of an outside package, as its own users meet it: installed elsewhere, found by its URL, checked there."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fullswarm import registry
from fullswarm.drivers.base import Twist
from fullswarm.testing import Rig, check_driver

PACKAGE = Path(__file__).parents[2] / "examples" / "outside_driver"


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """Return a folder that holds what pip would put there: the package and its entry points."""
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (tmp_path / "fullswarm_acme").symlink_to(PACKAGE / "fullswarm_acme")
    record = tmp_path / f"fullswarm_acme-{project['version']}.dist-info"
    record.mkdir()
    head = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    (record / "METADATA").write_text(head, encoding="utf-8")
    lines = [f"[{group}]\n{name} = {target}\n" for group, table in project["entry-points"].items()
             for name, target in table.items()]  # fmt: skip
    (record / "entry_points.txt").write_text("".join(lines), encoding="utf-8")
    return tmp_path


def test_its_own_tests_pass_and_the_check_leaves_nothing_out(installed: Path) -> None:
    paths = os.pathsep.join([str(installed), str(PACKAGE), str(PACKAGE.parents[1])])
    command = [sys.executable, "-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider", "tests"]
    run = subprocess.run(
        command, cwd=PACKAGE, env=os.environ | {"PYTHONPATH": paths}, check=False, capture_output=True, text=True,
        timeout=120,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout + run.stderr
    assert "passed" in run.stdout
    assert "skipped" not in run.stdout


def test_one_command_checks_it_with_all_its_hands(installed: Path) -> None:
    command = [sys.executable, "-m", "fullswarm", "robots", "check", "--rig", "fullswarm_acme.rig:rig", "--json"]
    paths = os.pathsep.join([str(installed), str(PACKAGE.parents[1])])
    run = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": paths}, check=False, capture_output=True, text=True, timeout=120
    )
    assert run.returncode == 0, run.stdout + run.stderr
    told = json.loads(run.stdout)
    assert told["skipped"] == {}
    assert "after open(), deactivate() and close()" in told["checked"].values()


@pytest.fixture
def emulator(installed: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.syspath_prepend(str(installed))
    with importlib.import_module("fullswarm_acme.emulator").AcmeEmulator() as robot:
        yield robot
    for name in [each for each in sys.modules if each.startswith("fullswarm_acme")]:
        del sys.modules[name]


def test_a_robot_that_stops_later_than_its_driver_claims_is_found_out(
    emulator: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = registry.driver_class(emulator.url)
    session = importlib.import_module("fullswarm_acme.emulator")
    monkeypatch.setattr(session, "WATCHDOG_S", 5.0)  # of the firmware; the driver's description still says 0.5 s
    monkeypatch.setattr("fullswarm.testing.driver.check_contract", lambda *_: None)
    monkeypatch.setattr("fullswarm.testing.driver.check_claims", lambda _: None)
    monkeypatch.setattr("fullswarm.testing.driver.check_faults", lambda _: None)

    def speed() -> Twist:
        now = emulator.body.state()
        return Twist(now.speed_m_s, now.turn_rad_s)

    rig = Rig(make=lambda: kind(emulator.url), body_speed=speed, other_process=True)
    with pytest.raises(AssertionError, match=r"still moves .* paused; its description says watchdog_s=0\.5"):
        check_driver(rig, settle_s=1.0)
