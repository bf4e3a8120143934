"""Orders of conditions: which participant meets which condition when.

A condition may change what follows it (practice, fatigue, carry-over). In a Latin square each condition stands in each
place equally often; in a Williams design each one also comes directly after each other one equally often (E. J.
Williams, "Experimental designs balanced for the estimation of residual effects of treatments", Australian Journal of
Scientific Research A 2, 1949).
"""

from __future__ import annotations

from random import Random
from typing import Literal

Order = Literal["williams", "latin", "random"]
Row = tuple[int, ...]


def latin_square(count: int) -> list[Row]:
    """Return `count` rows; row k begins with condition k, and the others follow in a circle."""
    return [tuple((start + place) % count for place in range(count)) for start in range(count)]


def williams(count: int) -> list[Row]:
    """Return the rows of a Williams design: `count` of them, and twice as many if `count` is odd and above 1."""
    first = [(place + 1) // 2 if place % 2 else (count - place // 2) % count for place in range(count)]
    rows = [tuple((each + shift) % count for each in first) for shift in range(count)]
    return rows + [row[::-1] for row in rows] if count % 2 and count > 1 else rows


def rows_of(order: Order, count: int) -> list[Row]:
    """Return the rows over which a study is balanced; none if it is random."""
    if order == "random":
        return []
    return williams(count) if order == "williams" else latin_square(count)


def orders(order: Order, count: int, participants: int, seed: int) -> list[Row]:
    """Return one row of conditions (0 to `count` - 1) per participant; the same for the same seed.

    Participants are taken in blocks as long as the design; within a block the rows are shuffled, so that the order of
    enrolment says nothing about the order of conditions.
    """
    random = Random(f"{order}/{count}/{seed}")  # noqa: S311  (no secret; text seeds give the same on every platform)
    found: list[Row] = []
    while len(found) < participants:
        block = rows_of(order, count)
        if not block:
            row = list(range(count))
            random.shuffle(row)
            block = [tuple(row)]
        random.shuffle(block)
        found += block
    return found[:participants]
