from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.cli.values import parse_parameters, parse_stored, parse_value
from fullswarm.errors import ConfigError
from fullswarm.messages import Value


@pytest.mark.parametrize(
    ("raw", "value"),
    [
        ("1.5", 1.5),
        ("-3", -3),
        ("1e-3", 0.001),
        ("true", True),
        ("word", "word"),
        ("two words", "two words"),
        ('"5"', "5"),
        ("'5'", "5"),
        ("[1, 2]", [1, 2]),
        ("5,5", [5, 5]),
        ("-1.5, 2", [-1.5, 2]),
        ("[[0, 0], [1.5, -1]]", [[0, 0], [1.5, -1]]),
        ("[0,0],[1,1]", [[0, 0], [1, 1]]),
        ("a,b", "a,b"),
        ("2024-01-01", "2024-01-01"),
    ],
)
def test_values_read_as_people_mean_them(raw: str, value: Value) -> None:
    found = parse_value(raw)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("raw", "what"),
    [
        ("", "has no value"),
        ("nan", "not finite"),
        ("-inf", "not finite"),
        ("Infinity", "not finite"),
        ("[1, nan]", "not finite"),
        ("[1, 2", "does not end"),
        ('"word', "does not end"),
        ("{}", "cannot be a parameter"),
        ("null", "cannot be a parameter"),
        ("[]", "not a list of numbers"),
        ('["a"]', "not a list of numbers"),
        ("[true]", "not a list of numbers"),
        ("[[[1]]]", "not a list of numbers"),
    ],
)
def test_values_that_no_parameter_can_have_are_refused(raw: str, what: str) -> None:
    with pytest.raises(ConfigError, match=what) as caught:
        parse_value(raw, where="--set key")
    assert str(caught.value).startswith("--set key: ")


def test_parameters_need_a_key_each() -> None:
    assert parse_parameters(["goal=5,5", "note=a=b"]) == {"goal": [5, 5], "note": "a=b"}
    for options, what in ((["goal"], "not key=value"), (["=1"], "not key=value"), (["a=1", "a=2"], "given twice")):
        with pytest.raises(ConfigError, match=what):
            parse_parameters(options)


def test_a_database_holds_more_than_a_request() -> None:
    assert parse_stored('{"a": [1, "x"], "b": null}') == {"a": [1, "x"], "b": None}
    assert parse_stored("null") is None


@given(
    st.one_of(
        st.booleans(),
        st.integers(-(2**53), 2**53),
        st.floats(allow_nan=False, allow_infinity=False),
        st.lists(st.lists(st.integers(-9, 9), min_size=2, max_size=2), min_size=1, max_size=3),
    )
)
def test_json_comes_back_as_it_was(value: Value) -> None:
    assert parse_value(json.dumps(value)) == value


@given(st.text(max_size=12))
def test_any_text_is_read_or_refused_with_an_error(raw: str) -> None:
    try:
        parse_value(raw)
    except ConfigError:
        return
