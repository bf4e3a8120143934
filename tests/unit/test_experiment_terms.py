"""What an experiment's requests say beside their parameters: team, needs and roles."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment.model import parse_experiment
from fullswarm.evaluate.experiment.plan import Trial, fits, plan, scenario_of
from fullswarm.evaluate.experiment.run import Options, check_behaviours, run
from fullswarm.evaluate.lockstep_swarm import LockstepSwarm, measure
from fullswarm.evaluate.provenance import Provenance
from fullswarm.evaluate.results.audit import audit
from fullswarm.evaluate.swarm import TrialFailed
from fullswarm.evaluate.trial import configure, record_of, request_of
from fullswarm.evaluate.trial_folder import launch_text, parse_trial, trial_id, write_trial
from tests.unit.experiment_work import answer
from tests.unit.results_fixture import a_trial

TEXT = """
name = "terms"
seeds = "3"
[limits.fast]
speed_limit_m_s = 0.5
turn_limit_rad_s = 4.25
[limits.slow]
speed_limit_m_s = 0.2
turn_limit_rad_s = 4.25
[mixes]
both = ["fast", "fast", "slow"]
[[groups]]
name = "all"
team = "swarm"
needs = { speed_m_s = 0.3 }
behaviours = [
    { name = "move_to_goal_bc", roles = { leader = ["r0"], guard = ["r1", "+gripper"] } },
    { name = "move_to_goal_bc", team = "request", needs = {} },
]
scenarios = ["empty"]
robots = [3]
engines = ["kinematic"]
limits = ["both"]
"""
ROLES = '{ leader = ["r0"], guard = ["r1", "+gripper"] }'
IDS = ("r0s3", "r1s3", "r2s3")


def trials(text: str = TEXT) -> list[Trial]:
    return plan(parse_experiment(text, "terms.toml"))


def test_a_behaviour_s_terms_count_before_those_of_its_group() -> None:
    first, second = (each.cell for each in trials())
    assert (first.team, first.needs) == ("swarm", (("speed_m_s", 0.3),))
    assert first.roles == (("leader", ("r0",)), ("guard", ("r1", "+gripper")))
    assert (second.team, second.needs, second.roles) == ("request", (), ())
    assert first.label == "move_to_goal_bc team=swarm needs.speed_m_s=0.3 roles.leader=r0 roles.guard=r1 +gripper"
    assert second.label == "move_to_goal_bc team=request"
    for text in ("team=swarm", "needs.speed_m_s=0.3", "roles.leader=*r0*", "swarm"):
        assert [fits(each.fields(), text) for each in (first, second)] == [True, False], text


def test_terms_are_part_of_a_trial_and_of_its_file() -> None:
    found = trials()
    cells = [
        replace(found[0].cell, **{name: type(getattr(found[0].cell, name))()}) for name in ("team", "needs", "roles")
    ]
    ids = {trial_id(each) for each in (*found, *(replace(found[0], cell=cell) for cell in cells))}
    assert len(ids) == 5
    for each in found:
        again = parse_trial(launch_text(each, "terms"), "trial.toml").trial
        assert again.cell == each.cell
        assert trial_id(again) == trial_id(each)


def test_what_robots_see_is_in_the_file_of_a_trial() -> None:
    (trial, _) = trials(TEXT.replace("scenarios", "sight = { bodies = false }\nscenarios"))
    assert trial.sight == (("bodies", False),)
    assert parse_trial(launch_text(trial, "terms"), "trial.toml").trial == trial


def test_trials_that_say_nothing_of_it_are_called_as_ever() -> None:
    assert (
        trial_id(a_trial("move_to_goal_bc", "concave", 8, 3))
        == "move_to_goal_bc-concave-n8-kinematic-paper-s3-38bb4937"
    )


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"swarm"', '"swarn"', ":14: groups[0].team: the robots of a trial have request or swarm, and no groups; "),
        ('"swarm"', '"swarn"', "did you mean 'swarm'?"),
        ('"swarm"', '"@west"', "no groups"),
        ("speed_m_s = 0.3", "speed = 0.3", ":15: groups[0].needs: unknown key 'speed' (did you mean 'speed_m_s'?)"),
        ("speed_m_s = 0.3", 'speed_m_s = "fast"', "groups[0].needs: speed_m_s: Expected `float`, got `str`"),
        ("speed_m_s = 0.3", "battery = 2", "groups[0].needs: battery: Expected"),
        ('["r0"]', '["r0s3"]', ":17: groups[0].behaviours[0].roles.leader[0]: 'r0s3' names no robot of a trial"),
        ('["r0"]', '["@west"]', "'@west' names no robot"),
        ('["r0"]', '["+"]', "'+' names no robot"),
        ('["r0"]', '["r3"]', "groups[0]: roles: there is no r3 in a trial of 3 robots: r0 to r2"),
        ('["r0"]', '"r0"', "groups[0].behaviours[0].roles.leader: must be a list, not 'r0'"),
        ("team =", "teams =", "unknown key, did you mean 'team'?"),
        (', team = "request", needs = {}', f", roles = {ROLES}", "'move_to_goal_bc' is given twice"),
    ],
)  # fmt: skip
def test_wrong_terms_are_refused_with_their_line(old: str, new: str, words: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(words)):
        parse_experiment(TEXT.replace(old, new, 1), "terms.toml")


def test_what_the_core_would_refuse_is_refused_before_any_trial() -> None:
    central = TEXT.replace("move_to_goal_bc", "formation_assigned_bc").replace("empty", "antipodal")
    with pytest.raises(ConfigError, match="team 'swarm': a centralised behaviour always has the robots of its request"):
        check_behaviours(trials(central), "terms.toml")
    check_behaviours(trials(), "terms.toml")


def test_a_role_that_the_behaviour_does_not_have_is_an_error(tmp_path: Path) -> None:
    file = tmp_path / "terms.toml"
    file.write_text(TEXT.replace("move_to_goal_bc", "convoy_bc").replace("leader", "carier"))
    examples = Path(__file__).parents[2] / "examples" / "behaviours"
    found = subprocess.run(
        [sys.executable, "-m", "fullswarm", "experiment", "run", str(file)],
        env={**os.environ, "FULLSWARM_DEVELOP": str(examples)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert found.returncode == 2, found.stderr
    assert "'convoy_bc' has no role 'carier' (did you mean 'carrier'?)" in found.stderr


def test_robots_get_the_team_the_needs_and_the_roles_of_the_experiment() -> None:
    (trial, plain) = trials(TEXT.replace('limits = ["both"]', 'limits = ["fast"]'))
    orders = []
    for each in (trial, plain):
        scenario = scenario_of(each)
        config, goals = configure(each, scenario)
        swarm = LockstepSwarm(config)
        try:
            swarm.settle()
            asked = request_of(each, scenario, goals, config, (10.0, "time limit"), safe_start=True)
            swarm.request(asked.behaviour, asked.parameters, team=asked.team, needs=asked.needs, roles=asked.roles)
            swarm.advance(lambda: False)
            orders.append([task.request for task in swarm._lockstep.agent.tasks.of if task is not None])
        finally:
            swarm.close()
    first, second = orders
    assert len(first) == len(second) == 3
    # Gripper: all simulated robots have one, and the leader has its role by name.
    assert {each.roles for each in first} == {("leader", "guard", "guard")}
    assert {each.members for each in first} == {IDS}
    assert {each.team for each in first} == {0}  # all that are sensed
    assert first[0].needs is not None
    assert first[0].needs.speed_m_s == 0.3
    assert {each.roles for each in second} == {()}
    assert {each.needs for each in second} == {None}
    assert 0 not in {each.team for each in second}


def test_robots_that_are_unfit_take_no_part_and_are_not_waited_for(tmp_path: Path) -> None:
    (trial, everyone) = trials()
    found = measure(trial)
    assert (found.outcome.robots, found.outcome.left_out, found.outcome.arrived) == (2, 1, 2)
    assert found.end_reason == "all arrived"
    assert found.outcome.quiet_s is None
    assert found.truth["arrival.fraction"] == 1.0
    distance_m = found.per_robot["truth work.distance_m"]
    assert (distance_m[IDS[0]] > 1.0, distance_m[IDS[2]]) == (True, 0.0)
    other = measure(everyone)
    assert (other.outcome.robots, other.outcome.left_out, other.outcome.arrived) == (3, 0, 2)
    assert other.end_reason == "time limit"  # it waits for the slow one
    for each, measured in ((trial, found), (everyone, other)):
        write_trial(tmp_path, record_of(each, "terms", measured), Provenance(), measured)
    assert audit(tmp_path, as_json=False, jobs=1) == 0  # an independent recount agrees


def test_a_trial_for_which_no_robot_is_fit_fails_with_the_reason() -> None:
    (trial, _) = trials(TEXT.replace("speed_m_s = 0.3", "speed_m_s = 3.0"))
    with pytest.raises(TrialFailed, match=r"the core refused: .*speed is 0\.5 m/s, and 3 m/s is needed"):
        measure(trial)


def test_a_run_goes_on_with_its_own_terms(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "terms.toml"
    options = Options(str(file), jobs=1, folder=tmp_path / "out")
    file.write_text(TEXT)
    assert run(options, answer) == 0
    assert run(options, answer) == 0
    assert "2 of 2 trials are in" in capsys.readouterr().err
    file.write_text(TEXT.replace("speed_m_s = 0.3", "speed_m_s = 0.1"))
    assert run(options, answer) == 0
    assert "1 of 2 trials are in" in capsys.readouterr().err
