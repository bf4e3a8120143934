from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path
from threading import Event

import pytest

from fullswarm.bringup.emulate import (
    FAULTS,
    EmulateOptions,
    _started,
    explain_faults,
    inject,
    openings,
    run,
    supported_faults,
)
from fullswarm.clock import MonotonicClock, SimClock
from fullswarm.emulators.base import LinkFaults
from fullswarm.errors import ConfigError, DriverError, FullswarmError
from fullswarm.simulation.bodies import FreeBody


@pytest.fixture
def keep_signals() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


class FakeEmulator:
    """Has the names that all makes share and those of a Create; remembers what happened to it."""

    def __init__(self) -> None:
        self.faults, self.body = LinkFaults(), FreeBody(clock=SimClock())
        self.seen: list[tuple[object, ...]] = []

    def unplug(self) -> None:
        self.seen.append(("unplug",))

    def mute(self, on: bool) -> None:
        self.seen.append(("mute", on))

    def set_battery(self, fraction: float) -> None:
        self.seen.append(("battery", fraction))

    def set_cliff(self, *, front_left: bool, front_right: bool) -> None:
        self.seen.append(("cliff", front_left, front_right))


@pytest.mark.parametrize(
    ("line", "happened"),
    [
        ("unplug", ("unplug",)),
        ("  mute   on ", ("mute", True)),
        ("mute off", ("mute", False)),
        ("battery 0.1", ("battery", 0.1)),
        ("cliff on", ("cliff", True, True)),
    ],
)
def test_orders_reach_the_emulator(line: str, happened: tuple[object, ...]) -> None:
    emulator = FakeEmulator()
    inject(emulator, line)
    assert emulator.seen == [happened]


def test_orders_reach_link_and_body() -> None:
    emulator = FakeEmulator()
    for line in ("drop 0.25", "corrupt 0.5", "delay 0.1", "bump left", "push 0.5 1.0"):
        inject(emulator, line)
    assert emulator.faults == LinkFaults(0.25, 0.5, 0.1)
    state = emulator.body.state()
    assert (state.bumps, state.rolled_m, state.turned_rad) == ((True, False), 0.5, 1.0)
    inject(emulator, "bump off")
    assert emulator.body.state().bumps == (False, False)


@pytest.mark.parametrize(
    ("line", "word"),
    [
        ("", "no command"),
        ("umplug", "did you mean 'unplug'"),
        ("unplug now", "has wrong arguments"),
        ("mute", "mute on|off"),
        ("mute perhaps", "neither on nor off"),
        ("battery 1.5", "from 0 to 1"),
        ("drop nan", "not a number"),
        ("delay -1", "from 0 to 10"),
        ("estop on", "is not supported by this make"),
    ],
)
def test_wrong_orders_are_refused_in_words(line: str, word: str) -> None:
    emulator = FakeEmulator()
    with pytest.raises(ConfigError) as refused:
        inject(emulator, line)
    assert word in str(refused.value)
    assert emulator.seen == []


def test_help_names_only_what_the_robot_can_suffer() -> None:
    text = explain_faults(FakeEmulator())
    assert "cliff on|off" in text
    assert "estop" not in text


ARGUMENTS = {
    "": [""], "on|off": ["on", "off"], "on|off|left|right": ["right", "off"], "0..1": ["0.5", "0"], "NUMBER": ["4"],
    "SECONDS": ["0.1", "0"], "METRES [RADIANS]": ["0.5", "0.5 0.1"], "NAME[,NAME]|none": ["clean", "day,clock", "none"],
    "0..1023": ["700", "0"], "LEFT [RIGHT]": ["900", "0 3000"], "0..255|none": ["172", "none"],
}  # fmt: skip
COMMON = {"unplug", "replug", "reboot", "mute", "stick", "battery", "bump", "push", "drop", "corrupt", "delay"}


@pytest.mark.parametrize(
    ("options", "more"),
    [
        (
            EmulateOptions("create"),
            {"cliff", "wheel_drop", "overcurrent", "charger", "dock", "button", "light", "infrared"},
        ),
        (EmulateOptions("mavlink", listen="udpin://127.0.0.1:0"), {"estop", "pilot", "gps"}),
        (EmulateOptions("mavlink", listen="udpin://127.0.0.1:0", model="px4"), {"pilot"}),
        (EmulateOptions("odrive"), {"estop"}),
        (EmulateOptions("vesc"), {"estop"}),
    ],
)
def test_every_make_suffers_all_that_its_help_says(options: EmulateOptions, more: set[str], tmp_path: Path) -> None:
    with _started(options, str(tmp_path / "port"), FreeBody()) as emulator:
        names = supported_faults(emulator)
        assert set(names) >= COMMON | more
        for name in names:
            for argument in ARGUMENTS[FAULTS[name].usage]:
                obey_in_time(emulator, f"{name} {argument}".strip())


def obey_in_time(emulator: object, line: str) -> None:
    """Obey; a port that was pulled a moment ago may not be free at once, which is told in words."""
    clock, pause = MonotonicClock(), Event()
    end_s = clock.now_s() + 2.0
    while True:
        try:
            return inject(emulator, line)
        except DriverError:
            if line != "replug" or clock.now_s() > end_s:
                raise
            pause.wait(0.01)


@pytest.mark.parametrize(
    ("url", "client", "opening"),
    [
        ("create:///tmp/p?model=create1", "port", "/tmp/p at 57600 baud"),
        ("create:///tmp/p?model=create2", "pycreate2", "Create2(port='/tmp/p', baud=115200)"),
        ("mavlink+udp://127.0.0.1:14550", "pymavlink", "mavutil.mavlink_connection('udpin:127.0.0.1:14550')"),
        ("mavlink+udpout://127.0.0.1:14551", "MAVSDK", "udpout://127.0.0.1:14551"),
        ("mavlink+tcp://127.0.0.1:5760", "MAVProxy", "mavproxy.py --master=tcp:127.0.0.1:5760"),
        ("mavlink+serial:///dev/pts/7", "port", "/dev/pts/7"),
        ("can+odrive:///tmp/c?interface=slcan&left=1", "python-can", "can.Bus(interface='slcan', channel='/tmp/c')"),
        (
            "can+vesc://239.1.2.3?interface=udp_multicast&port=4000",
            "python-can",
            "can.Bus(interface='udp_multicast', channel='239.1.2.3', port=4000)",
        ),
    ],
)
def test_other_clients_are_told_what_to_open(url: str, client: str, opening: str) -> None:
    assert openings(url)[client] == opening


@pytest.mark.usefixtures("keep_signals")
@pytest.mark.parametrize(
    ("options", "word"),
    [
        (EmulateOptions("create", listen="udp://127.0.0.1:1"), "--listen"),
        (EmulateOptions("create", model="create3"), "did you mean 'create"),
        (EmulateOptions("mavlink", model="rovr"), "did you mean 'rover'"),
        (EmulateOptions("vesc", model="create2"), "--model"),
        (EmulateOptions("odrive", url="can+vesc://x?interface=virtual"), "write can+odrive://"),
        (EmulateOptions("odrive", port=Path("/tmp/x"), url="can+odrive://x"), "exclude each other"),
        (EmulateOptions("mavlink", listen="carrier-pigeon:"), "not an address"),
    ],
)
def test_options_that_do_not_fit_are_refused(options: EmulateOptions, word: str) -> None:
    with pytest.raises(FullswarmError) as refused:
        run(options, LinkFaults(), (), 0.1, as_json=True)
    assert refused.value.exit_code == 2
    assert word in str(refused.value)
