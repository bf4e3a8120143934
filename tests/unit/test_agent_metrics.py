"""What robots notice of themselves: arrival, gaps, standing still; and the message that carries it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from fullswarm.agent.telemetry.metrics import MetricSampler
from fullswarm.messages import RobotMeasurement
from fullswarm.perf.calculators import Calculators
from tests.unit.agent_bench import Bench


def listen(bench: Bench) -> list[RobotMeasurement]:
    heard: list[RobotMeasurement] = []
    bench.bus.subscribe(bench.keys.measurement("robots"), RobotMeasurement, heard.append)
    return heard


def column(message: RobotMeasurement, name: str) -> list[float]:
    assert message.robots == tuple(f"r{row + 1}" for row in range(len(message.robots)))
    return list(message.columns[name])


def test_arrival_counts_from_the_request_and_until_the_disc() -> None:
    bench = Bench([(2.0, 2.0, 0.0), (2.0, 6.0, 0.0)])
    heard = listen(bench)
    bench.run(1.0)
    assert all(math.isnan(each) for each in column(heard[-1], "arrived_s") + column(heard[-1], "goal_m"))
    bench.enable("move_to_goal", {"goal": [4.0, 2.0], "gain": 1.0, "arrive_radius_m": 0.5}, robot="r1")
    bench.run(1.0)
    assert math.isnan(column(heard[-1], "arrived_s")[0])
    bench.run(6.0)
    arrived_s, goal_m = column(heard[-1], "arrived_s"), column(heard[-1], "goal_m")
    # 0.5 m/s from 2 m until 0.5 m from the goal: 3 s, and a little for speeding up
    assert 2.9 < arrived_s[0] < 3.8
    assert goal_m[0] == pytest.approx(0.5, abs=0.1)
    assert math.isnan(arrived_s[1])


def test_a_new_request_counts_anew_and_the_end_of_one_keeps_what_is_known() -> None:
    bench = Bench([(2.0, 2.0, 0.0)])
    heard = listen(bench)
    asked: dict[str, Any] = {"goal": [2.0, 2.0], "gain": 1.0, "arrive_radius_m": 0.5}
    bench.enable("move_to_goal", asked, request_id="one")
    bench.run(3.0)
    first = column(heard[-1], "arrived_s")
    assert first[0] == pytest.approx(0.0, abs=0.2)
    bench.enable("move_to_goal", asked, request_id="one", enable=False)
    bench.run(1.0)
    assert column(heard[-1], "arrived_s") == first
    assert math.isnan(column(heard[-1], "still_s")[0])
    bench.enable("move_to_goal", {**asked, "goal": [9.0, 2.0]}, request_id="two")
    bench.run(1.0)
    assert math.isnan(column(heard[-1], "arrived_s")[0])
    bench.enable("rendezvous", {"gain": 1.0}, request_id="three")
    bench.run(1.0)
    assert math.isnan(column(heard[-1], "goal_m")[0])


@pytest.mark.parametrize("filtered", [False, True])
def test_the_smallest_gap_is_the_bodies(filtered: bool) -> None:
    """They pass each other at 0.6 m between their lanes."""
    bench = Bench([(2.0, 2.0, 0.0), (4.0, 2.6, math.pi)])
    heard = listen(bench)
    bench.enable("move_to_goal", {"goal": [8.0, 2.0], "gain": 1.0, "arrive_radius_m": 0.1}, "r1", filtered=filtered)
    least_m = math.inf
    for _ in range(300):
        bench.run(0.02)
        position = bench.simulated.pose[:, :2]
        least_m = min(least_m, float(np.hypot(*(position[0] - position[1]))) - 0.34)
    assert column(heard[-1], "gap_m") == pytest.approx([least_m, least_m], abs=0.03)


def test_a_robot_that_cannot_move_stands_still() -> None:
    bench = Bench([(2.0, 2.0, 0.0), (5.0, 5.0, 0.0)])
    heard = listen(bench)
    bench.enable("move_to_goal", {"goal": [2.0, 2.0], "gain": 1.0, "arrive_radius_m": 0.1}, "r1")
    bench.enable("move_to_goal", {"goal": [9.0, 5.0], "gain": 1.0, "arrive_radius_m": 0.1}, "r2")
    bench.run(4.0)
    still_s = column(heard[-1], "still_s")
    assert still_s[0] == pytest.approx(4.0, abs=0.6)
    assert still_s[1] < 1.0


def test_energy_deadlines_and_messages_go_along() -> None:
    bench = Bench([(2.0, 2.0, 0.0)])
    heard = listen(bench)
    bench.run(1.0)
    assert column(heard[-1], "energy_j") == [0.0]
    bench.enable("move_to_goal", {"goal": [9.0, 2.0], "gain": 1.0, "arrive_radius_m": 0.1})
    bench.run(3.0)
    kinetic_j = 0.5 * 3.6 * 0.5**2
    assert kinetic_j < column(heard[-1], "energy_j")[0] < kinetic_j + 0.02 * 9.81 * 3.6 * 1.6
    earlier, later = heard[-2].totals, heard[-1].totals
    assert later["ticks"] - earlier["ticks"] >= 25
    assert later["sent"] - earlier["sent"] >= 10  # states at 20 Hz
    assert later["received"] > earlier["received"]  # heartbeats
    assert later["missed"] == 0.0


def test_the_file_may_say_how_near_is_there() -> None:
    bench = Bench([(2.0, 2.0, 0.0)], performance={"arrive_radius_m": 3.0})
    heard = listen(bench)
    bench.enable("move_to_goal", {"goal": [4.5, 2.0], "gain": 1.0, "arrive_radius_m": 0.1})
    bench.run(0.6)
    assert column(heard[-1], "arrived_s")[0] < 0.3


@pytest.mark.parametrize(
    ("owner", "method"), [(Calculators, "update"), (MetricSampler, "sample"), (MetricSampler, "message")]
)
def test_a_measurement_that_fails_stops_no_robot(owner: type, method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise OverflowError("math range error")

    monkeypatch.setattr(owner, method, broken)
    bench = Bench([(2.0, 2.0, 0.0)])
    bench.enable("move_to_goal", {"goal": [9.0, 2.0], "gain": 1.0, "arrive_radius_m": 0.5})
    bench.run(2.0)
    assert bench.commanded[0, 0] > 0.4
    assert bench.agent.failed_measurements > 0
    bench.agent.close()
