"""Numbers per robot: joined by their rules, over restarts, beside the truth; the conditions that look at them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.config import PerformanceConfig, SwarmConfig
from fullswarm.errors import MessageError
from fullswarm.keys import TRUTH, Keys
from fullswarm.messages import CoverageMeasurement, Message, RobotMeasurement, Summary
from fullswarm.perf.coverage import pack
from fullswarm.perf.metrics import COLUMNS, METRICS, SELDOM_S, SHAPE, SHAPE_DOC
from fullswarm.perf.summarizers import CoverageSummarizer, robot_summarizers
from fullswarm.perf.tallies import RobotTally
from fullswarm.perf.termination import Progress, reason_to_stop
from fullswarm.perf.truth import SupervisorCalculator, Truth
from fullswarm.runtime import Runtime

KEYS = Keys("lab")
ARENA = (0.0, 0.0, 4.0, 3.0)
NAN = math.nan


def numbers(host: str, process: str = "p", robots: str = "", **columns: Any) -> RobotMeasurement:
    """Return a measurement of the robots named by the letters of `robots`, or of the one named like its host."""
    totals = {name: columns.pop(name) for name in list(columns) if COLUMNS[name].per_host}
    named = tuple(robots) or (host,)
    return RobotMeasurement(
        host=host,
        process=process,
        robots=named,
        columns={name: tuple(np.atleast_1d(values).astype(float).tolist()) for name, values in columns.items()},
        totals=totals,
        stamp_s=0.0,
    )


def tally_of(*messages: RobotMeasurement, robots: str = "") -> RobotTally:
    tally = RobotTally(tuple(robots), ARENA)
    for message in messages:
        tally.add(message)
    return tally


def test_each_quantity_follows_its_rule() -> None:
    tally = tally_of(
        numbers("a", energy_j=2.0, gap_m=0.5, arrived_s=NAN, goal_m=3.0, deadlock_count=1,
                ticks=10.0, worst_late_s=0.2),
        numbers("h", robots="bc", energy_j=[1.0, 6.0], gap_m=[0.3, math.inf], arrived_s=[4.0, 8.0], goal_m=[4.0, 0.0],
                deadlock_count=[0, 2], ticks=5.0, worst_late_s=0.1),
    )  # fmt: skip
    results = tally.results()
    assert results["energy"].values == {"total_j": 9.0, "mean_j": 3.0, "max_j": 6.0}
    assert results["energy"].per_robot == {"a": 2.0, "b": 1.0, "c": 6.0}
    assert results["separation"].values == {"min_m": 0.3}
    assert results["separation"].per_robot == {"a": 0.5, "b": 0.3}  # c has met nobody
    assert results["arrival"].values == {"fraction": pytest.approx(2 / 3), "mean_s": 6.0, "last_s": 8.0}
    assert results["formation"].values == {"error_m": pytest.approx(math.sqrt(25.0 / 3.0))}
    assert results["deadlocks"].values == {"deadlock_count": 3.0}
    assert results["loop"].values == {"ticks": 15.0, "worst_late_s": 0.2}


def test_what_nobody_tells_is_left_out() -> None:
    results = tally_of(numbers("a", energy_j=1.0, arrived_s=NAN)).results()
    assert results["arrival"].values == {"fraction": 0.0}
    assert results["filter"].values == results[SHAPE].values == {}


def test_the_table_names_only_columns_that_there_are() -> None:
    assert {column for metric in METRICS.values() for _, column in metric.quantities.values()} <= COLUMNS.keys()
    assert {metric.per_robot for metric in METRICS.values()} - {""} <= COLUMNS.keys()
    x: dict[str, Any] = {"x_m": [1.0, 2.0], "y_m": [1.0, 1.0], "heading_rad": [0.0, 0.0]}
    assert tally_of(numbers("h", robots="ab", **x)).results()[SHAPE].values.keys() == SHAPE_DOC.keys()


@given(st.lists(st.tuples(st.sampled_from("pqr"), st.floats(0.0, 9.0), st.floats(0.0, 9.0)), min_size=1, max_size=9))
@settings(deadline=None)
def test_counters_outlive_their_agent_and_extremes_stay(told: list[tuple[str, float, float]]) -> None:
    """Each change of the process is a restart: what the last one counted is kept."""
    tally = tally_of(
        *(numbers("a", process, energy_j=joule, gap_m=gap, goal_m=gap, late=joule) for process, joule, gap in told)
    )
    ends = [row for row in range(len(told)) if row + 1 == len(told) or told[row][0] != told[row + 1][0]]
    results = tally.results()
    assert results["energy"].values["total_j"] == pytest.approx(sum(told[row][1] for row in ends))
    assert results["loop"].values["late"] == pytest.approx(sum(told[row][1] for row in ends))
    assert results["separation"].values["min_m"] == min(told[row][2] for row in ends)
    assert results["formation"].values["error_m"] == pytest.approx(told[-1][2])


def test_columns_that_do_not_fit_are_refused_and_unknown_ones_ignored() -> None:
    tally = tally_of(numbers("a", energy_j=1.0))
    with pytest.raises(MessageError):
        tally.add(numbers("a", energy_j=[2.0, 3.0]))
    assert tally.results()["energy"].values["total_j"] == 1.0
    newer = RobotMeasurement(host="a", process="p", robots=("a",), columns={"mood": (1.0,)}, stamp_s=0.0)
    tally.add(newer)
    tally.add(numbers("a", "q", energy_j=4.0))
    assert tally.results()["energy"].values["total_j"] == 4.0


# ---------------------------------------------------------------- conditions
def test_all_have_arrived_when_each_of_the_file_has() -> None:
    tally = tally_of(robots="ab")
    assert tally.progress(0.0).all_arrived is None
    tally.add(numbers("a", arrived_s=3.0))
    tally.add(numbers("x", arrived_s=3.0))  # a stranger
    assert tally.progress(0.0).all_arrived is False
    tally.add(numbers("b", arrived_s=4.0))
    assert tally.progress(0.0).all_arrived is True
    tally.add(numbers("a", arrived_s=NAN))  # pushed out again
    assert tally.progress(0.0).all_arrived is False


def test_without_a_file_all_that_are_heard_must_arrive() -> None:
    tally = tally_of(numbers("a", arrived_s=3.0), numbers("b", arrived_s=NAN))
    assert tally.progress(0.0).all_arrived is False
    tally.add(numbers("b", arrived_s=3.0))
    assert tally.progress(0.0).all_arrived is True


def test_the_swarm_stands_as_long_as_its_last_mover() -> None:
    tally = tally_of(numbers("h", robots="ab", still_s=[5.0, NAN]), numbers("c", still_s=2.0))
    assert tally.progress(0.0).still_s == 2.0
    tally.add(numbers("c", still_s=NAN))
    assert tally.progress(0.0).still_s == 5.0
    assert tally_of(numbers("a", still_s=NAN)).progress(0.0).still_s is None


@pytest.mark.parametrize(
    ("conditions", "progress", "reason"),
    [
        ({"all_arrived": True}, Progress(all_arrived=True), "all_arrived"),
        ({"all_arrived": True}, Progress(all_arrived=False), ""),
        ({}, Progress(all_arrived=True, still_s=99.0), ""),
        ({"stalled_s": 5.0}, Progress(still_s=4.9), ""),
        ({"stalled_s": 5.0}, Progress(still_s=5.0), "stalled_s"),
        ({"stalled_s": 5.0, "all_arrived": True}, Progress(still_s=5.0, all_arrived=True), "all_arrived"),
        ({"stalled_s": 5.0, "max_execution_s": 5.0}, Progress(still_s=5.0, elapsed_s=5.0), "stalled_s"),
    ],
)
def test_the_first_condition_that_is_met_is_the_reason(
    conditions: dict[str, Any], progress: Progress, reason: str
) -> None:
    assert reason_to_stop(PerformanceConfig.model_validate(conditions), progress) == reason


# ---------------------------------------------------------------- summarizers
class Bench:
    """All summarizers on a simulated clock."""

    def __init__(self, **conditions: Any) -> None:
        self.runtime = Runtime(SimClock(50.0))
        self.bus = LocalBus(self.runtime.mailbox)
        self.sent: list[Summary] = []
        self.bus.subscribe(KEYS.summary(), Summary, self.sent.append)
        ask = lambda: PerformanceConfig.model_validate(conditions)  # noqa: E731
        self.coverage = CoverageSummarizer(self.bus, KEYS, self.runtime, ask)
        self.often, self.robots = robot_summarizers(self.bus, KEYS, self.runtime, ask, ("a", "b"), ARENA)

    def over(self) -> bool:
        return self.robots.finished

    def now(self, metric: str) -> Summary:
        return next(each for each in self.often.summaries() if each.metric == metric)

    def tell(self, metric: str, message: Message) -> None:
        self.bus.publish(KEYS.measurement(metric, "any"), message)
        self.runtime.mailbox.drain()


def test_every_metric_of_the_table_is_reported() -> None:
    bench = Bench()
    bench.tell("robots", numbers("a", energy_j=3.0))
    bench.runtime.run(SELDOM_S)
    assert {each.metric for each in bench.sent} == {*METRICS, SHAPE}
    energy = next(each for each in bench.sent if each.metric == "energy")
    assert energy.values == {"total_j": 3.0, "mean_j": 3.0, "max_j": 3.0, "elapsed_s": SELDOM_S}


def test_it_halts_when_all_have_arrived_and_the_result_stands() -> None:
    bench = Bench(all_arrived=True)
    bench.tell("robots", numbers("a", arrived_s=3.0, energy_j=1.0))
    assert not bench.over()
    bench.tell("robots", numbers("b", arrived_s=4.0, energy_j=1.0))
    assert bench.over()
    assert {each.reason for each in bench.sent} == {"all_arrived"}
    bench.tell("robots", numbers("b", arrived_s=NAN, energy_j=9.0))
    bench.robots.report()
    bench.runtime.mailbox.drain()
    assert [each.values["total_j"] for each in bench.sent if each.metric == "energy"] == [2.0, 2.0]


def test_it_halts_when_nobody_moves() -> None:
    bench = Bench(stalled_s=5.0)
    bench.tell("robots", numbers("a", still_s=4.0))
    assert not bench.over()
    bench.tell("robots", numbers("a", still_s=5.0))
    assert {each.reason for each in bench.robots.summaries()} == {"stalled_s"}


def work(host: str, metres: float) -> RobotMeasurement:
    return numbers(host, robots="a", distance_m=metres)


def hits(host: str, events: int) -> RobotMeasurement:
    return numbers(host, robots="a", events=events)


def covered(host: str, cells: int) -> CoverageMeasurement:
    grid = np.zeros((2, 5), np.uint8)
    grid.flat[:cells] = 1
    return CoverageMeasurement(
        host=host, robots=("a",), origin_x_m=0.0, origin_y_m=0.0, cell_m=1.0, rows=2, columns=5, cells=pack(grid),
        stamp_s=0.0,
    )  # fmt: skip


def test_the_truth_is_shown_beside_what_the_robots_say() -> None:
    bench = Bench()
    bench.tell("robots", work("a", 4.0))
    bench.tell("robots", work(TRUTH, 5.0))
    values = bench.now("work").values
    assert (values["total_m"], values["truth_total_m"], values["robots"]) == (4.0, 5.0, 1.0)
    bench.tell("coverage", covered(TRUTH, 5))
    bench.tell("coverage", covered("a", 2))
    values = bench.coverage.summary().values
    assert (values["fraction"], values["truth_fraction"]) == (0.2, 0.5)


def test_the_truth_stands_in_for_robots_that_say_nothing() -> None:
    bench = Bench()
    bench.tell("robots", work(TRUTH, 5.0))
    summary = bench.now("work")
    assert (summary.values["total_m"], summary.per_robot) == (5.0, {"a": 5.0})
    bench.tell("robots", work("a", 4.0))
    assert bench.now("work").values["total_m"] == 4.0


def test_the_truth_decides_when_it_is_over() -> None:
    bench = Bench(stop_on_collision=True, coverage_at_least=0.4)
    bench.tell("robots", hits(TRUTH, 0))
    bench.tell("robots", hits("a", 1))  # a bumper that sticks
    assert not bench.often.finished
    bench.tell("robots", hits(TRUTH, 1))
    assert bench.now("collisions").reason == "stop_on_collision"
    bench.tell("coverage", covered("a", 3))
    bench.tell("coverage", covered(TRUTH, 4))
    assert bench.coverage.summary().reason == "coverage_at_least"


def test_what_the_truth_does_not_know_the_robots_decide() -> None:
    bench = Bench(all_arrived=True)
    bench.tell("robots", numbers(TRUTH, robots="ab", energy_j=[1.0, 1.0]))
    bench.tell("robots", numbers("h", robots="ab", arrived_s=[1.0, 2.0], energy_j=[2.0, 2.0]))
    values = {each.metric: each.values for each in bench.robots.summaries()}
    assert bench.over()
    assert (values["energy"]["total_j"], values["energy"]["truth_total_j"]) == (4.0, 2.0)


def test_a_supervisor_publishes_what_the_bodies_did() -> None:
    bench = Bench()
    truth = Truth(("a", "b"), np.full(2, 0.17), np.array([[1.0, 1.0], [3.0, 1.0]]), 0.2, ARENA, 0.1)
    node = SupervisorCalculator(bench.bus, KEYS, bench.runtime, truth)
    bench.runtime.every(0.02, lambda: look(truth, bench.runtime.now_s() - 50.0))
    bench.runtime.run(2.0)
    bench.tell("robots", work("a", 0.7))
    node.close()
    bench.runtime.mailbox.drain()
    values = {each.metric: each.values for each in (bench.now("work"), bench.now("collisions"))}
    assert values["work"]["total_m"] == 0.7
    assert values["work"]["truth_total_m"] == pytest.approx(truth.values()["work.total_m"]) == pytest.approx(0.98)
    assert values["collisions"]["truth_events"] == 2.0
    assert bench.coverage.summary().values["truth_fraction"] == pytest.approx(truth.values()["coverage.fraction"])
    arrival = next(each for each in bench.robots.summaries() if each.metric == "arrival")
    assert arrival.values["truth_fraction"] == 0.5
    robots = {each.metric: each.values for each in bench.robots.summaries()}
    told = {f"{metric}.{name}": value for metric, values in robots.items() for name, value in values.items()}
    for name, value in truth.values().items():
        if name.partition(".")[0] in ("energy", "arrival", "formation", SHAPE):
            metric, _, quantity = name.partition(".")
            assert told[f"{metric}.truth_{quantity}"] == pytest.approx(value), name


def look(truth: Truth, time_s: float) -> None:
    """Robot a drives to its goal at 0.5 m/s and bumps once; b stands."""
    pose = np.array([[0.1 + 0.5 * time_s, 1.0, 0.0], [2.5, 1.0, 1.0]])
    touching = int(0.5 < time_s < 0.7)
    truth.sample(time_s, pose, np.array([[0.5, 0.0], [0.0, 0.0]]), 0.02, np.array([touching, touching]))


def test_no_robot_may_be_called_truth() -> None:
    with pytest.raises(ValidationError, match="cannot name a robot"):
        SwarmConfig.model_validate({"robot": [{"id": TRUTH}]})
