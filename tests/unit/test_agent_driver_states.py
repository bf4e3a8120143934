"""A driver that stops by itself, or is not there yet: who drives on, and who must not."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from fullswarm.agent.node import AgentNode
from fullswarm.agent.state import Identity
from fullswarm.bus.codec import decode, encode
from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.config import SwarmConfig
from fullswarm.drivers.base import STAND, Description, Hazard, Lifecycle, Limits, Pose, Reading, Twist
from fullswarm.drivers.fleet import OneRobot
from fullswarm.keys import Keys
from fullswarm.messages import ControlAck, ControlRequest, HealthReport, Heartbeat, RobotStates
from fullswarm.operator.robot_state import advise
from fullswarm.operator.view import RobotRow
from fullswarm.reasons import Code
from fullswarm.runtime import Mailbox, Runtime

KEYS = Keys()


class Base:
    """A driver whose state the test sets; standing down takes it a while, as it takes a rover."""

    url, firmware, fault, fault_code = "test://r1", "", "", ""
    description = Description("test", "test", 0.17, Limits(0.5, 2.0, 2.0, 20.0), senses_pose=True)
    state = Lifecycle.READY
    hazards = Hazard.NONE
    leaving_s = -math.inf

    def __init__(self, runtime: Runtime) -> None:
        self.runtime, self.applied = runtime, STAND

    def open(self) -> None:
        """Nothing to open."""

    def close(self) -> None:
        """Nothing to close."""

    def activate(self) -> None:
        if self.state is Lifecycle.READY and not self.fault:
            self.state = Lifecycle.ACTIVE

    def deactivate(self) -> None:
        if self.leaving_s == -math.inf:
            self.leaving_s = self.runtime.now_s()

    def read(self) -> Reading:
        if math.isfinite(self.leaving_s) and self.runtime.now_s() - self.leaving_s > 0.3:
            self.leaving_s = -math.inf
            if self.state is Lifecycle.ACTIVE:
                self.state = Lifecycle.READY
        return Reading(self.runtime.now_s(), Pose(0.0, 0.0, 0.0), STAND, pose=Pose(0.0, 0.0, 0.0), hazards=self.hazards)

    def command(self, twist: Twist) -> Twist:
        self.applied = twist if self.state is Lifecycle.ACTIVE and self.leaving_s == -math.inf else STAND
        return self.applied


class Lone:
    """One agent on that driver."""

    def __init__(self, state: Lifecycle = Lifecycle.READY) -> None:
        self.runtime = Runtime(SimClock(), Mailbox())
        self.bus, self.base = LocalBus(self.runtime.mailbox), Base(self.runtime)
        self.base.state = state
        config = SwarmConfig.model_validate({"robot": [{"id": "r1"}]})
        self.agent = AgentNode(
            self.bus, self.runtime, config, OneRobot("r1", self.base), Identity("r1", "p"), np.zeros((1, 3)),
            self.runtime.stats,
        )  # fmt: skip
        self.acks: list[ControlAck] = []
        self.bus.subscribe(KEYS.ack(), ControlAck, self.acks.append)
        self.sequence = 0
        beat = Heartbeat(node="core", process="c", sequence=1)
        self.runtime.every(0.1, lambda: self.bus.publish(KEYS.heartbeat("core"), beat), first_s=0.0)
        self.runtime.run(0.1)

    def say(self, request_id: str, *, enable: bool = True) -> None:
        self.sequence += 1
        request = ControlRequest(
            request_id=request_id, robot="r1", behaviour="drive", law="drive", enable=enable, core="c",
            sequence=self.sequence,
            parameters={"linear": 1.0, "angular": 0.0, "speed_m_s": 0.5, "turn_rad_s": 1.0},
        )  # fmt: skip
        self.bus.publish(KEYS.control_requests("r1", "drive"), request)

    def drives(self, request_id: str) -> bool:
        self.say(request_id)
        self.runtime.run(1.0)
        return self.base.applied != STAND


@pytest.fixture
def lone() -> Iterator[Lone]:
    made = Lone()
    yield made
    made.agent.close()


@pytest.mark.parametrize("state", [Lifecycle.READY, Lifecycle.FAULT])
def test_what_stopped_by_itself_goes_on_only_with_a_new_request(lone: Lone, state: Lifecycle) -> None:
    assert lone.drives("a")
    lone.base.state = state  # READY: a fault that came and went between two ticks, a power button, a new world
    lone.runtime.run(0.3)
    lone.base.state = Lifecycle.READY
    lone.runtime.run(1.0)
    assert lone.base.applied == STAND
    assert not lone.drives("a")
    assert "ask for it again" in lone.acks[-1].reason
    assert lone.drives("b")


def test_a_switch_while_it_stands_down_is_no_stop_of_its_own(lone: Lone) -> None:
    assert lone.drives("a")
    lone.say("b", enable=False)
    lone.say("b")
    lone.runtime.run(2.0)
    assert lone.base.applied != STAND


def test_a_base_that_is_switched_on_late_runs_what_it_should() -> None:
    lone = Lone(Lifecycle.FAULT)
    assert not lone.drives("a")
    lone.base.state = Lifecycle.READY
    lone.runtime.run(1.0)
    assert lone.base.applied != STAND
    lone.agent.close()


def test_a_robot_that_is_barred_tells_why_keeps_its_task_and_drives_when_that_is_over(lone: Lone) -> None:
    reports: list[HealthReport] = []
    lone.bus.subscribe(KEYS.health("r1"), HealthReport, reports.append)
    lone.base.fault, lone.base.fault_code = "the charger is plugged in", Code.CHARGER
    assert not lone.drives("a")
    health = reports[-1].robots[0]
    assert (health.lifecycle, health.fault, health.behaviour) == ("READY", "the charger is plugged in", "drive")
    assert advise(RobotRow("r1", 0.1, 0.0, 0.0, 0.0, 0.0, health)) == "Take it off its charger."
    lone.base.fault = lone.base.fault_code = ""
    lone.runtime.run(1.0)
    assert lone.base.applied != STAND


def test_a_robot_that_falls_ends_its_task_with_its_own_words(lone: Lone) -> None:
    assert lone.drives("a")
    lone.base.state, lone.base.fault = Lifecycle.READY, "the robot stopped itself: a wheel hangs"
    lone.runtime.run(0.3)
    lone.base.fault = ""
    assert not lone.drives("a")
    assert "a wheel hangs" in lone.acks[-1].reason


def test_a_rover_that_another_station_disarmed_says_just_that(lone: Lone) -> None:
    reports: list[HealthReport] = []
    lone.bus.subscribe(KEYS.health("r1"), HealthReport, reports.append)
    assert lone.drives("a")
    taken = "udp://r1: it was disarmed by the pilot, another station or the autopilot: ask for a behaviour again"
    lone.base.state, lone.base.fault, lone.base.hazards = Lifecycle.READY, taken, Hazard.ESTOP_BUTTON
    lone.runtime.run(0.6)
    assert reports[-1].robots[0].stop_reason == taken
    lone.base.hazards = Hazard.NONE
    lone.runtime.run(0.6)
    assert reports[-1].robots[0].stop_reason == taken  # why its behaviour ended


@pytest.mark.parametrize(
    ("hazards", "words", "remedy"),
    [
        (Hazard.CLIFF, "a cliff sensor sees no floor", "put it on safe ground"),
        (Hazard.WHEEL_DROP | Hazard.BUMP, "a wheel hangs", "put it on safe ground"),
        (Hazard.OVERCURRENT, "a wheel motor draws too much current (overcurrent)", "free its wheels"),
        (Hazard.MOTORS_OFF | Hazard.ESTOP_BUTTON, "its safety switch keeps the motors off", "release the switch"),
        (Hazard.CLIFF | Hazard.WHEEL_DROP, "a cliff sensor sees no floor and a wheel hangs", "put it on safe ground"),
    ],
)
def test_a_hazard_is_called_by_its_name(lone: Lone, hazards: Hazard, words: str, remedy: str) -> None:
    reports: list[HealthReport] = []
    lone.bus.subscribe(KEYS.health("r1"), HealthReport, reports.append)
    assert lone.drives("a")
    lone.base.hazards = hazards
    lone.runtime.run(0.6)
    health = reports[-1].robots[0]
    assert health.stop_reason == words
    assert advise(RobotRow("r1", 0.1, 0.0, 0.0, 0.0, 0.0, health))
    assert not lone.drives("b")
    assert lone.acks[-1].reason == f"{words}; {remedy}, then ask for it again"
    lone.base.hazards = Hazard.NONE
    assert not lone.drives("a")
    assert lone.acks[-1].reason == f"{words}; ask for it again"


def test_a_stop_button_without_words_of_its_driver_is_told_too(lone: Lone) -> None:
    reports: list[HealthReport] = []
    lone.bus.subscribe(KEYS.health("r1"), HealthReport, reports.append)
    lone.base.hazards = Hazard.ESTOP_BUTTON
    lone.runtime.run(0.6)
    assert reports[-1].robots[0].stop_reason == "a person pressed its stop button or took it over"


def test_the_states_of_a_robot_without_limits_can_be_read(monkeypatch: pytest.MonkeyPatch) -> None:
    without = Description("test", "test", 0.17, Limits(1e9, 1e9, 1e9, 1e9), senses_pose=True)
    monkeypatch.setattr(Base, "description", without)
    lone = Lone()
    received: list[RobotStates] = []
    lone.bus.subscribe(KEYS.state(), RobotStates, received.append)
    lone.runtime.run(0.5)
    lone.agent.close()
    assert received
    assert all(decode(encode(states), RobotStates) == states for states in received)
