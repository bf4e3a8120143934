"""One agent, its driver and an emulated rover behind a real port: e-stops at rest and at a creep, lost satellites."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from fullswarm.agent.motion.robot_controller import StopReason
from fullswarm.clock import MonotonicClock
from fullswarm.drivers.base import Lifecycle
from fullswarm.drivers.mavlink.driver import MavlinkDriver
from fullswarm.emulators.mavlink.emulator import RoverEmulator
from fullswarm.simulation.bodies import FreeBody
from tests.unit.rover_agent import FASTEST, RoverAgent

CONFIRMED_S, TRIES = 1.0, 20
CREEP_M_S, WATCHED_S = 0.05, 3.0
STANDS_S, STANDS_M = 2.0, 1.3  # from 1 m/s; about 1.7 s and 1.0 m on an idle machine


class Rover(RoverAgent):
    """With its emulator."""

    def __init__(self) -> None:
        self.body = FreeBody()
        self.emulator = RoverEmulator("udpin://127.0.0.1:0", self.body, seed=7).start()
        url = f"{self.emulator.url}?{FASTEST}"
        super().__init__(MonotonicClock(), lambda _: MavlinkDriver(url))
        self.ready()

    def close(self) -> None:
        super().close()
        self.emulator.close()


@pytest.fixture
def rover() -> Iterator[Rover]:
    made = Rover()
    yield made
    made.close()


def confirmed_after_s(rover: Rover) -> float:
    order, pressed_s = rover.estop()
    rover.until(lambda: rover.confirmation(order) is not None, CONFIRMED_S)
    at_s, receipt = rover.confirmation(order) or pytest.fail("it was confirmed")
    assert receipt.rolled_m == 0.0
    return at_s - pressed_s


def test_each_e_stop_of_a_standing_rover_is_confirmed_within_a_second(rover: Rover) -> None:
    rover.runtime.run(0.5)
    assert max(confirmed_after_s(rover) for _ in range(TRIES)) <= CONFIRMED_S


def test_no_e_stop_of_a_creeping_rover_is_confirmed(rover: Rover) -> None:
    rover.emulator.firmware.creep_m_s = CREEP_M_S
    rover.runtime.run(0.3)
    orders = []
    for _ in range(TRIES):
        orders.append(rover.estop()[0])
        rover.runtime.run(0.07)
    rover.runtime.run(WATCHED_S)
    assert [rover.confirmation(order) for order in orders] == [None] * TRIES
    rover.emulator.firmware.creep_m_s = 0.0
    rover.until(lambda: rover.confirmation(orders[-1]) is not None, CONFIRMED_S)


def test_a_rover_without_satellites_stands_and_says_why(rover: Rover) -> None:
    rover.drive()
    rover.until(lambda: rover.body.state().speed_m_s > 0.98)
    rover.runtime.run(1.5)
    rolled_m, lost_s = rover.body.state().rolled_m, rover.runtime.now_s()
    rover.emulator.set_gps(False)
    rover.until(lambda: rover.reason is StopReason.UNSURE, STANDS_S)
    rover.until(lambda: abs(rover.body.state().speed_m_s) < 0.05, STANDS_S)
    took_s, way_m = rover.runtime.now_s() - lost_s, rover.body.state().rolled_m - rolled_m
    assert took_s < STANDS_S
    assert way_m < STANDS_M
    assert rover.driver.state is Lifecycle.ACTIVE
    rover.runtime.run(1.0)
    assert "satellite receiver" in rover.driver.fault
    rover.emulator.set_gps(True)
    rover.until(lambda: rover.body.state().speed_m_s > 0.9, 3.0)
