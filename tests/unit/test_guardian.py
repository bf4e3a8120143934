"""The guardian of a serial port: whoever is paused or killed, the robot is told to stop. Real processes, real ports."""

from __future__ import annotations

import errno
import os
import select
import signal
import subprocess
import sys
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn

import pytest

from fullswarm import registry
from fullswarm.clock import MonotonicClock
from fullswarm.drivers.base import Description, Lifecycle, Limits, Twist
from fullswarm.drivers.create_oi.driver import CreateDriver
from fullswarm.drivers.create_oi.protocol import Mode
from fullswarm.drivers.create_oi.session import PARK
from fullswarm.drivers.fleet import OneRobot
from fullswarm.drivers.guardian import SILENCE_S, GuardedPort, Guardian, HolderLost, StopPlan, guarded
from fullswarm.drivers.guardian_process import REPEATS
from fullswarm.emulators.create_oi.emulator import CreateEmulator
from fullswarm.errors import DriverError

CLOCK = MonotonicClock()
LOOK_S = 0.15
"""For a busy machine to run us."""
START_S = 15.0
PACE_M_S = 0.2
ODRIVE = "left=1&right=2&wheel_radius=0.05&base=0.3"
VESC = f"{ODRIVE}&gear=10&pole_pairs=7"


def until(condition: Callable[[], bool], timeout_s: float, each: Callable[[], object] = lambda: None) -> float:
    began_s = CLOCK.now_s()
    while not condition():
        assert CLOCK.now_s() - began_s < timeout_s, f"not within {timeout_s} s"
        each()
        select.select([], [], [], 0.005)
    return CLOCK.now_s() - began_s


def wheels(robot: CreateEmulator) -> tuple[int, int]:
    return robot.firmware.wheels_mm_s


@contextmanager
def puppet(robot: CreateEmulator) -> Iterator[subprocess.Popen[bytes]]:
    """Drive the robot from a process of its own, behind a guardian."""
    kind, paths = CreateDriver, os.pathsep.join(each for each in sys.path if each)
    command = [
        sys.executable, "-m", "fullswarm.testing.drives_on", f"{kind.__module__}:{kind.__qualname__}",
        f"{robot.url}&guardian=1", repr(PACE_M_S),
    ]  # fmt: skip
    with subprocess.Popen(command, env=os.environ | {"PYTHONPATH": paths}, stdin=subprocess.DEVNULL) as process:
        try:
            until(lambda: wheels(robot) != (0, 0), START_S)
            yield process
        finally:
            process.kill()


def guardians(robot: CreateEmulator) -> list[int]:
    """Processes other than this one that hold the robot's port."""
    device, found = Path(robot.port).resolve(), []
    for entry in Path("/proc").glob("[0-9]*"):
        if int(entry.name) == os.getpid():
            continue
        with suppress(OSError):
            if any(each.readlink() == device for each in (entry / "fd").iterdir()):
                found.append(int(entry.name))
    return found


def test_a_driver_that_is_killed() -> None:
    with CreateEmulator() as robot, puppet(robot) as process:
        [guardian] = guardians(robot)
        assert guardian != process.pid
        process.kill()
        assert until(lambda: wheels(robot) == (0, 0), 5.0) < LOOK_S  # a closed socket, no silence to wait for
        until(lambda: robot.mode is Mode.PASSIVE, 1.0)
        until(lambda: not guardians(robot), 2.0)


def test_a_driver_that_is_paused_and_goes_on() -> None:
    told: set[tuple[int, int]] = set()
    with CreateEmulator() as robot, puppet(robot) as process:
        process.send_signal(signal.SIGSTOP)
        assert until(lambda: wheels(robot) == (0, 0), 5.0) < SILENCE_S + LOOK_S
        until(lambda: robot.mode is Mode.PASSIVE, 1.0)
        assert len(guardians(robot)) == 1  # it keeps the port for the driver
        process.send_signal(signal.SIGCONT)
        limit_s = CLOCK.now_s() + 0.5
        until(lambda: CLOCK.now_s() > limit_s, 1.0, lambda: told.add(wheels(robot)))
        assert told == {(0, 0)}
        assert robot.mode is Mode.PASSIVE


@contextmanager
def active(robot: CreateEmulator) -> Iterator[tuple[CreateDriver, Callable[[], object]]]:
    """Yield a guarded driver whose robot drives, and what keeps it driving."""
    driver = guarded(CreateDriver(robot.url))
    driver.open()
    try:
        until(lambda: driver.state is Lifecycle.READY, 5.0)
        driver.activate()
        until(lambda: driver.state is Lifecycle.ACTIVE, 2.0)

        def drive() -> object:
            return driver.command(Twist(PACE_M_S, 0.0))

        until(lambda: wheels(robot) != (0, 0), 2.0, drive)
        yield driver, drive
    finally:
        driver.close()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_guardian_that_is_killed_or_hangs_is_replaced(number: signal.Signals) -> None:
    """Nobody can stop the robot until the next one is there: the time that takes is the price, and is kept short."""
    with CreateEmulator() as robot, active(robot) as (driver, drive):
        [guardian] = guardians(robot)
        os.kill(guardian, number)
        assert until(lambda: driver.state is Lifecycle.FAULT, 2.0, drive) < 0.6 + LOOK_S
        assert "guardian" in driver.fault
        assert until(lambda: wheels(robot) == (0, 0), 2.0, drive) < 0.5 + LOOK_S
        until(lambda: driver.state is Lifecycle.READY, 3.0, drive)
        assert guardians(robot) != [guardian]
        assert driver.command(Twist(PACE_M_S, 0.0)) == Twist()


def test_a_guardian_ignores_who_ends_a_whole_group_and_goes_with_its_driver() -> None:
    with CreateEmulator() as robot:
        with active(robot) as (driver, drive):
            [guardian] = guardians(robot)
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                os.kill(guardian, number)
            limit_s = CLOCK.now_s() + 0.3
            until(lambda: CLOCK.now_s() > limit_s, 1.0, drive)
            assert driver.state is Lifecycle.ACTIVE
            assert guardians(robot) == [guardian]
        assert wheels(robot) == (0, 0)
        assert robot.mode is Mode.PASSIVE
        assert not guardians(robot)


def test_a_cable_that_is_pulled_behind_the_guardian() -> None:
    with CreateEmulator() as robot, active(robot) as (driver, drive):
        robot.unplug()
        until(lambda: driver.state is Lifecycle.FAULT, 1.0, drive)
        assert "plug it in again" in driver.fault
        robot.replug()
        until(lambda: driver.state is Lifecycle.READY, 3.0, drive)
        assert wheels(robot) == (0, 0)


def test_why_the_port_is_gone_comes_before_the_guardian_s_own_end() -> None:
    master, slave = os.openpty()
    guarded = GuardedPort(os.ttyname(slave), 115200, PARK)
    try:
        until(lambda: guarded.read() == [] and not guarded.waits_for, 5.0)
        os.close(master)
        os.close(slave)
        state = Path(f"/proc/{guarded.pid}/stat")
        until(lambda: state.read_text().rpartition(")")[2].split()[0] == "Z", 2.0)  # its words and its end wait here
        with pytest.raises(OSError, match=r"Input/output error|hung up") as gone:
            guarded.read()
        assert not isinstance(gone.value, HolderLost)
        with pytest.raises(HolderLost):
            guarded.read()
    finally:
        guarded.close()


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def no_room(*_: object, **__: object) -> NoReturn:
    raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))


@pytest.mark.parametrize("lacking", ["subprocess.Popen", "socket.socketpair"])
def test_a_computer_without_room_for_another_guardian_stops_the_robot_and_recovers(
    monkeypatch: pytest.MonkeyPatch, lacking: str
) -> None:
    with CreateEmulator() as robot, active(robot) as (driver, drive):
        [guardian] = guardians(robot)
        before = open_files()
        with monkeypatch.context() as short:
            short.setattr(f"fullswarm.drivers.guardian.{lacking}", no_room)
            os.kill(guardian, signal.SIGKILL)
            until(lambda: "does not start: Cannot allocate memory" in driver.fault, 2.0, drive)
            assert "end other programs" in driver.fault
            until(lambda: wheels(robot) == (0, 0), 1.0)  # nobody guards the port, but it can still be written
            limit_s = CLOCK.now_s() + 0.8  # three more tries
            until(lambda: CLOCK.now_s() > limit_s, 1.0, drive)
            assert open_files() <= before
            assert driver.state is Lifecycle.FAULT
        until(lambda: driver.state is Lifecycle.READY, 3.0, drive)
        driver.activate()
        until(lambda: wheels(robot) != (0, 0), 2.0, drive)


@pytest.mark.parametrize("lacking", ["guardian.subprocess.Popen", "guardian.socket.socketpair", "linked.os.pipe2"])
def test_a_computer_without_room_is_a_fault_that_passes(monkeypatch: pytest.MonkeyPatch, lacking: str) -> None:
    with CreateEmulator() as robot:
        fleet = OneRobot("r1", guarded(CreateDriver(robot.url)))
        try:
            with monkeypatch.context() as short:
                short.setattr(f"fullswarm.drivers.{lacking}", no_room)
                fleet.open()
                assert "Cannot allocate memory" in fleet.fault(0)
                assert "end other programs" in fleet.fault(0)
                assert robot.port in fleet.fault(0)
                assert not guardians(robot)
            until(lambda: fleet.lifecycle(0) is Lifecycle.READY, 5.0, fleet.read)
        finally:
            fleet.close()


@contextmanager
def port() -> Iterator[tuple[int, str]]:
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    try:
        yield master, os.ttyname(slave)
    finally:
        os.close(master)
        os.close(slave)


def heard(master: int) -> bytes:
    try:
        return os.read(master, 4096)
    except BlockingIOError:
        return b""


def test_a_silent_driver_is_told_nothing_old_when_it_speaks_again() -> None:
    with port() as (master, path):
        guarded, said = GuardedPort(path, 115200, PARK), b""

        def listen() -> None:
            nonlocal said
            said += heard(master)

        try:
            guarded.write(b"go")  # it counts from here: the guardian hears it first of all
            took_s = until(lambda: said.count(PARK) == 1 + REPEATS, 2.0, listen)
            assert SILENCE_S <= took_s < SILENCE_S + 0.2 + LOOK_S
            assert said == PARK + b"go" + PARK * REPEATS  # the first one from who opened the port
            os.write(master, b"old")
            select.select([], [], [], 2 * 0.05)  # the guardian looks each 50 ms
            guarded.write(b"back")
            until(lambda: said.endswith(b"back"), 1.0, listen)
            os.write(master, b"new")
            answer = b""

            def look() -> None:
                nonlocal answer
                answer += b"".join(guarded.read())
                guarded.beat()

            until(lambda: answer.endswith(b"new"), 1.0, look)
            assert answer == b"new"
        finally:
            guarded.close()


def test_a_watched_port_gets_what_was_left_for_it_and_nothing_while_nobody_drives() -> None:
    with port() as (master, path):
        descriptor, said = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK), b""
        guardian = Guardian()

        def listen() -> None:
            nonlocal said
            said += heard(master)

        def fall_silent(duration_s: float) -> None:
            limit_s = CLOCK.now_s() + duration_s
            until(lambda: CLOCK.now_s() > limit_s, duration_s + 1.0, listen)

        try:
            guardian.watch(descriptor)
            assert "starting" in guardian.trouble
            until(lambda: not guardian.trouble, 5.0, guardian.beat)
            fall_silent(SILENCE_S + 0.3)
            assert not guardian.beat()
            guardian.stop_with(StopPlan(((0.0, b"stop."), (0.1, b"again.")), ((0.0, b"off."),)))
            until(lambda: said == b"stop.again.", 2.0, listen)
            assert guardian.beat()  # it says that it has stopped the robot, once
            assert not guardian.beat()
            guardian.stop_with(None)
            fall_silent(SILENCE_S + 0.3)
            assert said == b"stop.again."
        finally:
            guardian.release()
            os.close(descriptor)
        assert not guardian.watching


def test_it_is_small_and_starts_at_once() -> None:
    with port() as (master, path):
        began_s = CLOCK.now_s()
        guarded = GuardedPort(path, 115200, PARK)
        try:
            guarded.write(b"x")
            until(lambda: heard(master).endswith(b"x"), 2.0, guarded.beat)
            assert CLOCK.now_s() - began_s < 0.3
            status = Path(f"/proc/{guarded.pid}/status").read_text()
            resident_kb = int(status.partition("VmRSS:")[2].split()[0])
            assert resident_kb < 15_000
        finally:
            guarded.close()
        guarded.close()


def test_a_port_that_is_held_or_missing_is_said_as_without_a_guardian() -> None:
    with port() as (_, path):
        guarded = GuardedPort(path, 115200, PARK)
        try:
            with pytest.raises(DriverError, match="held"):
                GuardedPort(path, 115200, PARK)
        finally:
            guarded.close()
        GuardedPort(path, 115200, PARK).close()
    with pytest.raises(DriverError, match="no such port"):
        GuardedPort("/dev/ttyNONE", 115200, PARK)


@pytest.fixture
def slow_starts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], list[int]]:
    """Let an interpreter need 3 s to start, as on a small board that is busy; return what names those started."""
    starts, wrapper = tmp_path / "starts", tmp_path / "python"
    wrapper.write_text(f'#!/bin/sh\necho $$ >> {starts}\nsleep 3\nexec {sys.executable} "$@"\n')
    wrapper.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(wrapper))
    return lambda: [int(each) for each in starts.read_text().split()]


def test_a_guardian_that_needs_three_seconds_to_start_is_waited_for(slow_starts: Callable[[], list[int]]) -> None:
    with CreateEmulator() as robot:
        driver, began_s = guarded(CreateDriver(robot.url)), CLOCK.now_s()
        faults = set[str]()
        driver.open()
        try:
            until(lambda: driver.state is Lifecycle.READY, START_S, lambda: faults.add(driver.fault))
            assert CLOCK.now_s() - began_s > 3.0
            assert slow_starts() == guardians(robot)
            assert len(slow_starts()) == 1
            [fault] = faults - {""}
            assert "still starting" in fault
            assert "cable" not in fault
            assert "busy or slow" in fault
            driver.activate()
            until(lambda: driver.state is Lifecycle.ACTIVE, 2.0)
        finally:
            driver.close()


def test_a_guardian_that_ends_before_its_first_word_is_tried_ever_less_often_and_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts, broken = tmp_path / "starts", tmp_path / "python"
    broken.write_text(f"#!/bin/sh\necho >> {starts}\nexit 3\n")
    broken.chmod(0o755)
    with CreateEmulator() as robot:
        driver = guarded(CreateDriver(robot.url))
        with monkeypatch.context() as context:
            context.setattr(sys, "executable", str(broken))
            driver.open()
        try:
            with monkeypatch.context() as context:
                context.setattr(sys, "executable", str(broken))
                limit_s = CLOCK.now_s() + 4.0
                until(lambda: CLOCK.now_s() > limit_s, 5.0)
                assert "ended with exit code 3 before it was ready" in driver.fault
                assert "cable" not in driver.fault
                assert 3 <= len(starts.read_text()) <= 6  # four a second would be 16
            until(lambda: driver.state is Lifecycle.READY, 8.0)  # a whole Python again
        finally:
            driver.close()


@pytest.mark.parametrize(
    ("url", "watched"),
    [
        ("create:///dev/ttyUSB0", True),
        ("create:///dev/ttyUSB0?guardian=0", False),
        ("mavlink+udp://127.0.0.1:14550", True),
        ("mavlink+tcp://127.0.0.1:5760?autopilot=px4", True),
        ("mavlink+serial:///dev/ttyACM0?guardian=0", False),
        (f"can+vesc://vcan0?{VESC}", True),
        (f"can+vesc://vcan0?{VESC}&watchdog=0.5", False),
        (f"can+odrive://vcan0?{ODRIVE}", True),
        (f"can+odrive://vcan0?{ODRIVE}&watchdog=0.5", False),
        ("sim://127.0.0.1:4000/r1", False),
    ],
)
def test_whose_own_watchdog_is_missing_or_slow_gets_a_guardian(url: str, watched: bool) -> None:
    driver = guarded(registry.driver_class(url)(url))
    assert getattr(driver, "guarded", False) is watched


def test_a_driver_from_outside_gets_a_guardian_by_what_it_states() -> None:
    class Outside:
        def __init__(self, watchdog_s: float | None) -> None:
            limits = Limits(1.0, 1.0, 1.0, 1.0)
            self.description = Description("a", "b", 0.2, limits, watchdog_s=watchdog_s)
            self.asked = 0

        def guard(self) -> None:
            self.asked += 1

    assert [guarded(Outside(each)).asked for each in (None, 0.2, 0.5, 0.6)] == [1, 0, 0, 1]
