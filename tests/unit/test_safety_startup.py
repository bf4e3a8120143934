"""Which settings are refused before a start because robots could not stop in time."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.agent.safety.startup import check_stopping, distances, expected_sigma_m, stopping_problem, vaguest_fix_m
from fullswarm.bringup.doctor import run as doctor
from fullswarm.config import SwarmConfig
from fullswarm.drivers.base import Description, Limits
from fullswarm.drivers.fleet_file import load_fleet
from fullswarm.drivers.sim.settings import describe
from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment.model import experiment_names, load_experiment, parse_experiment
from fullswarm.evaluate.experiment.plan import plan
from fullswarm.launch.lockstep import Lockstep
from fullswarm.launch.stopping import check_fleet

ROOT = Path(__file__).parents[2]
PAPER = {"speed_limit_m_s": 4.0, "turn_limit_rad_s": 0.785, "accel_limit_m_s2": 8.0}


def swarm(
    world: dict[str, Any], agent: dict[str, Any] | None = None, network: str | None = None, robots: int = 2
) -> tuple[SwarmConfig, Description]:
    config = SwarmConfig.model_validate(
        {
            "world": world,
            "agent": agent or {},
            "robot": [{"id": f"r{row}"} for row in range(robots)],
            "network": {"conditions": network},
        }
    )
    return config, describe(config.world_or_default)


def test_half_a_metre_at_4_m_s_is_refused_with_what_is_enough() -> None:
    config, robot = swarm(PAPER, {"sensing_radius_m": 0.5})
    with pytest.raises(ConfigError, match=r"two at 4 m/s need 2\.\d+ m .* the sensing radius is 0\.5 m") as caught:
        check_stopping(config, [robot])
    assert caught.value.hint.startswith("sensing_radius_m = 2.7 or more, or speed_limit_m_s = ")
    assert caught.value.exit_code == 2
    enough, _ = swarm(PAPER, {"sensing_radius_m": 2.7})
    assert stopping_problem(enough, [robot]) is None
    speed_m_s = float(caught.value.hint.split("speed_limit_m_s = ")[1].split()[0])
    for factor, fits in ((1.0, True), (1.1, False)):
        slower, _ = swarm(PAPER, {"sensing_radius_m": 0.5, "speed_limit_m_s": factor * speed_m_s})
        assert (stopping_problem(slower, [robot]) is None) == fits


@pytest.mark.parametrize("world", [{}, PAPER], ids=["create", "paper"])
@pytest.mark.parametrize("noise_m", [0.0, 0.05])
@pytest.mark.parametrize("network", [None, "delay=200ms,loss=30%"])
def test_the_defaults_are_enough_for_both_limits_with_noise_and_delay(
    world: dict[str, Any], noise_m: float, network: str | None
) -> None:
    config, robot = swarm({**world, "noise": {"position_m": noise_m}}, network=network)
    assert stopping_problem(config, [robot]) is None


def test_a_robot_alone_stops_for_no_other() -> None:
    config, robot = swarm(PAPER, {"sensing_radius_m": 0.5}, robots=1)
    assert stopping_problem(config, [robot]) is None


@given(
    speed_m_s=st.floats(0.05, 10.0), accel=st.floats(0.2, 20.0), margin_m=st.floats(0.0, 1.0),
    rate_hz=st.floats(1.0, 100.0), period_hz=st.floats(5.0, 200.0), delay_s=st.floats(0.0, 1.0),
    overrun_s=st.floats(0.0, 1.0), dead_s=st.floats(0.0, 0.5),
)  # fmt: skip
def test_what_is_needed_holds_two_robots_that_brake_in_the_last_moment(
    speed_m_s: float, accel: float, margin_m: float, rate_hz: float, period_hz: float, delay_s: float,
    overrun_s: float, dead_s: float,
) -> None:  # fmt: skip
    """Two robots drive at each other in steps of a millisecond; each reacts a period and its dead time later."""
    config, robot = swarm(
        {}, {"safety_margin_m": margin_m, "state_rate_hz": rate_hz, "control_rate_hz": period_hz,
             "state_delay_s": delay_s},
    )  # fmt: skip
    limits = Limits(speed_m_s, 1.0, accel, 10.0, overrun_s=overrun_s, overrun_m=1.0, dead_time_s=dead_s)
    robot = replace(robot, limits=limits)
    left_m, speed, step_s, time_s = distances(config, robot, [robot]).needed_m, speed_m_s, 1e-3, 0.0
    while speed > 0.0:
        left_m -= 2.0 * speed * step_s
        time_s += step_s
        if time_s > 1.0 / period_hz + dead_s:
            speed -= accel * step_s
    assert left_m >= 2.0 * robot.radius_m + margin_m - 2.0 * speed_m_s * 2 * step_s


def test_the_error_expected_of_a_filter_is_the_one_that_it_reaches() -> None:
    robots = [{"id": "r1", "pose": [2.0, 5.0, 0.0]}, {"id": "r2", "pose": [2.0, 8.0, 0.0]}]
    config = SwarmConfig.model_validate(
        {"world": {"engine": "kinematic", "noise": {"position_m": 0.05}}, "robot": robots}
    )
    run = Lockstep(config)
    run.run(2.0)
    at_rest, _ = swarm({"noise": {"position_m": 0.05}, "speed_limit_m_s": 0.01})
    expected_m = expected_sigma_m(at_rest, run.agent.fleet.descriptions[0])
    moving_m = expected_sigma_m(config, run.agent.fleet.descriptions[0])
    assert 0.5 * expected_m < run.agent._state.sigma[0, 0] < moving_m < 0.02
    run.close()


def test_direct_counts_the_whole_noise() -> None:
    config, robot = swarm({"noise": {"position_m": 0.05}}, {"estimator": "direct"})
    assert expected_sigma_m(config, robot) == 0.05
    exact, _ = swarm({})
    assert distances(config, robot, [robot]).errors_m == pytest.approx(
        distances(exact, robot, [robot]).errors_m + 3.0 * math.sqrt(2.0) * 0.05
    )


def test_fixes_may_be_as_vague_as_the_sensing_radius_allows() -> None:
    config, simulated = swarm(PAPER)
    robot = replace(simulated, senses_pose=False)
    vague_m = vaguest_fix_m(config, [robot])
    assert 0.1 < vague_m < 10.0
    for factor, fits in ((0.999, True), (1.001, False)):
        needed_m = distances(config, robot, [robot], fix_sigma_m=factor * vague_m).needed_m
        assert (needed_m <= config.agent.sensing_radius_m) == fits
    far, _ = swarm(PAPER, {"sensing_radius_m": 4.0})
    assert vaguest_fix_m(far, [robot]) > 2.0 * vague_m
    alone, _ = swarm(PAPER, robots=1)
    assert vaguest_fix_m(alone, [robot]) == vaguest_fix_m(config, [simulated]) == 100.0


# ---------------------------------------------------------------- where it is checked
def test_an_agent_does_not_start() -> None:
    config, _ = swarm({**PAPER, "engine": "kinematic"}, {"sensing_radius_m": 0.5})
    with pytest.raises(ConfigError, match="cannot stop in time"):
        Lockstep(config)


def test_an_experiment_is_refused_before_its_first_trial() -> None:
    text = (ROOT / "fullswarm/evaluate/experiment/safety.toml").read_text("utf-8")
    assert plan(parse_experiment(text, "safety.toml"), seeds=(0,))
    shrunk = text.replace('name = "swap"\n', 'name = "swap"\nagent = { sensing_radius_m = 0.5 }\n', 1)
    with pytest.raises(ConfigError, match=r"group 'swap', limits 'paper': agent\.sensing_radius_m: .*cannot stop"):
        plan(parse_experiment(shrunk, "safety.toml"))


def test_doctor_reports_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fleet = tmp_path / "fleet.toml"
    world = "[world]\nspeed_limit_m_s = 4.0\naccel_limit_m_s2 = 8.0\nnoise = { position_m = 0.03 }\n"
    rest = "[fleet]\ncount = 2\n[agent]\nestimator = 'direct'\n"
    fleet.write_text(f"{world}{rest}sensing_radius_m = 0.5\n", "utf-8")
    assert doctor(fleet, as_json=False) == 1
    assert "failure  stopping distance: robots cannot stop in time" in capsys.readouterr().out
    fleet.write_text(world + rest, "utf-8")
    doctor(fleet, as_json=False)
    out = capsys.readouterr().out
    assert "ok       stopping distance: robots need 2." in out
    assert "warning  estimator: agent.estimator = 'direct'" in out


@pytest.mark.parametrize(
    "path",
    [
        each
        for folder in ("examples", "fullswarm/demo")
        for each in (ROOT / folder).glob("*.toml")
        if each.stem != "mission"
    ],
    ids=lambda each: each.name,
)
def test_every_fleet_file_that_is_shipped_passes(path: Path) -> None:
    check_fleet(load_fleet(path))


@pytest.mark.parametrize("name", experiment_names())
def test_every_experiment_that_is_shipped_passes(name: str) -> None:
    assert plan(load_experiment(name), seeds=(0,))
