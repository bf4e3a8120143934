"""The example of an outside package, as its own users meet it: installed elsewhere, found by its URL, checked there."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from fullswarm import registry
from fullswarm.clock import MonotonicClock
from fullswarm.drivers.base import Lifecycle, Twist
from fullswarm.drivers.fleet_file import load_fleet
from fullswarm.drivers.guardian import guarded
from fullswarm.errors import ConfigError
from fullswarm.launch.network import emulated_url, on_free_ports
from fullswarm.launch.world import start_emulator
from fullswarm.simulation.bodies import FreeBody
from fullswarm.testing import Rig, check_driver
from tests.emulated import outside
from tests.waiting import until

CLOCK = MonotonicClock()
PACKAGE = outside.EXAMPLES / "outside_driver"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return outside.install(PACKAGE, "fullswarm_acme", tmp_path_factory.mktemp("installed"))


def paths(installed: Path) -> dict[str, str]:
    return outside.paths(installed, PACKAGE)


def python(installed: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return outside.python(installed, PACKAGE, *arguments)


def fullswarm(installed: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return python(installed, "fullswarm", *arguments)


LONG = {
    "own tests": ("pytest", "-q", "-rs", "-p", "no:cacheprovider", "tests"),
    "robots check": ("fullswarm", "robots", "check", "--emulated", "scout", "--json"),
}


@pytest.fixture(scope="module", autouse=True)
def runs(installed: Path) -> Iterator[dict[str, Future[subprocess.CompletedProcess[str]]]]:
    """Run what takes long beside the tests: it waits for real time most of it."""
    with ThreadPoolExecutor(len(LONG)) as pool:
        yield {name: pool.submit(python, installed, *arguments) for name, arguments in LONG.items()}


def test_every_command_knows_the_outside_make_as_a_built_in_one(installed: Path, tmp_path: Path) -> None:
    emulate = [sys.executable, "-m", "fullswarm", "emulate", "acme", "--json"]
    with subprocess.Popen(
        emulate, env=paths(installed), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True
    ) as scout:
        try:
            assert scout.stdout is not None
            url = json.loads(scout.stdout.readline())["url"]
            found = fullswarm(installed, "robots", "find", "--json")
            robot = next(each for each in json.loads(found.stdout)["robots"] if each["make"] == "Acme")
            assert (robot["url"], robot["battery"]) == (url, 1.0)
            assert [each["proof"] for each in robot["evidence"]] == ["emulated"]
            tested = fullswarm(installed, "robots", "test", url, "--yes", "--json")
            assert tested.returncode == 0, tested.stdout + tested.stderr
            checked = fullswarm(installed, "robots", "check", url, "--yes", "--json")
            assert checked.returncode == 0, checked.stdout + checked.stderr
            fleet = tmp_path / "fleet.toml"
            robots = f'[[robot]]\nid = "a1"\ndriver = "{url}"\n[[robot]]\nid = "a2"\nemulate = "scout"\n'
            fleet.write_text(robots, encoding="utf-8")
            looked = json.loads(fullswarm(installed, "doctor", str(fleet), "--json").stdout)
            told = {each["name"]: each for each in looked["checks"]}
            assert "never on hardware" in told["evidence for acme"]["what"]
            assert (told["robot a1"]["status"], "Acme Scout" in told["robot a1"]["what"]) == ("ok", True)
            assert told["robot a2"]["what"] == "emulated by the world: scout"
        finally:
            scout.terminate()


def test_a_fleet_file_emulates_it(installed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(installed))
    fleet, body = tmp_path / "fleet.toml", FreeBody()
    fleet.write_text('[[robot]]\nid = "a1"\nemulate = "scout"\n', encoding="utf-8")
    config = on_free_ports(load_fleet(fleet), prefer_configured=False)
    url = emulated_url(config, config.robot[0])
    robot = start_emulator("scout", url, body)
    driver = guarded(registry.driver_class(url)(url))
    try:
        driver.open()
        until(lambda: driver.state is Lifecycle.READY)
        driver.activate()
        until(lambda: driver.state is Lifecycle.ACTIVE)
        driver.command(Twist(0.2, 0.0))
        until(lambda: body.state().speed_m_s > 0.1)
    finally:
        driver.close()
        robot.close()
    fleet.write_text('[[robot]]\nid = "a1"\nemulate = "scuot"\n', encoding="utf-8")
    with pytest.raises(ConfigError, match="did you mean 'scout'"):
        load_fleet(fleet)
    for name in [each for each in sys.modules if each.startswith("fullswarm_acme")]:
        del sys.modules[name]


DRIVES = """
import sys, time
from fullswarm import registry
from fullswarm.drivers.base import Lifecycle, Twist
from fullswarm.drivers.guardian import guarded
driver = guarded(registry.driver_class(sys.argv[1])(sys.argv[1]))
driver.open()
while True:
    if driver.state is Lifecycle.READY:
        driver.activate()
    driver.command(Twist(0.5, 0.0))
    time.sleep(0.05)
"""


def test_its_guardian_stops_it_when_its_driver_is_killed(emulator: Any, installed: Path) -> None:
    command = [sys.executable, "-c", DRIVES, emulator.url]
    with subprocess.Popen(command, env=paths(installed), stdin=subprocess.DEVNULL) as driver:
        try:
            until(lambda: emulator.body.state().speed_m_s > 0.45, 20.0)
        finally:
            driver.kill()
        killed_s = CLOCK.now_s()
        until(lambda: emulator.body.state().speed_m_s == 0.0)
        # Braking from 0.5 m/s takes 0.25 s. Without its guardian the robot drives on for a second before that.
        assert CLOCK.now_s() - killed_s < 0.9
        until(lambda: not emulator.motors_on)


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
    monkeypatch.setattr(session, "WATCHDOG_S", 5.0)  # of the firmware; the driver's description still says 1 s
    monkeypatch.setattr("fullswarm.testing.driver.check_contract", lambda *_: None)
    monkeypatch.setattr("fullswarm.testing.driver.check_claims", lambda _: None)
    monkeypatch.setattr("fullswarm.testing.driver.check_actuators", lambda *_: None)
    monkeypatch.setattr("fullswarm.testing.driver.check_faults", lambda _: None)

    def speed() -> Twist:
        now = emulator.body.state()
        return Twist(now.speed_m_s, now.turn_rad_s)

    rig = Rig(make=lambda: kind(emulator.url), body_speed=speed, other_process=True)
    with pytest.raises(AssertionError, match=r"still moves .* paused; its description claims watchdog_s=1\.0"):
        check_driver(rig, settle_s=1.0)


def test_its_own_tests_pass_and_the_check_leaves_nothing_out(
    runs: dict[str, Future[subprocess.CompletedProcess[str]]],
) -> None:
    run = runs["own tests"].result()
    assert run.returncode == 0, run.stdout + run.stderr
    assert "passed" in run.stdout
    assert "skipped" not in run.stdout


def test_one_command_checks_it_with_all_its_hands(
    runs: dict[str, Future[subprocess.CompletedProcess[str]]],
) -> None:
    run = runs["robots check"].result()
    assert run.returncode == 0, run.stdout + run.stderr
    told = json.loads(run.stdout)
    assert told["skipped"] == {}
    assert "after open(), deactivate() and close()" in told["checked"].values()
