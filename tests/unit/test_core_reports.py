"""Late and foreign reports of robots, and their refusals: nothing that is over changes anything."""

from __future__ import annotations

from typing import Any

from fullswarm.messages import ControlAck, ControlRequest, HealthReport
from tests.unit.core_swarm import KEYS, Swarm, health


# ------------------------------------------------------------------ late and foreign reports
def report(robot: str, process: str, stamp_s: float, **fields: Any) -> HealthReport:
    return HealthReport(host=robot, process=process, version="", robots=(health(robot, **fields),), stamp_s=stamp_s)


def test_a_late_report_of_a_process_that_is_gone_changes_nothing() -> None:
    swarm = Swarm(count=1)
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    robot = swarm.robots["r0"]
    robot.kill()
    robot.start()
    swarm.run(0.2)
    switches = list(robot.log)
    swarm.bus.publish(KEYS.health("r0"), report("r0", "r0-1", 0.0))  # idle, from before
    swarm.run(0.3)
    assert robot.log == switches
    assert swarm.status("a").running == ("r0",)
    swarm.close()


def test_a_first_report_that_comes_after_the_next_process_does_not_shut_that_out() -> None:
    swarm = Swarm(count=1)
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    robot = swarm.robots["r0"]
    robot.kill()
    robot.start()
    swarm.run(0.2)
    swarm.bus.publish(KEYS.health("r0"), report("r0", "in between", 0.0))  # it died before anybody heard of it
    swarm.run(3.0)
    assert robot.behaviour == "flocking"
    assert swarm.status("a").running == ("r0",)
    swarm.close()


def test_a_late_report_of_the_same_process_changes_nothing() -> None:
    swarm = Swarm(count=1)
    robot = swarm.robots["r0"]
    robot.kill()
    swarm.bus.publish(KEYS.health("r0"), report("r0", "p", 10.0))
    swarm.ask("a", "flocking")
    swarm.run(0.05)
    sent = swarm.sent(ControlRequest)[-1]
    assert isinstance(sent, ControlRequest)
    ack = ControlAck(
        request_id="a", robot="r0", behaviour="flocking", enabled=True, accepted=True, core=sent.core,
        sequence=sent.sequence,
    )  # fmt: skip
    swarm.bus.publish(KEYS.ack("r0"), ack)
    for stamp_s in (12.0, 13.0, 11.0):  # the idle one waited somewhere
        swarm.run(0.4)
        runs = {} if stamp_s == 11.0 else {
            "behaviour": "flocking", "request_id": "a", "core": sent.core, "sequence": sent.sequence
        }  # fmt: skip
        swarm.bus.publish(KEYS.health("r0"), report("r0", "p", stamp_s, **runs))
    swarm.run(0.1)
    assert swarm.status("a").phase == "running"
    assert swarm.core.handler.order_of("r0") is not None
    swarm.close()


def test_a_robot_taken_over_by_another_core_is_not_called_running() -> None:
    swarm = Swarm(count=1)
    swarm.ask("a", "flocking")
    swarm.run(1.0)
    robot = swarm.robots["r0"]
    other = ControlRequest(
        request_id="z", robot="r0", behaviour="rendezvous", law="rendezvous", enable=True, core="core-9", sequence=1
    )
    swarm.bus.publish(KEYS.control_requests("r0", "rendezvous"), other)
    swarm.run(2.0)
    assert robot.behaviour == "rendezvous", "they do not fight over it"
    assert "another core" in swarm.status("a").reason
    assert swarm.status("a").running == ()
    swarm.close()


# ------------------------------------------------------------------ refusals
def test_a_refusal_is_final_whatever_the_robot_reports_later() -> None:
    swarm = Swarm(count=2)
    robot = swarm.robots["r1"]
    robot.refuse = "cliff; ask for it again"
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    assert swarm.status("a").refused_by == ("r1",)
    robot.refuse = ""
    swarm.messages.clear()
    swarm.run(5.0)
    robot.kill()
    robot.start()
    swarm.run(5.0)
    to_r1 = [m for m in swarm.sent(ControlRequest) if isinstance(m, ControlRequest) and m.robot == "r1"]
    assert to_r1 == []
    assert (swarm.status("a").refused_by, swarm.status("a").reason) == (("r1",), "r1: cliff; ask for it again")
    swarm.close()
