"""Pull the cable, break the radio, kill the robot while it drives: real agents, real drivers, real ports, one world.

A Create has no watchdog of its own: one whose cable is pulled rolls on, whatever we do; it is stopped as soon as the
cable is back. All others stop by themselves within the time that their driver's description states.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.system.live import LiveSwarm

CONFIG = {
    "swarm": "unplug",
    "world": {"engine": "kinematic", "bounds_m": [0, 0, 60, 60]},
    "agent": {"speed_limit_m_s": 0.4},
    "robot": [
        {"id": "c1", "emulate": "create2", "pose": [2.0, 2.0, 0.0]},
        {"id": "m1", "emulate": "rover", "pose": [2.0, 12.0, 0.0]},
        {"id": "o1", "emulate": "odrive", "pose": [2.0, 22.0, 0.0]},
        {"id": "v1", "emulate": "vesc", "pose": [2.0, 32.0, 0.0]},
    ],
}
ROBOTS = ("c1", "m1", "o1", "v1")
LOOK_S = 0.3
"""The world is stepped and this test looks each 5 ms, on a machine that may be busy."""
STOPPED_M_S = 0.05
# From the last frame that got through until the body stands, s: the device's watchdog, then braking from 0.4 m/s.
AT_REST_S = {"m1": 3.0 + 0.6, "o1": 0.5 + 1.2, "v1": 1.0 + 1.2}
FAULT_S = {"c1": 1.0, "m1": 5.0, "o1": 1.5, "v1": 1.5}
READY_S = 2.0


@pytest.fixture(scope="module")
def swarm() -> Iterator[LiveSwarm]:
    live = LiveSwarm(CONFIG, watch=True)
    yield live
    live.close()


def speed(swarm: LiveSwarm, robot: str) -> float:
    assert swarm.node
    return abs(swarm.node.bodies.of[robot].state().speed_m_s)


def emulator(swarm: LiveSwarm, robot: str) -> Any:
    assert swarm.node
    return swarm.node.emulators[robot]


def lifecycle(swarm: LiveSwarm, robot: str) -> str:
    health = swarm.row(robot).health
    return health.lifecycle if health else ""


def set_off(swarm: LiveSwarm, robot: str) -> None:
    """Ask for a drive that is long enough for all tests."""
    swarm.operator.request("flocking", (robot,), {"cruise_m_s": 0.35})
    swarm.until(lambda: speed(swarm, robot) > 0.25, 15.0, f"{robot} drives")


def stands(swarm: LiveSwarm, robot: str) -> bool:
    return speed(swarm, robot) < STOPPED_M_S


def comes_back(swarm: LiveSwarm, robot: str) -> None:
    """READY within 2 s, standing, and on again only when asked again."""
    swarm.until(lambda: lifecycle(swarm, robot) == "READY", READY_S + LOOK_S, f"{robot} is READY again")
    swarm.until(lambda: stands(swarm, robot), 1.5, f"{robot} stands after it is back")
    swarm.rest(1.0)
    assert stands(swarm, robot), "nobody asked for anything new"
    assert lifecycle(swarm, robot) == "READY"
    set_off(swarm, robot)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_pulled_cable(swarm: LiveSwarm, robot: str) -> None:
    set_off(swarm, robot)
    emulator(swarm, robot).unplug()
    if robot in AT_REST_S:
        swarm.until(lambda: stands(swarm, robot), AT_REST_S[robot] + LOOK_S, f"{robot} stops by itself")
    swarm.until(lambda: lifecycle(swarm, robot) == "FAULT", FAULT_S[robot] + LOOK_S, f"{robot} is in FAULT")
    health = swarm.row(robot).health
    assert health
    assert health.fault
    emulator(swarm, robot).replug()
    comes_back(swarm, robot)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_robot_that_falls_silent(swarm: LiveSwarm, robot: str) -> None:
    """It still hears: the driver must stop it, whoever has a watchdog."""
    set_off(swarm, robot)
    emulator(swarm, robot).mute(True)
    swarm.until(lambda: stands(swarm, robot), 4.0 + LOOK_S, f"{robot} stands")
    swarm.until(lambda: lifecycle(swarm, robot) == "FAULT", FAULT_S[robot] + LOOK_S, f"{robot} is in FAULT")
    emulator(swarm, robot).mute(False)
    comes_back(swarm, robot)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_robot_that_starts_anew(swarm: LiveSwarm, robot: str) -> None:
    set_off(swarm, robot)
    emulator(swarm, robot).reboot()
    swarm.until(lambda: stands(swarm, robot), 1.5 + LOOK_S, f"{robot} has no power")
    swarm.until(lambda: lifecycle(swarm, robot) == "READY", 10.0, f"{robot} is READY again")
    swarm.rest(1.0)
    assert stands(swarm, robot)


@pytest.mark.parametrize("robot", ROBOTS)
def test_an_agent_that_is_killed(swarm: LiveSwarm, robot: str) -> None:
    """What has a watchdog stops by itself; the Create does so when its agent is back."""
    set_off(swarm, robot)
    swarm.supervisor.kill(robot)
    if robot in AT_REST_S:
        swarm.until(lambda: stands(swarm, robot), AT_REST_S[robot] + LOOK_S, f"{robot} stops by itself")
    else:
        assert not stands(swarm, robot), "nothing on this machine can stop it: the README says so"
    swarm.supervisor.revive(robot)
    if robot not in AT_REST_S:
        passive = emulator(swarm, robot).mode.PASSIVE
        swarm.until(lambda: emulator(swarm, robot).mode is passive, 10.0, "its new agent stops the motors first")
    swarm.until(lambda: speed(swarm, robot) > 0.25 and swarm.row(robot).age_s < 0.5, 20.0, f"{robot} goes on")
