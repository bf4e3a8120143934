from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from fullswarm.bringup import doctor, machine
from fullswarm.bringup.checks import Check
from fullswarm.bringup.machine import EXTRAS, access, clocks, extras, network_time, python, resources
from fullswarm.bus.endpoint import DEFAULT_HUB
from fullswarm.config import SwarmConfig
from fullswarm.drivers.probe import ask
from fullswarm.drivers.probe.found import Asked, Found
from fullswarm.errors import Unreachable


def by_name(checks: list[Check]) -> dict[str, Check]:
    return {each.name: each for each in checks}


def test_this_interpreter_is_fine() -> None:
    assert python().status == "ok"


def test_a_missing_extra_is_a_warning_unless_the_fleet_needs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EXTRAS, "can", ("no_such_module",))
    unused = by_name(list(extras()))["extra [can]"]
    needed = by_name(list(extras(frozenset({"can"}))))["extra [can]"]
    assert (unused.status, needed.status) == ("warning", "failure")
    assert needed.mend == "pip install 'fullswarm[can]'"


def test_a_port_that_may_not_be_used_gets_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = tmp_path / "ttyUSB0"
    port.touch(mode=0o660)
    assert access(str(port)).status == "ok"
    monkeypatch.setattr(os, "access", lambda *_: False)
    port.chmod(0o600)
    check = access(str(port))
    assert check.status == "failure"
    assert check.mend.startswith("sudo chmod g+rw")
    assert access(str(tmp_path / "gone")).status == "failure"


def test_a_group_that_lacks_this_user_gets_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = tmp_path / "ttyUSB0"
    port.touch()
    port.chmod(0o660)
    facts = os.stat_result((0o100660, 0, 0, 0, 0, 20, 0, 0, 0, 0))
    monkeypatch.setattr(Path, "stat", lambda *_, **__: facts)
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setattr(machine, "_group", lambda _: "dialout")
    monkeypatch.setattr(machine, "_user", lambda: "ann")
    monkeypatch.setattr(machine, "_members", lambda _: [])
    assert access(str(port)).mend.startswith("sudo usermod -aG dialout ann")
    monkeypatch.setattr(machine, "_members", lambda _: ["ann"])
    assert access(str(port)).mend == "log out and in again"


@pytest.mark.parametrize(
    ("passed_s", "wall_passed_s", "wall_s", "status"),
    [
        (1.0, 1.001, 2e9, "ok"),
        (1.0, 1.3, 2e9, "warning"),
        (1.0, -3600.0, 2e9, "warning"),
        (0.0, 0.0, 2e9, "failure"),
        (1.0, 1.0, 1e6, "failure"),
    ],
)
def test_clocks(passed_s: float, wall_passed_s: float, wall_s: float, status: str) -> None:
    assert clocks(passed_s, wall_passed_s, wall_s).status == status


@pytest.mark.parametrize(("free", "status"), [(5e7, "failure"), (5e8, "warning"), (5e9, "ok")])
def test_disk(free: float, status: str, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = type("Usage", (), {"free": free})
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage)
    assert by_name(list(resources()))["disk"].status == status


def test_a_busy_processor_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getloadavg", lambda: (1000.0, 0.0, 0.0))
    assert by_name(list(resources()))["cpu"].status == "warning"


def test_without_systemd_network_time_is_not_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.which", lambda _: None)
    assert "unknown" in network_time().what


# ---------------------------------------------------------------- a fleet
@pytest.fixture(autouse=True)
def no_hub(monkeypatch: pytest.MonkeyPatch) -> None:
    class Bus:
        def __init__(self, *_: object, **__: object) -> None:
            self.closed = False

        def wait_connected(self, _: float) -> None:
            raise Unreachable("no hub answers")

        def close(self) -> None:
            self.closed = True

    monkeypatch.setattr("fullswarm.bus.zenoh_bus.ZenohBus", Bus)


def fleet(*robots: dict[str, object], hub: str = DEFAULT_HUB) -> SwarmConfig:
    return SwarmConfig.model_validate({"hub": {"endpoint": hub}, "robot": list(robots)})


def checks_of(config: SwarmConfig) -> list[Check]:
    found: list[Check] = []
    for each in config.robot:
        found += list(doctor._robot(config, each))
    return found


def test_robots_without_hardware_need_none() -> None:
    config = fleet({"id": "r1"}, {"id": "r2", "driver": "null://r2"}, {"id": "r3", "emulate": "create2"})
    assert [each.status for each in checks_of(config)] == ["ok"] * 3


def test_each_robot_with_trouble_says_which() -> None:
    port = "/dev/serial/by-id/no-such-robot"
    config = fleet(
        {"id": "r1", "driver": f"create://{port}"},
        {"id": "r2", "driver": f"create://{port}?model=create1"},
        {"id": "r3", "driver": "create://oops"},
        {"id": "r4", "driver": "crate:///dev/ttyUSB0"},
    )
    checks = checks_of(config)
    assert [each.status for each in checks] == ["failure"] * 6  # two for each of the two that share a port
    told = [(each.name, each.what) for each in checks]
    assert ("robot r1", f"{port} does not exist") in told
    assert ("robot r1", f"{port} is also the port of r2") in told
    assert ("robot r3", "this names no serial port") in told
    assert any(name == "robot r4" and "no driver for 'crate'" in what for name, what in told)


def test_a_base_without_a_watchdog_is_warned_of(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_answer", lambda *_: iter(()))
    url = "can+odrive://can0?left=1&right=2&wheel_radius=0.05&base=0.3"
    (check,) = checks_of(fleet({"id": "r1", "driver": url}))
    assert (check.status, "watchdog" in check.what) == ("warning", True)
    assert checks_of(fleet({"id": "r1", "driver": f"{url}&watchdog=0.5"})) == []


def test_a_weak_battery_is_a_warning_and_a_held_port_too(monkeypatch: pytest.MonkeyPatch) -> None:
    found = Found("p", "iRobot", "Create 2", battery=0.1, url="create:///dev/p?model=create2")
    monkeypatch.setattr(ask, "ask_url", lambda _: Asked("p", robots=(found,)))
    (check,) = doctor._answer("robot r1", "create:///dev/p")
    assert (check.status, check.mend) == ("warning", "charge it")
    assert "battery 10%" in check.what
    (check,) = doctor._answer("robot r1", "mavlink+serial:///dev/p")
    assert (check.status, check.mend) == ("failure", found.url)
    monkeypatch.setattr(ask, "ask_url", lambda _: Asked("p", problem="agent (pid 7) has it", held=True))
    assert [each.status for each in doctor._answer("robot r1", "create:///dev/p")] == ["warning"]
    monkeypatch.setattr(ask, "ask_url", lambda _: Asked("p", problem="nobody answers"))
    assert [each.status for each in doctor._answer("robot r1", "create:///dev/p")] == ["failure"]


def test_the_hub_of_this_machine_may_be_down_another_may_not() -> None:
    assert doctor._hub(fleet()).status == "warning"
    assert doctor._hub(fleet(hub="tcp/192.0.2.1:7447")).status == "failure"


def test_what_a_fleet_needs_decides_about_extras() -> None:
    config = fleet({"id": "a", "emulate": "rover"}, {"id": "b", "driver": "can+vesc://can0"}, {"id": "c"})
    assert doctor._needed_extras(config) == {"sim", "mavlink", "can"}
    assert doctor._needed_extras(None) == frozenset()


def test_the_exit_code_follows_the_worst(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    lines = [Check("a", "ok", "fine"), Check("b", "warning", "hm", "mend b")]
    monkeypatch.setattr(doctor, "_checks", lambda _: iter(lines))
    assert doctor.run(None, as_json=False) == 0
    shown = capsys.readouterr()
    assert shown.out.splitlines() == ["ok       a: fine", "warning  b: hm", "         fix: mend b"]
    lines.append(Check("c", "failure", "broken"))
    assert doctor.run(None, as_json=True) == 1
    document = json.loads(capsys.readouterr().out)
    assert document["ok"] is False
    assert document["checks"][1]["mend"] == "mend b"
