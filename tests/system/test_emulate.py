"""``emulate``, ``robots find``, ``robots test`` and ``doctor`` as a user runs them: real processes, real ports."""

from __future__ import annotations

import json
import math
import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pytest

from fullswarm.clock import MonotonicClock
from fullswarm.drivers.lidar.sensor import LidarSensor
from fullswarm.drivers.lidar.settings import parse_url
from fullswarm.drivers.ranges import sensor_of
from tests.waiting import until

CLOCK = MonotonicClock()
# Whoever runs these tests under `nohup` passes on that a closed terminal is nothing.
COMMAND = ["env", "--default-signal=HUP", sys.executable, "-m", "fullswarm"]
START_S, DONE_S = 30.0, 60.0


class Process:
    """A running command, its stdin and both outputs line by line; killed at the end whatever happens."""

    def __init__(self, *arguments: str) -> None:
        self._process = subprocess.Popen(
            [*COMMAND, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        self.errors = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.communicate()

    def first_line(self) -> Any:
        """Return the JSON document of the first line on stdout."""
        assert self._process.stdout is not None
        ready, _, _ = select.select([self._process.stdout], [], [], START_S)
        assert ready, "nothing on stdout"
        return json.loads(self._process.stdout.readline())

    def say(self, line: str) -> None:
        """Type a line."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n".encode())
        self._process.stdin.flush()

    def tells(self, text: str) -> str:
        """Wait until stderr holds `text`; return stderr up to there and forget it."""
        assert self._process.stderr is not None
        end_s = CLOCK.now_s() + START_S
        while text not in self.errors:
            left_s = end_s - CLOCK.now_s()
            ready, _, _ = select.select([self._process.stderr], [], [], max(0.0, left_s))
            data = os.read(self._process.stderr.fileno(), 65536) if ready else b""
            assert data, f"'{text}' was not told, only: {self.errors}"
            self.errors += data.decode()
        end = self.errors.index(text) + len(text)
        told, self.errors = self.errors[:end], self.errors[end:]
        return told

    def interrupt(self, number: signal.Signals = signal.SIGINT) -> None:
        """Press Ctrl-C, or send another signal."""
        self._process.send_signal(number)

    def end(self) -> tuple[int, str, str]:
        """Wait for the end; return exit code, the rest of stdout, the rest of stderr."""
        out, errors = self._process.communicate(timeout=DONE_S)
        told = self.errors + errors.decode()
        assert "Traceback" not in told
        return self._process.returncode, out.decode(), told


def fullswarm(*arguments: str) -> tuple[int, str, str]:
    with Process(*arguments) as process:
        return process.end()


@pytest.fixture
def create(tmp_path: Path) -> Iterator[tuple[Process, str]]:
    """An emulated Create 2 and its port."""
    port = str(tmp_path / "create")
    with Process("emulate", "create", "--port", port, "--json") as process:
        announced = process.first_line()
        assert announced["url"] == f"create://{port}?model=create2"
        assert announced["clients"]["pycreate2"] == f"Create2(port='{port}', baud=115200)"
        yield process, port


def test_an_emulated_create_is_found_with_its_battery_and_quits(create: tuple[Process, str]) -> None:
    process, port = create
    process.say("battery 0.25")
    process.tells("done: battery 0.25")
    code, out, _ = fullswarm("robots", "find", "--port", port, "--json")
    (robot,) = json.loads(out)["robots"]
    assert (code, robot["make"]) == (0, "iRobot")
    assert robot["battery"] == pytest.approx(0.25, abs=0.01)
    code, out, _ = fullswarm("robots", "find", "--port", port)
    assert f'driver = "create://{port}?model=create2"' in out.splitlines()  # ready to copy, whatever the width
    process.say("fly")
    process.tells("no command 'fly'")
    process.say("help")
    process.tells("wheel_drop on|off")
    process.say("unplug")
    process.tells("done: unplug")
    code, out, told = fullswarm("robots", "find", "--port", port)
    assert (code, out) == (1, "")
    assert "no such port" in told
    assert "what to check" in told
    process.say("quit")
    assert process.end()[0] == 0
    assert not Path(port).exists()


def test_each_make_passes_the_guided_test_through_its_real_port(tmp_path: Path) -> None:
    wishes = (
        ("create", "--port", str(tmp_path / "create")),
        ("odrive", "--port", str(tmp_path / "odrive")),
        ("vesc", "--port", str(tmp_path / "vesc")),
        ("mavlink", "--listen", "tcp://127.0.0.1:0"),
    )
    with ExitStack() as stack:
        robots = [stack.enter_context(Process("emulate", *wish, "--json")) for wish in wishes]
        urls = [robot.first_line()["url"] for robot in robots]
        tests = [stack.enter_context(Process("robots", "test", url, "--yes", "--json")) for url in urls]
        for test in tests:
            code, out, told = test.end()
            result = json.loads(out)
            verdicts = {step["name"]: step["verdict"] for step in result["steps"]}
            assert (code, result["passed"]) == (0, True), told
            for name in ("forwards", "backwards", "left", "right", "silence stops it", "close"):
                assert verdicts[name] == "passed"


@pytest.mark.parametrize("kind", ["ld19", "rplidar"])
def test_an_emulated_lidar_is_read_as_the_printed_line_says_and_can_be_carried(kind: str, tmp_path: Path) -> None:
    port = str(tmp_path / "lidar")
    with Process("emulate", kind, "--port", port, "--json") as process:
        announced = process.first_line()
        assert announced["clients"]["fleet file"] == f'ranges = "{kind}://{port}"'
        lidar = LidarSensor(parse_url(announced["url"]))
        try:
            lidar.start()
            until(lambda: measured_m(lidar, 0.0) == pytest.approx(3.0, abs=0.02), START_S)
            assert measured_m(lidar, math.pi / 2) == pytest.approx(2.0, abs=0.02)
            process.say("push 1 0")
            until(lambda: measured_m(lidar, 0.0) == pytest.approx(2.0, abs=0.02), START_S)
            assert measured_m(lidar, math.pi) == pytest.approx(4.0, abs=0.02)
            process.say("help")
            assert "press the bumper" not in process.tells("hold the lidar's motor")
            process.say("block on")
            until(lambda: bool(lidar.trouble), START_S)
            process.say("bump on")
            process.tells("'bump' is not supported")
        finally:
            lidar.close()
        process.say("quit")
        assert process.end()[0] == 0
    code, _, told = fullswarm("emulate", kind, "--model", "a1")
    assert (code, "means nothing to an emulated" in told) == (2, True), told


def test_emulated_time_of_flight_sensors_are_read_as_the_printed_line_says(tmp_path: Path) -> None:
    port = str(tmp_path / "tof")
    with Process("emulate", "vl53l1x", "--port", port, "--json") as process:
        announced = process.first_line()
        assert announced["url"].startswith(f"vl53l1x://{port}?sensor=0@")
        assert announced["clients"]["fleet file"] == f'ranges = "{announced["url"]}"'
        sensors = sensor_of(announced["url"])
        try:
            sensors.start()
            until(lambda: [each.distances_m[0] for each in sensors.scans] == 5 * [math.inf], START_S)
            process.say("push 2.1 0")
            until(lambda: sensors.scans[2].distances_m[0] == pytest.approx(0.8, abs=0.01), START_S)
            process.say("sensor 2 off")
            until(lambda: "sensor 2 on" in sensors.trouble and "does not answer" in sensors.trouble, START_S)
            process.say("sensor 2 on")
            until(lambda: not sensors.trouble, START_S)
            process.say("sensor 9 off")
            process.tells("no sensor '9'")
            process.say("block on")
            process.tells("'block' is not supported")
        finally:
            sensors.close()
    one = f"vl53l1x://{tmp_path / 'one'}?sensor=0x30@0.1,0,0"
    with Process("emulate", "vl53l1x", "--url", one, "--json") as process:
        assert process.first_line()["url"] == one


def measured_m(lidar: LidarSensor, angle_rad: float) -> float:
    """Return what a lidar has measured in a direction, m; NaN: nothing yet."""
    if not lidar.scans:
        return math.nan
    scan = lidar.scans[0]
    away_rad = np.abs([math.remainder(each - angle_rad, math.tau) for each in scan.angles_rad])
    return float(scan.distances_m[int(np.argmin(away_rad))])


def test_a_robot_at_a_cliff_does_not_pass(tmp_path: Path) -> None:
    port = str(tmp_path / "create")
    with Process("emulate", "create", "--port", port, "--cliff", "--json") as process:
        url = process.first_line()["url"]
        code, out, _ = fullswarm("robots", "test", url, "--yes")
    assert code == 1
    assert "FAILED" in out
    assert "cliff" in out


def test_ctrl_c_stops_the_wheels_first(create: tuple[Process, str]) -> None:
    process, port = create
    with Process("robots", "test", f"create://{port}", "--yes") as test:
        test.tells("passed   forwards")
        process.tells("-0.10 m/s")  # backwards has begun
        test.interrupt()
        code, _, told = test.end()
    assert code == 130
    assert "stopping the wheels" in told
    process.tells("PASSIVE +0.00 m/s +0.00 rad/s")


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGKILL])
def test_a_guided_test_that_is_hung_up_or_killed_leaves_the_wheels_at_zero(
    create: tuple[Process, str], number: signal.Signals
) -> None:
    process, port = create
    with Process("robots", "test", f"create://{port}", "--yes") as test:
        process.tells("-0.10 m/s")  # backwards has begun
        test.interrupt(number)
        process.tells("PASSIVE +0.00 m/s +0.00 rad/s")
        code, _, told = test.end()
    assert code == (130 if number == signal.SIGHUP else -signal.SIGKILL)
    assert ("stopping the wheels" in told) == (number == signal.SIGHUP)


IN_A_TERMINAL = """
import fcntl, os, signal, sys, termios
signal.signal(signal.SIGHUP, signal.SIG_DFL)
fcntl.ioctl(0, termios.TIOCSCTTY)
os.execv(sys.executable, [sys.executable, "-m", "fullswarm", *sys.argv[1:]])
"""


def test_a_closed_terminal_stops_the_wheels(create: tuple[Process, str]) -> None:
    """As when an SSH connection drops: the signal comes, and nothing can be written any more."""
    process, port = create
    ours, theirs = os.openpty()
    command = [sys.executable, "-c", IN_A_TERMINAL, "robots", "test", f"create://{port}", "--yes"]
    with subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True) as test:
        os.close(theirs)
        try:
            process.tells("-0.10 m/s")
            os.close(ours)
            process.tells("PASSIVE +0.00 m/s +0.00 rad/s")
            test.wait(DONE_S)
        finally:
            test.kill()


def test_a_pulled_cable_fails_the_test_without_a_stack_trace(create: tuple[Process, str]) -> None:
    process, port = create
    with Process("robots", "test", f"create://{port}", "--yes") as test:
        test.tells("passed   activate")
        process.say("unplug")
        code, out, _ = test.end()
    assert code == 1
    assert "FAILED" in out


def test_the_operator_presses_what_the_test_asks_for(create: tuple[Process, str]) -> None:
    robot, port = create
    with Process("robots", "test", f"create://{port}") as test:
        test.tells("Is it safe")
        test.say("y")
        for asked, mishap, verdict in (
            ("Press the front bumper", "bump", "passed   bumper"),
            ("Lift the robot", "wheel_drop", "passed   cliff, wheel drop"),
        ):
            test.tells(asked)
            robot.say(f"{mishap} on")
            test.tells("Let go")
            robot.say(f"{mishap} off")
            test.tells(verdict)
        test.tells("passed   activate")
        test.interrupt()
        assert test.end()[0] == 130


def test_nobody_or_somebody_who_says_no_moves_nothing(create: tuple[Process, str]) -> None:
    process, port = create
    with Process("robots", "test", f"create://{port}") as test:
        test.tells("Is it safe")
        test.say("no")
        code, out, told = test.end()
    assert (code, out) == (1, "")
    assert "nothing moved" in told
    code, _, told = fullswarm("robots", "test", f"create://{port}")  # stdin ends at once
    assert code == 2
    assert "--yes" in told
    process.interrupt()
    code, _, told = process.end()
    assert code == 130
    assert "PASSIVE" not in told  # nobody has even called the robot


def test_a_usage_error_is_one_clear_line() -> None:
    code, out, told = fullswarm("emulate", "create", "--do", "fly on")
    assert (code, out) == (2, "")
    assert "no command 'fly'" in told


def test_robots_without_a_verb_still_lists_the_swarm() -> None:
    code, _, told = fullswarm("robots", "--hub", "tcp/127.0.0.1:9")
    assert code == 3
    assert "no hub answers" in told
    code, out, _ = fullswarm("robots", "--help")
    assert code == 0
    assert all(word in out for word in ("find", "test", "--json", "--hub"))


def test_the_doctor_fails_on_a_broken_fleet_and_says_what_mends_it(tmp_path: Path) -> None:
    fleet = tmp_path / "fleet.toml"
    fleet.write_text(
        '[hub]\nendpoint = "tcp/127.0.0.1:9"\n[[robot]]\nid = "r1"\ndriver = "null://r1"\n'
        '[[robot]]\nid = "r2"\ndriver = "create:///dev/ttyUSB77"\n'
    )
    code, out, _ = fullswarm("doctor", str(fleet), "--json")
    assert code == 1
    document = json.loads(out)
    checks = {check["name"]: check for check in document["checks"]}
    assert document["ok"] is False
    assert [checks[name]["status"] for name in ("python", "hub", "robot r1", "robot r2")] == [
        "ok", "warning", "ok", "failure",
    ]  # fmt: skip
    assert checks["robot r2"]["what"] == "/dev/ttyUSB77 does not exist"
    assert "fullswarm robots find" in checks["robot r2"]["mend"]
