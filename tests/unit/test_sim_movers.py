"""Bodies that no agent commands: on their way, solid, seen, and judged apart from the robots' own contacts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from fullswarm.config import MoverConfig, WorldConfig
from fullswarm.evaluate.scenarios import load_scenario, world_config
from fullswarm.evaluate.scenarios.model import parse_scenario, scenario_to_toml
from fullswarm.evaluate.witness import Referee, Standard
from fullswarm.simulation.movers import Movers
from fullswarm.simulation.sight import look
from fullswarm.simulation.world import World


def world(*starts: tuple[float, float, float], engine: str = "kinematic", **settings: Any) -> World:
    config = WorldConfig.model_validate({"engine": engine, "bounds_m": [0, 0, 10, 10], **settings})
    return World(config, [f"r{row}" for row in range(len(starts))], list(starts))


@pytest.mark.parametrize(
    ("repeat", "time_s", "place"),
    [("back", 1.0, (1.0, 0.0)), ("back", 5.0, (1.0, 0.0)), ("once", 9.0, (2.0, 1.0)), ("loop", 3.5, (1.553, 0.776))],
)
def test_a_mover_goes_along_its_waypoints(repeat: str, time_s: float, place: tuple[float, float]) -> None:
    way = {"waypoints": [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0)], "speed_m_s": 1.0, "accel_m_s2": 1e4, "repeat": repeat}
    movers = Movers([MoverConfig.model_validate(way), MoverConfig(waypoints=((7.0, 7.0),))])
    movers.set_time(time_s)
    assert movers.place[0] == pytest.approx(place, abs=1e-3)
    assert movers.place[1].tolist() == [7.0, 7.0]


@pytest.mark.parametrize("repeat", ["back", "loop", "once"])
def test_a_mover_keeps_its_speed_and_acceleration(repeat: str) -> None:
    way = {"waypoints": [(0.0, 0.0), (2.0, 0.0), (2.0, 0.3)], "speed_m_s": 1.0, "accel_m_s2": 2.0, "repeat": repeat}
    movers, places = Movers([MoverConfig.model_validate(way)]), []
    for step in range(2000):
        movers.set_time(0.01 * step)
        places.append(movers.place[0].copy())
    velocity = np.diff(places, axis=0) / 0.01
    assert np.hypot(*velocity.T).max() == pytest.approx(1.0, abs=1e-6)
    assert np.hypot(*(np.diff(velocity, axis=0) / 0.01).T).max() < 2.0 + 1e-6


@pytest.mark.parametrize("engine", ["kinematic", "pybullet"])
def test_a_mover_is_solid_and_what_it_touches_is_told_by_who_moved(engine: str) -> None:
    if engine == "pybullet":
        pytest.importorskip("pybullet")
    mover = {"waypoints": [[1.0, 5.0], [9.0, 5.0]], "speed_m_s": 1.0, "radius_m": 0.25, "repeat": "once"}
    made = world((4.0, 5.0, 0.0), engine=engine, movers=[mover])
    referee = Referee(made, Standard.of_world(made, np.zeros((1, 2)), 0.1))
    for _ in range(200):
        made.step()
        referee.sample()
    assert made.pose[0, 0] > 4.9, "it was pushed"
    assert referee.movers.hit.events.tolist() == [1]
    assert referee.movers.own.events.tolist() == [0]
    assert referee.obstacles.events.tolist() == [0]
    made.close()


def test_a_robot_that_drives_into_a_mover_has_touched_it_by_its_own_motion() -> None:
    made = world((2.0, 5.0, 0.0), movers=[{"waypoints": [[4.0, 5.0]], "radius_m": 0.25}])
    referee = Referee(made, Standard.of_world(made, np.zeros((1, 2)), 0.1))
    for _ in range(250):
        made.set_twists(np.array([[0.5, 0.0]]))
        made.step()
        referee.sample()
    assert made.pose[0, 0] == pytest.approx(4.0 - 0.42, abs=1e-6)
    assert (referee.movers.own.events.tolist(), referee.movers.hit.events.tolist()) == ([1], [0])
    assert not referee.touched.any()


def test_robots_meet_by_a_push_where_a_mover_pushes_one_into_the_other_and_by_themselves_elsewhere() -> None:
    mover = {"waypoints": [[1.0, 5.0], [9.0, 5.0]], "speed_m_s": 1.0, "radius_m": 0.25, "repeat": "once"}
    made = world((4.0, 5.0, 0.0), (5.0, 5.0, 0.0), (4.0, 1.0, 0.0), (5.0, 1.0, 0.0), movers=[mover])
    referee = Referee(made, Standard.of_world(made, np.zeros((4, 2)), 0.1))
    for _ in range(250):
        made.set_twists(np.array([[0.0, 0.0], [0.0, 0.0], [0.5, 0.0], [0.0, 0.0]]))
        made.step()
        referee.sample()
    assert referee.robots.pushed.events.tolist() == [1, 1, 0, 0]
    assert referee.robots.own.events.tolist() == [0, 0, 1, 1]
    assert referee.pairs == {(0, 1), (2, 3)}


def test_bodies_are_seen_in_range_and_line_of_sight() -> None:
    wall = [3.0, 5.0, 0.2, 2.0, 0.0]
    made = world((2.0, 5.0, 0.0), (2.0, 6.0, 0.0), (4.0, 5.0, 0.0), (2.0, 9.5, 0.0), boxes=[wall])
    seen = made.seen_bodies(0, 3.0)
    assert seen is not None
    assert seen[:, :2].tolist() == [[2.0, 6.0]]
    of_all = made.seen_bodies(None, 3.0)
    assert of_all is not None
    assert len(of_all) == 0, "a fleet of all robots knows where they are"
    blind = world((2.0, 5.0, 0.0), (2.0, 6.0, 0.0), sight={"bodies": False})
    assert blind.seen_bodies(0, 3.0) is None


def test_a_body_that_is_partly_hidden_is_seen() -> None:
    bodies = np.array([[0.0, 0.0, 0.17], [2.0, 0.0, 0.17], [1.0, 0.15, 0.17]])
    seen = np.zeros(3, bool)
    assert look(0.0, 0.0, 0, bodies, np.zeros((0, 8)), 0, 3.0, seen) == 2
    bodies[2] = 1.0, 0.0, 0.3
    assert look(0.0, 0.0, 0, bodies, np.zeros((0, 8)), 0, 3.0, seen) == 1


def test_a_sense_may_miss_bodies_and_place_them_wrongly() -> None:
    made = world((2.0, 5.0, 0.0), (3.0, 5.0, 0.0), sight={"dropout": 0.3, "noise_m": 0.05})
    looks = [made.seen_bodies(0, 3.0) for _ in range(500)]
    found = np.array([each[0, :2] for each in looks if each is not None and len(each)])
    assert 0.6 < len(found) / 500 < 0.8
    assert found.std(axis=0) == pytest.approx([0.05, 0.05], rel=0.2)


def test_a_scenario_with_movers_comes_back_from_its_file() -> None:
    scenario = load_scenario("people")
    assert len(scenario.movers) == 4
    assert parse_scenario(scenario_to_toml(scenario), "again") == scenario
    assert len(world_config(scenario, 0, WorldConfig()).movers) == 4
    assert math.isclose(load_scenario("people_fast").movers[0].speed_m_s, 1.0)
