"""Real devices of the kernel's: a gamepad, a CAN bus, a USB serial cable, in a small guest that boots in seconds."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

from tests.machines.devices_guest import kernel_and_initramfs
from tests.machines.machine import booted
from tests.machines.needs import require
from tests.machines.packages import REPOSITORY

pytestmark = pytest.mark.slow
LIMIT_S = 900.0
"""One and a half minutes of a processor's time; a machine with other work takes longer."""
INPUT = 104
"""The group's number in the guest."""


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory, tell: Callable[[str], None]) -> dict[str, Any]:
    """What each part found out; all are tried in one guest."""
    require("mmdebstrap", "qemu-system-x86_64")
    folder = tmp_path_factory.mktemp("devices")
    kernel, initramfs = kernel_and_initramfs(folder, REPOSITORY / "fullswarm/deploy/robot/60-fullswarm-ports.rules")
    began_s = time.monotonic()
    with booted(folder, kernel, initramfs) as machine:
        machine.wait_for_end(LIMIT_S)
        parts = {each["part"]: each for each in machine.facts()}
        assert parts, machine.story()
    times = ", ".join(f"{name} {each['took_s']} s" for name, each in parts.items())
    tell(f"devices guest: {time.monotonic() - began_s:.0f} s; in its own time {times}")
    initramfs.unlink()
    return parts


def facts(said: dict[str, Any], part: str) -> dict[str, Any]:
    assert part in said, f"the guest did not come to {part}"
    assert "facts" in said[part], said[part]["error"]
    found: dict[str, Any] = said[part]["facts"]
    return found


# ---------------------------------------------------------------- a gamepad of uinput's
def test_a_gamepad_is_listed_and_known_with_udev_and_without(said: dict[str, Any]) -> None:
    found = facts(said, "joystick")
    assert found["without_a_pad"] == 1
    assert found["exit_code"] == 0
    (pad,) = found["listed"]
    assert (pad["number"], pad["known"]) == (1, True)
    assert pad["guid"][8:12] == "5e04"
    assert found["without_udev"] == found["listed"]


def test_who_is_in_the_group_input_may_read_it(said: dict[str, Any]) -> None:
    event = facts(said, "joystick")["event"]
    assert event == {"mode": "0o660", "group": INPUT}


def test_buttons_sticks_and_the_cross_arrive_and_a_pad_may_come_and_go(said: dict[str, Any]) -> None:
    found = facts(said, "joystick")
    assert found["there"].endswith(": at rest")
    assert "leftshoulder = dead man" in found["both"]
    assert "lefty -1.0" in found["both"]
    assert "dpup" in found["cross"]
    assert found["gone"] == "no gamepad"
    assert found["ended"] == 0


# ---------------------------------------------------------------- a CAN bus of vcan's
@pytest.mark.parametrize("make", ["odrive", "vesc"])
def test_a_base_is_driven_over_a_bus_of_the_kernels(said: dict[str, Any], make: str) -> None:
    found = facts(said, "can_bus")[make]
    assert found["rolled_m"] > 0.3
    assert found["moved"].startswith("+0.30 m/s")


@pytest.mark.parametrize("make", ["odrive", "vesc"])
def test_a_bus_that_goes_down_is_a_fault_and_comes_back(said: dict[str, Any], make: str) -> None:
    found = facts(said, "can_bus")[make]
    assert "Network is down" in found["fault"]
    assert "vcan0" in found["fault"]
    assert found["back_s"] < 10.0


# ---------------------------------------------------------------- a USB serial cable
def test_our_udev_rule_names_the_port(said: dict[str, Any]) -> None:
    found = facts(said, "serial_robot")
    assert found["port"].startswith("/dev/fullswarm/")
    assert found["target"].startswith("/dev/ttyACM")
    assert found["mode"] == "0o660"


def test_a_create_is_driven_over_usb_and_a_pulled_cable_is_a_fault(said: dict[str, Any]) -> None:
    found = facts(said, "serial_robot")
    assert found["speed_m_s"] == pytest.approx(0.2, abs=0.01)
    assert found["odometry_m"] > 0.1
    assert found["port"] in found["fault"]
    assert found["back_s"] < 20.0
