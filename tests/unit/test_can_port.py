"""The bus: python-can behind our errors."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from can import CanOperationError
from can.interfaces.virtual import VirtualBus

import fullswarm
from fullswarm.drivers.can import settings
from fullswarm.drivers.can.port import UNRECEIVED, UNSENT, CanPort
from fullswarm.drivers.can.protocol import Frame
from fullswarm.errors import DriverError, LinkLost, MissingExtra

ODRIVE = "can+odrive://here?interface=virtual&left=1&right=2&wheel_radius=0.05&base=0.3"


def test_import_can_is_python_can() -> None:
    import can

    assert Path(fullswarm.__file__).parent not in Path(can.__file__).parents
    port = CanPort(settings.parse(ODRIVE))
    assert isinstance(port._bus, can.BusABC)
    port.close()


@pytest.mark.parametrize(("failed", "of"), [("send", UNSENT), ("recv", UNRECEIVED)])
def test_one_direction_that_fails_is_not_excused_by_the_other(
    failed: str, of: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    port, other = CanPort(settings.parse(ODRIVE)), CanPort(settings.parse(ODRIVE))
    frame, real = Frame(0x2D, False, bytes(8)), getattr(VirtualBus, {"send": "send", "recv": "_recv_internal"}[failed])

    def full(bus: VirtualBus, *rest: Any, **more: Any) -> Any:
        if bus is port._bus:
            raise CanOperationError("No buffer space available [Error Code 105]")
        return real(bus, *rest, **more)

    def both_ways() -> None:
        port.send(frame)
        other.send(frame)
        port.receive(0.0)

    both_ways()
    with monkeypatch.context() as patched:
        patched.setattr(VirtualBus, real.__name__, full)
        for _ in range(of - 1):
            both_ways()
    both_ways()  # one that succeeds makes up for them
    monkeypatch.setattr(VirtualBus, real.__name__, full)
    for _ in range(of - 1):
        both_ways()
    with pytest.raises(LinkLost, match="No buffer space available"):
        both_ways()
    for each in (port, other):
        each.close()


def test_python_can_is_imported_only_when_a_bus_is_opened() -> None:
    code = "import sys, fullswarm.drivers.can.driver, fullswarm.emulators.can.emulator; sys.exit('can' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=30).returncode == 0


def test_without_python_can_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "can", None)
    with pytest.raises(MissingExtra, match=r"fullswarm\[can\]"):
        CanPort(settings.parse(ODRIVE))


@pytest.mark.parametrize(
    ("interface", "text"),
    [
        ("socketcan", r"no-such-can: cannot open the bus: .*\(bring the interface up: ip link"),
        ("slcan", r"no-such-can: there is no such port \(plug the robot in"),
    ],
)
def test_a_bus_that_cannot_be_had_says_what_to_do(interface: str, text: str) -> None:
    url = ODRIVE.replace("virtual", interface).replace("//here", "//no-such-can")
    with pytest.raises(DriverError, match=text):
        CanPort(settings.parse(url))
