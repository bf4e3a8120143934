"""The driver's conversation with a rover that starts: boot, rates, and a failsafe that watches us."""

from __future__ import annotations

import pytest

from fullswarm.drivers.base import Lifecycle
from fullswarm.drivers.mavlink.protocol import Mode
from tests.unit.mavlink_bench import ArduBench


def test_a_real_boot_takes_its_time_and_early_acks_are_not_believed() -> None:
    bench = ArduBench(boot_s=42.4)
    bench.run(41.0, bench.insist)
    assert bench.session.state is Lifecycle.OPEN
    assert "position" in bench.session.why
    assert not bench.rover.armed
    bench.ready()
    assert bench.now_s - 100.0 == pytest.approx(42.4, abs=1.5)
    assert not bench.rover.setpoints


def test_no_vehicle_is_a_fault_after_three_seconds_and_heals() -> None:
    bench = ArduBench()
    bench.cut = True
    bench.run(3.2)
    assert bench.session.state is Lifecycle.FAULT
    assert "no heartbeat from system 1" in bench.session.fault
    bench.cut = False
    bench.ready()
    assert bench.session.fault == ""


def test_rates_are_asked_within_the_cap_and_lowered_when_denied() -> None:
    bench = ArduBench(loop_hz=20.0)  # cap 16 Hz
    bench.ready()
    bench.run(1.0)
    stamps = set()
    bench.run(2.0, lambda: stamps.add(getattr(bench.session.read(), "stamp_s", 0.0)))
    assert 17 <= len(stamps) <= 22  # 10 Hz
    assert any("too fast" in text for text in bench.texts)


def test_lost_frames_only_cost_time() -> None:
    bench = ArduBench(loss=0.3)
    bench.until(lambda: bench.session.state is Lifecycle.ACTIVE, 60.0, bench.insist)
    bench.run(2.0, bench.drive)
    assert bench.body.state().speed_m_s > 0.4
    assert all(record.armed for record in bench.rover.setpoints)
    bench.session.deactivate(bench.now_s)
    bench.until(lambda: not bench.rover.armed and bench.rover.mode == Mode.HOLD)


@pytest.mark.parametrize(("name", "value"), [("SYSID_MYGCS", 250.0)])
def test_a_failsafe_that_would_not_watch_us_keeps_it_open(name: str, value: float) -> None:
    bench = ArduBench()
    bench.rover.parameters[name] = value
    bench.run(4.0)
    assert bench.session.state is Lifecycle.OPEN
    assert name in bench.session.why


def test_without_the_failsafe_parameter_it_is_never_ready() -> None:
    bench = ArduBench()
    del bench.rover.parameters["FS_GCS_ENABLE"]
    bench.run(6.0, bench.insist)
    assert bench.session.state is Lifecycle.OPEN
    assert "FS_GCS_ENABLE=1 is not confirmed: the vehicle does not answer" in bench.session.why


def test_the_name_of_the_station_s_parameter_from_4_7_on_is_known() -> None:
    bench = ArduBench()
    bench.rover.parameters["MAV_GCS_SYSID"] = 250.0
    bench.run(4.0)
    assert "MAV_GCS_SYSID is 250" in bench.session.why


def test_rates_that_were_forgotten_are_asked_again() -> None:
    bench = ArduBench()
    bench.ready()
    for message in (30, 32):
        bench.rover.set_interval(message, 0.0, bench.now_s)  # back to 1 Hz
    bench.run(5.0)
    stamps = set()
    bench.run(1.0, lambda: stamps.add(getattr(bench.session.read(), "stamp_s", 0.0)))
    assert len(stamps) > 15


@pytest.mark.parametrize("action", [0, 1, 3, 4, 6, 9])
def test_a_failsafe_that_would_not_end_standing_is_not_switched_on_until_a_person_has_changed_it(action: int) -> None:
    bench = ArduBench()
    bench.rover.parameters["FS_ACTION"] = float(action)
    bench.run(4.0, bench.insist)
    assert bench.session.state is Lifecycle.OPEN
    assert f"FS_ACTION {action} " in bench.session.why
    assert "set it to 2 (HOLD)" in bench.session.why
    assert bench.session.unfit == f"bench: {bench.session.why}"  # the driver's fault: so that operators see it
    assert (bench.rover.parameters["FS_GCS_ENABLE"], bench.rover.parameters["FS_ACTION"]) == (0.0, action)
    bench.rover.parameters["FS_ACTION"] = 2.0
    bench.until(lambda: bench.session.state is Lifecycle.READY, 3.0)
    assert (bench.rover.parameters["FS_GCS_ENABLE"], bench.session.unfit) == (1.0, "")


def test_a_failsafe_that_disarms_ends_standing_too() -> None:
    bench = ArduBench()
    bench.rover.parameters["FS_ACTION"] = 5.0
    bench.ready()
    assert (bench.rover.parameters["FS_GCS_ENABLE"], bench.rover.parameters["FS_ACTION"]) == (1.0, 5.0)


def test_a_failsafe_s_action_that_is_never_told_does_not_count_as_hold() -> None:
    bench = ArduBench()
    del bench.rover.parameters["FS_ACTION"]
    bench.run(6.0, bench.insist)
    assert bench.session.state is Lifecycle.OPEN
    assert bench.session.why == "FS_ACTION=2 is not confirmed: the vehicle does not answer"
    assert bench.rover.parameters["FS_GCS_ENABLE"] == 0.0
