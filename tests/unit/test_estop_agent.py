"""The latch on board: what survives, what is measured, what a release starts (nothing)."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from fullswarm.agent.orders.estops import SETTLE_TIMEOUT_S, LatchFolder
from fullswarm.agent.orders.inbox import REMEMBERED
from fullswarm.config import SwarmConfig
from fullswarm.launch.processes import RUN, STATE, latch_folder
from fullswarm.messages import EStop, StopRequest
from tests.unit.agent_bench import TICK_S, Bench

ORDER = EStop(id="e", engaged=True, source="ann", reason="smoke")
FAR = {"goal": [39.0, 5.0], "gain": 1.0, "arrive_radius_m": 0.2}
STICK = {"direction": [1.0, 0.0], "magnitude": 1.0, "speed_m_s": 0.3}


@pytest.fixture
def bench() -> Bench:
    return Bench([(5.0, 5.0, 0.0)], world={"bounds_m": [0, 0, 40, 40]})


def driving(bench: Bench) -> None:
    bench.enable("move_to_goal", FAR, request_id=f"q{bench.runtime.now_s()}")
    bench.run(1.5)
    assert bench.commanded[0, 0] > 0.2


def noticed(bench: Bench, seconds: float = 2.0) -> tuple[float, float]:
    """Press, run; return the way in the receipt and the true one."""
    before = float(bench.simulated.pose[0, 0])
    bench.estop(True, "e")
    bench.run(seconds)
    return bench.receipts[-1].rolled_m, float(bench.simulated.pose[0, 0]) - before


# ------------------------------------------------------------------ receipts
def test_the_wheels_are_told_before_the_receipt_goes_out(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    driving(bench)
    at_receipt: list[bool] = []
    publish = bench.bus.publish

    def look(key: str, message: object) -> None:
        if "receipt" in key:
            at_receipt.append(bool(bench.agent.setpoints.any()))
        publish(key, message)  # type: ignore[arg-type]  # whatever came

    monkeypatch.setattr(bench.bus, "publish", look)
    bench.estop(True, "e")
    assert at_receipt == [False]


def test_the_receipt_tells_how_far_it_rolled(bench: Bench) -> None:
    driving(bench)
    told_m, true_m = noticed(bench)
    assert bench.receipts[-1].standing
    assert told_m == pytest.approx(true_m, abs=0.005)
    assert told_m > 0.02


def test_a_noisy_pose_adds_no_way() -> None:
    noisy = Bench([(5.0, 5.0, 0.0)], world={"bounds_m": [0, 0, 40, 40], "noise": {"position_m": 0.05}})
    driving(noisy)
    told_m, true_m = noticed(noisy)
    assert told_m == pytest.approx(true_m, abs=0.01)


def test_who_tells_nothing_new_has_not_been_seen_standing(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """The link to the base is lost: the last reading says zero speed for ever."""
    reading = bench.agent.reading
    assert reading is not None
    monkeypatch.setattr(bench.agent.fleet, "read", lambda: reading)
    bench.estop(True, "e")
    bench.run(SETTLE_TIMEOUT_S + 1.0)
    assert [each.standing for each in bench.receipts] == [False, False], "at once, and after the time to settle"
    monkeypatch.undo()
    bench.run(0.2)
    assert bench.receipts[-1].standing, "it is watched on"


def test_a_driver_that_counts_anew_adds_no_way(bench: Bench) -> None:
    driving(bench)
    bench.estop(True, "e")
    bench.run(TICK_S)
    bench.simulated.odometry[0, :2] += 70.0
    bench.run(2.0)
    assert bench.receipts[-1].standing
    assert bench.receipts[-1].rolled_m < 0.5


# ------------------------------------------------------------------ release
def test_a_release_starts_nothing_that_was_asked_for_before_it(bench: Bench) -> None:
    bench.estop(True, "e")
    bench.enable("move_to_goal", FAR, request_id="meanwhile")
    assert not bench.acks[-1].accepted
    bench.estop(False, "f")
    bench.enable("move_to_goal", FAR, request_id="meanwhile")  # the core sends it once more
    bench.run(0.5)
    assert not bench.acks[-1].accepted
    assert "released by test" in bench.acks[-1].reason
    assert not bench.commanded.any()
    driving(bench)


# ------------------------------------------------------------------ a new process
def test_a_latch_outlives_the_process(tmp_path: Path) -> None:
    folder = LatchFolder(tmp_path / "deep" / "er")
    for release in (False, True):
        bench = Bench([(5.0, 5.0, 0.0)])
        bench.agent.inbox.remember_latches(folder)
        assert bench.agent.controller.estop[0] == release
        bench.enable("move_to_goal", FAR, request_id="q")
        bench.run(0.5)
        assert bench.commanded.any() != release
        bench.estop(True, "e")
        assert folder.holds("r1")
        if release:
            bench.estop(False, "f")
            assert not folder.holds("r1")
            driving(bench)


def test_a_latch_of_one_robot_is_not_anothers(tmp_path: Path) -> None:
    folder = LatchFolder(tmp_path)
    bench = Bench([(5.0, 5.0, 0.0), (8.0, 5.0, 0.0)])
    bench.agent.inbox.remember_latches(folder)
    bench.estop(True, "e", ("r2",))
    again = Bench([(5.0, 5.0, 0.0), (8.0, 5.0, 0.0)])
    again.agent.inbox.remember_latches(folder)
    assert again.agent.controller.estop.tolist() == [False, True]


def test_a_stop_is_kept_until_something_is_started(tmp_path: Path) -> None:
    folder = LatchFolder(tmp_path, "boot 1")
    bench = Bench([(5.0, 5.0, 0.0)])
    bench.agent.inbox.remember_latches(folder)
    driving(bench)
    bench.bus.publish(bench.keys.stop, StopRequest(id="s", source="ann"))
    bench.run(1.0)
    kept = folder.halt_of("r1", bench.runtime.now_s()).halt
    assert kept is not None
    assert (kept.id, kept.source, kept.estop) == ("s", "ann", False)
    assert kept.stamp_s == pytest.approx(bench.runtime.now_s() - 1.0, abs=0.05)
    rebooted = LatchFolder(tmp_path, "boot 2").halt_of("r1", 7.0).halt
    assert rebooted is not None
    assert (rebooted.id, rebooted.stamp_s) == ("s", 7.0)
    (tmp_path / "r1.stop").write_bytes(b'{"clock"')
    unread = folder.halt_of("r1", 9.0).halt
    assert unread is not None
    assert unread.stamp_s == 9.0
    driving(bench)
    assert folder.halt_of("r1", 9.0).halt is None


def test_a_request_that_a_stop_ended_stays_ended_after_a_restart_of_the_agent(tmp_path: Path) -> None:
    """Also when the robot was driven by a stick since: a core whose disk was full comes back with the old request."""
    folder = LatchFolder(tmp_path, "boot 1")
    bench = Bench([(5.0, 5.0, 0.0)])
    bench.agent.inbox.remember_latches(folder)
    bench.enable("move_to_goal", FAR, request_id="old")
    bench.run(0.5)
    bench.bus.publish(bench.keys.stop, StopRequest(id="s", source="ann"))
    bench.run(0.1)
    for number in range(2 * REMEMBERED):
        bench.enable("move", STICK, request_id=f"stick-{number}", expires_s=0.5)
        bench.run(0.05)
    assert bench.commanded.any()
    bench.enable("move_to_goal", FAR, request_id="old")
    bench.run(0.1)
    assert not bench.acks[-1].accepted  # many new requests have not pushed it out

    again = Bench([(5.0, 5.0, 0.0)])
    again.agent.inbox.remember_latches(folder)
    assert again.agent.inbox.halts == [None]
    again.enable("move_to_goal", FAR, request_id="old")
    again.run(0.5)
    assert not again.acks[-1].accepted
    assert "ended before" in again.acks[-1].reason
    assert not again.commanded.any()
    driving(again)


@pytest.mark.parametrize("by", ["stick", "request"])
@pytest.mark.parametrize("how", ["at once", "after disabling"])
@pytest.mark.parametrize("restarted", [False, True])
def test_a_request_that_another_one_replaced_starts_no_more(tmp_path: Path, by: str, how: str, restarted: bool) -> None:
    """The core lost power after the replacement, with the newest entries of its database, and sends the old one."""
    folder = LatchFolder(tmp_path, "boot 1")
    bench = Bench([(5.0, 5.0, 0.0)])
    bench.agent.inbox.remember_latches(folder)
    bench.enable("move_to_goal", FAR, request_id="old")
    bench.run(0.5)
    if how == "after disabling":
        bench.enable("move_to_goal", {}, request_id="new", enable=False)
    if by == "stick":
        bench.enable("move", STICK, request_id="new", expires_s=0.5)
    else:
        bench.enable("move_to_goal", {"goal": [5.0, 5.0]}, request_id="new")
    bench.run(1.0)
    assert bench.acks[-1].accepted
    if restarted:
        bench = Bench([(5.0, 5.0, 0.0)])
        bench.agent.inbox.remember_latches(folder)
    bench.enable("move_to_goal", FAR, request_id="old", core="later")
    bench.run(1.0)
    assert not bench.acks[-1].accepted
    assert ("ended before" if restarted else "superseded by new") in bench.acks[-1].reason
    assert not bench.acks[-1].enabled
    if by == "stick" or restarted:
        assert not bench.commanded.any()
    driving(bench)


def test_a_request_that_has_arrived_starts_no_more_after_a_restart_of_the_agent(tmp_path: Path) -> None:
    folder = LatchFolder(tmp_path, "boot 1")
    bench = Bench([(5.0, 5.0, 0.0)])
    bench.agent.inbox.remember_latches(folder)
    bench.enable("move_to_goal", {"goal": [5.5, 5.0]}, request_id="old")
    bench.agent.inbox.end(0, "arrived", "")
    bench.run(1.0)
    again = Bench([(5.0, 5.0, 0.0)])
    again.agent.inbox.remember_latches(folder)
    again.enable("move_to_goal", FAR, request_id="old", core="later")
    again.run(0.5)
    assert not again.acks[-1].accepted
    assert not again.commanded.any()


def test_a_stop_kept_by_an_older_version_is_read(tmp_path: Path) -> None:
    (tmp_path / "r1.stop").write_text('{"clock":"boot 1","halt":{"id":"s","stamp_s":3.0}}\n')
    kept = LatchFolder(tmp_path, "boot 1").halt_of("r1", 9.0)
    assert kept.halt is not None
    assert (kept.halt.id, kept.halt.stamp_s, kept.voided) == ("s", 3.0, ())


def test_a_disk_that_cannot_be_written_stops_nobody_less(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    bench = Bench([(5.0, 5.0, 0.0)])
    bench.agent.inbox.remember_latches(LatchFolder(tmp_path / "file" / "latches", "boot"))
    driving(bench)
    bench.bus.publish(bench.keys.stop, StopRequest(id="s", source="ann"))
    bench.run(1.0)
    assert not bench.commanded.any()
    driving(bench)


def test_what_is_in_the_file_does_not_matter(tmp_path: Path) -> None:
    folder = LatchFolder(tmp_path)
    folder.engage("r1", ORDER)
    assert "smoke" in (tmp_path / "r1.estop").read_text()
    (tmp_path / "r1.estop").write_bytes(b"")
    assert folder.holds("r1")
    folder.release("r1")
    folder.release("r1")
    assert not folder.holds("r1")


def test_a_disk_that_fails_stops_nobody_from_stopping(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    bench = Bench([(5.0, 5.0, 0.0)])
    bench.agent.inbox.remember_latches(LatchFolder(tmp_path / "file" / "below"))
    driving(bench)
    bench.estop(True, "e")
    bench.run(2.0)
    assert bench.receipts[-1].standing
    bench.estop(False, "f")
    driving(bench)


def test_when_in_doubt_it_is_latched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError("not yours")

    monkeypatch.setattr(Path, "stat", refuse)
    assert LatchFolder(tmp_path).holds("r1")


def test_a_latch_lives_as_long_as_the_body(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(STATE, str(tmp_path / "state"))
    config = SwarmConfig.model_validate(
        {"swarm": "lab", "world": {}, "robot": [{"id": "real", "driver": "create:///dev/ttyUSB0"}, {"id": "sim"}]}
    )
    real, simulated = config.robot
    monkeypatch.delenv(RUN, raising=False)
    assert latch_folder(config, real) == tmp_path / "state" / "estop" / "lab"
    assert latch_folder(config, simulated) == tmp_path / "state" / "estop" / "lab" / "127.0.0.1_7450"
    monkeypatch.setenv(RUN, str(tmp_path / "run"))
    assert latch_folder(config, real) == tmp_path / "state" / "estop" / "lab"
    assert latch_folder(config, simulated) == tmp_path / "run" / "estop", "the next demo starts free"
    monkeypatch.delenv(STATE)
    assert "fullswarm" in latch_folder(config, real).parts


def test_orders_without_end_leave_no_trace(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    reading = bench.agent.reading
    assert reading is not None
    monkeypatch.setattr(bench.agent.fleet, "read", lambda: reading)  # nobody is ever seen standing
    for number in range(400):
        bench.estop(True, f"e{number}")
    assert len(bench.agent.inbox.estops._decelerating) <= 256
    assert math.isfinite(bench.receipts[-1].rolled_m)
