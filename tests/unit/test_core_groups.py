from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.config import load_swarm
from fullswarm.core.groups import Groups
from fullswarm.errors import ConfigError, RequestRefused
from fullswarm.messages import ParamReply, ParamRequest
from fullswarm.store import Store
from tests.unit.core_swarm import KEYS, Swarm

NUMBERS = itertools.count()


@pytest.fixture
def swarm() -> Iterator[Swarm]:
    store = Store()
    store.set("group/scouts", {"robots": ["r2", "r0"]}, "test")
    made = Swarm(store=store)
    yield made
    made.close()


def put(swarm: Swarm, key: str, value: object) -> ParamReply:
    replies: list[ParamReply] = []
    subscription = swarm.bus.subscribe(KEYS.param_reply("core"), ParamReply, replies.append)
    question = ParamRequest(id=f"p{next(NUMBERS)}", op="set", key=key, value=value, author="ann")  # type: ignore[arg-type]  # also what is no value
    swarm.bus.publish(KEYS.param_request("core"), question)
    swarm.run(0.01)
    subscription.close()
    return replies[-1]


def test_a_group_stands_for_its_robots_in_its_order(swarm: Swarm) -> None:
    swarm.ask("a", "formation", "@scouts", "r0", targets=[[1.0, 1.0], [2.0, 2.0]])
    swarm.run(0.1)
    targets = {name: robot.task.parameters["target"] for name, robot in swarm.robots.items() if robot.task}
    assert targets == {"r2": [1.0, 1.0], "r0": [2.0, 2.0]}
    assert swarm.status("a").robots == ("r2", "r0")


def test_an_unknown_group_is_refused_with_a_guess(swarm: Swarm) -> None:
    swarm.ask("a", "flocking", "@scout")
    swarm.run(0.05)
    assert swarm.status("a").reason == "unknown group '@scout' (did you mean '@scouts'?)"
    assert swarm.behaviours() == ["", "", ""]


def test_an_empty_group_is_not_the_whole_swarm(swarm: Swarm) -> None:
    assert put(swarm, "group/scouts", {"robots": []}).ok
    swarm.ask("a", "flocking", "@scouts")
    swarm.run(0.05)
    assert swarm.status("a").phase == "refused"
    assert swarm.behaviours() == ["", "", ""]


def test_a_robot_of_a_group_that_nobody_knows_is_refused(swarm: Swarm) -> None:
    assert put(swarm, "group/scouts", {"robots": ["r1", "r11"]}).ok
    swarm.ask("a", "flocking", "@scouts")
    swarm.run(0.05)
    assert swarm.status("a").reason == "unknown robot 'r11' in a group (did you mean 'r1'?)"


def test_a_group_changes_while_the_core_runs(swarm: Swarm) -> None:
    swarm.ask("a", "flocking", "@scouts")
    assert put(swarm, "group/scouts", {"robots": ["r1", "r1"]}).entries[0].value == {"robots": ["r1"]}
    swarm.ask("b", "rendezvous", "@scouts")
    swarm.run(0.1)
    assert swarm.behaviours() == ["flocking", "rendezvous", "flocking"]
    assert put(swarm, "group/scouts", None).ok
    swarm.ask("c", "flocking", "@scouts")
    swarm.run(0.05)
    assert "there are no groups" in swarm.status("c").reason


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("group/no good", {"robots": ["r1"]}, "cannot name a group"),
        ("group/scouts", ["r1"], "is no group"),
        ("group/scouts", {"robots": ["r1"], "more": 1}, "is no group"),
        ("group/scouts", {"robots": "r1"}, "is no group"),
        ("group/scouts", {"robots": ["r/1"]}, "cannot name a robot"),
        ("group/scouts", {"robots": ["truth"]}, "cannot name a robot"),
        ("group/scouts", {"robots": [1]}, "cannot name a robot"),
    ],
)
def test_what_is_no_group_is_not_stored(swarm: Swarm, key: str, value: object, said: str) -> None:
    reply = put(swarm, key, value)
    assert not reply.ok
    assert said in reply.reason
    assert swarm.store.get("group/scouts") == {"robots": ["r2", "r0"]}


@given(st.lists(st.text(max_size=5) | st.sampled_from(["@a", "@b", "r1", "@"]), max_size=5))
def test_expanding_never_makes_nobody_out_of_somebody(names: list[str]) -> None:
    store = Store()
    store.set("group/a", {"robots": ["r1", "r2"]}, "test")
    store.set("group/b", {"robots": []}, "test")
    groups = Groups(store)
    try:
        robots = groups.expand(names)
    except RequestRefused:
        assert any(name.startswith("@") and name != "@a" for name in names)
    else:
        assert bool(robots) == bool(names)
        assert not any(robot.startswith("@") for robot in robots)
    assert set(groups.known(names, ("r1", "r2"))) <= {"r1", "r2"}
    store.close()


def fleet(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "lab.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_group_of_the_fleet_file_names_robots_of_the_file(tmp_path: Path) -> None:
    good = fleet(tmp_path, '[fleet]\ncount = 3\n[groups]\nscouts = ["r1", "r3"]\n')
    assert load_swarm(good).groups == {"scouts": ("r1", "r3")}
    bad = fleet(tmp_path, '[fleet]\ncount = 3\n[groups]\nscouts = [\n  "r1",\n  "r33",\n]\n')
    with pytest.raises(ConfigError) as caught:
        load_swarm(bad)
    assert str(caught.value) == f"{bad}:6: groups.scouts[1]: no robot 'r33' in this file, did you mean 'r3'?"


def test_groups_of_a_file_without_robots_may_name_whoever_joins(tmp_path: Path) -> None:
    assert load_swarm(fleet(tmp_path, '[groups]\nscouts = ["r1"]\n')).groups == {"scouts": ("r1",)}
