"""Robots leave their tasks to charge, in the whole swarm in lockstep; truth is what the simulated world records."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.config import SwarmConfig
from fullswarm.core.charging import ChargingNode
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.messages import (
    BehaviourRequest,
    ChargeOrder,
    ChargingStatus,
    EStop,
    RequestStatus,
    RobotCharge,
    RobotHealth,
    RobotStates,
    StopRequest,
)
from fullswarm.reasons import Code
from fullswarm.runtime import Mailbox, Runtime
from fullswarm.store import Store

LINE: list[Any] = [[3.0, 1.5], [6.5, 1.5], [6.5, 6.5], [3.0, 6.5]]
DOCKS = [{"id": "d1", "pose": (0.4, 2.0, math.pi)}, {"id": "d2", "pose": (0.4, 6.0, math.pi)}]
FAST = {"rest_per_h": 0.5, "drive_per_m": 0.001, "charge_per_h": 20.0}


class Lab:
    """A swarm with batteries in lockstep."""

    def __init__(self, robots: int, battery: dict[str, Any], charging: dict[str, Any], docks: list[Any]) -> None:
        self.config = SwarmConfig.model_validate(
            {
                # 20 Hz: what is tested here takes minutes of simulated time.
                "world": {
                    "engine": "kinematic",
                    "bounds_m": (0, 0, 8, 8),
                    "battery": {**FAST, **battery},
                    "rate_hz": 20,
                },
                "agent": {"control_rate_hz": 20},
                "robot": [{"id": f"r{k + 1}", "pose": (3.0 + k, 4.0, 0.0)} for k in range(robots)],
                "dock": docks,
                "charging": charging,
            }
        )
        self.swarm = Lockstep(self.config)
        assert self.swarm.world.batteries is not None
        self.batteries = self.swarm.world.batteries
        self.bus = self.swarm.bus_of("test")
        self.status: ChargingStatus | None = None
        self.requests: dict[str, RequestStatus] = {}
        self.bus.subscribe(self.swarm.keys.charging_status, ChargingStatus, self._status)
        self.bus.subscribe(self.swarm.keys.behaviour_status, RequestStatus, self._request)
        self.swarm.run(1.0)

    def _status(self, status: ChargingStatus) -> None:
        self.status = status

    def _request(self, status: RequestStatus) -> None:
        self.requests[status.request_id] = status

    def ask(self, request: str = "q1", behaviour: str = "perimeter_bc", **fields: Any) -> None:
        line: dict[str, Any] = {"corners": LINE, "speed_m_s": 0.3}
        parameters = line if behaviour == "perimeter_bc" else fields.pop("parameters")
        message = BehaviourRequest(id=request, behaviour=behaviour, parameters=parameters, source="test", **fields)
        self.bus.publish(self.swarm.keys.behaviour_request, message)
        self.swarm.run(0.5)

    def health(self, robot: str) -> RobotHealth:
        found = self.swarm.agent.health(self.swarm.runtime.now_s()).robots
        return next(each for each in found if each.robot == robot)

    def phase(self, robot: str) -> str:
        charge = self.health(robot).charge
        return "" if charge is None else charge.phase

    def until(self, robot: str, phase: str, limit_s: float = 120.0) -> None:
        began_s = self.swarm.runtime.now_s()
        while self.phase(robot) != phase:
            self.swarm.run(0.2)
            assert self.swarm.runtime.now_s() - began_s < limit_s, f"{self.phase(robot)} instead of {phase}"

    def set_charge(self, robot: str, charge: float) -> None:
        self.batteries.charge[self.config.robots.index(robot)] = charge


@contextmanager
def lab(
    robots: int = 2, battery: dict[str, Any] | None = None, charging: dict[str, Any] | None = None,
    docks: list[Any] | None = None,
) -> Iterator[Lab]:  # fmt: skip
    made = Lab(robots, battery or {}, charging or {}, DOCKS if docks is None else docks)
    try:
        yield made
    finally:
        made.swarm.close()


def test_a_robot_charges_and_takes_its_task_up_again() -> None:
    with lab() as found:
        found.ask()
        found.set_charge("r1", 0.34)
        found.until("r1", "going", 5.0)
        assert found.health("r1").stop_code == Code.CHARGE_GOING
        found.until("r1", "docked")
        row = found.config.robots.index("r1")
        assert found.batteries.charging[row]
        assert found.health("r1").behaviour == "perimeter_bc"  # it is still the robot's request
        assert found.requests["q1"].phase == "running"
        found.swarm.run(2.0)
        assert not found.swarm.agent.controller.drive_on[row]  # its motors are off
        assert found.health("r1").stop_code == Code.CHARGING
        found.until("r1", "", 240.0)
        assert found.batteries.charge[row] > 0.9
        found.swarm.run(20.0)
        assert found.swarm.world.pose[row, 0] > 2.0  # back at its line
        assert found.requests["q1"].phase == "running"


def test_no_two_robots_go_to_one_dock() -> None:
    with lab(4, docks=DOCKS[:1]) as found:
        found.ask()
        for robot in found.config.robots:
            found.set_charge(robot, 0.34)
        most = 0
        for _ in range(1500):
            found.swarm.run(0.2)
            away = [robot for robot in found.config.robots if found.phase(robot) not in ("", "waiting")]
            most = max(most, len(away))
        assert most == 1
        assert found.batteries.flat_s.max() == 0.0
        assert found.batteries.charge.min() > 0.3  # all of them have had their turn


def test_robots_that_would_need_the_dock_at_once_are_sent_one_after_the_other() -> None:
    slow = {"rest_per_h": 4.0, "drive_per_m": 0.0, "charge_per_h": 12.0, "start": 0.9}
    guess = {"draw_per_h": 4.0, "charge_per_h": 12.0, "early_at": 0.85}
    with lab(3, battery=slow, charging=guess, docks=DOCKS[:1]) as found:
        found.ask()
        first = {}
        for _ in range(400):
            found.swarm.run(2.0)
            for robot in found.config.robots:
                if robot not in first and found.phase(robot):
                    first[robot] = float(found.batteries.charge[found.config.robots.index(robot)])
            if len(first) == 3:
                break
        assert len(first) == 3
        went = sorted(first.values())
        assert went[-1] > 0.6  # long before its threshold, so that
        assert np.diff(went).min() > 0.05  # the others can follow one by one
        assert found.batteries.flat_s.max() == 0.0


def test_a_stop_ends_charging_and_starts_nothing() -> None:
    with lab() as found:
        found.ask()
        found.set_charge("r1", 0.34)
        found.until("r1", "going", 5.0)
        found.swarm.run(1.0)
        found.bus.publish(found.swarm.keys.stop, StopRequest(id="s1", source="test"))
        found.swarm.run(0.1)
        assert not found.swarm.agent.setpoints.any()
        before = found.swarm.world.pose.copy()
        found.swarm.run(30.0)
        assert np.allclose(before, found.swarm.world.pose, atol=0.05)
        assert found.phase("r1") == ""
        assert found.health("r1").stop_code == Code.STOPPED


@pytest.mark.parametrize("idle", [False, True])
def test_a_robot_without_a_task_charges_only_if_the_fleet_file_says_so(idle: bool) -> None:
    with lab(charging={"idle_robots": idle}) as found:
        found.set_charge("r1", 0.3)
        before = found.swarm.world.pose[0].copy()
        found.swarm.run(60.0)
        assert (found.phase("r1") == "docked") == idle
        if not idle:
            assert np.allclose(before, found.swarm.world.pose[0])


def test_an_e_stop_in_a_dock_lasts_and_the_next_task_begins_from_the_dock() -> None:
    with lab() as found:
        found.ask()
        found.set_charge("r1", 0.34)
        found.until("r1", "docked")
        found.bus.publish(found.swarm.keys.estop, EStop(id="e1", engaged=True, source="test"))
        found.swarm.run(5.0)
        assert found.phase("r1") == ""
        assert found.batteries.charging[0]  # it stands there, and its contacts are on
        assert found.status is not None
        taken = next(each for each in found.status.docks if each.robot == "r1")
        assert (taken.phase, taken.code) == ("blocked", Code.DOCK_TAKEN)
        found.bus.publish(found.swarm.keys.estop, EStop(id="e2", engaged=False, source="test"))
        found.swarm.run(1.0)
        place = found.swarm.world.pose[0].copy()
        found.ask("q2")
        assert found.phase("r1") == "docked"  # it is not charged yet: it stays
        found.swarm.run(2.0)
        assert np.allclose(place, found.swarm.world.pose[0], atol=1e-3)
        found.until("r1", "leaving", 240.0)
        found.until("r1", "")
        assert found.requests["q2"].phase == "running"


def test_a_new_request_waits_until_the_robot_has_charged() -> None:
    with lab() as found:
        found.ask()
        found.set_charge("r1", 0.34)
        found.until("r1", "going", 5.0)
        found.ask("q2", "navigate_bc", parameters={"goal": [6.0, 6.0]}, robots=("r1",))
        assert found.requests["q2"].running == ("r1",)
        found.until("r1", "docked")
        found.until("r1", "", 240.0)
        found.swarm.run(40.0)
        assert math.dist(found.swarm.world.pose[0, :2].tolist(), (6.0, 6.0)) < 0.2


def test_the_stick_takes_a_robot_at_once() -> None:
    with lab() as found:
        found.ask()
        found.set_charge("r1", 0.34)
        found.until("r1", "going", 5.0)
        x_m = found.swarm.world.pose[0, 0]
        for number in range(20):
            parameters: dict[str, Any] = {"linear": 0.0, "angular": 1.0}
            message = BehaviourRequest(
                id=f"stick{number}", behaviour="drive", robots=("r1",), parameters=parameters, source="stick"
            )
            found.bus.publish(found.swarm.keys.behaviour_request, message)
            found.swarm.run(0.1)
        assert found.phase("r1") == ""
        assert found.swarm.world.twist[0, 1] > 0.5
        assert abs(found.swarm.world.pose[0, 0] - x_m) < 0.3


def test_a_dock_without_power_is_said_and_another_one_is_used() -> None:
    with lab() as found:
        found.batteries.powered[0] = False
        found.ask()
        found.swarm.world.pose[0, :2] = 3.0, 2.0
        found.set_charge("r1", 0.34)
        found.until("r1", "docked")
        assert found.batteries.slot[0] == 0
        for _ in range(600):
            found.swarm.run(0.2)
            if found.batteries.slot[0] == 1:
                break
        assert found.batteries.slot[0] == 1
        assert found.status is not None
        failed = found.status.docks[0]
        assert (failed.phase, failed.code) == ("failed", Code.DOCK_NO_CURRENT)
        found.swarm.run(2.0)
        assert found.batteries.charging[0]


def test_charging_robots_are_no_neighbours_for_control_laws() -> None:
    with lab(3) as found:
        found.ask()
        found.swarm.run(5.0)
        agent = found.swarm.agent
        position = np.ascontiguousarray(agent.pose[:, :2])
        start, _ = agent.neighbours.within(position, 30.0, agent.tasks.team)
        assert start.tolist() == [0, 2, 4, 6]
        found.set_charge("r1", 0.34)
        found.until("r1", "docked")
        position = np.ascontiguousarray(agent.pose[:, :2])
        start, other = agent.neighbours.within(position, 30.0, agent.tasks.team)
        others = [sorted(other[start[row] : start[row + 1]].tolist()) for row in (1, 2)]
        assert others == [[2], [1]]
        near = agent.neighbours.around(position, 30.0)
        assert near.start.tolist() == [0, 2, 4, 6]  # the safety filter keeps off all of them


def test_memory_survives_charging() -> None:
    with lab(1) as found:
        found.ask(behaviour="patrol_bc", parameters={"places": [[6.0, 6.0], [6.0, 2.0], [3.0, 4.0]]})
        found.swarm.run(5.0)
        before = found.swarm.agent.tasks.memory_of(0)
        assert before["place"] != [-1.0]
        found.set_charge("r1", 0.34)
        found.until("r1", "docked")
        assert found.swarm.agent.tasks.memory_of(0) == {}
        found.until("r1", "", 240.0)
        found.swarm.run(0.1)
        assert found.swarm.agent.tasks.memory_of(0) == before


class Roster:
    """What a core knows of robots: those of the file, and the reports of those that are present."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names, self.healths = names, dict[str, RobotHealth]()

    def known(self) -> tuple[str, ...]:
        return self.names

    def present(self) -> tuple[str, ...]:
        return tuple(self.healths)

    def health(self, robot: str) -> RobotHealth | None:
        return self.healths.get(robot)


class Planner:
    """A core's planner alone, on a simulated clock, with one dock for r1 to r3."""

    def __init__(self, path: Path) -> None:
        self.path, self.roster = path, Roster(("r1", "r2", "r3"))
        self.config = SwarmConfig.model_validate(
            {"robot": [{"id": name} for name in self.roster.names], "dock": DOCKS[:1]}
        )
        self.runtime = Runtime(SimClock(), Mailbox())
        self.bus = LocalBus(self.runtime.mailbox)
        self.orders: list[ChargeOrder] = []
        self.status: ChargingStatus | None = None
        for robot in self.roster.names:
            self.bus.subscribe(Keys().charge(robot), ChargeOrder, self.orders.append)
        self.bus.subscribe(Keys().charging_status, ChargingStatus, self._on_status)
        self.places: dict[str, tuple[float, float]] = {}
        self.start()

    def _on_status(self, status: ChargingStatus) -> None:
        self.status = status

    def start(self) -> None:
        """Start a core on what is on the disk."""
        self.store = Store(self.path)
        self.node = ChargingNode(
            self.bus, Keys(), self.runtime, self.config, self.store, self.roster, lambda _: (), "core"  # type: ignore[arg-type]
        )  # fmt: skip

    def die(self) -> None:
        """End the core."""
        self.node.close()
        self.store.close()

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds)):
            names = tuple(name for name in self.places if name in self.roster.healths)
            if names:
                x_m, y_m = zip(*(self.places[name] for name in names), strict=True)
                zeros = (0.0,) * len(names)
                self.bus.publish(
                    Keys().state("all", "h"),
                    RobotStates(
                        host="h", robots=names, x_m=x_m, y_m=y_m, heading_rad=zeros, speed_m_s=zeros,
                        turn_rad_s=zeros, radius_m=(0.17,) * len(names), stamp_s=self.runtime.now_s(), sequence=0,
                    ),
                )  # fmt: skip
            self.runtime.run(1.0)

    def report(self, robot: str, place: tuple[float, float], battery: float, **charge: Any) -> None:
        """Have a robot report from now on."""
        self.places[robot] = place
        self.roster.healths[robot] = RobotHealth(
            robot=robot, driver="null", make="", model="", firmware="", lifecycle="ACTIVE", behaviour="perimeter_bc",
            battery=battery, charging=None, charge=RobotCharge(**charge) if charge else None,
        )  # fmt: skip

    def fall_silent(self, robot: str) -> None:
        del self.roster.healths[robot]

    def sent(self) -> set[str]:
        return {each.robot for each in self.orders if each.op == "go"}


@pytest.mark.parametrize("place", [(0.4, 2.0), (0.95, 2.05)], ids=["in it", "before it"])
@pytest.mark.parametrize("restart", [False, True])
def test_a_dock_with_a_silent_robot_in_or_before_it_is_given_to_no_other(
    tmp_path: Path, place: tuple[float, float], restart: bool
) -> None:
    planner = Planner(tmp_path / "core.db")
    planner.report("r1", (3.0, 4.0), 0.2)
    planner.run(6.0)
    (order,) = {each.id: each for each in planner.orders}.values()
    planner.report("r1", place, 0.2, id=order.id, phase="docking", dock=order.dock)
    planner.run(3.0)
    planner.fall_silent("r1")
    if restart:
        planner.die()
        planner.start()
    planner.report("r2", (4.0, 4.0), 0.2)
    planner.report("r3", (0.5, 2.1), 0.9)  # passes by, and hides nothing
    planner.run(30.0)
    assert planner.sent() == {"r1"}
    assert planner.status is not None
    assert planner.status.docks[0].code == Code.DOCK_LOST
    assert "r1" in planner.status.docks[0].reason
    planner.report("r1", (6.0, 6.0), 0.9)  # a person has carried it away, and switched it on
    planner.report("r3", (5.0, 6.0), 0.9)
    planner.run(10.0)
    assert planner.sent() == {"r1", "r2"}
    planner.die()
