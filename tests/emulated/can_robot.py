"""A driver and the emulated base that it is plugged into."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable

import can
import pytest

from fullswarm.drivers.base import STAND, Lifecycle, Reading, Twist
from fullswarm.drivers.can.driver import CanBaseDriver
from fullswarm.drivers.can.odrive import AxisState
from fullswarm.emulators.can.emulator import EmulatedBase
from fullswarm.emulators.can.odrive import ODriveEmulator
from tests.emulated.rover_link import free_port
from tests.waiting import until

ODRIVE = "left=1&right=2&right_sign=-1&wheel_radius=0.05&base=0.3&watchdog=0.5"
VESC = "left=1&right=2&right_sign=-1&wheel_radius=0.05&base=0.3&gear=10&pole_pairs=7"
GROUP = "239.74.163.2"
_channels = itertools.count()


def channel() -> str:
    """Return a virtual channel that nobody else uses."""
    return f"test-{next(_channels)}"


def multicast_refusal() -> str:
    """Return why this kernel does not carry multicast within the machine; empty when it does."""
    try:
        with can.Bus(
            interface="udp_multicast", channel=GROUP, port=free_port(), hop_limit=0, ignore_config=True
        ) as bus:
            bus.send(can.Message(arbitration_id=1, is_extended_id=False))
            return "" if bus.recv(timeout=1.0) else f"a datagram to {GROUP} does not come back"
    except (can.CanError, OSError) as error:
        return f"{error} ({error.__cause__})"


def multicast() -> str:
    """Return the part of a URL that names a multicast bus of its own."""
    if reason := multicast_refusal():
        pytest.skip(f"no multicast on loopback: {reason}")
    return f"{GROUP}?interface=udp_multicast&port={free_port()}"


def wait_state(driver: CanBaseDriver, state: Lifecycle, limit_s: float = 4.0) -> float:
    return until(lambda: driver.state is state, limit_s, lambda: f"{driver.state}, not {state}: {driver.fault}")


class Robot:
    """A driver and its emulated base, which may be in another process."""

    def __init__(self, url: str) -> None:
        self.url = url
        self.emulated = EmulatedBase(url)
        self.driver = CanBaseDriver(url)

    @property
    def odrives(self) -> tuple[ODriveEmulator, ODriveEmulator]:
        left, right = self.emulated.left, self.emulated.right
        assert isinstance(left, ODriveEmulator)
        assert isinstance(right, ODriveEmulator)
        return left, right

    def idle(self) -> bool:
        return all(each.state is AxisState.IDLE for each in self.odrives)

    def speed(self) -> float:
        return max(abs(self.emulated.left.spin.speed_m_s), abs(self.emulated.right.spin.speed_m_s))

    def standing(self) -> bool:
        state = self.emulated.body.state()
        return state.speed_m_s == 0.0 and state.turn_rad_s == 0.0

    def reading(self) -> Reading:
        reading = self.driver.read()
        assert reading is not None
        return reading

    def beyond(self, goal_m: float, sign: float) -> Callable[[], bool]:
        """Return what tells whether the odometry has passed `goal_m` in direction `sign`."""
        return lambda: sign * (self.reading().odometry.x_m - goal_m) > 0.0

    def activate(self) -> None:
        wait_state(self.driver, Lifecycle.READY)
        self.driver.activate()
        wait_state(self.driver, Lifecycle.ACTIVE, 1.0)

    def drive(self, twist: Twist, until: Callable[[], bool], limit_s: float = 4.0) -> Twist:
        """Command at 50 Hz until a condition holds; return what was applied last."""
        end_s, applied = time.monotonic() + limit_s, STAND
        while not until():
            assert time.monotonic() < end_s, f"{self.driver.state} {self.driver.fault} {self.driver.read()}"
            applied = self.driver.command(twist)
            time.sleep(0.02)
        return applied

    def moving(self) -> None:
        """Bring to ACTIVE and up to speed."""
        self.activate()
        self.drive(Twist(0.3, 0.0), lambda: self.speed() > 0.25)

    def keep_driving(self, twist: Twist, duration_s: float) -> list[str]:
        """Command at 50 Hz for a while, whatever happens; return the faults on the way."""
        end_s, faults = time.monotonic() + duration_s, dict[str, None]()
        while time.monotonic() < end_s:
            self.driver.command(twist)
            faults[self.driver.fault] = None
            time.sleep(0.02)
        return [each for each in faults if each]
