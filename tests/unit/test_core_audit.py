"""What a core records: requests with their results, stops, leases, missions, parameters, robots' own stops, storms."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from fullswarm.audit.log import AuditLog, files_of
from fullswarm.audit.verify import verify
from fullswarm.bus.base import NamedBus
from fullswarm.core.audit import AuditRecorder, noted_head
from fullswarm.core.node import CoreNode
from fullswarm.messages import (
    BehaviourRequest,
    EStop,
    HealthReport,
    LeaseRequest,
    MissionPlan,
    MissionRequest,
    MissionStep,
    MissionTrack,
    ParamRequest,
    RequestStatus,
    StepConditions,
    StopRequest,
)
from fullswarm.store import Store
from tests.unit.core_swarm import KEYS, Swarm, health

ANNA, BEN = "anna@lab", "ben@lab"


class Recorded(Swarm):
    """A core that records, in `folder`; the bus states the sender `console` for the operators' messages."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        super().__init__(store=Store(folder / "core.db"))
        self.operators = NamedBus(self.bus, "console")

    def start_core(self, store: Store | None = None) -> None:
        self.cores += 1
        self.store = store or self.store
        process = f"core-{self.cores}"
        log = AuditLog(
            self.folder / "core-audit", process, self.runtime.now_s, lambda: 1.7e9, anchor=noted_head(self.store)
        )
        self.recorder = AuditRecorder(
            self.bus, KEYS, self.runtime, log, self.store, process, lambda name: self.core.library.expires(name)
        )
        self.core = CoreNode(self.recorder.bus, self.runtime, self.config, self.store, process)

    def stop_core(self) -> None:
        self.core.close()
        self.recorder.close()
        self.store.close()

    def close(self) -> None:
        self.stop_core()
        self.bus.close()

    def order(self, ident: str, behaviour: str, *robots: str, operator: str = ANNA, take: bool = False) -> None:
        request = BehaviourRequest(
            id=ident, behaviour=behaviour, robots=robots, operator=operator, source="console@desk:1/1", take=take
        )
        self.operators.publish(KEYS.behaviour_request, request)
        self.run(0.2)

    def entries(self, *acts: str) -> list[dict[str, object]]:
        lines = [line for path in files_of(self.folder / "core-audit") for line in path.read_bytes().splitlines()]
        found = [json.loads(line) for line in lines]
        return [entry for entry in found if not acts or entry["act"] in acts]


@pytest.fixture
def swarm(tmp_path: Path) -> Iterator[Recorded]:
    made = Recorded(tmp_path)
    yield made
    made.close()


def said(entry: dict[str, object]) -> tuple[object, ...]:
    return tuple(entry[name] for name in ("act", "sender", "operator", "robots", "result"))


def test_requests_are_recorded_with_who_what_and_result(swarm: Recorded) -> None:
    swarm.order("a", "flocking", "r0", "r1")
    swarm.order("b", "no_such_thing", "r0")
    swarm.order("c", "rendezvous", "r0", "r1")
    accepted, refused, third = swarm.entries("request")
    assert said(accepted)[:4] == ("request", "console", ANNA, ["r0", "r1"])
    assert accepted["source"] == "console@desk:1/1"
    assert str(accepted["result"]).startswith(("accepted", "scheduled", "running"))
    assert accepted["what"] == {"id": "a", "behaviour": "flocking", "parameters": {}}
    assert str(refused["result"]).startswith("refused: unknown behaviour 'no_such_thing'")
    assert third["what"]["id"] == "c"  # type: ignore[index]  # JSON
    (end,) = swarm.entries("request_end")
    assert end["what"] == {"id": "a", "behaviour": "flocking"}
    assert str(end["result"]).startswith(("superseded", "ended"))


def test_repeated_request_is_one_entry_and_its_id_of_another_sender_is_stated(swarm: Recorded) -> None:
    for _ in range(3):
        swarm.order("a", "flocking", "r0")
    NamedBus(swarm.bus, "r2").publish(KEYS.behaviour_request, BehaviourRequest(id="a", behaviour="flocking"))
    swarm.run(0.2)
    _, other = swarm.entries("request")
    assert said(other)[1] == "r2"
    assert other["result"] == "ignored: the id of another sender's request"


def test_status_that_somebody_sends_is_no_result(swarm: Recorded) -> None:
    forged = RequestStatus(request_id="a", behaviour="flocking", phase="refused", reason="forged")
    swarm.operators.publish(KEYS.behaviour_status, forged)
    swarm.order("a", "flocking", "r0")
    swarm.operators.publish(KEYS.behaviour_status, forged)
    swarm.run(0.5)
    assert "forged" not in json.dumps(swarm.entries())


def test_stick_is_an_entry_at_its_begin_and_at_its_end(swarm: Recorded) -> None:
    for number in range(40):
        swarm.operators.publish(
            KEYS.behaviour_request,
            BehaviourRequest(
                id=f"s{number}", behaviour="drive", robots=("r0",), operator=ANNA,
                parameters={"linear": 0.1, "angular": 0.0},
            ),
        )  # fmt: skip
        swarm.run(0.05)
    swarm.run(4.0)
    held, released = swarm.entries("drive")
    assert (held["result"], released["result"]) == ("held", "released")
    assert released["what"]["requests"] == 40  # type: ignore[index]  # JSON
    assert swarm.entries("request") == []


def test_stops_and_estops_and_releases_are_one_entry_each_however_often_sent(swarm: Recorded) -> None:
    for _ in range(3):
        swarm.operators.publish(KEYS.stop, StopRequest(id="s", source="console@desk:1/1"))
        swarm.operators.publish(KEYS.estop, EStop(id="e", engaged=True, robots=("r0",), source="cli", reason="smoke"))
        swarm.run(0.2)
    NamedBus(swarm.bus, "intruder").publish(KEYS.estop, EStop(id="e", engaged=False, robots=("r0",), source="cli"))
    swarm.run(0.2)
    swarm.order("t", "stop", "r1")
    stop, also = swarm.entries("stop")
    (estop,), (release,) = swarm.entries("estop"), swarm.entries("estop_release")
    assert said(stop)[:4] == ("stop", "console", "", [])
    assert said(also)[:4] == ("stop", "console", ANNA, ["r1"])
    assert estop["what"] == {"id": "e", "reason": "smoke"}
    assert said(release)[1:4] == ("intruder", "", ["r0"])


def test_leases_and_take_overs(swarm: Recorded) -> None:
    swarm.operators.publish(KEYS.lease_request, LeaseRequest(operator=ANNA, robots=("r0", "r1"), hold=True))
    swarm.run(0.1)
    swarm.order("b", "flocking", "r0", operator=BEN)
    swarm.order("c", "flocking", "r0", operator=BEN, take=True)
    swarm.run(4.0)
    assert str(swarm.entries("request")[0]["result"]).startswith(f"refused: r0 is held by {ANNA}")
    found = [(each["act"], each["operator"], each["robots"], each["what"]) for each in swarm.entries()]
    assert ("lease", ANNA, ["r0", "r1"], {}) in found
    assert ("take_over", BEN, ["r0"], {"from": ANNA}) in found
    assert ("lease_end", ANNA, ["r1"], {}) in found


def test_a_hand_over_is_told_from_a_take_over(swarm: Recorded) -> None:
    def ask(operator: str, *robots: str, **fields: Any) -> None:
        request = LeaseRequest(operator=operator, robots=robots, hold=True, **fields)
        swarm.operators.publish(KEYS.lease_request, request)
        swarm.run(0.1)

    ask(ANNA, "r0", "r1")
    ask(BEN, "r0", take=True, given_by=ANNA)
    ask(BEN, "r1", take=True)
    found = [(each["act"], each["operator"], each["robots"], each["what"]) for each in swarm.entries()]
    assert ("hand_over", BEN, ["r0"], {"from": ANNA}) in found
    assert ("take_over", BEN, ["r1"], {"from": ANNA}) in found


def test_missions_and_parameters(swarm: Recorded) -> None:
    step = MissionStep(name="go", behaviour="flocking", robots=("r0",), done=StepConditions(time_s=60.0))
    plan = MissionPlan(name="survey", tracks=(MissionTrack(name="one", steps=(step,)),))
    for ident, op, given in (("m", "start", plan), ("p", "pause", None), ("q", "pause", None), ("x", "abort", None)):
        request = MissionRequest(id=ident, op=op, plan=given, operator=ANNA)  # type: ignore[arg-type]  # literals
        swarm.operators.publish(KEYS.mission_request, request)
        swarm.run(0.3)
    ops = [(each["what"]["op"], str(each["result"])[:8]) for each in swarm.entries("mission")]  # type: ignore[index]  # JSON
    assert ops == [("start", "accepted"), ("pause", "accepted"), ("pause", "refused:"), ("abort", "accepted")]
    states = [str(each["result"]).partition(":")[0] for each in swarm.entries("mission_state")]
    assert states == ["running", "paused", "aborted"]
    for ident, key, value in (("1", "schedule_interval_s", 0.2), ("2", "schedule_interval_s", -5.0), ("3", "no", 1)):
        request_ = ParamRequest(id=ident, op="set", key=key, value=value, author=ANNA)
        swarm.operators.publish(KEYS.param_request("core"), request_)
        swarm.run(0.1)
    changed, below, unknown = swarm.entries("parameter")
    assert said(changed) == ("parameter", "console", ANNA, [], "changed")
    assert changed["what"] == {"id": "1", "key": "schedule_interval_s", "value": 0.2}
    assert "refused" in str(below["result"])
    assert "refused" in str(unknown["result"])


def test_robots_own_stops_and_faults(swarm: Recorded) -> None:
    def report(**changes: object) -> None:
        state = msgspec.structs.replace(health("r0", behaviour="flocking", request_id="a"), **changes)
        message = HealthReport(host="r0", process="r0-1", version="1", robots=(state,))
        NamedBus(swarm.bus, "r0").publish(KEYS.health("r0"), message)
        swarm.run(0.05)

    report()
    for _ in range(3):
        report(stop_code="cliff", stop_reason="a cliff on the left")
    report()
    report(fault="motor hot", fault_code="heat", estop=True)
    report()
    (stop,) = swarm.entries("robot_stop")
    assert said(stop) == ("robot_stop", "r0", "", ["r0"], "a cliff on the left")
    assert [each["result"] for each in swarm.entries("robot_fault")] == ["motor hot", "cleared"]
    assert [each["result"] for each in swarm.entries("robot_estop")][:2] == ["latched", "not latched"]


def test_restart_and_end_and_whole_chain(swarm: Recorded, tmp_path: Path) -> None:
    swarm.order("a", "flocking", "r0")
    swarm.stop_core()
    swarm.start_core(Store(tmp_path / "core.db"))
    swarm.order("b", "rendezvous", "r0")
    swarm.stop_core()
    found = verify(tmp_path / "core-audit", tmp_path / "core.db")
    assert found.problems == []
    assert [(each["result"], each["run"]) for each in swarm.entries("core")] == [
        ("started", "core-1"), ("ended", "core-1"), ("started", "core-2"), ("ended", "core-2"),
    ]  # fmt: skip
    # Cut off, with the note beside it: the core's database still knows better.
    (path,) = files_of(tmp_path / "core-audit")
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:2]))
    second = json.loads(lines[1])
    (tmp_path / "core-audit" / "head.json").write_text(json.dumps({"n": 2, "hash": second["hash"]}))
    assert verify(tmp_path / "core-audit").problems == []
    assert "core.db names entry" in verify(tmp_path / "core-audit", tmp_path / "core.db").problems[0]
    swarm.start_core(Store(tmp_path / "core.db"))


def test_storm_does_not_fill_the_disk_and_hides_no_stop(swarm: Recorded) -> None:
    for number in range(5_000):
        NamedBus(swarm.bus, f"flood{number % 500}").publish(
            KEYS.behaviour_request,
            BehaviourRequest(id=f"x{number}", behaviour="flocking", robots=("nobody",), source="flood"),
        )
        if number % 500 == 499:
            swarm.run(0.1)
    swarm.operators.publish(KEYS.stop, StopRequest(id="s", source="console"))
    swarm.run(0.1)
    assert len(swarm.entries("stop")) == 1
    swarm.run(20.0)
    requests, summaries = swarm.entries("request"), swarm.entries("summary")
    assert 100 <= len(requests) <= 1100
    assert len(requests) + sum(each["what"]["entries"] for each in summaries) == 5_000  # type: ignore[index]  # JSON
    assert sum(path.stat().st_size for path in files_of(swarm.folder / "core-audit")) < 10**6


def test_disk_that_fails_leaves_the_core_as_it_is(tmp_path: Path) -> None:
    made = Recorded(tmp_path / "x")
    made.stop_core()
    (tmp_path / "y").mkdir()
    (tmp_path / "y" / "core-audit").touch()  # no folder can be made there
    swarm = Recorded(tmp_path / "y")
    try:
        swarm.order("a", "flocking", "r0")
        swarm.run(2.0)
        assert swarm.status("a").phase == "running"
        (tmp_path / "y" / "core-audit").unlink()
        swarm.order("b", "rendezvous", "r0")
        found = verify(tmp_path / "y" / "core-audit")
        assert "not_written" in found.notes[0]
        assert swarm.entries("request")[0]["what"]["id"] == "b"  # type: ignore[index]  # JSON
    finally:
        swarm.close()
