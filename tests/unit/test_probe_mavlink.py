"""`robots find` on a MAVLink line: the autopilot is the vehicle, whatever else speaks there."""

from __future__ import annotations

import pytest

from fullswarm.clock import MonotonicClock
from fullswarm.drivers.mavlink import probe as mavlink
from fullswarm.drivers.mavlink.codec import dialect

AUTOPILOT, GIMBAL = 1, 154
ROVER, GIMBAL_KIND, ARDUPILOT, ACTIVE = 10, 26, 3, 4


class Line:
    """A line on which heartbeats were heard, and nobody answers."""

    def __init__(self, *heard: bytes) -> None:
        self._heard = list(heard)

    def receive(self, _timeout_s: float) -> bytes:
        return self._heard.pop(0) if self._heard else b""

    def send(self, data: bytes) -> None:
        assert data


def heartbeat(component: int, kind: int) -> bytes:
    sender = dialect().MAVLink(None, srcSystem=1, srcComponent=component)
    return bytes(sender.heartbeat_encode(kind, ARDUPILOT, 0, 0, ACTIVE).pack(sender))


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("HEARTBEAT_S", "ANSWER_S"):
        monkeypatch.setattr(mavlink, name, 0.02)


def test_a_gimbal_that_calls_itself_ardupilot_is_not_the_vehicle() -> None:
    line = Line(heartbeat(GIMBAL, GIMBAL_KIND), heartbeat(AUTOPILOT, ROVER))
    (found,) = mavlink.ask(line, "udp:14550", "mavlink+udp://0.0.0.0:14550", MonotonicClock(), several=True)
    assert (found.make, found.model) == ("ArduPilot", "Rover")


def test_a_gimbal_alone_is_no_robot() -> None:
    line = Line(heartbeat(GIMBAL, GIMBAL_KIND))
    assert mavlink.ask(line, "udp:14550", "mavlink+udp://0.0.0.0:14550", MonotonicClock()) == ()
