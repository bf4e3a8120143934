from __future__ import annotations

from pathlib import Path

import pytest

from fullswarm.bringup.machine import gamepads
from fullswarm.errors import MissingExtra
from fullswarm.operator.joystick import pads

LISTING = """I: Bus=0011 Vendor=0001 Product=0001 Version=ab41
N: Name="AT keyboard"
H: Handlers=sysrq kbd event0 leds
B: EV=120013

I: Bus=0003 Vendor=045e Product=028e Version=0110
N: Name="Microsoft X-Box 360 pad"
H: Handlers=event5 js0
B: EV=20000b
"""


class Machine:
    """A folder of input devices and the kernel's listing of them."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.listing = folder / "input", folder / "devices"
        self.folder.mkdir()
        for name in ("event0", "event5", "js0"):
            (self.folder / name).touch()
        self.listing.write_text(LISTING)

    def checks(self) -> list[tuple[str, str, str]]:
        return [(each.status, each.what, each.mend) for each in gamepads(self.folder, self.listing)]

    def bar(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("os.access", lambda *_: False)


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_a_readable_pad_is_fine_and_a_keyboard_is_no_pad(machine: Machine) -> None:
    assert machine.checks() == [("ok", f"Microsoft X-Box 360 pad ({machine.folder}/event5)", "")]


def test_a_pad_that_may_not_be_read_gets_group_and_udev_rule(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    machine.bar(monkeypatch)
    [(status, what, mend)] = machine.checks()
    assert status == "warning"
    assert what == f"not readable by this user: Microsoft X-Box 360 pad ({machine.folder}/event5)"
    assert "usermod -aG input" in mend
    assert "udev" in mend


def test_without_the_kernels_listing_the_joystick_files_stand_for_the_pads(machine: Machine) -> None:
    machine.listing.unlink()
    assert machine.checks() == [("ok", f"js0 ({machine.folder}/js0)", "")]


@pytest.mark.parametrize("text", ["", "garbage", 'N: Name="x"\n\nH: Handlers=\n', "\x00\n\nH: Handlers=js0\n"])
def test_any_listing_is_read(machine: Machine, text: str) -> None:
    machine.listing.write_text(text)
    (machine.folder / "js0").unlink()
    assert machine.checks() == [("ok", "none is plugged in", "")]


def test_a_machine_without_input_devices_is_reported(tmp_path: Path) -> None:
    [check] = gamepads(tmp_path / "none", tmp_path / "none")
    assert check.what == f"none: there is no {tmp_path}/none"


def test_a_pad_without_sdl_is_a_warning_that_names_the_extra(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "sdl2", None)
    with pytest.raises(MissingExtra, match=r"fullswarm\[joystick\]"):
        pads.load_sdl()
    [(status, what, mend)] = machine.checks()
    assert (status, mend) == ("warning", "pip install 'fullswarm[joystick]'")
    assert "PySDL2" in what
    for each in machine.folder.iterdir():
        each.unlink()
    machine.listing.unlink()
    assert machine.checks() == [("ok", "none is plugged in", "")]
