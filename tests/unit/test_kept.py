"""Places on the map and saved requests: what the core stores, and what it refuses."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.errors import ConfigError
from fullswarm.kept import CHECKS, PLACE, SAVED, check_place, check_saved

COORDINATE = st.floats(-1e7, 1e7)
PLACES = st.one_of(
    st.builds(lambda point: {"kind": "point", "points": [list(point)]}, st.tuples(COORDINATE, COORDINATE)),
    st.builds(
        lambda points: {"kind": "area", "points": [list(each) for each in points]},
        st.lists(st.tuples(COORDINATE, COORDINATE), min_size=2, max_size=64),
    ),
)


@given(PLACES)
def test_a_place_is_stored_as_it_was_given_and_survives_json(place: dict[str, Any]) -> None:
    stored = check_place("place/dock", place)
    assert stored == place
    assert check_place("place/dock", json.loads(json.dumps(stored))) == place


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({"kind": "point", "points": [[0, 0], [1, 1]]}, "2 points"),
        ({"kind": "point", "points": []}, "length >= 1"),
        ({"kind": "area", "points": [[0, 0]]}, "opposite corners"),
        ({"kind": "area", "points": [[0.0, 0.0]] * 65}, "length <= 64"),
        ({"kind": "circle", "points": [[0, 0]]}, "circle"),
        ({"kind": "point", "points": [[0, 1e9]]}, "<= 1"),
        ({"kind": "point", "points": [[0, float("nan")]]}, "="),
        ({"kind": "point", "points": [[0, float("inf")]]}, "="),
        ({"kind": "point", "points": [[0]]}, "length 2"),
        ({"kind": "point", "points": "here"}, "array"),
        ({"kind": "point"}, "points"),
        ({"kind": "point", "points": [[0, 0]], "colour": "red"}, "colour"),
        ([[0, 0]], "object"),
        ("here", "object"),
        (7, "object"),
    ],
)
def test_what_is_no_place_is_refused_with_the_key(value: object, words: str) -> None:
    with pytest.raises(ConfigError, match="place/dock") as caught:
        check_place("place/dock", value)
    assert words in str(caught.value)


@pytest.mark.parametrize("name", ["", "two words", "a/b", "../x", "n" * 65, "ä"])
def test_a_name_is_one_chunk_of_a_key(name: str) -> None:
    for prefix, check in CHECKS.items():
        with pytest.raises(ConfigError, match="cannot be a name"):
            check(prefix + name, None)


def test_none_takes_it_away() -> None:
    assert check_place(f"{PLACE}dock", None) is None
    assert check_saved(f"{SAVED}sweep", None) is None


def test_a_request_is_kept_with_all_that_was_said() -> None:
    given: dict[str, Any] = {
        "behaviour": "area_sweep_bc",
        "parameters": {"area": [[0.0, 0.0], [4.0, 3.0]], "lane_m": 0.8},
        "robots": ["r1", "@west"],
        "team": "@west",
        "needs": {"capabilities": ["camera"]},
        "roles": {"scout": ["r1", "+camera"]},
    }
    assert check_saved("saved/sweep", given) == given
    assert check_saved("saved/sweep", {"behaviour": "stop_bc"}) == {"behaviour": "stop_bc"}


@pytest.mark.parametrize(
    "value",
    [
        {}, {"behaviour": ""}, {"behaviour": 3}, {"behaviour": "b" * 65}, {"behaviour": "x", "robots": "r1"},
        {"behaviour": "x", "take": True}, {"behaviour": "x", "needs": {"speed_m_s": -1.0}},
        {"behaviour": "x", "roles": []}, {"behaviour": "x", "parameters": {"a": {"b": {}}}},
    ],
)  # fmt: skip
def test_what_is_no_request_is_refused(value: object) -> None:
    with pytest.raises(ConfigError, match="saved/sweep"):
        check_saved("saved/sweep", value)
