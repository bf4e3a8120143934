"""An agent of each make, on each link, is killed or paused at full speed: its guardian stops the robot.

Real processes, ports and signals; the times and ways are the body's own.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from fullswarm.clock import wall_time_s
from fullswarm.drivers.base import Lifecycle, Twist
from fullswarm.drivers.can.driver import CanBaseDriver
from fullswarm.drivers.can.odrive import AxisState
from fullswarm.drivers.create_oi.driver import CreateDriver
from fullswarm.drivers.create_oi.protocol import Mode as OiMode
from fullswarm.drivers.guardian import SILENCE_S
from fullswarm.drivers.mavlink import px4
from fullswarm.drivers.mavlink.driver import MavlinkDriver
from fullswarm.drivers.mavlink.protocol import Mode
from fullswarm.drivers.mavlink.signing import EPOCH_S, TICKS_S
from fullswarm.drivers.ports import TcpPort, UdpPort
from fullswarm.emulators.can.emulator import EmulatedBase
from fullswarm.emulators.can.odrive import ODriveEmulator
from fullswarm.emulators.can.vesc import VescEmulator
from fullswarm.emulators.create_oi.emulator import CreateEmulator
from fullswarm.emulators.mavlink.emulator import Px4Emulator, RoverEmulator
from fullswarm.errors import DriverError
from tests.emulated.can_robot import multicast
from tests.emulated.rover_link import CLOCK, PAUSE, free_port
from tests.waiting import until

BOUND_S = 1.3
"""From the kill to rest, from 1 m/s."""
START_S = 20.0
RESTS_M_S = 0.05
"""A rover that stands creeps with up to 0.036 m/s."""
VESC = "left=1&right=2&wheel_radius=0.05&base=0.3&gear=10&pole_pairs=7&speed=1"
ODRIVE = "left=1&right=2&wheel_radius=0.05&base=0.3&vel_limit=4&speed=1"
KEY = bytes(range(32))


@dataclass(frozen=True, slots=True)
class Plugged:
    """An emulated robot, and the driver for it."""

    emulator: Any
    kind: type
    url: str
    speed_m_s: float = 1.0

    def speed(self) -> float:
        return abs(float(self.emulator.body.state().speed_m_s))


@contextmanager
def rover(address: str) -> Iterator[Plugged]:
    with RoverEmulator(address) as emulator:
        yield Plugged(emulator, MavlinkDriver, f"{emulator.url}?guardian=1")


@contextmanager
def signed_rover(folder: Path) -> Iterator[Plugged]:
    key = folder / "rover.key"
    key.write_bytes(KEY)
    key.chmod(0o600)
    # The first port believes unsigned frames, too.
    with RoverEmulator(f"udp://127.0.0.1:{free_port()}", more=["tcp://127.0.0.1:0"]) as emulator:
        emulator.firmware.keys.set_up(KEY, int((wall_time_s() - EPOCH_S) * TICKS_S), 0.0)
        url = f"{emulator.urls[1]}?guardian=1&sign_key={key}&sign_state={folder}/stamps"
        yield Plugged(emulator, MavlinkDriver, url)


@contextmanager
def px4_rover() -> Iterator[Plugged]:
    with Px4Emulator(f"udp://127.0.0.1:{free_port()}") as emulator:
        yield Plugged(emulator, MavlinkDriver, f"{emulator.url}?autopilot=px4&guardian=1")


@contextmanager
def base(url: str) -> Iterator[Plugged]:
    with EmulatedBase(url) as emulator:
        yield Plugged(emulator, CanBaseDriver, f"{url}&guardian=1")


@contextmanager
def create() -> Iterator[Plugged]:
    with CreateEmulator() as emulator:
        yield Plugged(emulator, CreateDriver, f"{emulator.url}&guardian=1", 0.5)


ROBOTS: dict[str, Callable[[Path], Any]] = {
    "rover udp": lambda _: rover(f"udp://127.0.0.1:{free_port()}"),
    "rover udpout": lambda _: rover("udpin://127.0.0.1:0"),
    "rover tcp": lambda _: rover("tcp://127.0.0.1:0"),
    "rover serial": lambda _: rover("pty:"),
    "rover tcp signed": signed_rover,
    "px4 udp": lambda _: px4_rover(),
    "vesc slcan": lambda folder: base(f"can+vesc://{folder}/v1?interface=slcan&settle=0&{VESC}"),
    "vesc multicast": lambda _: base(f"can+vesc://{multicast()}&{VESC}"),
    "odrive slcan": lambda folder: base(f"can+odrive://{folder}/o1?interface=slcan&settle=0&{ODRIVE}"),
    "odrive multicast": lambda _: base(f"can+odrive://{multicast()}&{ODRIVE}"),
    "create serial": lambda _: create(),
}
SLOW = ("rover udpout", "vesc multicast", "odrive slcan")
"""The same frames on a link that another make has in the quick tests."""
ONE_OF_EACH = ("rover udp", "rover tcp signed", "px4 udp", "vesc slcan", "odrive multicast", "create serial")


@contextmanager
def driven(robot: Plugged) -> Iterator[subprocess.Popen[bytes]]:
    """Drive the robot at full speed from a process of its own."""
    command = [
        sys.executable, "-m", "fullswarm.testing.drives_on", f"{robot.kind.__module__}:{robot.kind.__qualname__}",
        robot.url, repr(robot.speed_m_s),
    ]  # fmt: skip
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(each for each in sys.path if each)}
    with subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL) as process:
        try:
            until(lambda: robot.speed() > 0.98 * robot.speed_m_s, START_S, "at full speed")
            yield process
        finally:
            process.kill()


def to_rest(robot: Plugged, do: Callable[[], object]) -> tuple[float, float]:
    """Return how long and how far the robot went on after it happened, s and m."""
    from_m = robot.emulator.body.state().rolled_m
    do()
    took_s = until(lambda: robot.speed() < RESTS_M_S, 6.0, "at rest")
    return took_s, robot.emulator.body.state().rolled_m - from_m


def put_away(robot: Plugged, *, gone: bool) -> bool:
    """Whether the robot would not move without a new task; `gone`: nor has anybody its motors."""
    emulator = robot.emulator
    if isinstance(emulator, EmulatedBase):
        wheels = (emulator.left, emulator.right)
        idle = all(each.state is AxisState.IDLE for each in wheels if isinstance(each, ODriveEmulator))
        return (idle or not gone) and not any(each.driving for each in wheels if isinstance(each, VescEmulator))
    if isinstance(emulator, CreateEmulator):
        return emulator.mode is OiMode.PASSIVE
    hold = px4.HOLD if isinstance(emulator, Px4Emulator) else Mode.HOLD
    return bool(emulator.firmware.mode == hold and not emulator.firmware.armed)


def names(chosen: Iterable[str]) -> list[Any]:
    return [pytest.param(each, marks=[pytest.mark.slow] if each in SLOW else []) for each in chosen]


@pytest.mark.parametrize("name", names(ROBOTS))
def test_an_agent_that_is_killed_at_full_speed(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with ROBOTS[name](tmp_path) as robot:
        with driven(robot) as process:
            took_s, way_m = to_rest(robot, process.kill)
        with capsys.disabled():
            sys.stdout.write(f"\n{name}: killed, at rest after {took_s:.2f} s and {way_m:.2f} m\n")
        assert took_s < BOUND_S
        until(lambda: put_away(robot, gone=True), 2.0, "held and let go")
        driver = robot.kind(robot.url)
        try:
            until(lambda: opens(driver), 3.0, "the port is free for the next agent")
            until(lambda: driver.state is Lifecycle.READY, 10.0, "READY again")
            assert robot.speed() < RESTS_M_S
        finally:
            driver.close()


def opens(driver: Any) -> bool:
    try:
        driver.open()
    except DriverError:
        return False
    return True


@pytest.mark.parametrize("name", names(ONE_OF_EACH))
def test_an_agent_that_is_paused_at_full_speed_and_goes_on(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with ROBOTS[name](tmp_path) as robot, driven(robot) as process:
        took_s, way_m = to_rest(robot, lambda: process.send_signal(signal.SIGSTOP))
        with capsys.disabled():
            sys.stdout.write(f"\n{name}: paused, at rest after {took_s:.2f} s and {way_m:.2f} m\n")
        assert took_s < SILENCE_S + BOUND_S
        limit_s = CLOCK.now_s() + 1.0
        until(lambda: CLOCK.now_s() > limit_s or robot.speed() > RESTS_M_S, 2.0, "a second")
        process.send_signal(signal.SIGCONT)
        limit_s = CLOCK.now_s() + 1.5
        until(lambda: CLOCK.now_s() > limit_s or robot.speed() > RESTS_M_S, 2.0, "a second and a half")
        assert robot.speed() < RESTS_M_S
        until(lambda: put_away(robot, gone=False), 3.0, "held and let go")


@contextmanager
def active(robot: Plugged) -> Iterator[tuple[Any, Callable[[], object]]]:
    """Yield a guarded driver in this process whose robot drives, and what keeps it driving."""
    driver = robot.kind(robot.url)
    driver.open()

    def drive() -> object:
        return driver.command(Twist(0.5 * robot.speed_m_s, 0.0))

    try:
        until(lambda: driver.state is Lifecycle.READY, 10.0, "READY")
        driver.activate()
        until(lambda: bool(drive()) and robot.speed() > 0.3 * robot.speed_m_s, 5.0, "it drives")
        yield driver, drive
    finally:
        driver.close()


def watchers() -> set[int]:
    """Return the guardians that this process has started."""
    found = set()
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            words = (entry / "cmdline").read_bytes().split(b"\0")
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == os.getpid() and b"watch" in words:
                found.add(int(entry.name))
    return found


@pytest.mark.parametrize("name", ["rover udp", "rover tcp signed", "px4 udp"])
def test_a_link_thread_that_is_paused_just_before_it_reads_sees_its_guardian_s_stop_and_no_pilot(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pauses = [2.0]

    def slow(port: type[UdpPort] | type[TcpPort]) -> None:
        read = port.read

        def paused(self: Any) -> Sequence[bytes]:
            if pauses and begun.is_set():
                PAUSE.wait(pauses.pop())
            return read(self)

        monkeypatch.setattr(port, "read", paused)

    begun = threading.Event()
    slow(UdpPort)
    slow(TcpPort)
    with ROBOTS[name](tmp_path) as robot, active(robot) as (driver, drive):
        begun.set()
        faults: list[str] = []

        def put() -> bool:
            drive()
            faults.append(driver.fault)
            return not pauses and driver.state is Lifecycle.READY

        until(put, 8.0, "READY again")
        assert any("its guardian stopped it" in each for each in faults), set(faults)
        assert not any("pilot" in each for each in faults), set(faults)
        assert put_away(robot, gone=False)


@pytest.mark.parametrize("name", ["rover tcp", "vesc slcan"])
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_guardian_that_is_killed_or_hangs_ends_motion_and_is_replaced(
    name: str, number: signal.Signals, tmp_path: Path
) -> None:
    with ROBOTS[name](tmp_path) as robot, active(robot) as (driver, drive):
        [guardian] = watchers()
        os.kill(guardian, number)
        until(lambda: bool(drive()) and driver.state is Lifecycle.FAULT, 1.0, "FAULT: nothing would stop it any more")
        assert "guardian" in driver.fault
        until(lambda: robot.speed() < RESTS_M_S, 2.0, "at rest")
        until(lambda: driver.state is Lifecycle.READY, 10.0, "READY again")
        assert watchers() not in ({guardian}, set())
    assert not watchers()


@pytest.mark.parametrize("name", ["rover udp", "vesc slcan"])
def test_a_robot_is_not_ready_before_its_guardian_is(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts, slow = tmp_path / "starts", tmp_path / "python"
    slow.write_text(f'#!/bin/sh\necho >> {starts}\nsleep 3\nexec {sys.executable} "$@"\n')
    slow.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(slow))
    with ROBOTS[name](tmp_path) as robot:
        driver, began_s = robot.kind(robot.url), CLOCK.now_s()
        faults: list[str] = []
        driver.open()

        def ready() -> bool:
            faults.append(driver.fault)
            return driver.state is Lifecycle.READY

        try:
            until(ready, 12.0, "READY")
            assert CLOCK.now_s() - began_s > 3.0
            assert any("guards this port is still starting" in each for each in faults)
            assert len(starts.read_text()) == 1
        finally:
            driver.close()
