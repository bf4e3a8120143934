"""Robots that differ: what laws know of it, who takes part in a request, and who has which role in it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fullswarm import Lab, registry
from fullswarm.cli.status import demands
from fullswarm.cli.values import parse_needs, parse_roles
from fullswarm.config import SwarmConfig
from fullswarm.config.mission_file import parse_mission
from fullswarm.core.behaviours import load_records, make_record
from fullswarm.core.node import CoreNode
from fullswarm.errors import ConfigError, RequestRefused
from fullswarm.fitness import both, unfit
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.launch.network import with_network
from fullswarm.messages import (
    ControlRequest,
    MissionReply,
    MissionRequest,
    Needs,
    ReportQuery,
    RequestStatus,
    RobotProfile,
    RobotProfiles,
    Value,
)
from fullswarm.operator.client import NOTHING_NEEDED, Operator
from fullswarm.operator.view import FleetView
from fullswarm.reasons import Code
from tests.unit.agent_bench import Bench
from tests.unit.laws import install

ALL = ("r1", "r2", "slow", "wide")
ROBOTS: list[dict[str, Any]] = [
    {"id": "r1", "pose": (2.0, 2.0, 0.0), "capabilities": ["carry"]},
    {"id": "r2", "pose": (3.0, 2.0, 0.0), "capabilities": ["carry", "camera"]},
    {"id": "slow", "pose": (2.0, 3.0, 0.0)},
    {"id": "wide", "pose": (3.5, 3.5, 0.0), "capabilities": ["camera"]},
]
BODIES = {"slow": {"speed_limit_m_s": 0.2}, "wide": {"radius_m": 0.3, "speed_limit_m_s": 0.8}}
GROUPS = {"quick": ("r1", "r2"), "mixed": ("r1", "slow")}

seen: dict[str, dict[str, Any]] = {}
"""What the law below has seen last, by robot."""


def tell(view: Any, _: Any) -> np.ndarray:
    facts = {
        "role": view.role, "make": view.make, "carries": view.can("carry"), "grips": view.can("gripper"),
    }  # fmt: skip
    pairs = {
        "role": view.neighbour_role, "make": view.neighbour_make, "carries": view.neighbour_can("carry"),
        "battery": view.neighbour_battery, "speed": view.neighbour_limits[:, 0].round(6),
    }  # fmt: skip
    for row, robot in enumerate(view.id.tolist()):
        mine = np.flatnonzero(view.of == row)
        others = {
            view.neighbour_id[e]: {name: column[e].item() for name, column in pairs.items()} for e in mine.tolist()
        }
        seen[str(robot)] = {name: column[row].item() for name, column in facts.items()} | {"others": others}
    return np.zeros_like(view.position)


@pytest.fixture(autouse=True)
def _law(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, tell=SimpleNamespace(velocity=tell))
    seen.clear()


class Swarm:
    """Four robots that differ, and an operator."""

    def __init__(self, network: str | None = None) -> None:
        world = {"engine": "kinematic", "bounds_m": (0.0, 0.0, 8.0, 8.0), "bodies": BODIES}
        config = SwarmConfig.model_validate({"world": world, "robot": ROBOTS, "groups": GROUPS})
        self.lockstep = Lockstep(with_network(config, network) if network else config)
        self.operator = Operator(self.lockstep.bus, Keys(), self.lockstep.runtime, "op")
        self.lockstep.run(1.5)

    def store(self, name: str, **record: Any) -> None:
        self.lockstep.store.set(f"behaviour/{name}", {"summary": "", "law": "tell", **record}, "test")

    def ask(
        self, behaviour: str, robots: tuple[str, ...] = (), parameters: Mapping[str, Value] | None = None,
        needs: Needs = NOTHING_NEEDED, roles: Mapping[str, tuple[str, ...]] | None = None,
    ) -> RequestStatus:  # fmt: skip
        answers: list[RequestStatus] = []
        self.operator.request(behaviour, robots, parameters, answers.append, needs=needs, roles=roles)
        self.lockstep.run(0.5)
        return answers[-1]

    def close(self) -> None:
        self.operator.close()
        self.lockstep.close()


@pytest.fixture
def swarm() -> Iterator[Swarm]:
    made = Swarm()
    yield made
    made.close()


# ------------------------------------------------------------------ what laws know
@pytest.mark.parametrize("network", [None, "loss=0%"], ids=["one agent", "an agent each"])
def test_laws_know_what_their_robots_and_neighbours_are(network: str | None) -> None:
    swarm = Swarm(network)
    try:
        swarm.store("tell")
        assert swarm.ask("tell", roles={"leader": ("r1",), "eye": ("+camera",)}).phase == "running"
        swarm.lockstep.run(0.5)
        carries, eyes, speed = {"r1", "r2"}, {"r2", "wide"}, {"slow": 0.2, "wide": 0.8}
        for robot in ALL:
            facts = {
                each: {
                    "role": "leader" if each == "r1" else "eye" if each in eyes else "",
                    "make": "sim", "carries": each in carries,
                }
                for each in ALL
            }  # fmt: skip
            own = seen[robot]
            assert {name: own[name] for name in ("role", "make", "carries")} == facts[robot]
            assert own["grips"]  # the simulated make has a gripper
            assert own["others"] == {
                each: {**facts[each], "battery": -1.0, "speed": speed.get(each, 0.5)} for each in ALL if each != robot
            }
    finally:
        swarm.close()


def test_profiles_are_sent_seldom_and_when_something_is_new() -> None:
    bench = Bench([(2.0, 2.0, 0.0)], agent_settings={"battery_low": 0.0})
    sent: list[RobotProfiles] = []
    bench.bus.subscribe(
        bench.keys.profile(), RobotProfiles, lambda each: sent.append(each) if each.host == "bench" else None
    )
    bench.run(20.4)
    assert 3 <= len(sent) <= 5
    assert sent[-1].robots[0].capabilities == ("bodies", "bumps", "gripper", "lamp", "obstacles", "pose", "reverse")
    reading = bench.agent.reading
    assert reading is not None
    reading.battery[:] = 0.62
    bench.run(2.1)
    assert sent[-1].robots[0].battery == 0.62
    before = len(sent)
    for step in range(30):
        reading.battery[:] = 0.6 - 0.02 * step
        bench.run(0.1)
    assert 2 <= len(sent) - before <= 4  # once per second at most, whatever changes
    stranger = RobotProfile(
        robot="new", make="create", model="", radius_m=0.17, speed_limit_m_s=0.5, turn_limit_rad_s=4.0, accel_m_s2=1.0
    )
    before = len(sent)
    bench.run(1.2)
    for _ in range(20):
        bench.bus.publish(
            bench.keys.profile("all", "new"), RobotProfiles(host="new", process="new-1", robots=(stranger,))
        )
        bench.run(0.1)
    assert 1 <= len(sent) - before <= 4  # an answer to the robot that has just started, and no more


# ------------------------------------------------------------------ who can take part
def test_robots_that_are_named_and_unfit_are_refused_and_others_are_left_out(swarm: Swarm) -> None:
    needs = Needs(capabilities=("carry",), speed_m_s=0.3)
    refused = swarm.ask("rendezvous_bc", ("r1", "slow", "wide"), needs=needs)
    assert (refused.phase, refused.code) == ("refused", Code.UNFIT)
    assert "slow: it cannot take part: it has no carry; its speed is 0.2 m/s, and 0.3 m/s is needed" in refused.reason
    assert "wide: it cannot take part: it has no carry" in refused.reason
    assert "r1" not in refused.reason
    running = swarm.ask("rendezvous_bc", needs=needs)
    assert (running.phase, running.running, running.left_out) == ("running", ("r1", "r2"), ("slow", "wide"))
    assert running.code == Code.UNFIT
    assert swarm.lockstep.agent.tasks.active.tolist() == [True, True, False, False]
    slow = swarm.ask("rendezvous_bc", ("@mixed",), needs=Needs(speed_m_s=0.3))
    assert (slow.running, slow.left_out, slow.code) == (("r1",), ("slow",), Code.TOO_SLOW)
    none = swarm.ask("rendezvous_bc", ("@mixed",), needs=Needs(speed_m_s=3.0))
    assert (none.phase, none.code) == ("refused", Code.TOO_SLOW)


def test_a_record_needs_what_a_parameter_says(swarm: Swarm) -> None:
    cruise = {"cruise_m_s": {"type": "number", "unit": "m/s", "default": 0.1, "min": 0.0, "max": 2.0}}
    swarm.store("fly", parameters=cruise, needs={"speed_m_s": "cruise_m_s"})
    assert swarm.ask("fly").running == ALL
    assert swarm.ask("fly", parameters={"cruise_m_s": 0.4}).left_out == ("slow",)
    assert swarm.ask("fly", parameters={"cruise_m_s": 0.6}).running == ("wide",)
    with pytest.raises(ConfigError, match=r"needs\.speed_m_s: there is no parameter 'cruise'"):
        make_record("x", {"x": {"summary": "", "law": "tell", "needs": {"speed_m_s": "cruise"}}})


def test_a_robot_refuses_by_itself_what_the_core_did_not_know(swarm: Swarm) -> None:
    bench = Bench([(2.0, 2.0, 0.0)])
    bench.enable("rendezvous", needs=Needs(capabilities=("arm",)))
    assert (bench.acks[-1].accepted, bench.acks[-1].code) == (False, Code.UNFIT)
    bench.enable("rendezvous", needs=Needs(capabilities=("gripper",), makes=("sim",), radius_m=0.2))
    assert bench.acks[-1].accepted
    bench.enable("rendezvous", needs=Needs(battery=0.5))
    assert "its charge is unknown, and 50% is needed" in bench.acks[-1].reason


def test_needs_are_joined_and_judged_one_by_one() -> None:
    robot = RobotProfile(
        robot="r", make="create", model="2", capabilities=("lamp",), radius_m=0.17, speed_limit_m_s=0.5,
        turn_limit_rad_s=4.0, accel_m_s2=1.0, battery=0.4,
    )  # fmt: skip
    assert not unfit(Needs(), robot)
    fits = Needs(capabilities=("lamp",), makes=("create", "rover"), speed_m_s=0.5, radius_m=0.17, battery=0.4)
    assert not unfit(fits, robot)
    for needs, code, part in (
        (Needs(capabilities=("lamp", "arm")), Code.UNFIT, "it has no arm"),
        (Needs(makes=("rover",)), Code.UNFIT, "its make is 'create', not rover"),
        (Needs(radius_m=0.1), Code.UNFIT, "its radius is 0.17 m, and 0.1 m is allowed"),
        (Needs(battery=0.5), Code.UNFIT, "its charge is 40%, and 50% is needed"),
        (Needs(speed_m_s=0.6), Code.TOO_SLOW, "its speed is 0.5 m/s, and 0.6 m/s is needed"),
        (Needs(turn_rad_s=5.0), Code.TOO_SLOW, "its turn rate is 4 rad/s"),
        (Needs(accel_m_s2=2.0), Code.TOO_SLOW, "its acceleration is 1 m/s²"),
        (both(Needs(makes=("create",)), Needs(makes=("rover",))), Code.UNFIT, "its make is 'create'"),
        (both(Needs(speed_m_s=0.1, radius_m=1.0), Needs(speed_m_s=0.9)), Code.TOO_SLOW, "0.9 m/s is needed"),
    ):
        why = unfit(needs, robot)
        assert (why.code, part in why.text) == (code, True), why
    assert both(Needs(radius_m=1.0), Needs(radius_m=0.5)).radius_m == 0.5


# ------------------------------------------------------------------ roles
def test_robots_without_a_given_role_get_the_first_that_they_can_have(swarm: Swarm) -> None:
    swarm.store("haul", roles={"carrier": {"needs": ["carry"], "at_least": 1, "at_most": 1}, "scout": {}})
    status = swarm.ask("haul")
    assert status.roles == {"r1": "carrier", "r2": "scout", "slow": "scout", "wide": "scout"}
    assert swarm.ask("haul", roles={"carrier": ("r2",)}).roles["r1"] == "scout"
    for roles, why in (
        ({"carrier": ("slow",)}, "slow cannot be carrier (it needs carry)"),
        ({"carrier": ("r1", "r2")}, "2 robots are to be carrier (1 at most)"),
        ({"carrier": ("r1",), "scout": ("r1",)}, "'r1' is to be both carrier and scout"),
        ({"carrier": ("r9",)}, "'r9' is to be carrier, but is no robot of the request"),
        ({"cook": ("r1",)}, "'haul' has no role 'cook'"),
    ):
        refused = swarm.ask("haul", roles=roles)
        assert (refused.phase, refused.code) == ("refused", Code.ROLES)
        assert why in refused.reason
    few = swarm.ask("haul", ("slow", "wide"))
    assert "0 of 1 robots needed can be carrier" in few.reason


def test_names_count_before_groups_and_groups_before_capabilities(swarm: Swarm) -> None:
    swarm.store("tell")
    status = swarm.ask("tell", roles={"eye": ("+camera",), "fast": ("@quick",), "boss": ("r1",)})
    assert status.roles == {"r1": "boss", "r2": "fast", "wide": "eye"}
    assert {robot: seen[robot]["role"] for robot in ALL} == {"r1": "boss", "r2": "fast", "slow": "", "wide": "eye"}


def test_roles_and_needs_reach_the_robots_with_their_orders(swarm: Swarm) -> None:
    got: list[ControlRequest] = []
    swarm.lockstep.bus.subscribe(Keys().control_requests(), ControlRequest, got.append)
    swarm.store("tell")
    swarm.ask("tell", ("slow", "r1"), needs=Needs(capabilities=("lamp",)), roles={"boss": ("r1",)})
    assert {(each.members, each.roles) for each in got if each.enable} == {(("slow", "r1"), ("", "boss"))}
    assert {each.needs for each in got if each.enable} == {Needs(capabilities=("lamp",))}


def test_records_of_roles_are_checked() -> None:
    tables = load_records()
    for record, why in (
        ({"roles": {"a b": {}}}, "'a b' cannot name a role"),
        ({"roles": {"boss": {"at_most": 0}}}, "at_most"),
        ({"like": "drive", "roles": {"boss": {}}}, "roles are not for an intent"),
        ({"needs": {"speed": 0.1}}, "needs.speed: no such key"),
    ):
        tables["x"] = {"like": "rendezvous", **record}
        with pytest.raises(ConfigError, match=why):
            make_record("x", tables)


# ------------------------------------------------------------------ robots that have finished
@pytest.mark.parametrize("finished", ["leaves", "stays"])
def test_a_robot_that_has_finished_leaves_its_team_or_stays_in_it(
    swarm: Swarm, monkeypatch: pytest.MonkeyPatch, finished: str
) -> None:
    sensed: dict[str, set[str]] = {}

    def end(view: Any, _: Any) -> np.ndarray:
        for row, robot in enumerate(view.id.tolist()):
            sensed[str(robot)] = set(view.neighbour_id[view.of == row].tolist())
        view.finish(np.flatnonzero((view.id == "r1") & (view.time_s > 0.3)), "arrived")
        return np.zeros_like(view.position)

    install(monkeypatch, end=SimpleNamespace(velocity=end))
    swarm.store("end", law="end", finished=finished)
    swarm.ask("end")
    swarm.lockstep.run(0.5)
    team = swarm.lockstep.agent.tasks.team
    assert ("r1" in sensed["r2"]) == (finished == "stays")
    assert sensed["slow"] >= {"r2", "wide"}
    assert (team[0] == team[1]) == (finished == "stays")
    swarm.operator.stop(("r1",))
    swarm.lockstep.run(0.2)
    assert team[0] == 0
    assert "r1" not in sensed["r2"]


# ------------------------------------------------------------------ operators and missions
def test_operators_learn_at_once_what_robots_are_and_who_cannot_take_part(swarm: Swarm) -> None:
    swarm.lockstep.run(1.3)  # some time after the profiles were sent
    view = FleetView(swarm.lockstep.bus, Keys(), swarm.lockstep.runtime)
    swarm.lockstep.run(1.0)
    seen = view.snapshot()
    assert {row.robot: "carry" in row.profile.capabilities for row in seen.robots if row.profile} == {
        "r1": True, "r2": True, "slow": False, "wide": False,
    }  # fmt: skip
    record = {
        "parameters": {"cruise_m_s": {"default": 0.3}}, "needs": {"speed_m_s": "cruise_m_s", "capabilities": ["lamp"]},
        "roles": {"carrier": {"needs": ["carry"], "at_least": 1, "doc": "lifts"}},
    }  # fmt: skip
    assert demands(record, seen) == [
        "needs: speed_m_s as the parameter cruise_m_s, capabilities lamp",
        "role carrier: lifts (needs carry, at_least 1)",
        "slow: it is too slow: its speed is 0.2 m/s, and 0.3 m/s is needed",
    ]
    assert demands({}, seen) == []
    swarm.lockstep.run(3.0)
    queries: list[ReportQuery] = []
    swarm.lockstep.bus.subscribe(Keys().report_query, ReportQuery, queries.append)
    swarm.lockstep.run(5.0)
    assert queries == []  # all is known
    view.close()


MISSION = """
[[steps]]
name = "out"
behaviour = "rendezvous_bc"
robots = ["r1", "r2"]
team = "@quick"
needs = { capabilities = ["carry"], speed_m_s = 0.3 }
roles = { boss = ["r1"], rest = ["+camera"] }
done = { time_s = 1.0 }
"""


def test_a_step_of_a_mission_says_team_needs_and_roles(swarm: Swarm) -> None:
    replies: list[MissionReply] = []
    got: list[ControlRequest] = []
    bus = swarm.lockstep.bus
    bus.subscribe(Keys().mission_reply(), MissionReply, replies.append)
    bus.subscribe(Keys().control_requests(), ControlRequest, got.append)

    def send(op: str, text: str, id_: str) -> MissionReply:
        plan = parse_mission(text, "m.toml", "m").plan
        bus.publish(Keys().mission_request, MissionRequest(id=id_, op=op, plan=plan))  # type: ignore[arg-type]
        swarm.lockstep.run(0.5)
        return replies[-1]

    for number, (text, why) in enumerate(
        (
            (MISSION.replace("0.3", "0.9"), "it is too slow: its speed is 0.5 m/s, and 0.9 m/s is needed"),
            (MISSION.replace('["r1"]', '["slow"]'), "'slow' is to be boss, but is no robot of the request"),
            (MISSION.replace("@quick", "@west"), "unknown group '@west'"),
        )
    ):
        reply = send("check", text, f"m{number}")
        assert [why in each.text for each in reply.problems] == [True], reply
    assert send("start", MISSION, "go").ok
    asked = {each.robot: each for each in got if each.enable}
    assert asked.keys() == {"r1", "r2"}
    assert asked["r1"].roles == ("boss", "rest")
    assert asked["r2"].peers == ("r1", "r2")
    assert asked["r2"].needs == Needs(capabilities=("carry",), speed_m_s=0.3)
    for wrong, why in (("{ speed = 0.3 }", "speed"), ('{ speed_m_s = "fast" }', "speed_m_s")):
        with pytest.raises(ConfigError, match=rf"m\.toml:7.*needs.*{why}"):
            parse_mission(MISSION.replace('{ capabilities = ["carry"], speed_m_s = 0.3 }', wrong), "m.toml", "m")


def test_the_command_line_reads_needs_and_roles() -> None:
    needs = parse_needs(["capabilities=gripper, camera", "speed_m_s=0.3", "makes=iRobot"])
    assert needs == Needs(capabilities=("gripper", "camera"), speed_m_s=0.3, makes=("iRobot",))
    assert parse_roles(["carrier=r1, @west", "scout=+camera", "carrier=r3"]) == {
        "carrier": ("r1", "@west", "r3"), "scout": ("+camera",),
    }  # fmt: skip
    for wrong in ("speed=1", "speed_m_s=fast", "speed_m_s=-1"):
        with pytest.raises(ConfigError, match="--needs"):
            parse_needs([wrong])
    for wrong in ("carrier", "=r1", "carrier="):
        with pytest.raises(ConfigError, match="--role"):
            parse_roles([wrong])


def test_centralised_laws_know_the_same_of_their_robots(swarm: Swarm, monkeypatch: pytest.MonkeyPatch) -> None:
    facts: list[dict[Any, dict[str, Any]]] = []

    def velocity(view: Any, _: Any) -> np.ndarray:
        told = {"role": view.role, "make": view.make, "carries": view.can("carry"), "charge": view.battery}
        theirs = {
            "role": view.neighbour_role, "make": view.neighbour_make, "carries": view.neighbour_can("carry"),
            "charge": view.neighbour_battery, "fast": view.neighbour_limits[:, 0] > 0.4,
        }  # fmt: skip
        found: dict[Any, dict[str, Any]] = {}
        for row, robot in enumerate(view.id.tolist()):
            found[robot] = {name: column[row].item() for name, column in told.items()}
        for e, pair in enumerate(zip(view.id[view.of].tolist(), view.neighbour_id.tolist(), strict=True)):
            found[pair] = {name: column[e].item() for name, column in theirs.items()}
        facts.append(found)
        return np.zeros_like(view.position)

    law = SimpleNamespace(velocity=velocity, __file__="law.py")
    monkeypatch.setattr(registry, "centralised_module", lambda _: law)
    monkeypatch.setattr(registry, "centralised_names", lambda: ["herd"])
    swarm.lockstep.run(1.3)  # some time after the profiles were sent
    swarm.store("herd", law="herd", centralised=True, roles={"boss": {"needs": ["camera"], "at_most": 1}})
    status = swarm.ask("herd", ("slow", "r2", "wide"))
    swarm.lockstep.run(1.5)
    assert status.roles == {"r2": "boss"}
    newest = facts[-1]
    assert newest["r2"] == {"role": "boss", "make": "sim", "carries": True, "charge": -1.0}
    assert newest["wide"] == {"role": "", "make": "sim", "carries": False, "charge": -1.0}
    assert newest["wide", "r2"] == {"role": "boss", "make": "sim", "carries": True, "charge": -1.0, "fast": True}
    assert newest["r2", "slow"] == {"role": "", "make": "sim", "carries": False, "charge": -1.0, "fast": False}


def test_roles_by_capability_wait_for_robots_that_have_not_said_what_they_can_do(swarm: Swarm) -> None:
    swarm.store("haul", roles={"carrier": {"needs": ["carry"]}, "scout": {}})
    core = next(node for node in swarm.lockstep._nodes if isinstance(node, CoreNode))
    core.roster._profiles.clear()  # as after a restart
    refused = swarm.ask("haul")
    assert refused.code == Code.ROLES
    assert "r1, r2, slow, wide: not known yet what they can do (request it again in a second)" in refused.reason
    swarm.lockstep.run(1.0)
    assert swarm.ask("haul").roles["r1"] == "carrier"


def test_a_laboratory_says_team_needs_and_roles() -> None:
    world = {"engine": "kinematic", "bounds_m": (0.0, 0.0, 8.0, 8.0), "bodies": BODIES}
    with Lab(SwarmConfig.model_validate({"world": world, "robot": ROBOTS, "groups": GROUPS})) as lab:
        asked = lab.request(
            "rendezvous", team="@quick", needs={"capabilities": ["lamp"]}, roles={"boss": ["r1"], "eye": ["+camera"]}
        )
        lab.run(0.5)
        assert asked.status is not None
        assert asked.status.roles == {"r1": "boss", "r2": "eye", "wide": "eye"}
        assert set(lab._lockstep.agent.tasks.peers.values()) == {frozenset({"r1", "r2"})}
        with pytest.raises(
            RequestRefused, match=r"slow: it is too slow: its speed is 0\.2 m/s, and 0\.3 m/s is needed"
        ):
            lab.request("rendezvous_bc", robots=["slow"], needs={"speed_m_s": 0.3})
        with pytest.raises(ConfigError, match="speed"):
            lab.request("rendezvous_bc", needs={"speed": 0.3})
