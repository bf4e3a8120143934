"""Summarizers on a simulated clock: totals, restarts, lost messages, termination."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.config import PerformanceConfig
from fullswarm.keys import Keys
from fullswarm.messages import CoverageMeasurement, Message, RobotMeasurement, Summary
from fullswarm.perf.coverage import MAX_CELLS, pack
from fullswarm.perf.performance_node import PerformanceNode
from fullswarm.perf.summarizers import CoverageSummarizer, robot_summarizers
from fullswarm.perf.tallies import RobotTally
from fullswarm.perf.termination import Progress, reason_to_stop
from fullswarm.runtime import Runtime

KEYS = Keys("lab")


class Bench:
    """A bus on a simulated clock, the summarizers, and all summaries that they sent."""

    def __init__(self, **conditions: float | bool) -> None:
        self.runtime = Runtime(SimClock(100.0))
        self.bus = LocalBus(self.runtime.mailbox)
        self.conditions = PerformanceConfig.model_validate(conditions)
        self.sent: list[Summary] = []
        self.bus.subscribe(KEYS.summary(), Summary, self.sent.append)
        ask = lambda: self.conditions  # noqa: E731
        self.often, _ = robot_summarizers(self.bus, KEYS, self.runtime, ask, (), (0.0, 0.0, 4.0, 3.0))
        self.coverage = CoverageSummarizer(self.bus, KEYS, self.runtime, ask)

    def tell(self, *messages: Message) -> None:
        names = {RobotMeasurement: "robots", CoverageMeasurement: "coverage"}
        for message in messages:
            host = str(getattr(message, "host", ""))
            self.bus.publish(KEYS.measurement(names[type(message)], host), message)
        self.runtime.mailbox.drain()

    def of(self, metric: str) -> list[Summary]:
        return [each for each in self.sent if each.metric == metric]

    def now(self, metric: str) -> Summary:
        return next(each for each in self.often.summaries() if each.metric == metric)


def column(host: str, process: str, name: str, values: dict[str, float]) -> RobotMeasurement:
    columns = {name: tuple(map(float, values.values()))}
    return RobotMeasurement(host=host, process=process, robots=tuple(values), columns=columns, stamp_s=0.0)


def work(host: str, process: str = "p", **distance_m: float) -> RobotMeasurement:
    return column(host, process, "distance_m", distance_m)


def hits(host: str, process: str = "p", **events: float) -> RobotMeasurement:
    return column(host, process, "events", events)


def covered(host: str, *cells: tuple[int, int], shape: tuple[int, int] = (4, 5)) -> CoverageMeasurement:
    grid = np.zeros(shape, np.uint8)
    for cell in cells:
        grid[cell] = 1
    return CoverageMeasurement(
        host=host, robots=(host,), origin_x_m=0.0, origin_y_m=0.0, cell_m=0.5, rows=shape[0], columns=shape[1],
        cells=pack(grid), stamp_s=0.0,
    )  # fmt: skip


# ---------------------------------------------------------------- totals
def test_work_is_summed_over_hosts() -> None:
    bench = Bench()
    bench.tell(work("h1", a=1.0, b=2.0), work("h2", c=6.0))
    result = bench.now("work")
    assert result.values == {"total_m": 9.0, "mean_m": 3.0, "max_m": 6.0, "robots": 3.0, "elapsed_s": 0.0}
    assert result.per_robot == {"a": 1.0, "b": 2.0, "c": 6.0}
    assert not result.finished


def test_measurements_are_cumulative_so_a_lost_one_costs_nothing() -> None:
    complete, lossy = Bench(), Bench()
    reports = [work("h", a=float(metre)) for metre in range(10)]
    complete.tell(*reports)
    lossy.tell(reports[0], reports[4], reports[9])
    assert complete.now("work") == lossy.now("work")
    assert lossy.now("work").values["total_m"] == 9.0


def test_the_total_survives_restarts_of_an_agent() -> None:
    bench = Bench()
    bench.tell(work("h1", a=5.0), work("h2", b=1.0), work("h1", "q", a=0.5), work("h1", "q", a=2.0))
    assert bench.now("work").per_robot == {"a": 7.0, "b": 1.0}
    bench.tell(work("h1", "r", a=0.0), work("h1", "r", a=0.25))
    assert bench.now("work").per_robot == {"a": 7.25, "b": 1.0}


def test_another_process_of_an_agent_has_begun_again_with_all_its_counters() -> None:
    bench = Bench()
    bench.tell(hits("h", a=4, b=1), hits("h", "q", a=1, b=1))
    assert bench.now("collisions").per_robot == {"a": 5.0, "b": 2.0}


def test_an_agent_that_came_back_with_fewer_robots_counts_none_twice() -> None:
    bench = Bench()
    bench.tell(work("h", a=4.0, b=1.0), work("h", "q", a=1.0))
    assert bench.now("work").per_robot == {"a": 5.0, "b": 1.0}


def test_a_robot_that_moved_to_another_host_keeps_its_total() -> None:
    bench = Bench()
    bench.tell(work("old", a=5.0), work("new", a=1.0))
    assert bench.now("work").per_robot == {"a": 6.0}


def test_collisions_are_summed_and_robots_counted() -> None:
    bench = Bench()
    bench.tell(hits("h1", a=2, b=0), hits("h2", c=1))
    values = bench.now("collisions").values
    assert (values["events"], values["robots_touched"], values["max_events"], values["robots"]) == (3, 2, 2, 3)


def test_coverage_is_the_union_of_hosts() -> None:
    bench = Bench()
    bench.tell(covered("h1", (0, 0), (0, 1)), covered("h2", (0, 1), (3, 4)))
    result = bench.coverage.summary()
    assert result.values["fraction"] == pytest.approx(3 / 20)
    assert result.values["area_m2"] == pytest.approx(3 * 0.25)
    assert result.per_robot == {"h1": 0.5, "h2": 0.5}


def test_coverage_survives_a_restart() -> None:
    bench = Bench()
    bench.tell(covered("h", (0, 0), (0, 1)), covered("h"), covered("h", (2, 2)))
    assert bench.coverage.summary().values["cells"] == 3.0


def test_a_host_with_another_grid_is_named_by_count_until_it_fits() -> None:
    bench = Bench()
    bench.tell(covered("h1", (0, 0)), covered("h2", (0, 0), (1, 1), shape=(5, 4)))
    assert bench.coverage.summary().values == {
        "fraction": 1 / 20, "area_m2": 0.25, "cells": 1.0, "refused_hosts": 1.0, "elapsed_s": 0.0,
    }  # fmt: skip
    assert bench.coverage.refused == 1
    bench.tell(covered("h2", (1, 1)))
    assert bench.coverage.summary().values["refused_hosts"] == 0.0
    assert bench.coverage.summary().values["cells"] == 2.0


def broken(**changes: object) -> CoverageMeasurement:
    good = covered("h", (0, 0))
    fields = {name: getattr(good, name) for name in good.__struct_fields__}
    return CoverageMeasurement(**{**fields, **changes})


NONSENSE: list[Message] = [
    work("h", a=-1.0),
    work("h", a=math.inf),
    RobotMeasurement(host="h", process="p", robots=("a", "b"), columns={"distance_m": (1.0,)}, stamp_s=0.0),
    hits("h", a=-1),
    broken(rows=0),
    broken(rows=-4, columns=-5),
    broken(rows=MAX_CELLS, columns=2),
    broken(cell_m=math.nan),
    broken(cell_m=0.0),
    broken(cells=b"no"),
]


@pytest.mark.parametrize("message", NONSENSE, ids=range(len(NONSENSE)))
def test_nonsense_is_counted_and_starts_nothing(message: Message) -> None:
    bench = Bench(max_execution_s=1.0)
    bench.tell(message)
    assert bench.often.refused + bench.coverage.refused == 1
    bench.runtime.run(3.0)
    assert bench.sent == []


# ---------------------------------------------------------------- reports and the end
def test_it_reports_once_per_second_from_the_first_measurement_on() -> None:
    bench = Bench()
    bench.runtime.run(2.5)
    assert bench.sent == []
    bench.tell(work("h", a=1.0))
    bench.runtime.run(3.0)
    sent = bench.of("work")
    assert [each.stamp_s for each in sent] == [103.0, 104.0, 105.0]
    assert [each.values["elapsed_s"] for each in sent] == [0.5, 1.5, 2.5]


def test_report_sends_at_once_and_close_ends_it() -> None:
    bench = Bench()
    bench.tell(work("h", a=1.0))
    bench.often.report()
    bench.runtime.mailbox.drain()
    assert [each.metric for each in bench.sent] == ["work", "collisions"]
    bench.often.close()
    bench.often.close()
    bench.tell(work("h", a=9.0))
    bench.runtime.run(3.0)
    assert [each.metric for each in bench.sent] == ["work", "collisions"]


@pytest.mark.parametrize("limit_s", [0.3, 2.0, 2.7])
def test_max_execution_is_kept_to_the_instant_from_the_first_measurement(limit_s: float) -> None:
    bench = Bench(max_execution_s=limit_s)
    bench.runtime.run(1.4)
    bench.tell(work("h", a=1.0))
    bench.runtime.run(10.0)
    reports = bench.of("work")
    assert next(each.stamp_s for each in reports if each.finished) == pytest.approx(101.4 + limit_s)
    final = reports[-1]
    assert final.finished
    assert final.reason == "max_execution_s"
    assert final.values["elapsed_s"] == pytest.approx(limit_s)


def test_after_the_end_the_result_stands_and_is_still_sent() -> None:
    bench = Bench(max_execution_s=2.0)
    bench.tell(work("h", a=1.0))
    bench.runtime.run(2.5)
    final = bench.of("work")[-1]
    assert final.finished
    bench.tell(work("h", a=50.0))
    bench.runtime.run(3.0)
    assert bench.now("work") == final
    assert bench.sent.count(final) == 4  # at the end, and then each second
    assert bench.often.finished


def test_a_collision_ends_the_trial_at_once_if_asked_to() -> None:
    asked, not_asked = Bench(stop_on_collision=True), Bench()
    for bench in (asked, not_asked):
        bench.tell(hits("h", a=0))
        assert not bench.often.finished
        bench.tell(hits("h", a=1))
    assert asked.now("collisions").reason == "stop_on_collision"
    assert asked.of("collisions")[-1].values["events"] == 1.0
    assert not not_asked.often.finished


def test_coverage_reached_ends_the_trial_at_once() -> None:
    bench = Bench(coverage_at_least=0.1)
    bench.tell(covered("h1", (0, 0)))
    assert not bench.coverage.finished
    bench.tell(covered("h2", (1, 1)))
    assert bench.coverage.summary().reason == "coverage_at_least"
    bench.tell(covered("h2", (1, 1), (2, 2)))
    assert bench.coverage.summary().values["cells"] == 2.0


def test_conditions_may_change_while_it_runs() -> None:
    bench = Bench(max_execution_s=3.0)
    bench.tell(work("h", a=1.0))
    bench.runtime.run(2.5)
    bench.conditions = PerformanceConfig(max_execution_s=6.0)
    bench.runtime.run(2.0)
    assert not bench.often.finished
    bench.conditions = PerformanceConfig(max_execution_s=1.0)
    bench.runtime.run(1.0)
    assert bench.often.finished


def test_a_change_before_the_deadline_moves_it() -> None:
    bench = Bench()
    bench.tell(work("h", a=1.0))
    bench.runtime.run(1.0)
    bench.conditions = PerformanceConfig(max_execution_s=2.25)
    bench.runtime.run(5.0)
    assert bench.now("work").values["elapsed_s"] == 2.25


@pytest.mark.parametrize(
    ("conditions", "progress", "reason"),
    [
        ({}, Progress(1e9, 1.0, 9), ""),
        ({"max_execution_s": 60.0}, Progress(59.9), ""),
        ({"max_execution_s": 60.0}, Progress(60.0), "max_execution_s"),
        ({"coverage_at_least": 0.9}, Progress(1.0, None, 3), ""),
        ({"coverage_at_least": 0.9}, Progress(1.0, 0.9), "coverage_at_least"),
        ({"stop_on_collision": True}, Progress(1.0, 1.0, 0), ""),
        ({"stop_on_collision": True, "max_execution_s": 1.0}, Progress(2.0, None, 1), "stop_on_collision"),
    ],
)
def test_reason_to_stop(conditions: dict[str, float | bool], progress: Progress, reason: str) -> None:
    assert reason_to_stop(PerformanceConfig.model_validate(conditions), progress) == reason


def test_a_robot_without_a_number_is_left_out() -> None:
    bench = Bench()
    bench.tell(work("a", a=3.0), work("b", b=math.nan), work("c", c=1.7e308), hits("b", "q", b=math.nan))
    assert bench.now("work").values == {"total_m": 3.0, "mean_m": 3.0, "max_m": 3.0, "robots": 1.0, "elapsed_s": 0.0}
    assert bench.now("work").per_robot == {"a": 3.0}
    assert bench.now("collisions").values["robots_touched"] == 0.0
    bench.runtime.run(2.0)
    assert (bench.of("work")[-1].reason, bench.often.failures) == ("", 0)


def test_a_failure_ends_nothing_and_the_metric_says_so_until_it_passes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench()
    node = PerformanceNode(bench.bus, KEYS, bench.runtime, tmp_path)

    def broken(*_: object) -> None:
        raise ZeroDivisionError("for once")

    with monkeypatch.context() as patch:
        patch.setattr(RobotTally, "add", broken)
        bench.tell(work("a", a=2.0))
        bench.runtime.run(1.0)
        assert bench.of("work")[-1].reason == "failed: ZeroDivisionError: for once"
        assert "total_m" not in bench.of("work")[-1].values
    bench.tell(work("a", a=3.0))
    bench.runtime.run(1.0)
    assert bench.of("work")[-1].reason == ""
    with monkeypatch.context() as patch:
        patch.setattr(RobotTally, "add", broken)
        bench.tell(work("a", a=4.0))
        bench.runtime.run(1.0)
    newest = bench.of("work")[-1]
    assert newest.reason == "failed: ZeroDivisionError: for once"
    assert not newest.finished
    assert newest.values["total_m"] == 3.0  # what could be worked out last
    assert bench.often.failures > 0
    assert {row.state for row in node.table()} == {newest.reason}
    bench.tell(covered("a", (0, 0)))
    bench.runtime.run(1.0)
    assert bench.of("coverage")[-1].reason == ""
    assert bench.of("work")[-1].reason == ""
    with monkeypatch.context() as patch:
        patch.setattr(RobotTally, "add", broken)
        bench.tell(work("a", a=5.0))
        bench.often.report()  # as at the end of the core
        bench.runtime.mailbox.drain()
        node.close()
    assert "failed: ZeroDivisionError" in (tmp_path / "performance.json").read_text()
    bench.tell(work("a", a=4.0))
    bench.runtime.run(1.0)
    assert bench.of("work")[-1].values["total_m"] == 4.0
