"""What control laws broadcast arrives at neighbours of the same request, within range, at the rate, and expires."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fullswarm.agent.view import Params, View
from fullswarm.bus.base import OPERATOR, NamedBus
from fullswarm.config import SwarmConfig
from fullswarm.kernels import Array, Flags, Index
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.launch.network import with_network
from fullswarm.memory import rows
from fullswarm.messages import (
    BehaviourBroadcast,
    BroadcastValues,
    HealthReport,
    RequestStatus,
    RobotMeasurement,
    TableEntry,
    TableUpdate,
)
from fullswarm.operator.client import Operator
from fullswarm.operator.params import ParamClient
from fullswarm.reasons import Code
from tests.unit.agent_bench import Bench
from tests.unit.laws import install

PLACES = [(2.0, 2.0, 0.0), (4.0, 2.0, 1.0), (9.0, 2.0, 2.0)]  # the third is out of the first one's range


@dataclass
class Says:
    """What each robot tells the others."""

    place: Array = rows(2)
    count: Index = rows(fill=0)
    lit: Flags = rows(fill=False)


@dataclass
class Memory:
    """What each robot received last, by the sender's place in the request."""

    calls: Index = rows(fill=0)
    place: Array = rows(4, 2, fill=math.nan)
    number: Array = rows(4, fill=math.nan)
    age_s: Array = rows(4, fill=math.nan)


def talking(view: View, params: Params, kept: Memory) -> Array:
    kept.calls += 1
    heard = view.heard
    kept.age_s[:] = math.nan
    kept.place[heard.of, heard.index] = heard.place
    kept.number[heard.of, heard.index] = heard.number
    kept.age_s[heard.of, heard.index] = heard.age_s
    view.say(place=view.position, number=kept.calls, lit=kept.calls > 3)
    return np.zeros((len(view.position), 2)) + 0.0 * params.gain


@dataclass
class SaysNumbers:
    """As `Says`, without a name that is taken."""

    place: Array = rows(2)
    number: Index = rows(fill=0)
    lit: Flags = rows(fill=False)


TALKING = SimpleNamespace(velocity=talking, Memory=Memory, Says=SaysNumbers)


def sharing(view: View, params: Params) -> Array:
    for row, index in enumerate(view.index.tolist()):
        view.table.put(row, f"of/{index}", [float(index), 0.5])
        view.table.put(row, "least", float(view.position[row, 0]))
    return np.zeros((len(view.position), 2)) + 0.0 * params.gain


SHARING = SimpleNamespace(velocity=sharing, MERGE={"least": min})


class Swarm:
    """Robots and an operator in lockstep: one agent for all, or on a network one for each, as on board."""

    def __init__(self, places: list[tuple[float, float, float]], network: str | None = None, **agent: Any) -> None:
        robots = [{"id": f"r{row + 1}", "pose": place} for row, place in enumerate(places)]
        world = {"engine": "kinematic", "bounds_m": (0.0, 0.0, 40.0, 40.0)}
        config = SwarmConfig.model_validate({"world": world, "robot": robots, "agent": agent})
        self.lockstep = Lockstep(with_network(config, network) if network else config)
        self.bus = NamedBus(self.lockstep.bus, OPERATOR)
        self.operator = Operator(self.bus, Keys(), self.lockstep.runtime, "op")
        self.params = ParamClient(self.bus, Keys(), self.lockstep.runtime, "op")
        self.sent: list[BehaviourBroadcast] = []
        self.bus.subscribe(Keys().broadcast(), BehaviourBroadcast, self.sent.append)
        self.lockstep.run(1.0)

    def store(self, name: str, record: dict[str, Any]) -> None:
        self.params.ask("set", f"behaviour/{name}", lambda _: None, {"summary": "", "law": name} | record)
        self.lockstep.run(0.3)

    def ask(self, behaviour: str, robots: tuple[str, ...]) -> RequestStatus:
        answers: list[RequestStatus] = []
        self.operator.request(behaviour, robots, {}, answers.append)
        self.lockstep.run(0.5)
        return answers[-1]

    def kept(self, robot: str) -> dict[str, Any]:
        agents = self.lockstep.agents
        row = int(robot[1:]) - 1
        return agents[row].tasks.memory_of(0) if len(agents) > 1 else agents[0].tasks.memory_of(row)

    def table(self, robot: str) -> dict[str, Any]:
        agents = self.lockstep.agents
        row = int(robot[1:]) - 1
        agent, row = (agents[row], 0) if len(agents) > 1 else (agents[0], row)
        return dict(agent.exchange._replicas[row].table.items())

    def close(self) -> None:
        self.operator.close()
        self.lockstep.close()


@pytest.fixture(params=[None, "loss=0%", "loss=20%,delay=50ms±30"], ids=["one agent", "an agent each", "bad network"])
def swarm(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    install(monkeypatch, talking=TALKING, sharing=SHARING)
    made = Swarm(PLACES, request.param)
    for name in ("talking", "sharing"):
        made.store(name, {"static": {"gain": 1.0}})
    yield made
    made.close()


def test_neighbours_of_the_request_within_range_receive_what_is_said(swarm: Swarm) -> None:
    swarm.ask("talking", ("r1", "r2", "r3"))
    swarm.lockstep.run(2.0)
    first = swarm.kept("r1")
    place = np.array(first["place"]).reshape(4, 2)
    assert place[1].tolist() == [4.0, 2.0]
    assert np.isnan(place[[0, 2, 3]]).all()  # itself, out of range, nobody
    assert 0.0 <= first["age_s"][1] < 0.6
    assert swarm.kept("r3")["number"] == pytest.approx([math.nan] * 4, nan_ok=True)


def test_nothing_is_received_from_another_request_and_nothing_is_sent_without_one(swarm: Swarm) -> None:
    assert not swarm.sent
    swarm.ask("talking", ("r1",))
    swarm.ask("talking", ("r2",))
    swarm.lockstep.run(1.0)
    assert np.isnan(swarm.kept("r1")["number"]).all()
    swarm.ask("stop", ("r1", "r2"))
    swarm.lockstep.run(0.5)
    swarm.sent.clear()
    swarm.lockstep.run(1.0)
    assert not swarm.sent


def test_a_robot_broadcasts_at_ten_hertz_however_often_its_law_says_something(swarm: Swarm) -> None:
    swarm.ask("talking", ("r1", "r2"))
    swarm.lockstep.run(1.0)
    swarm.sent.clear()
    swarm.lockstep.run(5.0)
    of_first = sum("r1" in part.robots for message in swarm.sent for part in message.values)
    assert 48 <= of_first <= 51
    assert all(len(part.values) == 4 * len(part.robots) for message in swarm.sent for part in message.values)


def test_a_record_may_say_how_often_and_how_far(swarm: Swarm) -> None:
    swarm.store("talking", {"static": {"gain": 1.0, "says_hz": 2.0, "says_m": 12.0}})
    swarm.ask("talking", ("r1", "r2", "r3"))
    swarm.lockstep.run(3.0)
    assert not math.isnan(swarm.kept("r1")["number"][2])
    swarm.sent.clear()
    swarm.lockstep.run(5.0)
    assert 9 <= sum("r1" in part.robots for message in swarm.sent for part in message.values) <= 11


def test_a_table_is_shared_over_several_hops(swarm: Swarm) -> None:
    swarm.store("sharing", {"static": {"gain": 1.0, "says_m": 5.5}})  # r1 and r3 are out of each other's range
    swarm.ask("sharing", ("r1", "r2", "r3"))
    swarm.lockstep.run(5.0)
    expected = {"least": 2.0, "of/0": (0.0, 0.5), "of/1": (1.0, 0.5), "of/2": (2.0, 0.5)}
    assert [swarm.table(robot) for robot in ("r1", "r2", "r3")] == [expected] * 3


def test_a_partition_leaves_two_tables_that_become_one_again(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, sharing=SHARING)
    swarm = Swarm([(2.0, 2.0, 0.0), (4.0, 2.0, 0.0), (6.0, 2.0, 0.0)], "loss=20%,partition=r1|r2+r3@0s-8s")
    swarm.store("sharing", {"static": {"gain": 1.0}})
    swarm.ask("sharing", ("r1", "r2", "r3"))
    swarm.lockstep.run(5.0)
    assert sorted(swarm.table("r2")) == ["least", "of/1", "of/2"]
    assert swarm.table("r1")["least"] == 2.0
    assert swarm.table("r2")["least"] == 4.0
    swarm.lockstep.run(4.0)
    assert swarm.table("r1") == swarm.table("r2") == swarm.table("r3")
    assert swarm.table("r3")["least"] == 2.0
    assert len(swarm.table("r3")) == 4
    swarm.close()


def test_a_request_asked_again_begins_with_an_empty_table(swarm: Swarm) -> None:
    swarm.ask("sharing", ("r1", "r2"))
    swarm.lockstep.run(2.0)
    assert "of/1" in swarm.table("r1")
    swarm.ask("stop", ("r1", "r2"))
    swarm.ask("sharing", ("r1",))
    swarm.lockstep.run(2.0)
    assert sorted(swarm.table("r1")) == ["least", "of/0"]


def test_broadcasts_expire(swarm: Swarm) -> None:
    swarm.ask("talking", ("r1", "r2"))
    swarm.lockstep.run(1.0)
    assert not math.isnan(swarm.kept("r1")["age_s"][1])
    swarm.ask("stop", ("r2",))
    swarm.lockstep.run(1.5)
    assert math.isnan(swarm.kept("r1")["age_s"][1])


def test_broadcasts_are_counted(swarm: Swarm) -> None:
    measured: dict[str, RobotMeasurement] = {}
    swarm.bus.subscribe(Keys().measurement("robots"), RobotMeasurement, lambda each: measured.update({each.host: each}))
    swarm.ask("talking", ("r1", "r2"))
    swarm.lockstep.run(4.0)
    totals = {
        name: sum(each.totals[f"broadcasts_{name}"] for each in measured.values())
        for name in ("sent", "received", "dropped")
    }
    assert 70 <= totals["sent"] <= 95
    assert 0.5 * totals["sent"] <= totals["received"] <= totals["sent"]
    assert totals["dropped"] == 0


# ------------------------------------------------------------------ senders that do not keep to the rules
def flood(bench: Bench, sequence: int, robot: str = "r2", law: str = "talking", number: float = 7.0) -> None:
    values = BroadcastValues(
        team=5, law=law, robots=(robot,), fields={"place": 2, "number": 1, "lit": 1}, values=(1.0, 1.0, number, 0.0)
    )
    message = BehaviourBroadcast(host="stranger", sequence=sequence, stamp_s=0.0, values=(values,))
    bench.bus.publish(bench.keys.broadcast("all", "stranger"), message)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    install(monkeypatch, talking=TALKING, sharing=SHARING)
    made = Bench([(2.0, 2.0, 0.0), (4.0, 2.0, 0.0)], agent_settings={"state_cell_m": 0.0})
    made.enable("talking", {"gain": 1.0}, "r1", team=5, members=("r1", "r2"))
    made.run(0.1)
    return made


def test_a_sender_that_floods_is_throttled_and_named_and_others_are_not(bench: Bench) -> None:
    reports: list[HealthReport] = []
    bench.bus.subscribe(bench.keys.health(), HealthReport, reports.append)
    for number in range(400):  # 4 s at 100 Hz
        flood(bench, number, number=float(number))
        bench.run(0.01)
    counts = bench.agent.exchange.counts
    taken = counts.received - counts.sent  # its own ones come back
    assert 1.0 * 10.0 * 4.0 <= taken <= 1.2 * 10.0 * 4.0 + 12
    assert taken + counts.dropped == 400
    notes = [each.robots[0] for each in reports]
    assert notes[-1].message_code == Code.FLOOD
    assert "'r2' broadcasts 100 times a second" in notes[-1].message_note
    assert not reports[-1].robots[1].message_note  # runs nothing
    bench.run(5.0)
    assert not reports[-1].robots[0].message_note


def test_what_does_not_fit_is_ignored(bench: Bench) -> None:
    exchange = bench.agent.exchange
    flood(bench, 1, robot="unknown")
    flood(bench, 2, law="sharing")
    for fields, values in [({"place": 2}, (1.0, 1.0)), ({"place": 2, "number": 1, "lit": 1}, (1.0,)), ({}, ())]:
        part = BroadcastValues(team=5, law="talking", robots=("r2",), fields=fields, values=values)
        message = BehaviourBroadcast(host="x", sequence=3, stamp_s=0.0, values=(part,))
        bench.bus.publish(bench.keys.broadcast("all", "x"), message)
    bench.run(0.1)
    assert exchange.counts.received == exchange.counts.sent  # its own ones come back
    flood(bench, 4)
    flood(bench, 4)  # twice
    flood(bench, 3)  # late
    bench.run(0.04)
    assert exchange.counts.received == exchange.counts.sent + 1


def test_a_table_takes_nothing_from_beyond_its_range(bench: Bench) -> None:
    bench.enable("sharing", {"gain": 1.0, "says_m": 1.5}, "r1", team=6, members=("r1", "r2"))
    bench.run(0.1)

    def update(sequence: int) -> None:
        sent = TableUpdate(robot="r2", team=6, law="sharing", entries=(TableEntry("far", 1.0, 1, "r2"),))
        message = BehaviourBroadcast(host="x", sequence=sequence, stamp_s=0.0, tables=(sent,))
        bench.bus.publish(bench.keys.broadcast("all", "x"), message)
        bench.run(0.04)

    update(1)
    table = bench.agent.exchange._replicas[0].table
    assert table.get("far") is None
    bench.enable("sharing", {"gain": 1.0, "says_m": 2.5}, "r1", team=6, members=("r1", "r2"))
    bench.run(0.1)
    update(2)
    assert table.get("far") == 1.0


@pytest.mark.parametrize(
    ("says", "problem"),
    [
        (Says, "'count' is a name of `view.heard` itself"),
        (type("Large", (), {}), "it is no dataclass"),
        (dataclass(type("Large", (), {"__annotations__": {"much": "Array"}, "much": rows(33)})), "broadcast 264 bytes"),
    ],
)
def test_a_wrong_declaration_is_refused_with_the_reason(
    monkeypatch: pytest.MonkeyPatch, says: type, problem: str
) -> None:
    install(monkeypatch, talking=SimpleNamespace(velocity=talking, Says=says))
    bench = Bench([(2.0, 2.0, 0.0)])
    bench.enable("talking", {"gain": 1.0})
    bench.run(0.1)
    assert not bench.acks[-1].accepted
    assert problem in bench.acks[-1].reason


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ({"place": 1.0}, "declared are place, number, lit"),
        ({"place": np.zeros((3, 2)), "number": 0, "lit": 0}, r"the shape is \(3, 2\), declared is \(1, 2\)"),
        ({"place": math.inf, "number": 0, "lit": 0}, "infinite or too large"),
    ],
)
def test_values_other_than_declared_stop_the_robot(
    monkeypatch: pytest.MonkeyPatch, fields: dict[str, Any], problem: str
) -> None:
    def wrong(view: View, params: Params) -> Array:
        view.say(**fields)
        return np.zeros((len(view.position), 2)) + 0.0 * params.gain

    install(monkeypatch, wrong=SimpleNamespace(velocity=wrong, Says=SaysNumbers))
    bench = Bench([(2.0, 2.0, 0.0)])
    reports: list[HealthReport] = []
    bench.bus.subscribe(bench.keys.health(), HealthReport, reports.append)
    bench.enable("wrong", {"gain": 1.0})
    bench.run(1.0)
    assert reports[-1].robots[0].stop_code == Code.LAW
    assert re.search(problem, reports[-1].robots[0].stop_reason)


def test_a_robot_with_a_nan_among_its_values_is_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    def shy(view: View, params: Params) -> Array:
        place = view.position.copy()
        place[view.index == 0] = math.nan
        view.say(place=place, number=1, lit=True)
        return np.zeros((len(view.position), 2)) + 0.0 * params.gain

    install(monkeypatch, shy=SimpleNamespace(velocity=shy, Says=SaysNumbers))
    bench = Bench([(2.0, 2.0, 0.0), (4.0, 2.0, 0.0)])
    sent: list[BehaviourBroadcast] = []
    bench.bus.subscribe(bench.keys.broadcast(), BehaviourBroadcast, sent.append)
    bench.enable("shy", {"gain": 1.0}, members=("r1", "r2"))
    bench.run(0.5)
    assert {part.robots for each in sent for part in each.values} == {("r2",)}
