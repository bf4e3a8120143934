"""Where a mission's steps are on the map: by the kinds that parameters declare, and the targets of formations."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fullswarm.core.behaviours import Record, load_records, make_record
from fullswarm.core.mission_places import places_of
from fullswarm.messages import MOST_PLACE_POINTS
from tests.unit.mission_lab import MissionLab

THREE = ("r0", "r1", "r2")
TOUR = """
name = "tour"
robots = ["r0", "r1", "r2"]
[[steps]]
name = "go"
behaviour = "move_to_goal_bc"
parameters = { goal = [2.0, 1.0] }
done = { arrived = "all" }
[[steps]]
name = "gather"
behaviour = "formation_bc"
parameters = { shape = "circle", centre = [5.0, 5.0], spacing_m = 1.0 }
done = { time_s = 5 }
[[steps]]
name = "wait"
done = { time_s = 5 }
"""


def record(name: str) -> Record:
    return make_record(name, load_records())


def custom(**parameters: dict[str, Any]) -> Record:
    """A behaviour that nobody has written yet."""
    return Record.model_validate({"name": "new", "summary": "new", "law": "new", "parameters": parameters})


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[MissionLab]:
    lab = MissionLab(tmp_path / "core.db")
    yield lab
    lab.close()


def test_points_are_found_by_their_kind_and_unit_whatever_they_are_called() -> None:
    behaviour = custom(
        rendezvous={"type": "point", "unit": "m"},
        inspected={"type": "points", "unit": "m"},
        field={"type": "points", "unit": "m", "default_from": "world/bounds"},
        drift={"type": "point", "unit": "m/s"},
        speed={"type": "number", "unit": "m"},
    )
    given: dict[str, Any] = {
        "rendezvous": [1, 2.5], "inspected": [[0, 0], [3, 4]], "field": [[0, 0], [2, 2]], "drift": [9, 9], "speed": 4.0,
    }  # fmt: skip
    found = {each.parameter: (each.kind, each.points) for each in places_of(behaviour, given, ())}
    assert found == {
        "rendezvous": ("point", ((1.0, 2.5),)),
        "inspected": ("points", ((0.0, 0.0), (3.0, 4.0))),
        "field": ("area", ((0.0, 0.0), (2.0, 2.0))),
    }


def test_an_area_that_is_not_given_is_the_arena_and_no_place() -> None:
    assert places_of(record("area_sweep_bc"), {}, THREE) == ()


def test_a_formation_has_a_target_for_each_robot() -> None:
    (place,) = places_of(record("navigate_each_bc"), {"shape": "circle", "centre": [4.0, 9.0], "spacing_m": 1.2}, THREE)
    assert place.kind == "formation"
    assert len(place.points) == 3
    sides = [math.dist(place.points[k], place.points[k - 1]) for k in range(3)]
    assert sides == pytest.approx([1.2] * 3)
    middle = [sum(each) / 3 for each in zip(*place.points, strict=True)]
    assert middle == pytest.approx([4.0, 9.0])


def test_a_formation_whose_robots_are_not_known_has_its_centre() -> None:
    (place,) = places_of(record("navigate_each_bc"), {"shape": "line", "centre": [4.0, 9.0]}, ())
    assert (place.kind, place.points) == ("point", ((4.0, 9.0),))


@pytest.mark.parametrize("value", [None, 3, "here", [1], [1, "x"], [[1, 2], 3], [[[1]]], [], True])
def test_what_is_no_place_is_left_out(value: Any) -> None:
    behaviour = custom(goal={"type": "point", "unit": "m"}, spots={"type": "points", "unit": "m"})
    found = places_of(behaviour, {"goal": value, "spots": value}, THREE)
    assert all(len(point) == 2 for place in found for point in place.points)
    assert not any(place.parameter == "goal" for place in found)


def test_a_place_that_no_message_may_have_is_left_out() -> None:
    behaviour = custom(spots={"type": "points", "unit": "m"})
    given: list[Any] = [[math.nan, 0.0], [math.inf, 0.0], [1e8, 0.0], [1.0, 2.0]]
    (place,) = places_of(behaviour, {"spots": given}, THREE)
    assert place.points == ((1.0, 2.0),)


def test_a_very_long_list_is_cut() -> None:
    behaviour = custom(spots={"type": "points", "unit": "m"})
    (place,) = places_of(behaviour, {"spots": [[float(k), 0.0] for k in range(10_000)]}, THREE)
    assert len(place.points) == MOST_PLACE_POINTS


def test_the_status_of_a_mission_has_the_places_of_all_steps(lab: MissionLab) -> None:
    assert lab.ask("start", TOUR).ok
    lab.run(0.3)
    assert lab.status is not None
    go, gather, wait = (lab.step("main", name) for name in ("go", "gather", "wait"))
    assert [(each.kind, each.points) for each in go.places] == [("point", ((2.0, 1.0),))]
    assert [(each.kind, len(each.points)) for each in gather.places] == [("formation", 3)]
    assert wait.places == ()


def test_they_are_there_again_after_a_restart_of_the_core(lab: MissionLab) -> None:
    assert lab.ask("start", TOUR).ok
    lab.run(0.3)
    lab.kill_core()
    lab.run(1.5)
    assert [each.points for each in lab.step("main", "go").places] == [((2.0, 1.0),)]
    assert len(lab.step("main", "gather").places) == 1
