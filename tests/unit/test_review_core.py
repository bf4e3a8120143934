"""Interleavings that the core must survive: half-done switches, restarts on either side, two operators, bad records."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec
import pytest
from structlog.testing import capture_logs

from fullswarm.core.centralised.node import CentralisedNode
from fullswarm.errors import ConfigError
from fullswarm.messages import (
    BehaviourRequest,
    CentralisedCommands,
    CentralisedRequest,
    ControlAck,
    ControlRequest,
    EStop,
    HealthReport,
    Heartbeat,
    Message,
    ParamReply,
    ParamRequest,
    RequestStatus,
    RobotStates,
    StopRequest,
    Value,
)
from fullswarm.operator.client import Operator
from fullswarm.operator.teleop import Teleop
from fullswarm.store import Store
from tests.unit.core_swarm import KEYS, Robot, Swarm, health

LINE: dict[str, Value] = {"shape": "line", "centre": [5.0, 5.0], "spacing_m": 1.0}


def restart_core(swarm: Swarm, path: Path) -> None:
    """Let the core die and another one start on the same database."""
    swarm.core.close()
    swarm.store.close()
    swarm.run(0.4)
    swarm.start_core(Store(path))


def set_param(swarm: Swarm, key: str, value: Any) -> ParamReply:
    replies: list[ParamReply] = []
    subscription = swarm.bus.subscribe(KEYS.param_reply("core"), ParamReply, replies.append)
    request = ParamRequest(id=f"p{len(swarm.messages)}", op="set", key=key, value=value)
    swarm.bus.publish(KEYS.param_request("core"), request)
    swarm.run(0.01)
    subscription.close()
    return replies[-1]


# ------------------------------------------------------------------ intents
def test_an_intent_resent_after_a_loss_lives_no_longer() -> None:
    swarm = Swarm(count=1)
    began_s = swarm.runtime.now_s()
    lost: list[Message] = []

    def drop(_key: str, message: Message) -> bool:
        lose = isinstance(message, ControlRequest) and len(lost) < 1
        lost.extend([message] if lose else [])
        return lose

    swarm.bus.drop = drop
    swarm.ask("i", "drive", "r0", linear=1.0)
    swarm.run(0.25)
    task = swarm.robots["r0"].task
    assert task is not None
    sent_s = next(at for at, _, m in swarm.messages if isinstance(m, ControlRequest) and m.enable)
    assert sent_s > began_s + 0.05
    assert sent_s + task.expires_s <= began_s + 0.3 + 1e-6
    swarm.close()


def test_an_intent_that_had_to_wait_for_a_disable_lives_no_longer() -> None:
    swarm = Swarm(count=1)
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    swarm.bus.drop = lambda _key, message: isinstance(message, ControlRequest | HealthReport)
    began_s = swarm.runtime.now_s()
    swarm.ask("i", "drive", "r0", linear=1.0)
    swarm.run(0.15)
    swarm.bus.drop = lambda _key, _message: False
    swarm.run(0.3)
    enables = [(at, m) for at, _, m in swarm.messages if isinstance(m, ControlRequest) and m.enable and m.expires_s]
    for at, message in enables:
        assert at + message.expires_s <= began_s + 0.3 + 1e-6
    swarm.close()


def test_an_intent_is_not_carried_out_after_the_interval_when_the_stick_is_long_released() -> None:
    swarm = Swarm(count=1, interval_s=5.0)
    swarm.ask("a", "flocking")
    swarm.run(0.1)
    swarm.ask("i", "drive", "r0", linear=1.0)
    swarm.run(0.1)
    assert swarm.robots["r0"].behaviour == "drive", "a stick waits for no interval"
    swarm.run(0.5)
    switches = len(swarm.robots["r0"].log)
    swarm.run(6.0)
    assert len(swarm.robots["r0"].log) == switches
    swarm.close()


# ------------------------------------------------------------------ restarts of the core
def test_a_request_is_kept_before_it_is_sent(tmp_path: Path) -> None:
    """A core that dies between the two must not leave robots with a request that its successor ends."""
    swarm = Swarm(store=Store(tmp_path / "core.db"))
    order: list[str] = []
    swarm.store.watch(lambda entry: order.append("kept") if entry.key.startswith("wanted/") else None)
    publish = swarm.bus.publish

    def note(key: str, message: Message) -> None:
        order.append(type(message).__name__) if isinstance(message, ControlRequest | RequestStatus) else None
        publish(key, message)

    swarm.bus.publish = note  # type: ignore[method-assign]  # listens at the very call, not after the mailbox
    swarm.ask("a", "flocking")
    swarm.run(0.02)
    assert order[0] == "kept"
    assert "ControlRequest" in order
    swarm.close()


def test_a_scheduled_request_survives_the_core(tmp_path: Path) -> None:
    swarm = Swarm(store=Store(tmp_path / "core.db"), interval_s=3.0)
    swarm.ask("a", "flocking")
    swarm.run(0.1)
    swarm.ask("b", "rendezvous")
    swarm.run(0.1)
    assert swarm.status("b").phase == "scheduled"
    restart_core(swarm, tmp_path / "core.db")
    swarm.run(4.0)
    assert swarm.behaviours() == ["rendezvous"] * 3
    assert swarm.status("b").phase == "running"
    assert all(robot.log.count(("on", "rendezvous", "b")) == 1 for robot in swarm.robots.values())
    swarm.close()


def test_core_restart_with_a_switch_half_done(tmp_path: Path) -> None:
    swarm = Swarm(store=Store(tmp_path / "core.db"))
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    swarm.bus.drop = lambda _key, message: isinstance(message, ControlRequest) and message.enable
    swarm.ask("b", "rendezvous")
    swarm.run(0.1)
    assert swarm.behaviours() == ["", "", ""]
    swarm.bus.drop = lambda _key, _message: False
    restart_core(swarm, tmp_path / "core.db")
    swarm.run(1.0)
    assert swarm.behaviours() == ["rendezvous"] * 3
    assert swarm.status("b").phase == "running"
    swarm.ask("b", "rendezvous")  # the operator, who never heard
    swarm.run(0.5)
    assert all(robot.log.count(("on", "rendezvous", "b")) == 1 for robot in swarm.robots.values())
    swarm.close()


def test_a_closed_core_does_nothing_more() -> None:
    swarm = Swarm(interval_s=1.0)
    swarm.ask("a", "flocking")
    swarm.run(0.1)
    swarm.ask("b", "rendezvous")
    swarm.run(0.1)
    swarm.core.close()
    swarm.store.close()
    swarm.messages.clear()
    swarm.run(2.0)
    assert swarm.sent(ControlRequest) == []
    swarm.bus.close()


def test_a_database_that_fails_does_not_end_the_core(monkeypatch: pytest.MonkeyPatch) -> None:
    swarm = Swarm()

    def fail(*_: object) -> None:
        raise ConfigError("the local database fails: disk full")

    monkeypatch.setattr(swarm.store, "set_many", fail)
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    assert swarm.behaviours() == ["flocking"] * 3
    swarm.bus.publish(KEYS.stop, StopRequest(id="s"))
    swarm.run(0.2)
    assert swarm.status("s").running == ("r0", "r1", "r2")
    swarm.close()


# ------------------------------------------------------------------ centralised behaviours
@pytest.mark.parametrize("both", [False, True])
def test_a_centralised_request_goes_on_after_a_restart_of_the_core(tmp_path: Path, both: bool) -> None:
    swarm = Swarm(store=Store(tmp_path / "core.db"))
    node = CentralisedNode(swarm.bus, swarm.runtime, swarm.config, "n1")
    commands: list[CentralisedCommands] = []
    swarm.bus.subscribe(KEYS.centralised_commands(), CentralisedCommands, commands.append)
    tell = swarm.runtime.every(0.05, lambda: swarm.bus.publish(KEYS.state("all", "h"), states("r0", "r1", "r2")))
    swarm.ask("c", "formation_assigned", **LINE)
    swarm.run(0.5)
    swarm.ask("d", "flocking", "r2")
    swarm.run(0.5)
    assert commands[-1].robots == ("r0", "r1")
    if both:
        node.close()
    restart_core(swarm, tmp_path / "core.db")
    if both:
        node = CentralisedNode(swarm.bus, swarm.runtime, swarm.config, "n2")
    swarm.run(4.0)
    commands.clear()
    before = len(swarm.robots["r0"].commands)
    swarm.run(1.0)
    assert commands[-1].robots == ("r0", "r1")
    assert len(swarm.robots["r0"].commands) - before >= 15
    swarm.ask("e", "flocking")
    swarm.run(1.0)
    commands.clear()
    swarm.run(1.0)
    assert commands == []
    tell.cancel()
    restart_core(swarm, tmp_path / "core.db")
    swarm.run(3.0)
    assert swarm.core.remapper.requests() == (), "what is over does not come back"
    node.close()
    swarm.close()


def test_a_centralised_intent_is_not_restored(tmp_path: Path) -> None:
    swarm = Swarm(store=Store(tmp_path / "core.db"))
    node = CentralisedNode(swarm.bus, swarm.runtime, swarm.config, "n1")
    swarm.ask("i", "teleop_centroid", vx=1.0)
    swarm.run(0.1)
    restart_core(swarm, tmp_path / "core.db")
    swarm.messages.clear()
    swarm.run(3.0)
    assert [m for m in swarm.sent(CentralisedRequest) if isinstance(m, CentralisedRequest) and m.enable] == []
    assert [m for m in swarm.sent(ControlRequest) if isinstance(m, ControlRequest) and m.enable] == []
    node.close()
    swarm.close()


def states(*robots: str, x_m: float = 1.0) -> RobotStates:
    count = len(robots)
    return RobotStates(
        host="h", sequence=1, stamp_s=0.0, robots=robots, x_m=tuple(x_m + k for k in range(count)),
        y_m=(1.0,) * count, heading_rad=(0.0,) * count, speed_m_s=(0.0,) * count, turn_rad_s=(0.0,) * count,
        radius_m=(0.17,) * count,
    )  # fmt: skip


def centralised_request(request_id: str, law: str, *robots: str, sequence: int = 1) -> CentralisedRequest:
    return CentralisedRequest(
        request_id=request_id, behaviour="x", law=law, enable=True, robots=robots, core="c", sequence=sequence,
        parameters={"targets": [[float(k), 0.0] for k in range(len(robots))], "gain": 1.0},
    )  # fmt: skip


def test_the_centralised_node_survives_what_it_does_not_know() -> None:
    swarm = Swarm(count=2)
    swarm.core.close()  # it would end what it did not ask for
    node = CentralisedNode(swarm.bus, swarm.runtime, swarm.config, "n1")
    with capture_logs() as logs:
        for sequence in range(1, 30):
            unknown = centralised_request("u", "nobody_knows", sequence=sequence)
            swarm.bus.publish(KEYS.centralised_request("x"), unknown)
            swarm.run(0.1)
    assert len(logs) == 1
    swarm.bus.publish(KEYS.centralised_request("x"), centralised_request("k", "formation_assigned", "r0", "r1"))
    swarm.run(0.1)
    uneven = msgspec.structs.replace(states("r0", "r1"), x_m=(1.0,))
    for odd in (uneven, states("r0", x_m=math.nan), states("r1", x_m=math.inf)):
        swarm.bus.publish(KEYS.state("all", "h"), odd)
        swarm.run(0.1)
    commands: list[CentralisedCommands] = []
    swarm.bus.subscribe(KEYS.centralised_commands(), CentralisedCommands, commands.append)
    swarm.bus.publish(KEYS.state("all", "h"), states("r0", "r1"))
    swarm.run(0.1)
    assert list(commands[-1].robots) == ["r0", "r1"]
    left = centralised_request("k", "formation_assigned", "r1", sequence=2)  # r0 left the group
    swarm.bus.publish(KEYS.centralised_request("x"), left)
    swarm.run(0.1)
    assert list(commands[-1].robots) == ["r1"]
    node.close()
    swarm.close()


def test_a_law_that_raises_anything_ends_nobody_else(monkeypatch: pytest.MonkeyPatch) -> None:
    from fullswarm.core.centralised import formation

    def broken(*_: object) -> None:
        raise TypeError("outside code")

    swarm = Swarm(count=1)
    monkeypatch.setattr(formation, "velocities", broken)
    swarm.core.close()
    node = CentralisedNode(swarm.bus, swarm.runtime, swarm.config, "n1")
    swarm.bus.publish(KEYS.centralised_request("x"), centralised_request("k", "formation_assigned", "r0"))
    swarm.run(0.05)
    swarm.bus.publish(KEYS.state("all", "h"), states("r0"))
    swarm.messages.clear()
    swarm.run(0.5)
    assert [m for m in swarm.sent(Heartbeat) if isinstance(m, Heartbeat) and m.node == "centralised"]
    node.close()
    swarm.close()


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
    assert swarm.core.handler.wanted("r0") is not None
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


def test_numbers_of_a_later_core_are_higher() -> None:
    swarm = Swarm(count=1)
    for k in range(5):
        swarm.ask(f"q{k}", "flocking" if k % 2 else "rendezvous")
        swarm.run(0.2)
    last = max(m.sequence for m in swarm.sent(ControlRequest) if isinstance(m, ControlRequest))
    swarm.core.close()
    swarm.store.close()
    swarm.messages.clear()
    swarm.start_core(Store())
    swarm.run(0.6)
    swarm.ask("n", "voronoi_coverage")
    swarm.run(0.2)
    assert min(m.sequence for m in swarm.sent(ControlRequest) if isinstance(m, ControlRequest)) > last
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


# ------------------------------------------------------------------ e-stop
def latches(swarm: Swarm) -> list[EStop]:
    return [m for m in swarm.sent(EStop) if isinstance(m, EStop)]


@pytest.mark.parametrize("with_core", [False, True])
def test_an_e_stop_outlives_the_agents_process(tmp_path: Path, with_core: bool) -> None:
    swarm = Swarm(store=Store(tmp_path / "core.db"))
    swarm.bus.publish(KEYS.estop, EStop(id="e", engaged=True, reason="smoke"))
    swarm.run(0.2)
    robot = swarm.robots["r1"]
    robot.kill()
    if with_core:
        restart_core(swarm, tmp_path / "core.db")
    swarm.messages.clear()
    robot.start()
    swarm.run(0.6)
    again = [each for each in latches(swarm) if "r1" in each.robots]
    assert len(again) == 1
    assert again[0].engaged
    assert again[0].id not in ("", "e")
    assert "smoke" in again[0].reason
    swarm.bus.publish(KEYS.estop, EStop(id="f", engaged=False))
    swarm.run(0.2)
    swarm.messages.clear()
    robot.kill()
    robot.start()
    swarm.run(0.6)
    assert latches(swarm) == []
    swarm.close()


def test_a_robot_that_was_away_is_latched_when_it_comes() -> None:
    swarm = Swarm(late=1)
    swarm.bus.publish(KEYS.estop, EStop(id="e", engaged=True))
    swarm.run(3.0)
    swarm.messages.clear()
    swarm.robots["r2"].start()
    swarm.run(2.0)
    assert [each.robots for each in latches(swarm)] == [("r2",)]
    swarm.close()


def test_a_failing_disk_cannot_keep_an_e_stop_from_being_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    swarm = Swarm()

    def fail(*_: object) -> None:
        raise ConfigError("the local database fails: disk full")

    monkeypatch.setattr(swarm.store, "set_many", fail)
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    swarm.bus.publish(KEYS.estop, EStop(id="e", engaged=True))
    swarm.run(0.2)
    assert swarm.behaviours() == ["", "", ""]
    swarm.close()


# ------------------------------------------------------------------ what operators may send
def test_odd_requests_are_answered_and_harm_nobody() -> None:
    swarm = Swarm()
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    odd: list[tuple[str, dict[str, Any]]] = [
        ("\u2603/**", {}), ("", {}), ("flocking\n", {}), ("x" * 100_000, {}),
        ("move_to_goal", {"goal": [math.nan, 1.0]}), ("move_to_goal", {"goal": [math.inf, 1.0]}),
        ("move_to_goal", {"goal": []}), ("move_to_goal", {"goal": [[1.0, 2.0]]}), ("move_to_goal", {"goal": "x"}),
        ("move_to_goal", {"goal": [1.0, 2.0], "gain": -math.inf}),
        ("move_to_goal", {"goal": [1.0, 2.0], "gain": 10**300}),
        ("move_to_goal", {"goal": [10**400, 2.0]}), ("formation", {"targets": [[1.0, 1.0]] * 5_000}),
        ("formation", {"targets": [1.0, [2.0, 3.0]]}), ("flocking", {"\u2603" * 1000: 1.0}),
        ("drive", {"linear": True}), ("drive", {"linear": 10**18}),
    ]  # fmt: skip
    for number, (behaviour, parameters) in enumerate(odd):
        request = BehaviourRequest(id=f"\u2603 {number}/*", behaviour=behaviour, parameters=parameters)
        swarm.bus.publish(KEYS.behaviour_request, request)
        swarm.run(0.02)
        status = swarm.status(f"\u2603 {number}/*")
        assert (status.phase, status.reason != "") == ("refused", True), (behaviour[:20], parameters)
    assert swarm.behaviours() == ["flocking"] * 3
    swarm.ask("b", "rendezvous", "r1", "r1", "r0", "r1")
    swarm.run(0.2)
    assert swarm.status("b").robots == ("r1", "r0")
    assert swarm.status("b").running == ("r1", "r0")
    swarm.close()


def test_an_empty_swarm_refuses_and_a_stranger_is_served() -> None:
    swarm = Swarm(count=0)
    swarm.ask("a", "flocking")
    swarm.bus.publish(KEYS.stop, StopRequest(id="s"))
    swarm.bus.publish(KEYS.estop, EStop(id="e", engaged=True))
    swarm.run(0.1)
    assert swarm.status("a").phase == "refused"
    assert swarm.status("s").phase == swarm.status("e").phase == "ended"
    stranger = Robot(swarm.bus, swarm.runtime, "x1").start()
    swarm.run(0.1)
    swarm.ask("b", "flocking")
    swarm.run(0.1)
    assert stranger.behaviour == "flocking"
    swarm.close()


def test_a_stop_without_an_id_counts_each_time() -> None:
    swarm = Swarm()
    for number in range(2):
        swarm.ask(f"a{number}", "flocking")
        swarm.run(0.2)
        assert swarm.behaviours() == ["flocking"] * 3
        swarm.bus.publish(KEYS.stop, StopRequest(id=""))
        for robot in swarm.robots.values():
            robot.stops.clear()
        swarm.run(1.0)
        assert swarm.behaviours() == ["", "", ""]
        assert all(swarm.core.handler.wanted(f"r{k}").behaviour == "stop" for k in range(3))  # type: ignore[union-attr]
    swarm.close()


def test_a_thousand_robots_in_one_request() -> None:
    swarm = Swarm(count=1000, late=999)
    swarm.ask("a", "formation", shape="grid", centre=[0.0, 0.0])
    swarm.run(0.1)
    status = swarm.status("a")
    assert (len(status.robots), status.running, len(status.missing)) == (1000, ("r0",), 999)
    swarm.close()


@pytest.mark.parametrize(
    "record",
    [
        {"summary": "x", "like": []},
        {"summary": "x", "like": {"a": 1}},
        {"summary": "x", "law": "flocking", "static": {"way": [{"a": 1}]}},
        {"summary": "x", "law": "flocking", "static": {"way": [[["deep"]]]}},
        {"summary": "x", "law": "flocking", "static": {"n": 2**70}},
        {"summary": "x", "law": "flocking", "parameters": {"p": {"type": "number", "default": 1.0, "min": 5.0}}},
        {"summary": "x", "law": "flocking", "expires_s": -1.0},
        {"like": "tested"},
        7,
        "flocking",
    ],
)
def test_a_bad_record_is_refused_and_the_old_one_goes_on(record: Any) -> None:
    swarm = Swarm(count=1)
    good: dict[str, object] = {"summary": "x", "law": "flocking", "parameters": {"p": {"type": "number", "default": 1}}}
    assert set_param(swarm, "behaviour/tested", good).ok
    swarm.ask("a", "tested")
    swarm.run(0.2)
    reply = set_param(swarm, "behaviour/tested", record)
    assert not reply.ok
    assert reply.reason
    swarm.ask("b", "tested", p=2.0)
    swarm.run(0.2)
    task = swarm.robots["r0"].task
    assert task is not None
    assert task.parameters == {"p": 2.0}
    swarm.close()


def test_a_record_changed_or_taken_away_while_it_runs_leaves_what_runs_alone() -> None:
    swarm = Swarm(count=2)
    record: dict[str, object] = {"summary": "x", "law": "flocking"}
    assert set_param(swarm, "behaviour/mine", record).ok
    swarm.ask("a", "mine")
    swarm.run(0.2)
    assert set_param(swarm, "behaviour/mine", {**record, "expires_s": 0.3}).ok
    assert set_param(swarm, "behaviour/mine", None).ok
    swarm.run(2.0)
    assert swarm.behaviours() == ["mine", "mine"]
    swarm.robots["r1"].kill()
    swarm.robots["r1"].start()
    swarm.run(1.0)
    assert swarm.behaviours() == ["mine", "mine"]
    swarm.ask("b", "mine")
    swarm.ask("c", "stop")
    swarm.run(0.2)
    assert swarm.status("b").phase == "refused"
    assert swarm.behaviours() == ["", ""]
    swarm.close()


# ------------------------------------------------------------------ operators
class Line:
    """An operator on a swarm's bus."""

    def __init__(self, swarm: Swarm, name: str = "o") -> None:
        self.swarm = swarm
        self.told: dict[str, list[RequestStatus]] = {}
        self.operator = Operator(swarm.bus, KEYS, swarm.runtime, name)

    def ask(self, behaviour: str, *robots: str) -> str:
        statuses: list[RequestStatus] = []
        asked = self.operator.request(behaviour, robots, {}, statuses.append)
        self.told[asked.request.id] = statuses
        return asked.request.id


def lose_first(swarm: Swarm, behaviour: str) -> None:
    lost: list[Message] = []

    def drop(_key: str, message: Message) -> bool:
        lose = isinstance(message, BehaviourRequest) and message.behaviour == behaviour and not lost
        lost.extend([message] if lose else [])
        return lose

    swarm.bus.drop = drop


def test_a_lost_request_is_not_repeated_after_a_newer_one_was_answered() -> None:
    swarm = Swarm()
    line = Line(swarm)
    lose_first(swarm, "flocking")
    old = line.ask("flocking")
    swarm.run(0.1)
    line.ask("rendezvous")
    swarm.run(1.0)
    assert swarm.behaviours() == ["rendezvous"] * 3, "the newest wins"
    assert [each.phase for each in line.told[old]] == ["superseded"], "and the lost one is not lost silently"
    swarm.close()


def test_a_lost_request_for_other_robots_is_still_repeated() -> None:
    swarm = Swarm()
    line = Line(swarm)
    lose_first(swarm, "flocking")
    line.ask("flocking", "r0")
    line.ask("rendezvous", "r1")
    swarm.run(1.0)
    assert swarm.behaviours() == ["flocking", "rendezvous", ""]
    swarm.close()


@pytest.mark.parametrize("how", ["stop", "estop"])
def test_a_lost_request_is_not_repeated_after_a_stop(how: str) -> None:
    swarm = Swarm()
    line = Line(swarm)
    lose_first(swarm, "flocking")
    old = line.ask("flocking")
    swarm.run(0.1)
    if how == "stop":
        line.operator.stop(("r0",))
    else:
        line.operator.estop(True, deadline_s=1.0)
    swarm.run(2.0)
    assert swarm.behaviours() == ["", "", ""]
    assert line.told[old][-1].phase == "superseded"
    swarm.close()


def test_a_stop_given_while_the_hub_is_away_is_given_when_it_is_back() -> None:
    swarm = Swarm()
    line = Line(swarm)
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    swarm.bus.drop = lambda _key, message: isinstance(message, StopRequest)
    swarm.bus.connected = lambda: False  # type: ignore[method-assign]  # the hub is away
    done: list[bool] = []
    burst = line.operator.stop(on_done=lambda: done.append(burst.done))
    swarm.run(1.5)
    assert not done
    swarm.bus.connected = lambda: True  # type: ignore[method-assign]
    swarm.run(0.6)  # the robots come back a little later than this operator
    swarm.bus.drop = lambda _key, _message: False
    swarm.run(3.0)
    assert swarm.behaviours() == ["", "", ""]
    assert done == [True]
    swarm.close()


def test_a_stop_that_cannot_be_given_says_so() -> None:
    swarm = Swarm()
    line = Line(swarm)
    swarm.bus.connected = lambda: False  # type: ignore[method-assign]  # and it stays away
    done: list[bool] = []
    burst = line.operator.stop(on_done=lambda: done.append(burst.done))
    swarm.run(30.0)
    assert done == [False]
    swarm.close()


def test_an_operator_who_dies_while_driving_and_one_who_asks_meanwhile() -> None:
    swarm = Swarm()
    line = Line(swarm)
    teleop = Teleop(line.operator, swarm.runtime)
    teleop.hold(1.0, 0.0)
    swarm.run(0.5)
    swarm.bus.drop = lambda _key, message: isinstance(message, BehaviourRequest) and message.source == "o"  # SIGKILL
    other = Line(swarm, "p")
    asked = other.ask("flocking")
    swarm.run(2.0)
    assert swarm.behaviours() == ["flocking"] * 3
    assert other.told[asked][-1].phase == "running"
    swarm.close()


def test_an_older_request_of_the_same_operator_that_comes_later_does_not_win() -> None:
    swarm = Swarm()
    swarm.run(10.0)
    new = BehaviourRequest(id="new", behaviour="rendezvous", robots=("r0", "r1"), source="o", stamp_s=100.0)
    swarm.bus.publish(KEYS.behaviour_request, new)
    swarm.run(0.1)
    for name, robots in (("old", ("r1",)), ("wide", ("r1", "r2"))):
        old = BehaviourRequest(id=name, behaviour="flocking", robots=robots, source="o", stamp_s=99.9)
        swarm.bus.publish(KEYS.behaviour_request, old)
        swarm.run(0.2)
    assert swarm.behaviours() == ["rendezvous", "rendezvous", "flocking"]
    assert (swarm.status("old").phase, swarm.status("old").reason) == (
        "superseded", "r1: superseded by new, which came first"
    )  # fmt: skip
    assert (swarm.status("wide").phase, swarm.status("wide").running) == ("running", ("r2",))
    assert "r1: superseded by new" in swarm.status("wide").reason
    other = BehaviourRequest(id="other", behaviour="flocking", robots=("r1",), source="p", stamp_s=1.0)
    swarm.bus.publish(KEYS.behaviour_request, other)
    swarm.run(0.2)
    assert swarm.behaviours() == ["rendezvous", "flocking", "flocking"], "another operator's clock tells nothing"
    swarm.run(5.0)
    for number in range(2):  # the operator's machine was started again: its clock begins anew
        again = BehaviourRequest(id=f"n{number}", behaviour="rendezvous", source="o", stamp_s=2.0 + number)
        swarm.bus.publish(KEYS.behaviour_request, again)
        swarm.run(0.2)
        assert swarm.status(f"n{number}").phase == "running"
    swarm.close()
