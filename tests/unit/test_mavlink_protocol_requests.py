"""Commands and parameters that are asked until they are answered, and what is known of the vehicle."""

from __future__ import annotations

import math
from functools import partial

import pytest
from hypothesis import given

from fullswarm.drivers.base import Pose
from fullswarm.drivers.linked import Odometer
from fullswarm.drivers.mavlink import protocol
from fullswarm.drivers.mavlink.autopilot import unsupported
from fullswarm.drivers.mavlink.px4 import AUTOPILOTS
from fullswarm.drivers.mavlink.requests import CommandQueue, EnsureParameter
from fullswarm.drivers.mavlink.vehicle import Vehicle
from tests.unit.mavlink_frames import angle, number, only, station


def test_a_command_is_sent_four_times_with_growing_confirmation() -> None:
    queue, encoder = CommandQueue(), station()
    results: list[int | None] = []
    queue.ask(511, lambda confirmation: encoder.message_interval(32, 20.0, confirmation), results.append)
    sent = [only(frame) for step in range(60) for frame in queue.tick(step * 0.05)]
    assert [message.confirmation for message in sent] == [0, 1, 2, 3]
    assert results == [None]
    assert queue.idle


def test_an_ack_settles_the_first_question_of_its_kind_only() -> None:
    queue, encoder = CommandQueue(), station()
    results: list[int | None] = []
    for message in (32, 30):
        queue.ask(511, partial(encoder.message_interval, message, 20.0), results.append)
    queue.on_ack(protocol.Ack(511, 0))  # before anything was sent: somebody else's
    assert results == []
    assert len(queue.tick(0.0)) == 1
    queue.on_ack(protocol.Ack(400, 0))
    queue.on_ack(protocol.Ack(511, protocol.Result.IN_PROGRESS))
    assert results == []
    queue.on_ack(protocol.Ack(511, 2))
    assert results == [2]
    assert only(queue.tick(0.0)[0]).param1 == 30.0


def test_a_parameter_counts_only_when_read_back_after_the_echo() -> None:
    ensure, encoder = EnsureParameter("FS_GCS_ENABLE", 1.0, frozenset((1.0, 2.0)), 2), station()
    assert only(ensure.tick(0.0, encoder)[0]).get_type() == "PARAM_REQUEST_READ"
    assert ensure.tick(0.5, encoder) == []
    ensure.receive(protocol.Parameter("WP_SPEED", 1.0))
    ensure.receive(protocol.Parameter("FS_GCS_ENABLE", 0.0))
    assert only(ensure.tick(0.6, encoder)[0]).get_type() == "PARAM_SET"
    ensure.receive(protocol.Parameter("FS_GCS_ENABLE", 1.0))  # the echo
    assert not ensure.confirmed
    assert only(ensure.tick(0.7, encoder)[0]).get_type() == "PARAM_REQUEST_READ"
    ensure.receive(protocol.Parameter("FS_GCS_ENABLE", 1.0))
    assert ensure.confirmed


def test_a_parameter_that_only_a_person_may_change_is_read_once_a_second_and_never_set() -> None:
    ensure, encoder = EnsureParameter("FS_ACTION", 2.0, frozenset((2.0, 5.0)), 2, writes=False), station()
    sent = []
    for step in range(30):
        frames = ensure.tick(step * 0.1, encoder)
        sent += [only(frame).get_type() for frame in frames]
        for _ in frames:
            ensure.receive(protocol.Parameter("FS_ACTION", 1.0))
    assert sent == ["PARAM_REQUEST_READ"] * 3
    assert (ensure.confirmed, ensure.found) == (False, 1.0)
    ensure.receive(protocol.Parameter("FS_ACTION", 2.0))
    assert ensure.confirmed
    ensure.receive(protocol.Parameter("FS_ACTION", 0.0))
    assert not ensure.confirmed


@given(number, number, angle)
def test_odometry_starts_at_zero_and_survives_a_new_origin(x: float, y: float, heading: float) -> None:
    odometer = Odometer()
    odometer.update(Pose(x, y, heading))
    assert odometer.pose == Pose(0.0, 0.0, 0.0)
    odometer.update(Pose(x + 2 * math.cos(heading), y + 2 * math.sin(heading), heading))
    assert odometer.pose.x_m == pytest.approx(2.0, abs=1e-6)
    assert odometer.pose.y_m == pytest.approx(0.0, abs=1e-6)
    odometer.rebase()
    odometer.update(Pose(0.0, 0.0, 1.0))
    assert odometer.pose.x_m == pytest.approx(2.0, abs=1e-6)


@pytest.mark.parametrize(("later_ms", "restarted"), [(4500, False), (5001, False), (100, True)])
def test_boot_time_going_backwards_is_a_restart(later_ms: int, restarted: bool) -> None:
    vehicle = Vehicle()
    for boot_ms in (5000, later_ms):
        vehicle.receive(protocol.Attitude(boot_ms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 1.0)
    assert vehicle.rebooted is restarted


@pytest.mark.parametrize(
    ("autopilot", "kind", "allowed"),
    [(3, 10, True), (3, 11, True), (3, 2, False), (12, 10, True), (12, 2, False), (0, 10, False)],
)
def test_only_rovers_of_the_two_autopilots_are_driven(autopilot: int, kind: int, allowed: bool) -> None:
    assert (unsupported(protocol.Heartbeat(kind, autopilot, 1, 0, 4), AUTOPILOTS) == "") is allowed
