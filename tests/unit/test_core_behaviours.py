from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm import registry
from fullswarm.config.parameter import Parameter
from fullswarm.core.behaviours import BEHAVIOURS, Library, Record, load_records, make_record, resolve, shape
from fullswarm.errors import ConfigError, RequestRefused
from fullswarm.messages import Value
from fullswarm.store import Store

TABLES = load_records()
RECORDS = {name: make_record(name, TABLES) for name in TABLES}
DATABASE: dict[str, Any] = {"agent/safety_margin_m": 0.03, "world/bounds": [[0.0, 0.0], [20.0, 20.0]]}


def test_the_file_holds_each_behaviour_with_its_filtered_twin() -> None:
    plain = {"move_to_goal", "navigate", "flocking", "rendezvous", "formation", "voronoi_coverage", "drive"}
    plain |= {"formation_assigned", "navigate_each"}
    plain |= {"dispersion", "aggregation", "leader_follower", "cyclic_pursuit", "perimeter", "area_sweep"}
    plain |= {"consensus", "average_consensus", "pursuit_evasion", "flocking_adaptive", "flocking_velocity"}
    plain |= {"task_auction", "pattern", "patrol", "exploration"}
    plain |= {"voronoi_centralised", "teleop_centroid"} | {
        f"move_{way}" for way in ("forward", "backward", "left", "right")
    }
    assert set(RECORDS) == plain | {f"{name}_bc" for name in plain} | {"stop", "paper_bc"}
    for name in plain:
        base, filtered = RECORDS[name], RECORDS[f"{name}_bc"]
        assert filtered.filtered
        assert not base.filtered
        assert filtered.model_copy(update={"name": name, "filtered": False}) == base
        assert len(TABLES[f"{name}_bc"]) == 2


def test_every_law_exists() -> None:
    for record in RECORDS.values():
        if record.law:
            assert record.law in (registry.CENTRALISED if record.centralised else registry.LAWS)
    assert [name for name, record in RECORDS.items() if not record.law] == ["stop"]


def test_moves_go_by_the_map_and_lapse() -> None:
    ways = {name: RECORDS[f"move_{name}"].static["direction"] for name in ("forward", "backward", "left", "right")}
    assert ways == {"forward": [0, 1], "backward": [0, -1], "left": [-1, 0], "right": [1, 0]}
    assert RECORDS["move_left_bc"].expires_s == RECORDS["drive"].expires_s == 0.3


@pytest.mark.parametrize(
    ("behaviour", "parameters", "texts"),
    [
        ("rendezvous", {"gain": 9}, ["gain = 9 is outside [0.05, 5] 1/s"]),
        ("move_to_goal", {}, ["goal is missing: point [x, y] m"]),
        ("move_to_goal", {"gial": 1, "goal": [1, 2]}, ["parameter 'gial' is unknown (did you mean 'goal'?)"]),
        ("move_to_goal", {"goal": [1.0]}, ["goal = [1.0] is not a point [x, y]"]),
        ("move_to_goal", {"goal": [1.0, math.nan]}, ["goal.y = nan is not a finite number"]),
        ("move_to_goal", {"gain": True, "x": 1}, ["parameter 'x'", "goal is missing", "gain = True is not"]),
        ("move_left", {"direction": [1, 0]}, ["parameter 'direction' is fixed by the record"]),
        ("stop", {"gain": 1.0}, ["parameter 'gain' is unknown (it takes none)"]),
        ("formation", {}, ["give either targets or shape"]),
        ("formation", {"targets": [[0, 0]]}, ["1 target for 2 robots"]),
        ("formation", {"shape": "cirlce"}, ["shape = 'cirlce' is not one of circle, line, grid"]),
        ("formation", {"shape": "circle"}, ["centre is missing: point [x, y] m"]),
        ("formation", {"shape": "circle", "centre": [0, 0], "targets": [[0, 0]] * 2}, ["not both"]),
        ("voronoi_centralised", {}, ["bounds is missing: list of points [x, y] m or world/bounds in the database"]),
    ],
)  # fmt: skip
def test_refusals_say_all_that_is_wrong(behaviour: str, parameters: dict[str, Value], texts: list[str]) -> None:
    with pytest.raises(RequestRefused) as caught:
        resolve(RECORDS[behaviour], parameters, ["a", "b"])
    for text in texts:
        assert text in caught.value.what


def test_statics_defaults_and_the_database_are_appended() -> None:
    record = RECORDS["move_to_goal_bc"]
    assert resolve(record, {"goal": [1, 2]}, ["a"], DATABASE.get) == {
        "a": {"goal": [1.0, 2.0], "gain": 1.0, "arrive_radius_m": 0.05, "safety_margin_m": 0.03}
    }
    left = resolve(RECORDS["move_left"], {}, ["a"], {"agent/speed_limit_m_s": 4.0}.get)["a"]
    assert left == {"direction": [-1.0, 0.0], "magnitude": 1.0, "speed_m_s": 4.0}
    assert resolve(RECORDS["move_left"], {}, ["a"])["a"]["speed_m_s"] == 0.5
    bounds = resolve(RECORDS["voronoi_centralised"], {}, ["a"], DATABASE.get)["a"]["bounds"]
    assert bounds == DATABASE["world/bounds"]


def test_each_robot_gets_its_own_target() -> None:
    each = resolve(RECORDS["formation"], {"targets": [[0, 0], [1, 1]], "gain": 2}, ["b", "a"])
    assert each == {"b": {"target": [0.0, 0.0], "gain": 2.0}, "a": {"target": [1.0, 1.0], "gain": 2.0}}
    line = resolve(RECORDS["formation"], {"shape": "line", "centre": [1, 5], "spacing_m": 2}, ["a", "b"])
    assert [line[robot]["target"] for robot in "ab"] == [[0.0, 5.0], [2.0, 5.0]]
    assigned = resolve(RECORDS["formation_assigned"], {"targets": [[0, 0], [1, 1]]}, ["a", "b"])
    assert assigned["a"] == assigned["b"]
    assert assigned["a"]["targets"] == [[0.0, 0.0], [1.0, 1.0]]


@settings(max_examples=50, deadline=None)
@given(st.sampled_from(["circle", "line", "grid"]), st.integers(1, 40), st.floats(0.1, 10.0))
def test_shapes_keep_the_spacing_and_the_centre(name: str, count: int, spacing_m: float) -> None:
    points = shape(name, count, (3.0, -2.0), spacing_m)
    assert len(points) == count
    gaps = [math.dist(a, b) for k, a in enumerate(points) for b in points[:k]]
    assert not gaps or min(gaps) == pytest.approx(spacing_m)
    if name != "grid":
        assert [sum(axis) / count for axis in zip(*points, strict=True)] == pytest.approx([3.0, -2.0], abs=1e-6)


numbers = st.floats(-100, 100) | st.integers(-100, 100)
lists = st.lists(st.one_of(numbers, st.lists(numbers, max_size=3)), max_size=3)
anything: st.SearchStrategy[Any] = st.one_of(st.none(), st.booleans(), st.floats(), st.text(max_size=4), numbers, lists)


@settings(max_examples=50, deadline=None)
@given(
    st.sampled_from(sorted(RECORDS)),
    st.dictionaries(st.sampled_from([*RECORDS["formation"].parameters, "goal", "magnitude", "nonsense"]), anything),
    st.lists(st.text("ab", min_size=1, max_size=3), min_size=1, max_size=4, unique=True),
)
def test_resolve_answers_completely_or_refuses(name: str, parameters: dict[str, Any], robots: list[str]) -> None:
    record = RECORDS[name]
    try:
        each = resolve(record, parameters, robots, DATABASE.get)
    except RequestRefused as refusal:
        assert refusal.what  # noqa: PT017  # both outcomes are right; the answer is what is checked
        return
    assert set(parameters) <= set(record.parameters)
    assert list(each) == robots
    for complete in each.values():
        for key, value in complete.items():
            if key in record.parameters:
                record.parameters[key].check(key, value)
        required = {key for key, spec in record.parameters.items() if spec.required or spec.default is not None}
        if not record.formation:
            assert required <= set(complete)


@settings(max_examples=50, deadline=None)
@given(st.floats(-10, 10), st.floats(-10, 10), st.floats(-20, 20))
def test_a_number_is_in_range_or_refused(a: float, b: float, value: float) -> None:
    parameter = Parameter(type="number", min=min(a, b), max=max(a, b))
    try:
        assert parameter.check("x", value) == value
        assert min(a, b) <= value <= max(a, b)
    except ValueError:
        assert not min(a, b) <= value <= max(a, b)


BOUND = st.none() | st.floats(allow_nan=False, allow_infinity=False)


@given(BOUND, BOUND, st.floats())
def test_what_lies_in_the_span_would_pass_the_check(low: float | None, high: float | None, value: float) -> None:
    if low is not None and high is not None and low > high:
        low, high = high, low
    parameter = Parameter(type="number", min=low, max=high)
    first, last = parameter.span
    if first <= value <= last:
        assert parameter.check("x", value) == value
    else:
        with pytest.raises(ValueError, match="x = "):
            parameter.check("x", value)


def test_only_numbers_have_a_span() -> None:
    first, last = Parameter(type="integer").span
    assert not first <= 1.0 <= last


def test_integers_flags_and_words() -> None:
    assert Parameter(type="integer").check("n", 3.0) == 3
    assert Parameter(type="flag").check("f", True) is True
    assert Parameter(type="flag", default=False).default is False
    with pytest.raises(ValueError, match="not an integer"):
        Parameter(type="integer").check("n", 3.5)
    with pytest.raises(ValueError, match="not a flag"):
        Parameter(type="flag").check("f", 1)


def test_a_bad_file_tells_all_its_errors_at_once(tmp_path: Path) -> None:
    path = tmp_path / "behaviours.toml"
    path.write_text(
        '[one]\nsummary = "a"\nlaww = "x"\n[one.parameters]\ngain = { type = "numbr", default = 1.0 }\n'
        'size = { type = "number", default = 9.0, max = 2.0 }\n'
        '[two]\nlike = "on"\n[three]\nlike = "three"\n[four]\nsummary = "c"\nlaw = "formaton_assigned"\n'
        "centralised = true\n"
    )
    with pytest.raises(ConfigError) as caught:
        load_records(path)
    text = str(caught.value)
    for part in (
        "behaviours.toml",
        "laww: no such key",
        "parameters.gain.type",
        "size: default = 9 is outside [-inf, 2]",
    ):
        assert part in text
    for part in ("behaviour 'two': like: unknown behaviour 'on'", "refers back to itself", "no centralised law"):
        assert part in text
    path.write_text("[one\n")
    with pytest.raises(ConfigError, match="at line 1"):
        load_records(path)
    assert BEHAVIOURS.is_file()


def test_the_library_follows_the_database() -> None:
    store = Store()
    store.seed({f"behaviour/{name}": table for name, table in TABLES.items()})
    library = Library(store)
    with pytest.raises(RequestRefused, match=r"unknown behaviour 'flokking' \(did you mean 'flocking'\?\)"):
        library.get("flokking")
    assert library.get("rendezvous_bc").parameters["gain"].max == 5.0
    raw: dict[str, Any] = {
        "like": "rendezvous",
        "parameters": {"gain": {"type": "number", "default": 1.0, "max": 50.0}},
    }
    store.set("behaviour/meet", library.check("behaviour/meet", raw), "ann")
    meet: Record = library.get("meet")
    assert (meet.law, meet.parameters["gain"].max, "hearing_m" in meet.parameters) == ("rendezvous", 50.0, True)
    with pytest.raises(ConfigError, match="no such key"):
        library.check("behaviour/meet", {**raw, "speed": 1})
    with pytest.raises(ConfigError, match="is not a table"):
        library.check("behaviour/meet", 7)
    with pytest.raises(ConfigError, match="unknown behaviour 'rendezvous'"):
        library.check("behaviour/rendezvous", None)  # its twin is like it
    store.set("behaviour/meet", library.check("behaviour/meet", None), "ann")
    with pytest.raises(RequestRefused, match="unknown behaviour 'meet'"):
        library.get("meet")
    store.close()
