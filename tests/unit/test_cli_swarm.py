from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from typer.testing import CliRunner, Result

from fullswarm.bus import LocalBus
from fullswarm.cli.main import app
from fullswarm.clock import SimClock
from fullswarm.keys import Keys
from fullswarm.messages import (
    BehaviourRequest,
    EStop,
    EStopReceipt,
    HealthReport,
    ParamEntry,
    ParamReply,
    ParamRequest,
    RequestStatus,
    RobotHealth,
    StopRequest,
)
from fullswarm.operator import session
from fullswarm.operator.session import Session, Target
from fullswarm.reasons import Code, Reason, given, joined, reason
from fullswarm.runtime import Runtime

RECORD: dict[str, object] = {
    "summary": "Keep together",
    "law": "flocking",
    "centralised": False,
    "filtered": True,
    "parameters": {
        "cohesion": {"type": "number", "unit": "1/s", "default": 0.5, "min": 0.0, "max": 10.0, "doc": "how near"},
        "goal": {"type": "point", "unit": "m", "required": True},
    },
}


class FakeSwarm:
    """A small core and robots on a simulated clock, behind the command line's session."""

    def __init__(self) -> None:
        self.keys = Keys("lab")
        self.requests: list[BehaviourRequest] = []
        self.stops: list[StopRequest] = []
        self.targets: list[Target] = []
        self.core_alive, self.standing, self.deaf = True, True, "r2"
        self.robots: tuple[str, ...] = ("r1", "r2")
        self.refusing: dict[str, Reason] = {}
        self.interrupt_after_s: float | None = None

    @contextmanager
    def connect(self, target: Target, within_s: float | None = None) -> Iterator[Session]:
        del within_s
        self.targets.append(target)
        self.runtime = Runtime(SimClock())  # a runtime runs once
        self.bus = LocalBus(self.runtime.mailbox)
        self.bus.subscribe(self.keys.behaviour_request, BehaviourRequest, self._on_request)
        self.bus.subscribe(self.keys.stop, StopRequest, self.stops.append)
        self.bus.subscribe(self.keys.estop, EStop, self._on_estop)
        self.bus.subscribe(self.keys.param_request("core"), ParamRequest, self._on_question)
        self.runtime.every(0.5, self._report, first_s=0.3)
        if self.interrupt_after_s is not None:
            self.runtime.after(self.interrupt_after_s, lambda: signal.raise_signal(signal.SIGINT))
        yield Session(self.bus, self.keys, self.runtime, "tcp/hub")

    def status(self, request: BehaviourRequest, **fields: object) -> None:
        plain: dict[str, object] = {"request_id": request.id, "behaviour": request.behaviour, "phase": "accepted"}
        message = RequestStatus(**{**plain, **fields})  # type: ignore[arg-type]  # keyword fields by name
        self.bus.publish(self.keys.behaviour_status, message)

    def _on_request(self, request: BehaviourRequest) -> None:
        self.requests.append(request)
        if not self.core_alive:
            return
        if request.behaviour not in ("flocking", "drive"):
            self.status(request, phase="refused", reason=f"no behaviour '{request.behaviour}'")
            return
        self.status(request, robots=("r1", "r2", "r3"), missing=("r3",))
        if self.refusing:
            self.runtime.after(0.1, lambda: self._refuse(request))
            return
        for delay_s, running in ((0.1, ("r1",)), (0.2, ("r1", "r2"))):
            self.runtime.after(
                delay_s,
                lambda running=running: self.status(  # type: ignore[misc]
                    request,
                    phase="running",
                    robots=("r1", "r2", "r3"),
                    running=tuple(each for each in running if each != self.deaf) if request.parameters else running,
                    missing=("r3",),
                ),
            )

    def _refuse(self, request: BehaviourRequest) -> None:
        asked, why = request.robots or self.robots, joined(self.refusing)
        self.status(
            request,
            phase="refused" if set(asked) == set(self.refusing) else "running",
            reason=why.text,
            code=why.code,
            parameters=dict(why.parameters),
            robots=asked,
            running=tuple(robot for robot in asked if robot not in self.refusing),
            refused_by=tuple(self.refusing),
        )

    def _on_estop(self, order: EStop) -> None:
        for robot in order.robots or self.robots:
            if robot != self.deaf:
                receipt = EStopReceipt(
                    id=order.id,
                    robot=robot,
                    engaged=order.engaged,
                    standing=order.engaged and self.standing,
                    rolled_m=0.03,
                )
                self.bus.publish(self.keys.estop_receipt(robot), receipt)

    def _on_question(self, question: ParamRequest) -> None:
        if not self.core_alive:
            return
        values: dict[str, object] = {
            "behaviour/flocking": RECORD,
            "agent/speed": 0.5,
            "group/scouts": {"robots": ["r1"]},
        }
        if question.op == "set":
            values[question.key] = question.value
        entries = tuple(
            ParamEntry(key=key, value=value, author="seed", changed=0.0)  # type: ignore[arg-type]
            for key, value in values.items()
            if key == question.key or (question.key.endswith("*") and key.startswith(question.key[:-1]))
        )
        ok = question.key != "locked"
        reply = ParamReply(id=question.id, ok=ok, reason="" if ok else "is read-only", entries=entries)
        self.bus.publish(self.keys.param_reply("core", question.id), reply)

    def _report(self) -> None:
        robots = tuple(
            RobotHealth(robot=robot, driver=f"sim://{robot}", make="sim", model="disc", firmware="", lifecycle="READY")
            for robot in self.robots
        )
        report = HealthReport(host="h", process="p", version="1", robots=robots)
        self.bus.publish(self.keys.health("h"), report)


@pytest.fixture
def swarm(monkeypatch: pytest.MonkeyPatch) -> FakeSwarm:
    fake = FakeSwarm()
    monkeypatch.setattr(session, "connect", fake.connect)
    monkeypatch.setattr("fullswarm.operator.target.nothing_listens", lambda _hub, _within_s: False)
    return fake


def run(*args: str) -> Result:
    result = CliRunner().invoke(app, list(args), env={"COLUMNS": "80"})
    assert "Traceback" not in result.output
    return result


def test_a_request_names_the_robots_that_run_it_and_those_missing(swarm: FakeSwarm) -> None:
    swarm.deaf = ""
    result = run("request", "flocking", "--robots", "r1,r2", "--robots", "r3", "--set", "goal=5,5", "--set", "a=x")
    assert result.exit_code == 0
    request = swarm.requests[0]
    assert request.robots == ("r1", "r2", "r3")
    assert request.parameters == {"goal": [5, 5], "a": "x"}
    assert result.stdout.splitlines() == [
        f"running {request.id}: flocking for r1, r2, r3",
        "confirmed by: r1, r2",
        "missing, will get it when they join: r3",
    ]
    assert result.stderr == ""
    assert swarm.runtime.now_s() < 0.3


def test_without_waiting_the_core_s_word_is_enough(swarm: FakeSwarm) -> None:
    swarm.refusing = dict.fromkeys(("r1", "r2"), reason(Code.ESTOP_LATCHED))
    result = run("request", "flocking", "--no-wait")
    assert result.exit_code == 0
    assert result.stdout.splitlines() == [
        f"accepted {swarm.requests[0].id}: flocking for r1, r2, r3",
        "missing, will get it when they join: r3",
    ]


@pytest.mark.parametrize(("why", "code"), [(reason(Code.ESTOP_LATCHED), 4), (reason(Code.BATTERY), 1)])
def test_a_request_that_the_only_robot_refuses_fails(swarm: FakeSwarm, why: Reason, code: int) -> None:
    swarm.refusing = {"r1": why}
    for more in ((), ("--wait",)):
        result = run("request", "flocking", "--robots", "r1", *more)
        assert result.exit_code == code
        assert result.stdout == ""
        assert result.stderr.endswith(f"error: flocking: r1: {why}\n")
    told = run("request", "flocking", "--robots", "r1", "--json")
    assert told.exit_code == code
    assert json.loads(told.stdout)["refused_by"] == ["r1"]


@pytest.mark.parametrize(("why", "code"), [(reason(Code.ESTOP_LATCHED), 4), (given("cliff; put it on safe ground"), 1)])
def test_a_request_that_some_robot_refuses_names_it(swarm: FakeSwarm, why: Reason, code: int) -> None:
    swarm.refusing = {"r2": why}
    result = run("request", "flocking", "--robots", "r1,r2")
    assert result.exit_code == code
    assert result.stdout.splitlines() == [
        f"running {swarm.requests[0].id}: flocking for r1, r2",
        f"reason: r2: {why}",
        "confirmed by: r1",
        "refused by: r2",
    ]


def test_a_missing_answer_is_reported_after_two_seconds(swarm: FakeSwarm) -> None:
    result = run("request", "flocking", "--set", "a=1")
    assert result.exit_code == 1
    assert result.stderr == "not confirmed within 2 s: r2\n"
    assert 1.9 < swarm.runtime.now_s() < 2.2


def test_waiting_ends_when_all_present_robots_confirmed(swarm: FakeSwarm) -> None:
    result = run("request", "flocking", "--wait", "--json")
    assert result.exit_code == 0
    status = json.loads(result.stdout)
    assert (status["phase"], status["running"], status["missing"]) == ("running", ["r1", "r2"], ["r3"])
    assert "running: 1 of 3 confirmed" in result.stderr


def test_waiting_names_the_robots_that_did_not_confirm(swarm: FakeSwarm) -> None:
    result = run("request", "flocking", "--wait", "--set", "a=1", "--timeout", "1.5")
    assert result.exit_code == 1
    assert "not confirmed within 1.5 s: r2" in result.stderr


def test_a_refusal_is_one_line_with_reason_and_hint(swarm: FakeSwarm) -> None:
    result = run("request", "floking")
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr == ("error: floking: no behaviour 'floking' (`fullswarm behaviours` lists the behaviours)\n")


def test_a_silent_core_is_exit_code_3(swarm: FakeSwarm) -> None:
    swarm.core_alive = False
    for args in (("request", "flocking"), ("behaviours",), ("mock", "flocking"), ("drive", "--linear", "1")):
        result = run(*args)
        assert result.exit_code == 3, result.output
        assert "error: tcp/hub: the core of swarm 'lab' did not answer within" in result.stderr


def test_no_hub_is_exit_code_3(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "CONNECT_S", 0.1)
    result = run("status", "--hub", "tcp/127.0.0.1:9")
    assert result.exit_code == 3
    assert result.stderr == (
        "error: tcp/127.0.0.1:9: no hub answers "
        "(start a swarm with `fullswarm up FLEET.toml`, or give the address of its hub with --hub)\n"
    )


def test_stop_is_sent_to_the_robots_named(swarm: FakeSwarm) -> None:
    result = run("stop", "r1", "r2")
    assert result.exit_code == 0
    assert len(swarm.stops) == 5
    assert {stop.robots for stop in swarm.stops} == {("r1", "r2")}
    assert result.stderr == "stop sent to r1, r2\n"


def test_an_estop_names_the_robots_that_did_not_confirm_and_exits_with_4(swarm: FakeSwarm) -> None:
    result = run("estop", "--reason", "smoke", "--timeout", "2")
    assert result.exit_code == 4
    assert result.stdout == "r1: at standstill after 0.030 m\n"
    assert result.stderr.splitlines() == [
        "after 0.5 s no answer from r2; still trying",
        "error: after 2 s no answer from r2 (go there: they may still move)",
    ]


def test_an_estop_distinguishes_a_decelerating_robot_from_a_silent_one(swarm: FakeSwarm) -> None:
    swarm.standing = False
    result = run("estop", "--timeout", "1")
    assert (result.exit_code, result.stdout) == (4, "r1: decelerating\n")
    assert "after 1 s no answer from r2; latched, but standstill not confirmed: r1 (go there" in result.stderr


def test_an_estop_that_all_confirm_is_exit_code_0(swarm: FakeSwarm) -> None:
    swarm.deaf = ""
    result = run("estop", "--json")
    assert result.exit_code == 0
    found = json.loads(result.stdout)
    assert [receipt["robot"] for receipt in found["receipts"]] == ["r1", "r2"]
    assert (found["engaged"], found["unconfirmed"]) == (True, [])


def test_the_estop_is_cleared_on_purpose_only(swarm: FakeSwarm) -> None:
    result = run("estop", "--clear", "r1")
    assert (result.exit_code, result.stdout) == (0, "r1: released\n")


def test_an_estop_that_no_robot_receives_is_exit_code_3(swarm: FakeSwarm) -> None:
    swarm.robots = ()
    result = run("estop", "--timeout", "1")
    assert result.exit_code == 3
    assert "no robot was received" in result.stderr


def test_driving_ends_with_zeros(swarm: FakeSwarm) -> None:
    result = run("drive", "--linear", "0.5", "--robots", "r1", "--seconds", "0.52")
    assert result.exit_code == 0
    sticks = [request.parameters["linear"] for request in swarm.requests]
    assert sticks == [0.5] * 11 + [0.0] * 3
    assert {request.robots for request in swarm.requests} == {("r1",)}


def test_ctrl_c_while_driving_sends_zeros_first(swarm: FakeSwarm) -> None:
    swarm.interrupt_after_s = 0.22
    result = run("drive", "--angular", "-1")
    assert result.exit_code == 0
    assert [request.parameters["angular"] for request in swarm.requests] == [-1.0] * 5 + [0.0] * 3


def test_ctrl_c_elsewhere_is_130(swarm: FakeSwarm) -> None:
    swarm.core_alive, swarm.interrupt_after_s = False, 0.5
    before = signal.getsignal(signal.SIGINT)
    result = run("request", "flocking")
    assert (result.exit_code, result.stderr) == (130, "interrupted\n")
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("args", [("watch",), ("params", "watch")])
def test_ctrl_c_is_how_watching_ends(swarm: FakeSwarm, args: tuple[str, ...]) -> None:
    swarm.interrupt_after_s = 2.0
    result = run(*args)
    assert result.exit_code == 0
    assert ("r1" in result.stdout) == (args == ("watch",))


def test_status_is_a_table_or_json(swarm: FakeSwarm) -> None:
    result = run("status")
    assert result.exit_code == 0
    assert result.stdout.startswith("swarm lab: 2 robots, hub connected, NO CORE")
    assert max(map(len, result.stdout.splitlines())) <= 80
    found = json.loads(run("status", "--json").stdout)
    assert [robot["robot"] for robot in found["robots"]] == ["r1", "r2"]


def test_some_robots_or_a_group_can_be_looked_at(swarm: FakeSwarm) -> None:
    text = run("status", "--robots", "r2,r7").stdout
    assert [line.split()[0] for line in text.splitlines()[2:3]] == ["r2"]
    assert "MISSING, not reporting: r7" in text
    robots = json.loads(run("status", "--robots", "@scouts", "--json").stdout)["robots"]
    assert [robot["robot"] for robot in robots] == ["r1"]
    wrong = run("status", "--robots", "@scout")
    assert (wrong.exit_code, wrong.stderr) == (2, "error: --robots: no group '@scout' (did you mean '@scouts'?)\n")


def test_watching_prints_a_line_of_json_at_each_refresh(swarm: FakeSwarm) -> None:
    swarm.interrupt_after_s = 2.1
    result = run("watch", "--json", "--robots", "r1")
    assert result.exit_code == 0
    seen = [json.loads(line) for line in result.stdout.splitlines()]
    assert len(seen) == 8
    assert [robot["robot"] for robot in seen[-1]["robots"]] == ["r1"]


def test_robots_and_behaviours_are_listed(swarm: FakeSwarm) -> None:
    assert "sim://r2" in run("robots").stdout
    text = run("behaviours").stdout
    assert "Keep together" in text
    assert "cohesion" not in text
    rows = [line.split() for line in run("behaviours", "flocking").stdout.splitlines()]
    assert ["cohesion", "number", "0.5", "0", "10", "1/s", "how", "near"] in rows
    assert ["goal", "point", "required", "m"] in rows
    wrong = run("behaviours", "floking")
    assert (wrong.exit_code, wrong.stderr) == (2, "error: no behaviour 'floking' (did you mean 'flocking'?)\n")
    assert json.loads(run("behaviours", "--json").stdout) == {"flocking": RECORD}


@pytest.mark.parametrize(
    ("args", "code", "stdout", "stderr"),
    [
        (("get", "agent/*"), 0, "agent/speed = 0.5  (seed, ", ""),
        (("get", "agent/sped"), 2, "", "the core's database has no 'agent/sped'"),
        (("set", "agent/turn", "[1, 2]"), 0, "agent/turn = [1, 2]  (", ""),
        (("set", "locked", "1"), 2, "", "error: locked: is read-only"),
        (("set", "agent/turn", "[1"), 2, "", "error: agent/turn: '[1' does not end"),
        (("history", "agent/speed"), 0, "agent/speed = 0.5", ""),
    ],
)
def test_the_database_is_read_and_set(
    swarm: FakeSwarm, args: tuple[str, ...], code: int, stdout: str, stderr: str
) -> None:
    result = run("params", *args)
    assert (result.exit_code, result.stdout.startswith(stdout), stderr in result.stderr) == (code, True, True)


def test_the_mock_publisher_prints_the_outcome_of_each_request(swarm: FakeSwarm) -> None:
    result = run("mock", "flocking", "--rate", "10", "--count", "3")
    assert result.exit_code == 0
    assert len(swarm.requests) == 3
    assert "3 sent, 3 answered, 0 refused" in result.stderr


def test_hub_and_swarm_come_from_the_environment(swarm: FakeSwarm) -> None:
    CliRunner().invoke(app, ["stop"], env={"FULLSWARM_HUB": "tcp/h:1", "FULLSWARM_SWARM": "other"})
    assert swarm.targets == [Target("tcp/h:1", "other")]


@pytest.mark.parametrize(
    "args",
    [
        ("request",),
        ("request", "flocking", "--timeout", "soon"),
        ("request", "flocking", "--set", "goal"),
        ("request", "flocking", "--set", "goal=nan"),
        ("request", "flocking", "--robots", "a b"),
        ("drive", "--linear", "2"),
        ("mock", "flocking", "--rate", "0"),
        ("nonsense",),
        ("params", "set", "key"),
        ("stop", "--now"),
    ],
)
def test_usage_errors_are_exit_code_2(swarm: FakeSwarm, args: tuple[str, ...]) -> None:
    result = run(*args)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr
    assert swarm.requests == []
