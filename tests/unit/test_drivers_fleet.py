"""One driver as a fleet of one: whom the agent's wish to drive, and its end, reach."""

from __future__ import annotations

import numpy as np
import pytest

from fullswarm.drivers.base import Description, Lifecycle, Reading, Twist
from fullswarm.drivers.fleet import OneRobot
from fullswarm.drivers.mavlink.protocol import Mode
from tests.unit.mavlink_bench import LIMITS, ArduBench

ON, OFF = np.array([True]), np.array([False])
GO, STOP = np.array([[0.5, 0.0]]), np.zeros((1, 2))


class Rover:
    """The bench's session as a driver; notes each call of `deactivate`."""

    url, firmware = "bench://r1", ""
    description = Description("bench", "bench", 0.35, LIMITS, senses_pose=True)

    def __init__(self, bench: ArduBench) -> None:
        self.bench = bench
        self.deactivated: list[Lifecycle] = []

    @property
    def state(self) -> Lifecycle:
        return self.bench.session.state

    @property
    def fault(self) -> str:
        return self.bench.session.fault

    def open(self) -> None:
        """It is open."""

    def close(self) -> None:
        """Nothing to close."""

    def activate(self) -> None:
        self.bench.session.activate(self.bench.now_s)

    def deactivate(self) -> None:
        self.deactivated.append(self.state)
        self.bench.session.deactivate(self.bench.now_s)

    def read(self) -> Reading | None:
        return self.bench.session.read()

    def command(self, twist: Twist) -> Twist:
        return self.bench.session.command(twist, self.bench.now_s)


def made() -> tuple[ArduBench, Rover, OneRobot]:
    bench = ArduBench()
    bench.ready()
    rover = Rover(bench)
    return bench, rover, OneRobot("r1", rover, bench.clock)


@pytest.mark.parametrize("asked_s", [0.02, 0.06, 0.15, 0.25])
def test_an_e_stop_before_the_rover_is_active_ends_the_wish_to_drive(asked_s: float) -> None:
    bench, rover, fleet = made()
    bench.run(asked_s, lambda: fleet.command(GO, ON))
    assert rover.state is Lifecycle.READY  # the mode and the arming are under way
    bench.run(0.6, lambda: fleet.command(STOP, OFF))
    bench.run(6.0, lambda: fleet.command(STOP, OFF) if not bench.rover.armed else pytest.fail("it armed"))
    assert (bench.rover.armed, rover.state) == (False, Lifecycle.READY)
    assert rover.deactivated == [Lifecycle.READY]
    assert not any(record.speed_m_s for record in bench.rover.setpoints)


def test_an_e_stop_while_a_refused_arm_waits_for_its_next_try_ends_the_wish_too() -> None:
    bench, rover, fleet = made()
    bench.rover.refuse_arm = "GPS 1: Bad fix"
    bench.until(lambda: rover.fault != "", each=lambda: fleet.command(GO, ON))
    bench.run(0.1, lambda: fleet.command(GO, ON))
    bench.rover.refuse_arm = ""
    bench.run(6.0, lambda: fleet.command(STOP, OFF) if not bench.rover.armed else pytest.fail("it armed"))
    assert bench.rover.mode == Mode.HOLD


def test_who_never_asked_to_drive_does_not_deactivate() -> None:
    bench, rover, fleet = made()
    bench.run(0.5, lambda: fleet.command(STOP, OFF))
    assert rover.deactivated == []
