"""Experiments with behaviours that take points or no goal, and with behaviours that end themselves."""

from __future__ import annotations

import pytest

from fullswarm.evaluate.experiment.model import Experiment, parse_experiment
from fullswarm.evaluate.experiment.plan import Trial, fits, plan
from fullswarm.evaluate.experiment.run import check_behaviours
from fullswarm.evaluate.lockstep_swarm import measure
from fullswarm.evaluate.swarm import ALL_ENDED
from fullswarm.evaluate.trial import TIME_LIMIT, takes_goal
from fullswarm.evaluate.trial_folder import launch_text, parse_trial, trial_id

TEXT = """
name = "goalless"
seeds = "0"
[limits.create]
speed_limit_m_s = 0.5
turn_limit_rad_s = 4.25
[[groups]]
name = "all"
behaviours = [
    { name = "move_to_goal_bc" },
    { name = "dispersion_bc", parameters = { spacing_m = 1.5 } },
    { name = "leader_follower_bc", parameters = { leader_goal = [9, 9.5] } },
    { name = "perimeter_bc", parameters = { corners = [[2.0, 2.0], [8.0, 2.0], [8.0, 8.0]] } },
    { name = "average_consensus_bc", parameters = { wait_s = 2.0, says_m = 30.0 } },
]
scenarios = ["empty"]
robots = [3]
engines = ["kinematic"]
limits = ["create"]
time_limit_s = 6.0
"""


def trials() -> dict[str, Trial]:
    experiment: Experiment = parse_experiment(TEXT, "goalless.toml")
    return {each.cell.behaviour: each for each in plan(experiment)}


def test_points_of_a_request_pass_through_the_file_of_a_trial() -> None:
    for trial in trials().values():
        again = parse_trial(launch_text(trial, "goalless"), "trial.toml").trial
        assert again.cell.requested() == trial.cell.requested()
        assert trial_id(again) == trial_id(trial)
    cell = trials()["perimeter_bc"].cell
    assert cell.requested() == {"corners": [[2.0, 2.0], [8.0, 2.0], [8.0, 8.0]]}
    assert cell.label == "perimeter_bc corners=2 2, 8 2, 8 8"
    assert fits(cell.fields(), "behaviour=perimeter_*")


def test_behaviours_without_a_goal_are_not_given_one() -> None:
    check_behaviours(trials().values(), "goalless.toml")  # raises what the core would refuse
    assert takes_goal("move_to_goal_bc")
    assert takes_goal("formation")
    assert not takes_goal("dispersion_bc")
    assert takes_goal("no_such_behaviour")  # the core says what is wrong with it


@pytest.mark.parametrize(
    ("behaviour", "reason"),
    [("dispersion_bc", TIME_LIMIT), ("perimeter_bc", TIME_LIMIT), ("average_consensus_bc", ALL_ENDED)],
)
def test_they_run_to_their_end(behaviour: str, reason: str) -> None:
    found = measure(trials()[behaviour])
    assert found.end_reason == reason
    assert (found.outcome.simulated_s < 6.0) == (reason == ALL_ENDED)
    assert found.outcome.arrived == 0
    assert found.outcome.robot_events == found.outcome.obstacle_events == 0
