"""A Create finds its Home Base by opcode 143, is charged there, and backs out, over a real port."""

from __future__ import annotations

import math

import numpy as np

from fullswarm.drivers.base import Lifecycle, Pose
from fullswarm.drivers.create_oi.driver import CreateDriver
from fullswarm.drivers.fleet import OneRobot
from fullswarm.emulators.create_oi.emulator import CreateEmulator
from fullswarm.simulation.bodies import FreeBody
from tests.waiting import until

ON = np.ones(1, bool)
BASE = Pose(0.5, 0.05, 0.0)


def test_a_create_docks_is_charged_and_backs_out() -> None:
    body = FreeBody()
    with CreateEmulator(body=body) as emulator:
        emulator.set_bases([BASE])
        emulator.set_battery(0.4)
        driver = CreateDriver(emulator.url)
        fleet = OneRobot("r1", driver)
        fleet.open()
        try:
            until(lambda: driver.state is Lifecycle.READY)
            assert not fleet.docked(0)

            def docked() -> bool:
                fleet.read()
                fleet.command(np.zeros((1, 2)), ON)
                assert fleet.seek_dock(0)
                return fleet.docked(0)

            until(docked, 20.0)
            fleet.command(np.zeros((1, 2)), ~ON)

            def charging() -> bool:
                reading = fleet.read()
                fleet.command(np.zeros((1, 2)), ~ON)
                return reading.charging is not None and bool(reading.charging[0] == 1)

            until(charging, 5.0)
            state = body.state()
            assert math.hypot(state.x_m - BASE.x_m, state.y_m - BASE.y_m) < 0.03

            def out() -> bool:
                fleet.read()
                fleet.command(np.array([[-0.1, 0.0]]), ON)
                return body.state().x_m < 0.2

            until(out, 15.0)
            assert not fleet.docked(0)
        finally:
            fleet.close()
