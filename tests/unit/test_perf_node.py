"""The performance node: files that are whole at any time, tables, and calculators to file end to end."""

from __future__ import annotations

import contextlib
import json
import math
import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.config import PerformanceConfig
from fullswarm.errors import ConfigError
from fullswarm.keys import Keys
from fullswarm.messages import RobotMeasurement, Summary
from fullswarm.perf.calculators import Calculators
from fullswarm.perf.performance_node import PerformanceNode
from fullswarm.perf.summarizers import CoverageSummarizer, Summarizer, robot_summarizers
from fullswarm.runtime import Runtime

KEYS = Keys("lab")


class Bench:
    def __init__(self, results: Path | None) -> None:
        self.runtime = Runtime(SimClock())
        self.bus = LocalBus(self.runtime.mailbox)
        self.node = PerformanceNode(self.bus, KEYS, self.runtime, results)

    def tell(self, metric: str, *, finished: bool = False, **values: float) -> None:
        summary = Summary(
            metric=metric,
            values=values,
            per_robot={"a": 1.0},
            finished=finished,
            reason="max_execution_s" if finished else "",
            stamp_s=self.runtime.now_s(),
        )
        self.bus.publish(KEYS.summary(metric), summary)
        self.runtime.mailbox.drain()


def stored(results: Path) -> dict[str, Any]:
    document = json.loads((results / "performance.json").read_text("utf-8"))
    assert isinstance(document, dict)
    return document


def logged(results: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (results / "summaries.jsonl").read_text("utf-8").splitlines()]


def test_it_writes_the_newest_of_each_metric(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "new" / "trial")
    bench.tell("work", total_m=1.0)
    bench.tell("work", total_m=2.0)
    bench.tell("collisions", finished=True, events=3.0)
    bench.runtime.run(1.0)
    document = stored(tmp_path / "new" / "trial")
    assert document == bench.node.document()
    assert document["metrics"]["work"]["values"] == {"total_m": 2.0}
    assert document["finished"] == {"collisions": "max_execution_s"}
    assert document["format"] == "fullswarm.performance/1"
    assert [line["metric"] for line in logged(tmp_path / "new" / "trial")] == ["work", "work", "collisions"]
    bench.node.close()


def test_it_writes_at_most_once_per_second_and_only_changes(tmp_path: Path) -> None:
    bench, file = Bench(tmp_path), tmp_path / "performance.json"
    bench.tell("work", total_m=1.0, elapsed_s=0.0)
    assert not file.exists()
    bench.runtime.run(1.0)
    first = file.stat().st_ino
    bench.tell("work", total_m=1.0, elapsed_s=1.0)  # nothing but time has passed
    bench.runtime.run(2.0)
    assert file.stat().st_ino == first
    bench.tell("work", total_m=2.0, elapsed_s=3.0)
    bench.runtime.run(0.5)
    assert file.stat().st_ino == first
    bench.runtime.run(0.5)
    assert file.stat().st_ino != first
    assert len(logged(tmp_path)) == 2
    bench.node.close()


def test_close_writes_what_is_left_and_ends_it(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.tell("work", total_m=1.0)
    bench.node.close()
    bench.tell("work", total_m=5.0)
    bench.runtime.run(3.0)
    bench.node.close()
    assert stored(tmp_path)["metrics"]["work"]["values"] == {"total_m": 1.0}


def test_a_reader_never_sees_half_a_file(tmp_path: Path) -> None:
    bench, file = Bench(tmp_path), tmp_path / "performance.json"
    bench.tell("work", total_m=1.0)
    bench.runtime.run(1.0)
    with file.open("rb") as reader:  # a reader that opened the file before it was replaced
        bench.tell("work", total_m=123456.0)
        bench.runtime.run(1.0)
        assert json.load(reader)["metrics"]["work"]["values"] == {"total_m": 1.0}
    assert stored(tmp_path)["metrics"]["work"]["values"] == {"total_m": 123456.0}
    assert sorted(each.name for each in tmp_path.iterdir()) == ["performance.json", "summaries.jsonl"]
    bench.node.close()


def test_a_second_run_appends_to_the_log(tmp_path: Path) -> None:
    for metres in (1.0, 2.0):
        bench = Bench(tmp_path)
        bench.tell("work", total_m=metres)
        bench.node.close()
    assert [line["values"] for line in logged(tmp_path)] == [{"total_m": 1.0}, {"total_m": 2.0}]


def test_a_disk_that_refuses_is_told_and_tried_again(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    (tmp_path / "performance.json").mkdir()  # no file can replace a directory
    bench.tell("work", total_m=1.0)
    bench.runtime.run(1.0)
    assert "cannot write" in bench.node.fault
    (tmp_path / "performance.json").rmdir()
    bench.runtime.run(1.0)
    assert bench.node.fault == ""
    assert stored(tmp_path)["metrics"]["work"]["values"] == {"total_m": 1.0}
    assert len(logged(tmp_path)) == 1
    bench.node.close()


@contextlib.contextmanager
def files_no_larger_than(size: int) -> Iterator[None]:
    """Let the kernel cut each write at `size` bytes, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_leaves_no_half_lines(tmp_path: Path) -> None:
    bench, log = Bench(tmp_path), tmp_path / "summaries.jsonl"
    bench.tell("work", total_m=1.0)
    bench.runtime.run(1.0)
    before = log.read_bytes()
    bench.tell("work", total_m=2.0)
    with files_no_larger_than(len(before) + 10):
        bench.runtime.run(1.0)
        assert "cannot write" in bench.node.fault
    assert log.read_bytes() == before
    bench.runtime.run(1.0)
    assert bench.node.fault == ""
    assert [line["values"] for line in logged(tmp_path)] == [{"total_m": 1.0}, {"total_m": 2.0}]
    bench.node.close()


def test_a_directory_that_cannot_be_made_is_a_configuration_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError) as caught:
        Bench(tmp_path / "file" / "trial")
    assert caught.value.where
    assert "core.results" in caught.value.hint


def test_without_a_directory_it_serves_the_operator_only() -> None:
    bench = Bench(None)
    bench.tell("work", total_m=2.0, robots=1.0)
    bench.tell("coverage", finished=True, area_m2=3.0)
    bench.runtime.run(2.0)
    rows = [(row.metric, row.quantity, row.value, row.unit, row.state) for row in bench.node.table()]
    assert rows == [
        ("coverage", "area_m2", 3.0, "m²", "max_execution_s"),
        ("work", "total_m", 2.0, "m", "running"),
        ("work", "robots", 1.0, "", "running"),
    ]
    assert bench.node.finished == {"coverage": "max_execution_s"}
    bench.node.close()


def run_trial(results: Path) -> bytes:
    """Two robots drive for 3 s, one bumps; calculators → summarizers → files, all over the bus."""
    bench = Bench(results)
    runtime, bus = bench.runtime, bench.bus
    conditions = PerformanceConfig(max_execution_s=2.0)
    arena = (0.0, 0.0, 5.0, 5.0)
    summarizers: list[Summarizer[Any]] = [
        CoverageSummarizer(bus, KEYS, runtime, lambda: conditions),
        *robot_summarizers(bus, KEYS, runtime, lambda: conditions, ("a", "b"), arena),
    ]
    calculators = Calculators(["a", "b"], arena, 0.02, [0.17, 0.17], 0.5)

    def tick() -> None:
        x = 1.0 + 0.5 * runtime.now_s()
        pose = np.array([[x, 1.0, 0.0], [1.0, 3.0, 0.0]])
        contacts = np.array([0, int(0.5 < runtime.now_s() < 0.8)])
        calculators.update(runtime.now_s(), pose, contacts, 0.02)

    runtime.every(0.02, tick)

    def publish() -> None:
        calculators.publish(bus, KEYS, "h", runtime.now_s())
        columns = {name: tuple(column.tolist()) for name, column in calculators.columns().items()}
        message = RobotMeasurement(
            host="h", process="p", robots=calculators.ids, columns=columns, stamp_s=runtime.now_s()
        )  # fmt: skip
        bus.publish(KEYS.measurement("robots", "h"), message)

    runtime.every(0.5, publish)
    runtime.run(6.0)
    bench.node.close()
    assert all(each.finished for each in summarizers)
    return (results / "performance.json").read_bytes()


def test_from_calculators_to_the_file_and_the_same_each_time(tmp_path: Path) -> None:
    first, second = run_trial(tmp_path / "1"), run_trial(tmp_path / "2")
    assert first == second
    metrics = json.loads(first)["metrics"]
    assert metrics["work"]["values"]["total_m"] == pytest.approx(0.98)  # 0.02 s to 1.98 s at 0.5 m/s
    assert metrics["collisions"]["per_robot"] == {"a": 0.0, "b": 1.0}
    assert metrics["coverage"]["values"]["area_m2"] == pytest.approx(0.98 * 0.34 + 2 * math.pi * 0.17**2, rel=0.03)
    assert {each["reason"] for each in metrics.values()} == {"max_execution_s"}


def test_whatever_fails_in_it_the_process_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(tmp_path)
    good = PerformanceNode.document

    def fails(_: PerformanceNode) -> dict[str, object]:
        raise ArithmeticError("a number that nobody thought of")

    monkeypatch.setattr(PerformanceNode, "document", fails)
    bench.tell("work", total_m=1.0)
    bench.runtime.run(3.5)
    assert bench.node.failures == 3
    assert "a number that nobody thought of" in bench.node.fault
    monkeypatch.setattr(PerformanceNode, "document", good)
    bench.runtime.run(1.5)
    assert bench.node.fault == ""
    assert stored(tmp_path)["metrics"]["work"]["values"] == {"total_m": 1.0}


def test_invented_metrics_fill_no_memory() -> None:
    bench = Bench(None)
    for number in range(1000):
        bench.tell(f"invented{number}", total_m=1.0)
    bench.tell("work", total_m=1.0)
    assert len(bench.node.summaries) <= 256
    assert "work" in bench.node.summaries
