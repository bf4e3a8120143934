"""What becomes of requests: told, answered, superseded, stopped, ended."""

from __future__ import annotations

import pytest

from fullswarm.messages import ControlAck, ControlRequest, EStop, HealthReport, Heartbeat, StopRequest
from tests.unit.core_swarm import KEYS, Robot, Swarm, fresh, health

swarm = pytest.fixture(fresh)


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
    assert "expired" in swarm.status("i9").reason
    swarm.close()


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
