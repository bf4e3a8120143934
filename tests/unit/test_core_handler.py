from __future__ import annotations

import itertools
import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from fullswarm.messages import (
    ControlAck,
    ControlRequest,
    EStop,
    HealthReport,
    Heartbeat,
    Message,
    StopRequest,
)
from fullswarm.store import Store
from tests.unit.core_swarm import KEYS, Robot, Swarm, health


@pytest.fixture
def swarm() -> Iterator[Swarm]:
    made = Swarm()
    yield made
    made.close()


def test_a_request_reaches_every_robot_and_runs(swarm: Swarm) -> None:
    swarm.ask("a", "flocking")
    swarm.run(0.02)
    assert swarm.behaviours() == ["flocking"] * 3
    assert swarm.phases("a") == ["accepted", "running"]
    status = swarm.status("a")
    assert status.robots == status.running == ("r0", "r1", "r2")
    assert status.missing == status.refused_by == ()


def test_a_status_is_said_again_for_a_while_since_the_first_word_may_be_lost(swarm: Swarm) -> None:
    swarm.ask("a", "flocking")
    swarm.run(0.1)
    told = len(swarm.phases("a"))
    swarm.run(10.0)
    again = swarm.phases("a")[told:]
    assert set(again) == {"running"}
    assert 4 <= len(again) <= 7


def test_repeated_delivery_runs_once_and_is_answered_each_time(swarm: Swarm) -> None:
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    for _ in range(4):
        told = len(swarm.phases("a"))
        swarm.ask("a", "flocking")
        swarm.run(0.02)
        assert swarm.phases("a")[told:] == ["running"]
        swarm.run(0.18)
    assert all(robot.log == [("on", "flocking", "a")] for robot in swarm.robots.values())
    swarm.ask("b", "rendezvous")
    swarm.run(0.2)
    swarm.ask("a", "flocking")  # a late copy of what is over
    swarm.run(0.2)
    assert swarm.behaviours() == ["rendezvous"] * 3
    assert swarm.status("a").phase == "ended"
    assert swarm.status("a").reason == "superseded by b"


def test_duplicates_in_one_batch_run_once(swarm: Swarm) -> None:
    for _ in range(3):
        swarm.ask("a", "flocking")
    swarm.run(0.1)
    assert swarm.robots["r0"].log == [("on", "flocking", "a")]


def test_the_active_behaviour_is_acknowledged_off_before_the_next_goes_on(swarm: Swarm) -> None:
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    swarm.messages.clear()
    swarm.ask("b", "rendezvous")
    swarm.run(0.2)
    assert swarm.robots["r1"].log[-2:] == [("off", "flocking", "b"), ("on", "rendezvous", "b")]
    order = []
    for message in (each for _, _, each in swarm.messages):
        if isinstance(message, ControlRequest) and message.robot == "r1":
            order.append(("request", message.enable))
        if isinstance(message, ControlAck) and message.robot == "r1":
            order.append(("ack", message.enabled))
    assert order == [("request", False), ("ack", False), ("request", True), ("ack", True)]


def test_no_enable_leaves_while_the_disable_is_unacknowledged(swarm: Swarm) -> None:
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    swarm.robots["r0"].kill()
    swarm.bus.drop = lambda key, message: isinstance(message, ControlAck) and message.robot == "r1"
    swarm.messages.clear()
    swarm.ask("b", "rendezvous")
    swarm.run(0.04)
    to_r1 = [m for m in swarm.sent(ControlRequest) if isinstance(m, ControlRequest) and m.robot == "r1"]
    assert [m.enable for m in to_r1] == [False]


def test_the_same_behaviour_with_new_parameters_is_an_update(swarm: Swarm) -> None:
    swarm.ask("a", "move_to_goal", goal=[1.0, 1.0])
    swarm.run(0.2)
    swarm.ask("b", "move_to_goal", goal=[2.0, 2.0])
    swarm.run(0.2)
    assert swarm.robots["r0"].log == [("on", "move_to_goal", "a"), ("on", "move_to_goal", "b")]
    task = swarm.robots["r0"].task
    assert task is not None
    assert task.parameters["goal"] == [2.0, 2.0]
    assert swarm.status("a").reason == "superseded by b"


def test_rapid_requests_first_at_once_then_the_newest_none_silent() -> None:
    swarm = Swarm(interval_s=0.3)
    began_s = swarm.runtime.now_s()
    for k, name in enumerate(["flocking", "rendezvous", "voronoi_coverage", "flocking_bc", "rendezvous_bc"]):
        swarm.ask(f"q{k}", name)
        swarm.run(0.01)
    assert swarm.behaviours() == ["flocking"] * 3  # the leading edge did not wait
    swarm.run(began_s + 0.29 - swarm.runtime.now_s())
    assert swarm.behaviours() == ["flocking"] * 3
    assert swarm.status("q4").phase == "scheduled"
    swarm.run(0.1)
    assert swarm.behaviours() == ["rendezvous_bc"] * 3
    for k in (1, 2, 3):
        assert swarm.phases(f"q{k}") == ["scheduled", "superseded"]
        assert swarm.status(f"q{k}").reason == f"superseded by q{k + 1}"
    assert swarm.status("q0").phase == "ended"
    assert swarm.status("q4").phase == "running"
    switches = [entry[2] for entry in swarm.robots["r0"].log if entry[0] == "on"]
    assert switches == ["q0", "q4"]
    swarm.close()


def test_intents_of_a_stick_are_never_delayed_and_take_one_hop() -> None:
    swarm = Swarm(interval_s=5.0)
    swarm.ask("i0", "move_left", magnitude=0.1)
    swarm.run(0.01)
    for k in range(1, 10):
        swarm.ask(f"i{k}", "move_left", magnitude=k / 10)
        swarm.runtime.mailbox.drain()  # at this very moment
        task = swarm.robots["r0"].task
        assert task is not None
        assert task.parameters["magnitude"] == k / 10
        assert task.expires_s == 0.3
        swarm.run(0.05)
    assert all(entry[0] == "on" for entry in swarm.robots["r0"].log)
    assert swarm.status("i8").phase == "ended"
    swarm.run(0.5)
    assert swarm.status("i9").phase == "ended"
    assert "lapsed" in swarm.status("i9").reason
    swarm.close()


def test_a_late_joiner_gets_it_and_19_of_20_is_a_start() -> None:
    swarm = Swarm(count=20, late=1)
    swarm.ask("a", "flocking")
    swarm.run(0.1)
    status = swarm.status("a")
    assert (status.phase, len(status.running), status.missing) == ("running", 19, ("r19",))
    swarm.robots["r19"].start()
    swarm.run(0.1)
    assert swarm.robots["r19"].behaviour == "flocking"
    assert len(swarm.status("a").running) == 20
    assert swarm.status("a").missing == ()
    swarm.close()


def test_a_configured_swarm_that_is_not_there_yet_is_accepted() -> None:
    swarm = Swarm(late=3)
    swarm.ask("a", "flocking")
    swarm.run(0.1)
    assert swarm.status("a").phase == "accepted"
    assert swarm.status("a").missing == ("r0", "r1", "r2")
    swarm.close()


def test_a_robot_started_again_is_told_again(swarm: Swarm) -> None:
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    swarm.robots["r1"].kill()
    swarm.run(0.2)
    swarm.robots["r1"].start()  # before anybody noticed
    swarm.run(0.1)
    assert swarm.robots["r1"].behaviour == "flocking"
    swarm.robots["r1"].kill()
    swarm.run(2.0)
    assert swarm.status("a").missing == ("r1",)
    swarm.robots["r1"].start()
    swarm.run(0.1)
    assert swarm.robots["r1"].behaviour == "flocking"
    assert swarm.status("a").missing == ()
    assert swarm.robots["r0"].log == [("on", "flocking", "a")]


@pytest.mark.parametrize("seed", range(8))
def test_any_loss_ends_in_the_wanted_state_once(seed: int) -> None:
    swarm, chance = Swarm(), random.Random(seed)
    kinds = (ControlRequest, ControlAck, HealthReport)
    swarm.bus.drop = lambda key, message: isinstance(message, kinds) and chance.random() < 0.5
    swarm.ask("a", "flocking")
    swarm.run(3.0)
    swarm.ask("b", "rendezvous")
    swarm.run(5.0)
    assert swarm.behaviours() == ["rendezvous"] * 3
    wanted = [("on", "flocking", "a"), ("off", "flocking", "b"), ("on", "rendezvous", "b")]
    assert all(robot.log == wanted for robot in swarm.robots.values())
    swarm.bus.drop = lambda key, message: False  # half of the reports lost may look like absence
    swarm.run(1.0)
    assert swarm.status("b").running == ("r0", "r1", "r2")
    swarm.close()


def test_unacknowledged_requests_are_repeated_with_backoff_under_one_number(swarm: Swarm) -> None:
    swarm.bus.drop = lambda key, message: isinstance(message, ControlAck | HealthReport) and "r0" in key
    swarm.messages.clear()
    swarm.ask("a", "flocking", "r0")
    swarm.run(1.4)
    sent = [(at, m) for at, _, m in swarm.messages if isinstance(m, ControlRequest)]
    gaps = [round(b[0] - a[0], 2) for a, b in itertools.pairwise(sent)]
    assert gaps == sorted(gaps)
    assert gaps[0] == pytest.approx(0.1, abs=0.05)
    assert max(gaps) <= 0.55
    assert len({m.sequence for _, m in sent}) == 1


def test_stop_is_wanted_and_stays(swarm: Swarm) -> None:
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    swarm.bus.publish(KEYS.stop, StopRequest(id="s", robots=("r0", "r1", "nobody")))
    swarm.run(3.0)
    assert swarm.behaviours() == ["", "", "flocking"]
    assert swarm.status("s").phase == "running"
    assert swarm.status("s").running == ("r0", "r1")
    assert swarm.status("a").running == ("r2",)
    swarm.robots["r0"].kill()
    swarm.robots["r0"].start()
    swarm.run(1.0)
    assert swarm.behaviours() == ["", "", "flocking"]
    swarm.ask("b", "rendezvous")
    swarm.bus.publish(KEYS.stop, StopRequest(id="s"))  # a late copy does not stop what came after
    swarm.run(1.0)
    assert swarm.behaviours() == ["rendezvous"] * 3
    assert swarm.status("b").phase == "running"


def test_a_stop_waits_for_no_interval() -> None:
    swarm = Swarm(interval_s=5.0)
    swarm.ask("a", "flocking")
    swarm.run(0.01)
    swarm.ask("b", "rendezvous")
    swarm.run(0.01)
    swarm.ask("s", "stop")
    swarm.run(0.02)
    assert swarm.behaviours() == ["", "", ""]
    assert swarm.status("s").phase == "running"
    assert swarm.phases("b") == ["scheduled", "superseded"]
    swarm.run(6.0)
    assert swarm.behaviours() == ["", "", ""]
    swarm.close()


def test_a_stop_that_only_the_robot_heard_is_respected(swarm: Swarm) -> None:
    swarm.ask("a", "flocking")
    swarm.run(2.0)
    swarm.robots["r1"].halt()
    swarm.run(3.0)
    assert swarm.behaviours() == ["flocking", "", "flocking"]
    assert "r1" not in swarm.status("a").running
    assert "stopped by itself" in swarm.status("a").reason


def test_e_stop_ends_what_was_wanted(swarm: Swarm) -> None:
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    swarm.bus.publish(KEYS.estop, EStop(id="e", engaged=True, reason="smoke"))
    swarm.run(0.2)
    swarm.bus.publish(KEYS.estop, EStop(id="f", engaged=False))
    swarm.run(2.0)
    assert swarm.behaviours() == ["", "", ""]
    assert swarm.status("e").reason == "e-stop: smoke"


def test_who_refuses_is_named_and_not_pestered(swarm: Swarm) -> None:
    swarm.robots["r2"].refuse = "e-stop is latched"
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    status = swarm.status("a")
    assert (status.phase, status.running, status.refused_by) == ("running", ("r0", "r1"), ("r2",))
    assert status.reason == "r2: e-stop is latched"
    swarm.robots["r2"].refuse = ""
    swarm.run(2.0)
    assert swarm.robots["r2"].behaviour == ""  # clearing the e-stop starts nobody
    swarm.robots["r2"].refuse = "e-stop is latched"
    swarm.robots["r1"].refuse = "e-stop is latched"
    swarm.ask("b", "rendezvous", "r1", "r2")
    swarm.run(0.2)
    assert swarm.status("b").phase == "refused"
    assert swarm.status("b").reason == "r1, r2: e-stop is latched"
    swarm.ask("c", "voronoi_coverage")
    swarm.run(0.2)
    assert swarm.phases("b")[-1] == "refused"


def test_core_restart_with_a_store(tmp_path: Path) -> None:
    swarm = Swarm(store=Store(tmp_path / "core.db"))
    swarm.ask("z", "voronoi_coverage")
    swarm.run(0.2)
    swarm.ask("a", "move_to_goal", goal=[1.0, 2.0])
    swarm.run(0.2)
    swarm.ask("i", "move_left", "r2")
    swarm.run(0.2)
    swarm.core.close()
    swarm.store.close()
    swarm.robots["r1"].kill()
    swarm.run(0.3)
    swarm.start_core(Store(tmp_path / "core.db"))
    assert swarm.core.handler.wanted("r2") is None  # an intent is not restored, nor what it replaced
    swarm.robots["r1"].start()
    swarm.run(1.0)
    assert swarm.robots["r0"].log[-1] == ("on", "move_to_goal", "a")
    assert len(swarm.robots["r0"].log) == 3  # left in peace
    task = swarm.robots["r1"].task
    assert task is not None
    assert (task.request_id, task.parameters["goal"], task.core) == ("a", [1.0, 2.0], "core-2")
    assert swarm.robots["r2"].log[-1] == ("on", "move_left", "i")
    assert swarm.status("a").phase == "running"
    swarm.ask("z", "voronoi_coverage")  # a late copy
    swarm.run(0.5)
    assert swarm.robots["r0"].behaviour == "move_to_goal"
    assert swarm.status("z").phase == "ended"
    swarm.ask("b", "flocking")
    swarm.run(0.5)
    assert swarm.behaviours() == ["flocking"] * 3
    swarm.close()


def test_core_restart_without_memory_adopts_what_runs() -> None:
    swarm = Swarm()
    swarm.ask("a", "flocking", "r0", "r1")
    swarm.ask("i", "drive", "r2", linear=0.5)
    swarm.run(0.2)
    swarm.core.close()
    swarm.store.close()
    swarm.start_core(Store())
    swarm.run(1.0)
    assert swarm.status("a").phase == "running"
    assert swarm.status("a").running == ("r0", "r1")
    assert swarm.core.handler.wanted("r2") is None
    assert swarm.robots["r0"].log == [("on", "flocking", "a")]
    swarm.robots["r1"].kill()
    swarm.robots["r1"].start()
    swarm.run(0.5)
    assert swarm.robots["r1"].behaviour == ""  # nobody knows its parameters any more
    assert "lost the parameters" in swarm.status("a").reason
    swarm.ask("b", "rendezvous")
    swarm.run(0.5)
    assert swarm.behaviours() == ["rendezvous"] * 3
    assert swarm.robots["r2"].log[-2:] == [("off", "drive", "b"), ("on", "rendezvous", "b")]
    swarm.close()


def test_robots_may_part_and_the_request_ends_with_the_last(swarm: Swarm) -> None:
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    swarm.ask("b", "rendezvous", "r0")
    swarm.run(0.2)
    assert swarm.status("a").phase == "running"
    assert swarm.status("a").running == ("r1", "r2")
    swarm.ask("c", "voronoi_coverage", "r1", "r2")
    swarm.run(0.2)
    assert swarm.status("a").phase == "ended"
    assert swarm.behaviours() == ["rendezvous", "voronoi_coverage", "voronoi_coverage"]


def test_switching_while_the_enable_is_unanswered_disables_it_first(swarm: Swarm) -> None:
    lost: list[Message] = []

    def drop(key: str, message: Message) -> bool:
        if isinstance(message, ControlAck | HealthReport) and "r0" in key and len(lost) < 4:
            lost.append(message)
            return True
        return False

    swarm.bus.drop = drop
    swarm.ask("a", "flocking", "r0")
    swarm.run(0.06)
    swarm.ask("b", "rendezvous", "r0")
    swarm.run(1.0)
    assert swarm.robots["r0"].log == [("on", "flocking", "a"), ("off", "flocking", "b"), ("on", "rendezvous", "b")]


def test_heartbeat_names_what_is_in_hand(swarm: Swarm) -> None:
    swarm.ask("a", "flocking")
    swarm.run(1.0)
    beats = [m for m in swarm.sent(Heartbeat) if isinstance(m, Heartbeat)]
    assert beats[-1].active == ("a",)
    assert [m.sequence for m in beats] == [*range(1, len(beats) + 1)]
    assert 10 <= len(beats) <= 12


def test_a_stranger_joins_and_can_be_asked(swarm: Swarm) -> None:
    stranger = Robot(swarm.bus, swarm.runtime, "x9").start()
    odd = HealthReport(host="h", process="p", version="", robots=(health("*"), health("a/b")))
    swarm.bus.publish(KEYS.health("h"), odd)  # names that would address others
    swarm.run(0.1)
    swarm.ask("a", "flocking", "x9")
    swarm.run(0.1)
    assert stranger.behaviour == "flocking"
    assert swarm.core.roster.known() == ("r0", "r1", "r2", "x9")
