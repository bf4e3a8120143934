from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace

import pytest

from fullswarm.bringup.robot_test import Bench, Step, steps
from fullswarm.clock import SimClock
from fullswarm.drivers.base import STAND, Description, Hazard, Lifecycle, Limits, Pose, Reading, Twist
from fullswarm.output import TypedLines
from fullswarm.runtime import Runtime
from fullswarm.simulation.bodies import FreeBody

TTL_S = 0.3
PLAIN = Description("Acme", "A1", 0.2, Limits(0.5, 4.0, 1.0, 8.0))


class FakeDriver:
    """A robot that does as it is told, except for what a test breaks."""

    url = "fake://r1"
    fault = ""
    firmware = "1.2"

    def __init__(self, clock: SimClock, description: Description = PLAIN) -> None:
        self.description = description
        self.clock, self.body = clock, FreeBody(clock=clock)
        self.state = Lifecycle.CLOSED
        self.forward_share = self.turn_share = 1.0  # of what is commanded, as the odometry sees it
        self.deaf_to_silence = self.never_ready = self.never_active = self.silent = self.coasts = False
        self.obeys_always = False
        self.hazards = Hazard.NONE
        self.commanded_s = 0.0

    def open(self) -> None:
        self.state = Lifecycle.OPEN

    def activate(self) -> None:
        if not self.never_active:
            self.state = Lifecycle.ACTIVE

    def deactivate(self) -> None:
        self.body.drive(0.0, 0.0)
        if self.state is Lifecycle.ACTIVE:
            self.state = Lifecycle.READY

    def read(self) -> Reading | None:
        now_s = self.clock.now_s()
        if self.state is Lifecycle.OPEN and not self.never_ready:
            self.state = Lifecycle.READY
        if now_s - self.commanded_s > TTL_S and not self.deaf_to_silence:
            self.body.drive(0.0, 0.0)
        if self.silent:
            return None
        at = self.body.state()
        twist = Twist(at.speed_m_s, at.turn_rad_s)
        return Reading(now_s, Pose(at.x_m, at.y_m, at.heading_rad), twist, hazards=self.hazards, battery=0.5)

    def command(self, twist: Twist) -> Twist:
        if self.state is not Lifecycle.ACTIVE and not self.obeys_always:
            return STAND
        self.commanded_s = self.clock.now_s()
        if twist != STAND or not self.coasts:
            self.body.drive(twist.linear_m_s * self.forward_share, twist.angular_rad_s * self.turn_share)
        return twist

    def close(self) -> None:
        self.state = Lifecycle.CLOSED


class Lab:
    """A fake robot on a bench, on a simulated clock."""

    def __init__(self, description: Description = PLAIN, typed: TypedLines | None = None) -> None:
        self.clock = SimClock()
        self.driver = FakeDriver(self.clock, description)
        self.runtime = Runtime(self.clock)
        self.bench = Bench(self.driver, self.runtime, typed)
        self.hertz: list[float] = []

    def test(self) -> dict[str, Step]:
        self.driver.open()
        return {step.name: step for step in steps(self.bench, self.clock, 0.1, 5.0, self.hertz)}


@pytest.fixture
def lab() -> Lab:
    return Lab()


def verdicts(done: dict[str, Step]) -> dict[str, str]:
    return {name: step.verdict for name, step in done.items()}


def test_a_robot_that_does_as_it_is_told_passes(lab: Lab) -> None:
    done = lab.test()
    assert set(verdicts(done).values()) == {"passed"}
    assert list(done) == [
        "ready", "state", "readings", "activate", "forwards", "backwards", "left", "right", "silence stops it",
        "deactivate",
    ]  # fmt: skip
    assert lab.hertz[0] >= 45.0
    assert "battery 50%" in done["state"].what
    assert lab.driver.state is Lifecycle.READY


@pytest.mark.parametrize(
    ("broken", "share", "step", "word"),
    [
        ("forward_share", -1.0, "forwards", "backwards"),
        ("forward_share", 0.5, "forwards", "one wheel"),
        ("forward_share", 3.0, "backwards", "scale"),
        ("forward_share", 0.0, "forwards", "not connected"),
        ("turn_share", -1.0, "left", "swapped"),
        ("turn_share", 1.5, "right", "scale"),
    ],
)
def test_wrong_signs_and_scales_are_named(lab: Lab, broken: str, share: float, step: str, word: str) -> None:
    setattr(lab.driver, broken, share)
    done = lab.test()
    assert done[step].verdict == "failed"
    assert word in done[step].what


def test_a_robot_that_drives_on_in_silence_fails_and_is_stopped(lab: Lab) -> None:
    lab.driver.deaf_to_silence = True
    done = lab.test()
    assert done["silence stops it"].verdict == "failed"
    assert "DANGEROUS" in done["silence stops it"].what
    assert lab.driver.body.state().speed_m_s == 0.0


@pytest.mark.parametrize(
    ("broken", "last", "word"),
    [
        ("never_ready", "ready", "not READY within 5 s"),
        ("silent", "ready", ""),
        ("never_active", "activate", "READY"),
    ],
)
def test_the_test_ends_where_going_on_makes_no_sense(lab: Lab, broken: str, last: str, word: str) -> None:
    setattr(lab.driver, broken, True)
    done = lab.test()
    assert any(step.verdict == "failed" for step in done.values())
    if word:
        assert list(done)[-1] == last
        assert word in done[last].what
    assert "forwards" not in done


def test_a_robot_that_ignores_zero_fails_each_way(lab: Lab) -> None:
    lab.driver.coasts = True
    done = lab.test()
    assert "does not stand" in done["forwards"].what


def test_commands_after_deactivation_are_a_failure(lab: Lab) -> None:
    lab.driver.obeys_always = True
    assert lab.test()["deactivate"].verdict == "failed"


def test_a_hanging_wheel_must_be_mended_first(lab: Lab) -> None:
    lab.driver.hazards = Hazard.WHEEL_DROP
    step = lab.test()["state"]
    assert step.verdict == "failed"
    assert "wheel drop" in step.what


def test_an_autopilot_in_the_air_is_not_called_broken_when_nobody_looks() -> None:
    lab = Lab(replace(PLAIN, senses_pose=True))
    lab.driver.forward_share = lab.driver.turn_share = 0.0
    done = verdicts(lab.test())
    assert (done["forwards"], done["left"], done["silence stops it"]) == ("skipped", "skipped", "skipped")


def test_a_robot_that_cannot_reverse_is_not_asked_to() -> None:
    limits = replace(PLAIN.limits, can_reverse=False)
    done = verdicts(Lab(replace(PLAIN, limits=limits)).test())
    assert (done["backwards"], done["silence stops it"]) == ("skipped", "passed")


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    ends = os.pipe()
    yield ends
    for each in ends:
        os.close(each)


def test_the_operator_presses_the_bumper_and_skips_the_cliff(pipe: tuple[int, int]) -> None:
    lab = Lab(replace(PLAIN, senses_bumps=True), TypedLines(pipe[0]))

    def press() -> None:
        lab.driver.hazards = Hazard.BUMP
        lab.runtime.after(0.5, release)

    def release() -> None:
        lab.driver.hazards = Hazard.NONE
        lab.runtime.after(0.5, skip)

    def skip() -> None:
        os.write(pipe[1], b"\n")

    lab.runtime.after(2.0, press)
    done = verdicts(lab.test())
    assert (done["bumper"], done["cliff, wheel drop"]) == ("passed", "skipped")


def test_a_dead_bumper_is_found(pipe: tuple[int, int]) -> None:
    lab = Lab(replace(PLAIN, senses_bumps=True), TypedLines(pipe[0]))
    assert lab.test()["bumper"].verdict == "failed"


def test_an_interrupt_ends_the_wait(lab: Lab) -> None:
    lab.driver.open()

    def interrupt() -> None:
        lab.runtime.exit_signal = 2
        lab.runtime.stop()

    lab.runtime.after(0.1, interrupt)
    with pytest.raises(KeyboardInterrupt):
        lab.bench.drive(Twist(0.1, 0.0), 5.0)
    assert lab.clock.now_s() < 0.2


# ---------------------------------------------------------------- typed lines
def test_lines_come_whole_and_the_end_is_noticed(pipe: tuple[int, int]) -> None:
    reader, writer = pipe
    typed = TypedLines(reader)
    assert typed.line() is None
    os.write(writer, b"cliff on\nbatt")
    assert (typed.line(), typed.line()) == ("cliff on", None)
    os.write(writer, b"ery 0.1\n\n")
    assert (typed.line(), typed.line(), typed.line()) == ("battery 0.1", "", None)
    assert not typed.ended


def test_the_last_line_needs_no_end() -> None:
    reader, writer = os.pipe()
    os.write(writer, b"y")
    os.close(writer)
    typed = TypedLines(reader)
    assert (typed.line(), typed.line(), typed.line()) == (None, "y", None)
    assert typed.ended
    os.close(reader)


def test_a_closed_descriptor_has_ended() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    os.close(writer)
    typed = TypedLines(reader)
    assert typed.line() is None
    assert typed.ended
