"""The published checks: they let the laws and the template driver pass, and name each defect of a broken one."""

from __future__ import annotations

import math
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from fullswarm import registry
from fullswarm.agent.tasks import Params
from fullswarm.agent.view import Array, View
from fullswarm.bus import Bus
from fullswarm.clock import SimClock
from fullswarm.drivers.base import STAND, Lifecycle, Pose, Reading, Twist
from fullswarm.drivers.null.driver import LIMITS, NullDriver
from fullswarm.errors import ConfigError
from fullswarm.messages import BehaviourRequest, Heartbeat, StopRequest
from fullswarm.runtime import Mailbox
from fullswarm.testing import FakeClock, LoopbackBus, check_behaviour, check_driver, driver, simulated_runtime, trial


def beat(sequence: int = 1) -> Heartbeat:
    return Heartbeat(node="n", process="p", sequence=sequence)


# ---------------------------------------------------------------- clock and bus
def test_a_node_runs_on_a_fake_clock_and_a_loopback_bus() -> None:
    bus = LoopbackBus()
    runtime = simulated_runtime(bus.mailbox, start_s=100.0)
    heard: list[tuple[float, int]] = []
    bus.subscribe("*/beat", Heartbeat, lambda message: heard.append((runtime.now_s(), message.sequence)))
    runtime.every(0.5, lambda: bus.publish("s/beat", beat(len(heard))))
    runtime.run(1.2)
    assert heard == [(100.5, 0), (101.0, 1)]
    assert runtime.now_s() == pytest.approx(101.2)
    assert isinstance(runtime.clock, FakeClock)
    assert FakeClock is SimClock


def test_what_arrives_on_a_loopback_bus_has_been_on_the_wire() -> None:
    mailbox = Mailbox()
    bus = LoopbackBus(mailbox)
    contract: Bus = bus
    heard: list[BehaviourRequest] = []
    contract.subscribe("s/request", BehaviourRequest, heard.append)
    said = BehaviourRequest(id="1", behaviour="b", parameters={"goal": [1.0, 2.0]})
    contract.publish("s/request", said)
    bus.publish("s/stop", StopRequest(id="2"))
    bus.publish("elsewhere", said)
    assert heard == []  # nobody runs on the publisher's stack
    assert bus.drain() == 1
    assert heard == [said]
    assert heard[0] is not said
    assert bus.sent(BehaviourRequest) == [said, said]
    assert bus.sent(BehaviourRequest, "elsewhere") == [said]
    assert [each.id for each in bus.sent(StopRequest)] == ["2"]
    bus.close()
    bus.publish("s/request", said)
    assert (bus.connected(), bus.drain(), len(bus.sent(BehaviourRequest))) == (False, 0, 2)


def test_what_does_not_survive_the_wire_is_said_with_its_key() -> None:
    bus = LoopbackBus()
    for sequence in (np.int64(3), "3", 2**70):
        with pytest.raises(AssertionError, match=r"Heartbeat on 'a/b' does not survive the wire"):
            bus.publish("a/b", Heartbeat(node="n", process="p", sequence=sequence))  # type: ignore[arg-type]  # the point
    assert bus.sent(Heartbeat) == []


def test_losses_repeat_with_their_seed() -> None:
    def arrived(loss: float, seed: int) -> list[int]:
        bus, heard = LoopbackBus(loss=loss, seed=seed), list[int]()
        bus.subscribe("k", Heartbeat, lambda message: heard.append(message.sequence))
        for sequence in range(200):
            bus.publish("k", beat(sequence))
        bus.drain()
        assert len(bus.sent(Heartbeat)) == 200
        return heard

    assert arrived(0.3, 1) == arrived(0.3, 1) != arrived(0.3, 2)
    assert 110 < len(arrived(0.3, 1)) < 170
    assert (len(arrived(0.0, 1)), arrived(1.0, 1)) == (200, [])
    with pytest.raises(ValueError, match="from 0 to 1"):
        LoopbackBus(loss=1.5)


def test_the_kit_needs_no_pytest() -> None:
    code = "import sys; sys.modules['pytest'] = None; import fullswarm.testing"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=30).returncode == 0


# ---------------------------------------------------------------- laws
PARAMETERS: dict[str, dict[str, Any]] = {
    "move_to_goal": {"goal": [3.0, 4.0], "gain": 1.0, "arrive_radius_m": 0.05},
    "flocking": {
        "repulsion_radius_m": 0.8, "alignment_radius_m": 2.0, "attraction_radius_m": 3.0, "separation": 1.5,
        "alignment": 1.0, "cohesion": 0.5, "cruise_m_s": 0.2,
    },
    "rendezvous": {"gain": 1.0, "hearing_m": 30.0},
    "formation": {"target": [1.0, 2.0], "gain": 1.0},
    "voronoi_coverage": {"gain": 1.0, "hearing_m": 30.0, "reach_m": 30.0},
    "move": {"magnitude": 0.5, "speed_m_s": 0.5, "direction": [0.0, 1.0]},
    "drive": {"linear": 0.3, "angular": -0.4, "speed_m_s": 0.5, "turn_rad_s": 2.0},
    "stop": {},
}  # fmt: skip


@pytest.mark.parametrize("law", registry.LAWS)
def test_our_own_laws_pass(law: str) -> None:
    check_behaviour(law, PARAMETERS[law])


def test_a_law_is_taken_by_module_and_for_any_number_of_robots() -> None:
    module = registry.law_module("flocking")
    for robots in (1, 2):
        check_behaviour(module, PARAMETERS["flocking"], robots=robots, seeds=range(3), bounds=(-9.0, -9.0, 9.0, 9.0))


def module(law: Callable[[View, Params], Any], name: str = "velocity") -> ModuleType:
    made = ModuleType("outside.mine")
    setattr(made, name, law)
    return made


def pull(view: View, _: Params) -> Array:
    """Head for the mean of the neighbours: a law without fault."""
    return view.sum(view.offset) / np.maximum(view.neighbours, 1.0)


def halves(view: View, _: Params) -> Array:
    view.offset[:] *= 0.5
    return view.sum(view.offset)


def wears_out(view: View, params: Params) -> Array:
    gain = params.gain
    gain *= 0.5
    return gain * pull(view, params)


def nearest(view: View, _: Params) -> Array:
    wish = np.zeros((len(view.position), 2))
    first = view.start[:-1][np.diff(view.start) > 0]
    wish[view.of[first]] = view.offset[first]
    return wish


def by_itself(view: View, params: Params) -> Array:
    gain: Array = getattr(params, "gain", np.ones(1))
    return gain * pull(view, params)


def with_default(view: View, params: Params) -> Array:
    gain: Array = vars(params).get("gain", np.full(1, 2.0))
    return gain * pull(view, params)


def by_dictionary(view: View, params: Params) -> Array:
    gain: Array = vars(params)["gain"]
    return gain * pull(view, params)


class Counting:
    """A law with a memory."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, view: View, params: Params) -> Array:
        self.calls += 1
        return pull(view, params) + self.calls


BROKEN_LAWS: list[tuple[Callable[[View, Params], Any], str]] = [
    (lambda view, _: pull(view, _)[:, 0], r"shape \(6,\) for 6 robots; return an array of shape \(6, 2\)"),
    (lambda view, _: view.position.tolist(), "a list for 6 robots"),
    (lambda view, _: np.zeros((len(view.position), 2), int), "int64, not floats"),
    (lambda view, _: view.sum(view.offset / view.distance[:, None]), "NaN or infinity, .*own place"),
    (lambda view, _: view.sum(view.offset) / view.neighbours, "NaN or infinity, "),
    (lambda view, p: (p.goal - view.position) / np.linalg.norm(p.goal - view.position, axis=1)[:, None],
     "exactly on their parameter 'goal'"),
    (lambda view, _: view.position - view.position.mean(axis=0), "must not mix"),
    (lambda view, p: p.gain[0] * pull(view, p), "must not mix"),
    (lambda view, _: view.sum(view.position[view.other % 9]), "raises IndexError"),
    (halves, r"modifies view\.offset"),
    (wears_out, r"modifies params\.gain"),
    (nearest, "order of the neighbours"),
    (Counting(), "answers the same question differently"),
    (lambda view, p: pull(view, p) + np.random.default_rng().random(), "answers the same question differently"),
    (with_default, "without the parameter 'gain' it answers something else"),
    (by_dictionary, r"KeyError.*read it as params\.gain"),
    (lambda view, p: p.speed * view.position, "needs a parameter 'speed'.*add it to the parameters of this check"),
]  # fmt: skip


@pytest.mark.parametrize(("law", "sentence"), BROKEN_LAWS)
def test_a_broken_law_is_told_what_is_wrong(law: Callable[[View, Params], Any], sentence: str) -> None:
    with pytest.raises(AssertionError, match=sentence) as caught:
        check_behaviour(module(law), {"gain": 1.0, "goal": [2.0, 3.0]}, seeds=range(3))
    assert str(caught.value).startswith("law 'mine': ")


def test_laws_without_fault_pass_whatever_they_are_called() -> None:
    for law, name in ((pull, "velocity"), (pull, "twist"), (by_itself, "velocity")):
        check_behaviour(module(law, name), {"gain": 1.0, "unused": "word"}, seeds=range(3))


def test_what_is_no_law() -> None:
    with pytest.raises(AssertionError, match=r"neither velocity\(view, params\) nor twist"):
        check_behaviour(module(pull, "law"), {})
    with pytest.raises(ConfigError, match="did you mean 'flocking'"):
        check_behaviour("floking", {})


# ---------------------------------------------------------------- drivers
class Remembering(NullDriver):
    """The template driver, with all that it was told."""

    def __init__(self, url: str = "null://r1") -> None:
        super().__init__(url)
        self.applied: list[Twist] = []

    def command(self, twist: Twist) -> Twist:
        self.applied.append(super().command(twist))
        return self.applied[-1]


class OpenAtOnce(NullDriver):
    def __init__(self, url: str) -> None:
        super().__init__(url)
        self.open()


class Unlimited(NullDriver):
    def __init__(self, url: str) -> None:
        super().__init__(url)
        limits = replace(LIMITS, turn_rad_s=math.inf)
        self.description = replace(self.description, limits=limits)


class NeverReady(NullDriver):
    def open(self) -> None:
        super().open()
        self.state = Lifecycle.OPEN


class Eager(NullDriver):
    def open(self) -> None:
        super().open()
        self.state = Lifecycle.ACTIVE


class Drifting(NullDriver):
    """Moves in READY, whatever it says."""

    def command(self, twist: Twist) -> Twist:
        applied = super().command(twist)
        if self.state is Lifecycle.READY:
            self._twist = twist
        return applied


class SaysWhatWasWished(NullDriver):
    def command(self, twist: Twist) -> Twist:
        applied = super().command(twist)
        return twist if self.state is Lifecycle.ACTIVE else applied


class MovesWhenClosed(NullDriver):
    def command(self, twist: Twist) -> Twist:
        super().command(twist)
        return twist


class Permissive(NullDriver):
    def command(self, twist: Twist) -> Twist:
        try:
            return super().command(twist)
        except ValueError:
            return STAND


class RefusesTooMuch(NullDriver):
    def command(self, twist: Twist) -> Twist:
        if abs(twist.linear_m_s) > 1.0:
            raise ValueError("too fast")
        return super().command(twist)


class RaisesOnly(NullDriver):
    """A value that is not finite raises, but the wheels go on until the watchdog bites."""

    def command(self, twist: Twist) -> Twist:
        if not (math.isfinite(twist.linear_m_s) and math.isfinite(twist.angular_rad_s)):
            raise ValueError("not finite")
        return super().command(twist)


class WrongWayRound(NullDriver):
    def command(self, twist: Twist) -> Twist:
        applied = super().command(twist)
        return Twist(applied.linear_m_s, -applied.angular_rad_s)


class Telling(NullDriver):
    """Changes what is read."""

    def change(self, reading: Reading) -> Reading:
        return reading

    def read(self) -> Reading | None:
        reading = super().read()
        return reading and self.change(reading)


class Clockwise(Telling):
    def change(self, reading: Reading) -> Reading:
        pose, twist = reading.odometry, reading.twist
        mirrored = Pose(pose.x_m, -pose.y_m, -pose.heading_rad)
        return replace(reading, odometry=mirrored, twist=Twist(twist.linear_m_s, -twist.angular_rad_s))


class Millimetres(Telling):
    def change(self, reading: Reading) -> Reading:
        pose = reading.odometry
        return replace(reading, odometry=Pose(pose.x_m * 1e3, pose.y_m * 1e3, pose.heading_rad))


class Degrees(Telling):
    def change(self, reading: Reading) -> Reading:
        twist = reading.twist
        return replace(reading, twist=Twist(twist.linear_m_s, math.degrees(twist.angular_rad_s)))


class Askew(Telling):
    """Its x axis points to the front left."""

    def change(self, reading: Reading) -> Reading:
        pose, share = reading.odometry, math.sqrt(0.5)
        x_m, y_m = share * (pose.x_m - pose.y_m), share * (pose.x_m + pose.y_m)
        return replace(reading, odometry=Pose(x_m, y_m, pose.heading_rad))


class WallClock(Telling):
    def change(self, reading: Reading) -> Reading:
        return replace(reading, stamp_s=time.time())


class Backwards(Telling):
    """Every second reading is older than the one before."""

    def change(self, reading: Reading) -> Reading:
        self.even = not getattr(self, "even", False)
        return replace(reading, stamp_s=reading.stamp_s + (0.0 if self.even else 0.015))


class HiddenPose(Telling):
    def change(self, reading: Reading) -> Reading:
        return replace(reading, pose=reading.odometry)


class NoWatchdog(NullDriver):
    def read(self) -> Reading | None:
        self._commanded_s = self._clock.now_s()
        return super().read()


class Waiting(NullDriver):
    def command(self, twist: Twist) -> Twist:
        threading.Event().wait(0.006)
        return super().command(twist)


class StaysActive(NullDriver):
    def deactivate(self) -> None:
        self._set(STAND)


class RollsOn(NullDriver):
    """Leaves the wheels to the watchdog."""

    def deactivate(self) -> None:
        if self.state is Lifecycle.ACTIVE:
            self.state = Lifecycle.READY


class CloseOnce(NullDriver):
    closed = False

    def close(self) -> None:
        if self.state is not Lifecycle.CLOSED:
            self.closed = True
            super().close()
        elif self.closed and sys.exc_info()[0] is None:
            raise AssertionError("closed twice")


class RemembersItsWay(NullDriver):
    def open(self) -> None:
        odometry = self._odometry
        super().open()
        self._odometry = odometry


BROKEN_DRIVERS: list[tuple[type[NullDriver], str]] = [
    (OpenAtOnce, "before open"),
    (Unlimited, r"limits\.turn_rad_s is inf"),
    (NeverReady, r"it is OPEN, not READY, 0\.3 s after open\(\)"),
    (Eager, r"it is ACTIVE, not READY"),
    (Drifting, "it moves while READY"),
    (SaysWhatWasWished, r"linear beyond 0\.5; clip"),
    (MovesWhenClosed, "anything but ACTIVE applies zero"),
    (Permissive, r"command\(Twist\(linear_m_s=nan.* before open\(\) returns"),
    (RefusesTooMuch, "it is finite: clip it"),
    (RaisesOnly, "set zero, then raise"),
    (WrongWayRound, "angular the other way round"),
    (Clockwise, "check sign"),
    (Millimetres, "check signs and scale"),
    (Degrees, "check signs and scale"),
    (Askew, "aside"),
    (WallClock, "monotonic clock's time of arrival"),
    (Backwards, "stamps of readings go back"),
    (HiddenPose, "set senses_pose"),
    (NoWatchdog, r"after silence \(set zero, from a thread of the driver's own"),
    (Waiting, r"command\(\) takes .* never wait there"),
    (StaysActive, r"ACTIVE, not READY, 0\.3 s after deactivate|after deactivate\(\) returns"),
    (RollsOn, r"deactivate\(\) slows it after 0\.3"),
    (CloseOnce, "closed twice"),
    (RemembersItsWay, r"starts at \(0, 0, 0\)"),
]


@pytest.fixture
def brisk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Watch for a shorter time: the template driver has no inertia."""
    monkeypatch.setattr(driver, "WINDOW_S", 0.06)
    monkeypatch.setattr(trial, "IDLE_S", 0.05)


@pytest.mark.usefixtures("brisk")
@pytest.mark.parametrize(("broken", "sentence"), BROKEN_DRIVERS)
def test_a_broken_driver_is_told_what_is_wrong(broken: type[NullDriver], sentence: str) -> None:
    with pytest.raises(AssertionError, match=sentence):
        check_driver(lambda: broken("null://r1"), settle_s=0.3, deadline_s=0.3)


@pytest.mark.usefixtures("brisk")
def test_nothing_moves_unless_it_may() -> None:
    made: list[Remembering] = []

    def make() -> Remembering:
        made.append(Remembering())
        return made[-1]

    check_driver(make, settle_s=0.3, deadline_s=0.3, exercise=False)
    assert len(made) == 2
    assert made[1].applied == []
    assert set(made[0].applied) == {STAND}
    check_driver(make, settle_s=0.3, deadline_s=0.3)
    assert max(each.linear_m_s for each in made[2].applied) == LIMITS.speed_m_s


@pytest.mark.usefixtures("brisk")
def test_the_pump_is_worked_while_the_check_waits() -> None:
    pumped: list[float] = []
    check_driver(
        lambda: NullDriver("null://r1"), settle_s=0.3, pump=lambda: pumped.append(time.monotonic()), exercise=False
    )
    assert len(pumped) > 5
    assert np.median(np.diff(pumped)) == pytest.approx(0.02, abs=0.01)
