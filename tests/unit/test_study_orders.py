"""Orders of conditions: the balance that each design promises, counted."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.study.order import latin_square, orders, rows_of, williams

SIZES = range(1, 12)


@pytest.mark.parametrize("count", SIZES)
def test_a_latin_square_has_each_condition_once_in_each_row_and_place(count: int) -> None:
    rows = latin_square(count)
    everything = set(range(count))
    assert all(set(row) == everything for row in rows)
    assert all({row[place] for row in rows} == everything for place in range(count))


@pytest.mark.parametrize("count", SIZES)
def test_in_a_williams_design_each_condition_comes_directly_after_each_other_equally_often(count: int) -> None:
    rows = williams(count)
    assert len(rows) == (count if count % 2 == 0 or count == 1 else 2 * count)
    pairs = Counter((row[place], row[place + 1]) for row in rows for place in range(count - 1))
    assert set(pairs) == {(one, other) for one in range(count) for other in range(count) if one != other}
    assert len(set(pairs.values())) <= 1, pairs
    places = Counter((place, each) for row in rows for place, each in enumerate(row))
    assert set(places.values()) == {len(rows) // count}


def test_the_usual_latin_square_is_not_balanced_for_what_follows_what() -> None:
    rows = latin_square(4)
    pairs = Counter((row[place], row[place + 1]) for row in rows for place in range(3))
    assert (0, 2) not in pairs


@given(st.sampled_from(["williams", "latin", "random"]), st.integers(1, 8), st.integers(1, 40), st.integers(0, 99))
def test_all_participants_meet_all_conditions_and_whole_blocks_are_balanced(
    order: str, count: int, people: int, seed: int
) -> None:
    rows = orders(order, count, people, seed)  # type: ignore[arg-type]
    assert rows == orders(order, count, people, seed)  # type: ignore[arg-type]
    assert len(rows) == people
    assert all(sorted(row) == list(range(count)) for row in rows)
    block = rows_of(order, count)  # type: ignore[arg-type]
    if block:
        for start in range(0, people - len(block) + 1, len(block)):
            assert sorted(rows[start : start + len(block)]) == sorted(block)


def test_an_order_does_not_depend_on_how_many_come_later() -> None:
    assert orders("williams", 4, 9, 3)[:5] == orders("williams", 4, 5, 3)
