"""Requests although words are lost, robots refuse, are late or die, and the core is started again."""

from __future__ import annotations

import itertools
import random
from pathlib import Path

import pytest

from fullswarm.messages import ControlAck, ControlRequest, HealthReport, Message
from fullswarm.store import Store
from tests.unit.core_swarm import KEYS, Swarm, fresh, health

swarm = pytest.fixture(fresh)


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


@pytest.mark.parametrize("answered", [False, True])
def test_a_restarted_agent_starts_a_request_once_though_its_first_report_comes_late(
    swarm: Swarm, answered: bool
) -> None:
    robot = swarm.robots["r1"]
    robot.kill()
    swarm.ask("a", "flocking", "r1")
    swarm.run(0.01)  # sent to the process that has died
    robot.start()
    swarm.bus.drop = lambda _, message: (
        isinstance(message, HealthReport) or (isinstance(message, ControlAck) and not answered)
    )
    swarm.run(0.4)
    assert robot.log == [("on", "flocking", "a")]
    swarm.bus.drop = lambda _key, _message: False
    process = f"r1-{robot.starts}"
    swarm.bus.publish(KEYS.health("r1"), HealthReport(host="r1", process=process, version="", robots=(health("r1"),)))
    swarm.run(2.0)
    assert robot.log == [("on", "flocking", "a")]
    assert swarm.status("a").running == ("r1",)
    robot.kill()
    swarm.run(0.2)
    robot.start()
    swarm.run(0.2)
    assert robot.log == [("on", "flocking", "a")] * 2  # another process, which has to start it


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
    assert swarm.core.handler.order_of("r2") is None  # an intent is not restored, nor what it replaced
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
    assert swarm.core.handler.order_of("r2") is None
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
