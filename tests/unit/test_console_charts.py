"""The console's charts: what is sampled, its bounds, and what pages are sent."""

from __future__ import annotations

import math
import statistics
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.messages import Summary
from fullswarm.operator.console import charts, frames, samples
from fullswarm.operator.console.charts import LINES, band
from fullswarm.operator.console.fields import FIELDS, NAMES, read
from fullswarm.operator.console.samples import DEFAULT, Samples
from fullswarm.operator.view import RobotRow
from fullswarm.perf.metrics import COVERAGE_DOC, METRICS, SHAPE_DOC, describe
from tests.unit.console_bench import KEYS, ConsoleBench, Page, health
from tests.unit.study_lab import StudyBench, plan

KNOWN = st.floats(-100.0, 100.0, width=32)


def row(robot: str, *, age_s: float = 0.1, x_m: float = 1.0, speed_m_s: float = 0.2, **fields: Any) -> RobotRow:
    return RobotRow(robot, age_s, x_m, 2.0, 0.5, speed_m_s, health(robot, **fields), turn_rad_s=0.1, round_trip_s=-1.0)


def value(rows: list[RobotRow], robot: str, name: str) -> float:
    found: float = read(rows)[[each.robot for each in rows].index(robot), NAMES.index(name)]
    return found


# -------------------------------------------------------------------- fields and quantities
def test_what_is_unknown_is_no_number() -> None:
    rows = [
        row("r1", battery=0.5, contacts=2),
        row("r2"),
        RobotRow("r3", 0.1, math.nan, math.nan, math.nan, 1e300, None),
    ]
    assert value(rows, "r1", "battery") == 0.5
    assert value(rows, "r1", "contacts") == 2.0
    assert math.isnan(value(rows, "r2", "battery"))
    assert math.isnan(value(rows, "r2", "round_trip"))
    assert math.isnan(value(rows, "r3", "x"))
    assert math.isnan(value(rows, "r3", "collisions"))
    assert read([]).shape == (0, len(FIELDS))


def test_of_a_silent_robot_only_the_age_goes_on() -> None:
    rows = [row("r1", age_s=5.0, battery=0.5), row("r2")]
    assert value(rows, "r1", "age") == 5.0
    assert [name for name in NAMES if not math.isnan(value(rows, "r1", name))] == ["age"]
    assert math.isnan(value(rows, "r2", "nearest"))


@settings(max_examples=30)
@given(st.lists(KNOWN, min_size=2, max_size=12))
def test_the_nearest_robot_is_that_of_all_pairs(places: list[float]) -> None:
    rows = [row(f"r{number}", x_m=x_m) for number, x_m in enumerate(places)]
    for number, x_m in enumerate(places):
        apart = min(abs(x_m - other) for place, other in enumerate(places) if place != number)
        assert value(rows, f"r{number}", "nearest") == pytest.approx(apart)


def test_each_quantity_that_is_summarized_has_unit_and_meaning() -> None:
    for metric, known in METRICS.items():
        for quantity in known.quantities or SHAPE_DOC:
            found = describe(metric, quantity)
            assert found is not None
            assert found.doc
            assert (found.unit == "m") == quantity.endswith("_m"), (metric, quantity)
            measured = describe(metric, f"truth_{quantity}")
            assert measured is not None
            assert measured.unit == found.unit
    assert all(describe("coverage", quantity) for quantity in COVERAGE_DOC)
    assert describe("work", "nonsense") is describe("nonsense", "total_m") is None


# -------------------------------------------------------------------- samples
Moment = tuple[dict[str, float], dict[str, float]]
MOMENTS = st.lists(
    st.tuples(
        st.dictionaries(st.sampled_from([f"r{number}" for number in range(12)]), KNOWN, max_size=12),
        st.dictionaries(st.sampled_from(["a_m", "b", "c"]), st.floats(-1e9, 1e9), max_size=3),
    ),
    min_size=1,
    max_size=40,
)


@settings(max_examples=60, deadline=None)
@given(moments=MOMENTS, window=st.tuples(st.integers(-1, 41), st.integers(-1, 41)))
def test_samples_are_what_was_given(moments: list[Moment], window: tuple[int, int]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(samples, "BLOCK_ROWS", 7)
        kept = Samples()
        for at_s, (robots, quantities) in enumerate(moments):
            rows = [row(robot, speed_m_s=speed_m_s) for robot, speed_m_s in robots.items()]
            kept.add(rows, [Summary(metric="m", values=quantities)], float(at_s))
    from_s, to_s = window
    expected = [(at_s, *moment) for at_s, moment in enumerate(moments) if from_s < at_s <= to_s]
    assert kept.times(from_s, to_s).tolist() == [float(at_s) for at_s, *_ in expected]
    asked = ("r3", "r0", "stranger")
    for robot, line in zip(asked, kept.of_robots("speed", asked, from_s, to_s).tolist(), strict=True):
        assert _same(line, [robots.get(robot, math.nan) for _, robots, _ in expected])
    (line,) = kept.of_swarm("m.b", from_s, to_s).tolist()
    assert _same(line, [quantities.get("b", math.nan) for *_, quantities in expected])
    assert set(kept.robots(from_s, to_s)) >= {robot for _, robots, _ in expected for robot in robots}


def _same(found: list[float], expected: list[float]) -> bool:
    return len(found) == len(expected) and all(
        a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(found, expected, strict=True)
    )


@settings(max_examples=30, deadline=None)
@given(
    counts=st.lists(st.integers(0, 60), min_size=10, max_size=60),
    seconds=st.floats(1.0, 40.0),
    most_bytes=st.integers(10_000, 400_000),
)
def test_samples_are_bounded_in_time_and_bytes(counts: list[int], seconds: float, most_bytes: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(samples, "BLOCK_ROWS", 5)
        kept = Samples(seconds, most_bytes)
        for at_s, count in enumerate(counts):
            kept.add([row(f"r{(at_s // 3) * 100 + number}") for number in range(count)], [], float(at_s))
            held = sum(each.size for each in (*kept._closed, kept._open) if each is not None)
            assert kept.size == held
            assert kept.size <= most_bytes or not kept._closed
            assert all(at_s - each.times[-1] <= seconds for each in kept._closed)
            assert kept.to_s == at_s
    oldest_s = float(kept.times(-1.0, 1e9)[0])
    assert len(counts) - 1 - oldest_s <= seconds + 5.0
    gone = {f"r{(at_s // 3) * 100}" for at_s, count in enumerate(counts) if count and at_s + 3 < oldest_s}
    assert gone.isdisjoint(kept.robots(-1.0, 1e9)), "a robot leaves with the time that it was there"


def test_a_flood_of_robots_and_metrics_is_bounded() -> None:
    kept = Samples()
    for number in range(50):
        rows = [row(f"r{100 * number + each}") for each in range(100)]
        values = {f"q{100 * number + each}": 1.0 for each in range(100)}
        kept.add(rows, [Summary(metric="flood", values=values)], 0.5 * number)
    assert len(kept.robots(-1.0, 1e9)) == samples.MOST_ROBOTS
    assert len(kept.names) == samples.MOST_METRICS
    assert kept.size < 10_000_000
    kept.add([row("r1")], [], 0.1)  # a clock that goes back
    assert kept.to_s == 24.5


def test_values_beyond_a_float_are_unknown() -> None:
    kept = Samples()
    kept.add([row("r1", speed_m_s=1e300), row("r2", speed_m_s=0.3)], [], 1.0)
    line = kept.of_robots("speed", ("r1", "r2"), 0.0, 2.0)
    assert not math.isfinite(line[0, 0])
    assert line[1, 0] == pytest.approx(0.3)


@settings(max_examples=60)
@given(st.lists(st.lists(st.none() | KNOWN, min_size=3, max_size=3), min_size=1, max_size=15))
def test_a_band_is_least_median_and_largest_of_the_known(lines: list[list[float | None]]) -> None:
    values = np.array([[math.nan if each is None else each for each in line] for line in lines], float)
    for column, found in enumerate(band(values).T.tolist()):
        known = [each for line in lines if (each := line[column]) is not None]
        if known:
            assert found == pytest.approx([min(known), statistics.median(known), max(known)])
        else:
            assert all(map(math.isnan, found))


# -------------------------------------------------------------------- pages
@pytest.fixture
def bench() -> ConsoleBench:
    return ConsoleBench()


def live(bench: ConsoleBench, seconds: float, robots: int = 3, battery: float = 0.5) -> None:
    """Let robots report; only r1 has a battery, which empties."""
    names = [f"r{number}" for number in range(1, robots + 1)]
    for _ in range(round(2 * seconds)):
        now_s = bench.runtime.now_s()
        bench.states(*names, x_m=now_s - 100.0)
        bench.report(health("r1", battery=battery - 0.001 * (now_s - 100.0)), *map(health, names[1:]))
        bench.run(0.5)


def ask(bench: ConsoleBench, page: Page, session: Any, *names: str, **more: Any) -> dict[str, Any]:
    asked = [
        {"of": name.partition(":")[0], "robots": [*filter(None, name.partition(":")[2].split(","))]} for name in names
    ]
    assert bench.say(session, page, "charts", charts=asked, **more)["ok"]
    bench.run(0.06)
    found = page.last("series")
    assert found["ref"] == page.ref
    return found


def test_a_page_that_shows_no_chart_is_sent_none(bench: ConsoleBench) -> None:
    page, _ = bench.join()
    live(bench, 3.0)
    assert page.all("series") == page.all("rows") == []
    catalogue = page.last("catalogue")
    assert [each["name"] for each in catalogue["fields"]] == list(FIELDS)
    assert [each["name"] for each in catalogue["metrics"]] == list(DEFAULT)


def test_a_chart_comes_whole_and_goes_on(bench: ConsoleBench) -> None:
    live(bench, 5.0)
    page, session = bench.join()
    (whole,) = ask(bench, page, session, "battery:r1,r2")["charts"]
    assert whole["lines"] == ["r1", "r2"]
    assert len(whole["times"]) == len(whole["values"][0]) >= 9
    live(bench, 5.0)
    rows = [each["charts"][0] for each in page.all("rows")]
    times = whole["times"] + [at_s for each in rows for at_s in each["times"]]
    assert times == sorted(set(times))
    assert np.diff(times) == pytest.approx(0.5)
    line = whole["values"][0] + [found for each in rows for found in each["values"][0]]
    for at_s, found in zip(times, line, strict=True):
        assert found == pytest.approx(0.5 - 0.001 * (at_s - 100.0), abs=0.0011)
    assert line[-1] == pytest.approx(page.last("fleet")["robots"][0]["battery"], abs=0.0006), "as the table shows"
    assert {found for each in rows for found in each["values"][1]} == {None}


def test_metrics_of_the_swarm(bench: ConsoleBench) -> None:
    page, session = bench.join()
    found = ask(bench, page, session, *DEFAULT)
    assert found["charts"][0]["why"] == "the swarm reports no work.total_m yet"
    bench.bus.publish(KEYS.summary("work"), Summary(metric="work", values={"total_m": 3.25, "max_m": 1.5}))
    bench.bus.publish(KEYS.summary("coverage"), Summary(metric="coverage", values={"fraction": 0.5}))
    bench.run(1.0)
    assert [each["values"][0][-1] for each in page.last("rows")["charts"]] == [3.25, 0.5, None]
    metrics = {each["name"]: each for each in page.last("catalogue")["metrics"]}
    assert metrics["work.max_m"]["title"] == "Work, max"
    assert metrics["work.max_m"]["unit"] == "m"
    assert "Distance travelled" in metrics["work.max_m"]["doc"]


def test_of_many_robots_there_is_a_band(bench: ConsoleBench) -> None:
    live(bench, 3.0, LINES + 1)
    page, session = bench.join()
    every, some = ask(bench, page, session, "x", "x:" + ",".join(f"r{each}" for each in range(1, LINES + 1)))["charts"]
    assert every["lines"] == ["least", "median", "largest"]
    assert every["robots"] == LINES + 1
    assert every["values"][0] == every["values"][1] == every["values"][2] == some["values"][0]
    assert some["lines"] == [f"r{each}" for each in range(1, LINES + 1)]


def test_a_further_robot_joins_a_chart_of_all(bench: ConsoleBench) -> None:
    live(bench, 2.0, 2)
    page, session = bench.join()
    assert ask(bench, page, session, "speed")["charts"][0]["lines"] == ["r1", "r2"]
    live(bench, 2.0, 3)
    assert page.last("series")["charts"][0]["lines"] == ["r1", "r2", "r3"]
    assert page.last("rows")["charts"][0]["values"][2] != [None]
    assert page.last("rows")["number"] == page.last("series")["number"] == 2


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("battery:r2", "r2 reports no battery"),
        ("battery:r2,r3", "r2, r3 report no battery"),
        ("round_trip", "no robot reports round trip"),
        ("speed:r77", "r77 has not reported"),
        ("batery", "there is no 'batery', did you mean 'battery'?"),
        ("work.totl_m", "there is no 'work.totl_m', did you mean 'work.total_m'?"),
        ("work.total_m:r1", "work.total_m is of the swarm, not of single robots"),
        ("shape.order", "the swarm reports no shape.order yet"),
    ],
)
def test_a_chart_without_data_says_why(bench: ConsoleBench, name: str, words: str) -> None:
    live(bench, 2.0)
    page, session = bench.join()
    (found,) = ask(bench, page, session, name)["charts"]
    assert found["why"] == words
    assert all(value is None for line in found["values"] for value in line)


def test_without_robots_a_chart_says_so(bench: ConsoleBench) -> None:
    page, session = bench.join()
    assert ask(bench, page, session, "speed")["charts"][0]["why"] == "no robot has reported"


def test_a_moment_of_the_past_has_what_was_before_it(bench: ConsoleBench) -> None:
    live(bench, 60.0)
    page, session = bench.join()
    found = ask(bench, page, session, "x:r1", at=110.0)
    assert found["at"] == 110.0
    assert found["to"] == 140.0
    (chart,) = found["charts"]
    assert chart["times"][-1] == pytest.approx(140.0)
    for at_s, x_m in zip(chart["times"], chart["values"][0], strict=True):
        assert x_m == pytest.approx(at_s - 100.0, abs=0.6)
    live(bench, 2.0)
    assert page.all("rows") == [], "the past does not go on"


def test_of_a_thousand_questions_the_newest_counts(bench: ConsoleBench) -> None:
    live(bench, 3.0)
    page, session = bench.join()
    for _ in range(1000):
        assert bench.say(session, page, "charts", charts=[{"of": "speed"}] * 6)["ok"]
    bench.run(0.06)
    assert [each["ref"] for each in page.all("series")] == [page.ref]
    for number in range(100):
        bench.say(session, page, "charts", charts=[{"of": "speed"}])
        bench.run(0.01)
        assert len(page.all("series")) <= 3 + number / 5
    bench.gateway.leave(session, page)
    sent = len(page.frames)
    live(bench, 2.0)
    assert not [each for each in page.frames[sent:] if each["t"] in ("series", "rows")]
    assert not bench.gateway._charts._pages


def test_a_page_ends_its_charts(bench: ConsoleBench) -> None:
    live(bench, 1.0)
    page, session = bench.join()
    ask(bench, page, session, "speed")
    assert bench.say(session, page, "charts")["ok"]
    live(bench, 2.0)
    assert page.all("rows") == []


@pytest.mark.parametrize(
    "wrong",
    [
        {"charts": [{"of": "speed"}] * 7},
        {"charts": [{"of": "<b>"}]},
        {"charts": [{"of": "x" * 200}]},
        {"charts": [{"of": ""}]},
        {"charts": [{"of": "speed", "robots": ["r1"] * 2000}]},
        {"charts": [{"of": "speed", "robots": ["@west"]}]},
        {"charts": [{"of": "speed", "more": 1}]},
        {"charts": 5},
        {"charts": [], "at": 1e300},
        {"charts": [], "at": "now"},
    ],
)
def test_garbage_is_refused(bench: ConsoleBench, wrong: dict[str, Any]) -> None:
    page, session = bench.join()
    answer = bench.say(session, page, "charts", **wrong)
    assert not answer["ok"]
    assert answer["reason"].startswith("malformed frame")
    assert not bench.gateway._charts._pages


def test_whoever_only_looks_on_has_charts() -> None:
    bench = ConsoleBench(read_only=True)
    live(bench, 1.0)
    page, session = bench.join()
    assert ask(bench, page, session, "speed")["charts"][0]["lines"] == ["r1", "r2", "r3"]


def test_in_a_study_there_are_only_the_charts_that_all_have(tmp_path: Path) -> None:
    bench = StudyBench(tmp_path, plan())
    live(bench, 1.0)
    page, session = bench.join()
    assert len(ask(bench, page, session, *DEFAULT)["charts"]) == 3
    others: list[dict[str, Any]] = [{"charts": [{"of": "speed"}]}, {"charts": [{"of": DEFAULT[0]}], "at": 101.0}]
    for more in others:
        answer = bench.say(session, page, "charts", **more)
        assert (answer["ok"], answer["reason"]) == (False, "this is not offered in a study")


class SlowScheduler:
    """A scheduler whose time passes as a desk makes charts: 0.2 s for each."""

    def __init__(self) -> None:
        self.at_s = 0.0
        self.waiting: list[tuple[float, Any]] = []

    def now_s(self) -> float:
        return self.at_s

    def after(self, delay_s: float, callback: Any) -> None:
        self.waiting.append((self.at_s + delay_s, callback))

    def put(self, kind: str, text: str) -> None:
        """Take what a page is sent."""
        self.at_s += 0.2


def test_whole_charts_take_a_share_of_the_time() -> None:
    slow = SlowScheduler()
    desk = charts.ChartDesk(Samples(), slow)  # type: ignore[arg-type]
    began_s: list[float] = []
    for number in range(20):
        desk.handle(frames.Charts(ref=number, charts=(frames.Charted(of="speed"),)), slow)
        assert len(slow.waiting) == 1, "one page at a time"
        slow.at_s, serve = slow.waiting.pop()
        began_s.append(slow.at_s)
        serve()
    assert min(np.diff(began_s)) >= 0.2 / charts.BUSY_SHARE - 0.01


def test_a_large_chart_is_thinned(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = ConsoleBench()
    live(bench, 20.0)
    monkeypatch.setattr(charts, "MOST_CELLS", 30)
    page, session = bench.join()
    (found,) = ask(bench, page, session, "x")["charts"]
    assert 8 <= len(found["times"]) <= 10
    assert len(found["values"][0]) == len(found["times"])
    assert found["times"][-1] == pytest.approx(bench.gateway.samples.to_s)


def test_frames_are_small(bench: ConsoleBench) -> None:
    """Six charts of all robots: what a page is sent twice a second."""
    live(bench, 2.0, 100)
    page, session = bench.join()
    ask(bench, page, session, *["x"] * 6)
    live(bench, 1.0, 100)
    assert len(msgspec.json.encode(page.last("rows"))) < 700
