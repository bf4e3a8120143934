"""Mission files: what they may say, and that every error is named at once with its line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fullswarm.config.mission_file import load_mission, parse_comparison, parse_mission, plan_problems, read_mission
from fullswarm.errors import ConfigError
from fullswarm.messages import MissionPlan, MissionProblem, MissionStep, MissionTrack, StepConditions

EXAMPLE = Path(__file__).parents[2] / "examples" / "missions" / "survey.toml"


def errors(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse_mission(text, "m.toml", "m")
    return str(caught.value).splitlines()


def test_the_example_is_read_as_it_is_written() -> None:
    plan = load_mission(EXAMPLE).plan
    assert [(track.name, [step.name for step in track.steps]) for track in plan.tracks] == [
        ("west", ["out", "search", "home"]), ("east", ["clear", "out"]),
    ]  # fmt: skip
    assert plan.tracks[0].steps[2].after == ("east/out",)
    assert plan.tracks[1].steps[1].robots == ("r5", "r6", "r7", "r8")


def test_steps_alone_are_one_track_with_names_of_their_own() -> None:
    plan = parse_mission('robots = ["@a"]\n[[steps]]\ndone = { time_s = 1 }\n[[steps]]\nrobots = []\ndone = { time_s = 1 }', "m.toml", "m").plan  # fmt: skip  # noqa: E501  (one file)
    (track,) = plan.tracks
    assert (plan.name, track.name) == ("m", "main")
    assert [(step.name, step.robots) for step in track.steps] == [("step 1", ("@a",)), ("step 2", ())]


def test_all_errors_come_at_once_with_their_lines() -> None:
    text = """name = "survey"
[tracks.west]
[[tracks.west.steps]]
behaviour = "move_to_goal_bc"
parameters = { goal = "x", also = { deep = 1 } }
done = { arrived = "most", metrc = 3 }
[[tracks.west.steps]]
behavior = "x"
fail_after_s = -1
"""
    assert [line.partition(": must")[0].partition(", did")[0] for line in errors(text)] == [
        "m.toml:5: tracks.west.steps[0].parameters: also is not a flag, number, word, point or list of points",
        "m.toml:6: tracks.west.steps[0].done.arrived",
        "m.toml:6: tracks.west.steps[0].done.metrc: unknown key",
        "m.toml:8: tracks.west.steps[1].behavior: unknown key",
        "m.toml:9: tracks.west.steps[1].fail_after_s",
    ]


def test_what_only_the_whole_plan_shows_comes_at_once_too() -> None:
    text = """[[tracks.a.steps]]
name = "x"
robots = ["r 1"]
done = { metric = "coverage > 1" }
[[tracks.a.steps]]
name = "y"
after = ["b/nowhere", "a/x"]
[[tracks.b.steps]]
done = { arrived = "all" }
[[tracks.c.steps]]
name = "x"
done = { time_s = 1 }
[[tracks.c.steps]]
name = "x"
done = { time_s = 1 }
"""
    found = errors(text)
    for line, what in (
        (11, "two steps of this track are named 'x'"), (3, "'r 1' cannot name a robot"), (4, "is not a comparison"),
        (5, "say when the step is over"), (7, "no step 'b/nowhere'"), (7, "is in the same track"),
        (9, "no behaviour that could arrive"),
    ):  # fmt: skip
        assert any(f"m.toml:{line}:" in each and what in each for each in found), (line, what, found)


def test_steps_that_wait_for_each_other_are_refused() -> None:
    def track(name: str, *after: str) -> MissionTrack:
        done = StepConditions(time_s=1.0)
        return MissionTrack(name=name, steps=tuple(MissionStep(name=f"s{k}", done=done, after=(each,) if each else ()) for k, each in enumerate(after)))  # fmt: skip  # noqa: E501  (one expression)

    fine = MissionPlan(name="m", tracks=(track("a", "", "b/s0"), track("b", "a/s0", "a/s1")))
    assert plan_problems(fine) == []
    circle = MissionPlan(name="m", tracks=(track("a", "", "b/s1"), track("b", "a/s0", "a/s1")))
    (problem,) = plan_problems(circle)
    assert (problem.key, problem.track, problem.step) == ("after", "a", "s1")


@pytest.mark.parametrize(
    ("text", "value", "holds"),
    [
        ("coverage.fraction >= 0.8", 0.8, True), ("shape.diameter_m<2", 2.0, False), ("work.total_m > 1e1", 11.0, True),
        ("work.total_m <= -1", float("nan"), False),
    ],
)  # fmt: skip
def test_a_comparison(text: str, value: float, holds: bool) -> None:
    assert parse_comparison(text).holds(value) is holds


@pytest.mark.parametrize("text", ["", "coverage", "coverage.fraction", "coverage.fraction == 1", "a.b > 1.2.3"])
def test_what_is_no_comparison(text: str) -> None:
    with pytest.raises(ConfigError):
        parse_comparison(text)


def test_a_dict_is_read_as_the_same_tables_of_a_file() -> None:
    step: dict[str, Any] = {
        "name": "go", "behaviour": "move_to_goal_bc", "parameters": {"goal": (1.0, 2.0)}, "done": {"arrived": "all"},
    }  # fmt: skip
    text = """robots = ["@a"]
[[steps]]
name = "go"
behaviour = "move_to_goal_bc"
parameters = { goal = [1.0, 2.0] }
done = { arrived = "all" }
"""
    read = read_mission({"robots": ("@a",), "steps": [step]})
    assert read.plan == parse_mission(text, "m.toml", "mission").plan
    tracks = read_mission({"name": "two", "tracks": {each: {"steps": [step]} for each in ("east", "west")}}).plan
    assert (tracks.name, [track.name for track in tracks.tracks]) == ("two", ["east", "west"])


def test_errors_of_a_dict_name_the_key() -> None:
    with pytest.raises(ConfigError) as caught:
        read_mission({"steps": [{"done": {"tim_s": 3}}, {"behaviour": 3, "done": {"time_s": 1}}]})
    first, second = str(caught.value).splitlines()
    assert first.startswith("mission: steps[0].done.tim_s: unknown key, did you mean 'time_s'")
    assert second.startswith("mission: steps[1].behaviour: ")
    with pytest.raises(ConfigError, match=r"mission: steps\[0\].done: is missing"):
        read_mission({"steps": [{"name": "x"}]})
    problem = MissionProblem(track="main", step="x", key="robots", text="no robot 'r9'")
    read = read_mission({"steps": [{"name": "x", "done": {"time_s": 1}}]})
    assert str(read.errors([problem])) == "mission: steps[0].robots: no robot 'r9'"
