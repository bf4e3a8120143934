"""The driver's conversation with a rover in trouble: links cut, position or attitude lost, restarts."""

from __future__ import annotations

import pytest

from fullswarm.drivers.base import STAND, Hazard, Lifecycle
from fullswarm.drivers.guardian_process import Frames
from fullswarm.drivers.mavlink.codec import Encoder, StreamParser, dialect
from fullswarm.drivers.mavlink.protocol import Mode
from fullswarm.emulators.mavlink import parameters
from tests.unit.mavlink_bench import STEP_S, ArduBench


def test_after_a_cut_it_is_ready_within_two_seconds_never_active_and_disarmed_first() -> None:
    bench = ArduBench()
    bench.active()
    bench.run(1.0, bench.drive)
    bench.cut = True
    bench.until(lambda: bench.session.state is Lifecycle.FAULT, 1.5, bench.drive)
    bench.run(4.0, bench.drive)
    assert "no heartbeat" in bench.session.fault
    bench.cut = False
    back_s, seen = bench.now_s, set()
    bench.until(lambda: bench.session.state is Lifecycle.READY, 2.0, lambda: seen.add(bench.session.state))
    assert Lifecycle.ACTIVE not in seen
    assert bench.now_s - back_s < 2.0
    assert (bench.rover.armed, bench.drive()) == (False, STAND)


def test_attitude_lost_while_driving_is_a_fault_although_heartbeats_go_on() -> None:
    bench = ArduBench()
    bench.active()

    def drive_without_attitude() -> None:
        bench.rover.set_interval(30, -1.0, bench.now_s)
        bench.drive()

    bench.until(lambda: bench.session.state is Lifecycle.FAULT, 1.3, drive_without_attitude)
    assert "position or attitude" in bench.session.fault
    bench.until(lambda: bench.rover.mode == Mode.HOLD, 5.0, drive_without_attitude)


def test_a_link_lost_for_long_stops_the_rover_by_its_own_failsafe_and_comes_back_ready() -> None:
    bench = ArduBench()
    bench.active()
    bench.run(1.0, bench.drive)
    bench.cut = True
    bench.until(lambda: bench.session.state is Lifecycle.FAULT, 3.5, bench.drive)
    bench.run(8.0, bench.drive)
    assert bench.rover.failsafe
    assert (bench.rover.mode, bench.rover.armed) == (Mode.HOLD, True)
    assert bench.body.state().speed_m_s < 0.05
    bench.cut = False
    bench.until(lambda: bench.session.state is Lifecycle.READY, each=bench.drive)
    assert (bool(bench.rover.failsafe), bool(bench.rover.armed)) == (False, False)


def beat(bench: ArduBench, kind: int, autopilot: int, mode: int = 0, component: int = 1) -> None:
    """Let the session hear a heartbeat, as if the rover's system had sent it."""
    frame = Encoder(1, component).pack(dialect().MAVLink_heartbeat_message(kind, autopilot, 1, mode, 4, 3))
    bench.hear(StreamParser().feed(frame))


@pytest.mark.parametrize(("kind", "component"), [(26, 154), (27, 156)])  # gimbal, ADS-B receiver: both say ArduPilot
def test_what_else_is_aboard_is_not_the_vehicle(kind: int, component: int) -> None:
    bench = ArduBench()
    for _ in range(3):
        beat(bench, kind, 3, component=component)
        bench.run(0.05)
    assert "not driven" not in bench.session.fault
    bench.active()
    seen: set[tuple[Lifecycle, str]] = set()

    def drive() -> None:
        beat(bench, kind, 3, component=component)
        bench.drive()
        seen.add((bench.session.state, bench.session.fault))

    bench.run(2.0, drive)
    assert seen == {(Lifecycle.ACTIVE, "")}
    assert bench.body.state().speed_m_s > 0.4


@pytest.mark.parametrize("mode", [Mode.MANUAL, Mode.GUIDED])
@pytest.mark.parametrize(("kind", "autopilot", "words"), [(2, 3, "type 2"), (10, 18, "autopilot 18"), (10, 12, "PX4")])
def test_what_is_no_rover_of_ours_any_more_is_stopped_before_it_is_left_alone(
    mode: Mode, kind: int, autopilot: int, words: str
) -> None:
    bench = ArduBench()
    bench.active()
    bench.run(1.0, bench.drive)
    count = len(bench.rover.setpoints)
    beat(bench, kind, autopilot, mode)
    bench.run(0.05, bench.drive)
    assert bench.session.state is Lifecycle.FAULT
    assert words in bench.session.fault
    assert [record.speed_m_s for record in bench.rover.setpoints][count:][-1] == 0.0
    assert (bench.rover.mode, bench.rover.armed) == (Mode.HOLD, False)
    bench.ready()  # the rover itself was heard again
    assert bench.session.autopilot.key == "ardupilot"


def test_one_that_stays_no_rover_is_told_to_stop_for_five_seconds_only() -> None:
    bench = ArduBench()
    bench.active()
    bench.run(1.0, bench.drive)
    told: list[int] = []
    for _ in range(140):
        beat(bench, 2, 3, Mode.GUIDED)
        told.append(len(bench.session.tick(bench.now_s)))
        bench.clock.advance_to(bench.now_s + 0.05)
    stops = [at for at, count in enumerate(told) if count >= 3]
    assert 9 <= len(stops) <= 11
    assert stops[-1] * 0.05 <= 5.0
    assert not bench.session.standing_down


def test_a_failsafe_s_action_that_is_changed_while_driving_stops_the_rover() -> None:
    bench = ArduBench()
    bench.active()
    bench.run(1.0, bench.drive)
    bench.rover.parameters["FS_ACTION"] = 1.0
    bench.rover.broadcast(parameters.value_of(bench.rover.parameters, "FS_ACTION"))
    bench.until(lambda: bench.session.state is Lifecycle.FAULT, 0.2, bench.drive)
    assert "FS_ACTION 1 is RTL" in bench.session.fault
    bench.until(lambda: not bench.rover.armed and bench.rover.mode == Mode.HOLD, 3.0, bench.drive)


def stopped_with(bench: ArduBench, frames: Frames) -> None:
    """Let a guardian's frames arrive."""
    parser = StreamParser()
    for _, frame in frames:
        for message in parser.feed(frame):
            bench.rover.receive(message, bench.now_s)


def test_what_a_guardian_is_left_with_holds_and_then_disarms_what_we_drive_and_nothing_else() -> None:
    bench = ArduBench()

    def watched() -> bool:
        return bench.session.stop_plan(bench.now_s) is not None

    bench.ready()
    assert not watched()  # a pilot may drive it
    bench.session.activate(bench.now_s)
    bench.run(0.02)
    arming = bench.plan()  # before the arm command is on its way
    assert watched()
    bench.until(lambda: bench.session.state is Lifecycle.ACTIVE)
    plan = bench.plan()
    assert len(arming.stop) < len(plan.stop)  # a set-point would be stored, and driven when it arms
    bench.run(1.0, bench.drive)
    stopped_with(bench, plan.stop)
    assert (bench.rover.mode, bench.rover.armed) == (Mode.HOLD, True)
    stopped_with(bench, plan.leave)
    assert not bench.rover.armed
    bench.until(lambda: bench.session.state is Lifecycle.READY, 3.0)
    assert not watched()  # it is somebody else's now


def test_our_own_guardian_s_stop_is_a_fault_that_says_so_and_no_pilot_s() -> None:
    bench = ArduBench()
    bench.active()
    bench.run(1.0, bench.drive)
    stopped_with(bench, bench.plan().stop)
    bench.session.stopped_by_guardian(bench.now_s)  # its word comes before the vehicle's
    assert "its guardian stopped it" in bench.session.fault
    bench.until(lambda: bench.session.state is Lifecycle.READY, 3.0, bench.drive)
    assert not bench.rover.armed
    reading = bench.session.read()
    assert reading is not None
    assert not reading.hazards & Hazard.ESTOP_BUTTON
    bench.session.stopped_by_guardian(bench.now_s)  # a late word of a guardian changes nothing for one that stands
    assert bench.session.state is Lifecycle.READY


def test_a_rover_that_nothing_watches_over_is_not_driven() -> None:
    bench = ArduBench()
    bench.active()
    bench.run(1.0, bench.drive)
    bench.session.unguarded = "its guardian has ended"
    bench.run(0.02, bench.drive)
    assert bench.session.state is Lifecycle.FAULT
    bench.until(lambda: bench.session.state is Lifecycle.OPEN, 5.0, bench.insist)
    assert "its guardian has ended" in bench.session.unfit
    assert not bench.rover.armed
    bench.session.unguarded = ""
    bench.ready()


class MuteBench(ArduBench):
    """The vehicle hears the session; whether the session hears it is switched by `mute`. Each frame is a datagram."""

    mute = ready_with_a_fault = False

    def step(self) -> None:
        self.clock.advance_to(self.now_s + STEP_S)
        for frame in self.rover.tick(self.now_s):
            self.hear(self._pass(frame, self._down))
            for answer in self.session.tick(self.now_s):
                for message in self._pass(answer, self._up):
                    self.rover.receive(message, self.now_s)
            self.ready_with_a_fault |= self.session.state is Lifecycle.READY and bool(
                self.session.fault or self.session.unaided(self.now_s)
            )

    def _pass(self, frame: bytes, parser: StreamParser) -> list[object]:
        return [] if self.mute and parser is self._down else super()._pass(frame, parser)


@pytest.mark.parametrize("silent_s", [1.2 + 0.07 * number for number in range(24)])
def test_a_vehicle_that_speaks_again_is_ready_once_its_receiver_is_heard_and_not_with_a_fault(silent_s: float) -> None:
    bench = MuteBench()
    bench.active()
    bench.run(1.0, bench.drive)
    bench.mute = True
    bench.run(silent_s, bench.drive)
    assert bench.session.state in (Lifecycle.FAULT, Lifecycle.OPEN)
    bench.mute = False
    bench.until(lambda: bench.session.state is Lifecycle.READY, 4.0, bench.drive)
    bench.run(0.5, bench.drive)
    assert not bench.ready_with_a_fault
