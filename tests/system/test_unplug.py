"""Pull the cable, break the radio, kill the robot while it drives: real agents, real drivers, real ports, one world.

A Create has no watchdog of its own: one whose cable is pulled rolls on, whatever we do; it is stopped as soon as the
cable is back. All others stop by themselves within the time that their driver's description states.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.system.live import LiveSwarm

pytestmark = pytest.mark.alone  # its bounds are those of devices, which other tests' load would exceed

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


def stands(swarm: LiveSwarm, robot: str) -> bool:
    return speed(swarm, robot) < STOPPED_M_S


def all_drive(swarm: LiveSwarm) -> None:
    """Request a drive that is long enough for all tests."""
    swarm.operator.request("flocking", (), {"cruise_m_s": 0.35})
    swarm.until(lambda: all(speed(swarm, robot) > 0.25 for robot in ROBOTS), 15.0, "all robots drive")


def within(swarm: LiveSwarm, bounds_s: dict[str, float], happened: Callable[[str], bool], what: str) -> None:
    """Wait until each of several things has happened once; assert that it did so within its own bound."""
    began_s, took_s = swarm.clock.now_s(), dict[str, float]()

    def all_seen() -> bool:
        for each in bounds_s.keys() - took_s.keys():
            if happened(each):
                took_s[each] = swarm.clock.now_s() - began_s
        return took_s.keys() == bounds_s.keys()

    swarm.until(all_seen, max(bounds_s.values()) + LOOK_S, what)
    assert not {each: took for each, took in took_s.items() if took > bounds_s[each] + LOOK_S}, what


def all_stop_and_report(swarm: LiveSwarm, rest_s: dict[str, float]) -> None:
    """Each robot stands within its bound, and reports a fault within its own after that."""
    bounds_s = {f"{robot} stops": bound_s for robot, bound_s in rest_s.items()}
    bounds_s |= {f"{robot} is in FAULT": rest_s.get(robot, 0.0) + FAULT_S[robot] for robot in ROBOTS}

    def happened(step: str) -> bool:
        robot = step.partition(" ")[0]
        return stands(swarm, robot) if step.endswith("stops") else lifecycle(swarm, robot) == "FAULT"

    within(swarm, bounds_s, happened, "all stop and report a fault")
    for robot in ROBOTS:
        health = swarm.row(robot).health
        assert health
        assert health.fault


def all_come_back(swarm: LiveSwarm) -> None:
    """All are READY within 2 s, standing, and drive only when a new request comes."""
    swarm.until(lambda: all(lifecycle(swarm, robot) == "READY" for robot in ROBOTS), READY_S + LOOK_S, "all are READY")
    swarm.until(lambda: all(stands(swarm, robot) for robot in ROBOTS), 1.5, "all stand after they are back")
    swarm.rest(1.0)
    assert all(stands(swarm, robot) for robot in ROBOTS), "there was no new request"
    assert {lifecycle(swarm, robot) for robot in ROBOTS} == {"READY"}
    all_drive(swarm)


def test_a_pulled_cable(swarm: LiveSwarm) -> None:
    all_drive(swarm)
    for robot in ROBOTS:
        emulator(swarm, robot).unplug()
    all_stop_and_report(swarm, AT_REST_S)
    for robot in ROBOTS:
        emulator(swarm, robot).replug()
    all_come_back(swarm)


def test_a_robot_that_falls_silent(swarm: LiveSwarm) -> None:
    """It still receives: the driver must stop it, with or without a watchdog."""
    all_drive(swarm)
    for robot in ROBOTS:
        emulator(swarm, robot).mute(True)
    all_stop_and_report(swarm, dict.fromkeys(ROBOTS, 4.0))
    for robot in ROBOTS:
        emulator(swarm, robot).mute(False)
    all_come_back(swarm)


def test_a_robot_that_restarts(swarm: LiveSwarm) -> None:
    all_drive(swarm)
    for robot in ROBOTS:
        emulator(swarm, robot).reboot()
    within(swarm, dict.fromkeys(ROBOTS, 1.5), lambda robot: stands(swarm, robot), "no robot has power")
    swarm.until(lambda: all(lifecycle(swarm, robot) == "READY" for robot in ROBOTS), 10.0, "all are READY again")
    swarm.rest(1.0)
    assert all(stands(swarm, robot) for robot in ROBOTS)


def test_an_agent_that_is_killed(swarm: LiveSwarm) -> None:
    """A robot with a watchdog stops by itself; the Create does so when its agent is back."""
    all_drive(swarm)
    for robot in ROBOTS:
        swarm.supervisor.kill(robot)
    (unwatched,) = set(ROBOTS) - AT_REST_S.keys()
    assert not stands(swarm, unwatched), "nothing on this machine can stop it: the README says so"
    within(swarm, AT_REST_S, lambda robot: stands(swarm, robot), "all that have a watchdog stop")
    for robot in ROBOTS:
        swarm.supervisor.revive(robot)
    passive = emulator(swarm, unwatched).mode.PASSIVE
    swarm.until(lambda: emulator(swarm, unwatched).mode is passive, 10.0, "its new agent stops the motors first")
    swarm.until(
        lambda: all(speed(swarm, robot) > 0.25 and swarm.row(robot).age_s < 0.5 for robot in ROBOTS),
        20.0,
        "all drive on",
    )
