"""Where am I, whom do I hear: estimators, the table of neighbours, the cells to listen to."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from fullswarm.agent.message_delay import MessageDelay
from fullswarm.agent.neighbours.estimates import Assumed, CellSubscriptions, Neighbours
from fullswarm.agent.pose.estimator import DirectEstimator, EkfEstimator
from fullswarm.bus import LocalBus
from fullswarm.config import SwarmConfig
from fullswarm.drivers.base import NO_OBSTACLES, FleetReading
from fullswarm.keys import Keys
from fullswarm.messages import RobotStates
from fullswarm.runtime import Mailbox

KEYS = Keys("s")


def reading(stamp_s: float, odometry: list[float], pose: list[float]) -> FleetReading:
    return FleetReading(
        np.array([stamp_s]), np.array([pose]), np.array([odometry]), np.zeros((1, 2)), np.zeros(1, np.uint8),
        np.zeros(1, np.int64), np.full(1, -1.0), NO_OBSTACLES, np.full(1, math.nan),
    )  # fmt: skip


def states(host: str, sequence: int, stamp_s: float, **where: tuple[float, float]) -> RobotStates:
    count = len(where)
    return RobotStates(
        host=host, sequence=sequence, stamp_s=stamp_s, robots=tuple(where), x_m=tuple(x for x, _ in where.values()),
        y_m=tuple(y for _, y in where.values()), heading_rad=(0.0,) * count, speed_m_s=(0.5,) * count,
        turn_rad_s=(0.0,) * count, radius_m=(0.17,) * count,
    )  # fmt: skip


def test_without_a_sensed_pose_odometry_is_laid_on_the_start() -> None:
    estimator = DirectEstimator(np.array([[2.0, 3.0, math.pi / 2]]))
    pose = estimator.update(reading(0.0, [1.0, 0.5, 0.1], [math.nan] * 3), 0.02)
    assert pose[0] == pytest.approx([1.5, 4.0, math.pi / 2 + 0.1])
    assert estimator.update(reading(0.0, [9.0, 9.0, 0.0], [1.0, 2.0, 0.3]), 0.02)[0] == pytest.approx([1.0, 2.0, 0.3])


def test_the_filter_is_nearer_the_truth_than_its_sensor() -> None:
    rng = np.random.default_rng(3)
    sigma_m, sigma_rad = 0.05, 0.05
    ekf = EkfEstimator(np.array([[0.0, 0.0, 0.0]]), np.array([[sigma_m, sigma_rad]]))
    truth, sensed_error, fused_error = np.zeros(3), [], []
    for tick in range(1, 600):
        truth += np.array([0.01 * math.cos(truth[2]), 0.01 * math.sin(truth[2]), 0.01])
        noisy = truth + rng.normal(0.0, [sigma_m, sigma_m, sigma_rad])
        pose = ekf.update(reading(0.02 * tick, truth.tolist(), noisy.tolist()), 0.02)[0]
        assert -math.pi <= pose[2] <= math.pi
        if tick > 100:
            sensed_error.append(math.dist(noisy[:2], truth[:2]))
            fused_error.append(math.dist(pose[:2], truth[:2]))
    assert np.mean(fused_error) < 0.4 * np.mean(sensed_error)


def test_the_filter_dead_reckons_while_the_sensor_is_silent() -> None:
    ekf = EkfEstimator(np.array([[1.0, 1.0, math.pi / 2]]), np.full((1, 2), 0.05))
    for tick in range(1, 51):
        pose = ekf.update(reading(0.02 * tick, [0.01 * tick, 0.0, 0.0], [math.nan] * 3), 0.02)
    assert pose[0] == pytest.approx([1.0, 1.5, math.pi / 2], abs=1e-6)


def test_neighbours_are_moved_on_and_forgotten_when_old() -> None:
    table = Neighbours(("me",), timeout_s=1.0)
    table.receive(states("a", 1, 0.0, a=(2.0, 0.0), me=(0.0, 0.0)), 10.0)
    position = np.array([[0.0, 0.0]])
    table.set_time(10.4)
    start, other = table.within(position, 3.0)
    assert start.tolist() == [0, 1]
    assert table.predicted[other[0]].tolist() == pytest.approx([2.2, 0.0])
    assert table.oldest_age_s(10.4) == pytest.approx(0.4)
    table.set_time(11.1)
    assert table.within(position, 3.0)[0].tolist() == [0, 0]


def test_the_error_of_a_reported_pose_widens_the_disc_and_not_its_direction() -> None:
    exact, noisy = (Neighbours(("me",), timeout_s=1.0, assumed=Assumed(2.0, 0.5, 4.0, 1.3, 3.0)) for _ in range(2))
    message = states("a", 1, 0.0, a=(2.0, 0.0))
    exact.receive(message, 10.0)
    noisy.receive(msgspec.structs.replace(message, sigma_m=(0.02,)), 10.0)
    for table in (exact, noisy):
        table.set_time(10.1)
        table.around(np.array([[0.0, 0.0]]), 3.0)
    assert noisy.spread_m[0] == pytest.approx(exact.spread_m[0] + 0.06)
    assert noisy.blur_m[0] == exact.blur_m[0] > 0.0
    turned = Neighbours(("me",), timeout_s=1.0, assumed=Assumed(2.0, 0.5, 4.0, 1.3, 3.0))
    turned.receive(msgspec.structs.replace(message, sigma_rad=(0.1,)), 10.0)
    turned.set_time(10.1)
    turned.around(np.array([[0.0, 0.0]]), 3.0)
    assert turned.spread_m[0] == turned.blur_m[0] > exact.spread_m[0]


def test_an_older_message_does_not_undo_a_newer_one_but_a_restarted_host_is_heard() -> None:
    table = Neighbours(("me",), timeout_s=1.0)
    table.receive(states("a", 5, 1.0, a=(2.0, 0.0)), 1.0)
    table.receive(states("a", 4, 0.9, a=(9.0, 0.0)), 1.1)
    assert table.states[0, 0] == 2.0
    table.receive(states("a", 1, 3.0, a=(4.0, 0.0)), 3.0)
    assert table.states[0, 0] == 4.0


def test_a_robot_whose_computer_has_booted_is_heard_at_its_new_place() -> None:
    table = Neighbours(("me",), timeout_s=1.0)
    table.receive(states("a", 9000, 900.0, a=(5.0, 0.0)), 10.0)
    table.receive(states("a", 8999, 899.9, a=(6.0, 0.0)), 10.9)
    assert table.states[0, 0] == 5.0
    table.receive(states("a", 1, 12.0, a=(1.0, 0.0)), 40.0)
    table.receive(states("a", 2, 12.1, a=(1.1, 0.0)), 40.1)
    assert table.states[0, 0] == 1.1


def test_the_table_grows_with_the_swarm() -> None:
    table = Neighbours(("r0",), timeout_s=1.0)
    for number in range(100):
        table.receive(states(f"r{number}", 1, 0.0, **{f"r{number}": (0.1 * number, 0.0)}), 0.0)
    table.set_time(0.0)
    start, _ = table.within(np.array([[0.0, 0.0]]), 20.0)
    assert start[-1] == 99


def test_a_robot_listens_to_the_cells_around_it() -> None:
    mailbox = Mailbox()
    bus, heard = LocalBus(mailbox), []
    listening = CellSubscriptions(bus, KEYS.state, RobotStates, 3.0, lambda message: heard.append(message.host))
    for x, expected in ((1.0, {"near"}), (31.0, {"far"})):
        heard.clear()
        listening.follow(np.array([[x, 1.0]]), 3.0)
        bus.publish(KEYS.state("0_0", "near"), states("near", 1, 0.0, a=(1.0, 1.0)))
        bus.publish(KEYS.state("10_0", "far"), states("far", 1, 0.0, b=(31.0, 1.0)))
        mailbox.drain()
        assert set(heard) == expected
    heard.clear()
    listening.follow(np.array([[1.0, 1.0]]), 60.0)
    bus.publish(KEYS.state("10_0", "far"), states("far", 2, 0.0, b=(31.0, 1.0)))
    mailbox.drain()
    assert heard == ["far"], "a law that hears far must get far states"
    listening.close()
    bus.publish(KEYS.state("0_0", "near"), states("near", 2, 0.0, a=(1.0, 1.0)))
    mailbox.drain()
    assert heard == ["far"]


@pytest.mark.parametrize(("robots", "cell_m"), [(16, 0.0), (17, 3.0)])
def test_many_robots_publish_by_cell(robots: int, cell_m: float) -> None:
    config = SwarmConfig.model_validate({"robot": [{"id": f"r{number}"} for number in range(robots)]})
    assert config.state_cell_m == cell_m


def test_delay_is_measured_without_a_common_clock() -> None:
    freshness = MessageDelay()
    assert freshness.delay_s("core", 1000.0, 5.0) == 0.0
    assert freshness.delay_s("core", 1000.5, 5.9) == pytest.approx(0.4)
    assert freshness.delay_s("core", 1001.0, 6.0) == pytest.approx(0.0)
    assert freshness.delay_s("another", 3.0, 6.1) == 0.0


def test_a_sender_that_was_suspended_is_believed_again() -> None:
    freshness = MessageDelay()
    freshness.delay_s("core", 0.0, 0.0)
    delays = [freshness.delay_s("core", 0.1 * tick, 0.1 * tick + 60.0) for tick in range(1, 150)]
    assert delays[0] == pytest.approx(60.0, abs=0.01)
    assert delays[-1] == pytest.approx(0.0)


def test_clocks_that_went_apart_in_a_long_silence_are_no_delay_but_a_queue_is() -> None:
    for waited_s, delay_s in ((0.0, 0.0), (60.0, 57.7)):
        freshness, silence_s = MessageDelay(), 8 * 3600.0
        freshness.delay_s("core", 100.0, 0.0)
        arrival_s = silence_s * (1.0 + 20e-6)
        assert freshness.delay_s("core", 100.0 + silence_s - waited_s, arrival_s) == pytest.approx(delay_s, abs=0.1)


def test_what_a_stranger_says_wrongly_is_not_heard() -> None:
    table = Neighbours(("me",), timeout_s=1.0)
    good = states("a", 1, 0.0, a=(2.0, 0.0))
    table.receive(msgspec.structs.replace(good, x_m=(1.0, 2.0)), 0.0)
    table.receive(msgspec.structs.replace(good, sequence=2, heading_rad=(math.inf,)), 0.0)
    table.receive(msgspec.structs.replace(states("b", 1, 0.0, b=(1.0, 0.0), c=(1.0, 1.0)), y_m=(0.0, math.nan)), 0.0)
    table.set_time(0.0)
    start, other = table.within(np.array([[0.0, 0.0]]), 3.0)
    assert table.states[other[: start[-1]], 0].tolist() == [1.0]


def test_a_host_may_say_its_cells_one_after_the_other() -> None:
    table = Neighbours(("me",), timeout_s=1.0)
    table.receive(states("host", 7, 1.0, a=(1.0, 0.0)), 1.0)
    table.receive(states("host", 7, 1.0, b=(2.0, 0.0)), 1.0)
    table.set_time(1.0)
    assert table.within(np.array([[0.0, 0.0]]), 3.0)[0].tolist() == [0, 2]
