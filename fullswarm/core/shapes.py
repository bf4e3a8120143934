"""Targets of a formation by name of a shape."""

from __future__ import annotations

import math


def shape(name: str, count: int, centre: tuple[float, float], spacing_m: float) -> list[list[float]]:
    """Return `count` targets around `centre`, neighbours `spacing_m` apart.

    Parameters
    ----------
    name
        ``circle`` (from the east, counter-clockwise), ``line`` (west to east) or ``grid`` (from the south west).
    """
    x, y = centre
    if name == "circle":
        # Neighbours on the circle are a chord of 2 r sin(π/n) apart; one robot stands in the middle.
        radius = spacing_m / (2.0 * math.sin(math.pi / count)) if count > 1 else 0.0
        angles = [math.tau * k / count for k in range(count)]
        return [[x + radius * math.cos(angle), y + radius * math.sin(angle)] for angle in angles]
    columns = count if name == "line" else math.ceil(math.sqrt(count))
    rows = math.ceil(count / columns)
    return [
        [
            x + (k % columns - (columns - 1) / 2.0) * spacing_m,
            y + (k // columns - (rows - 1) / 2.0) * spacing_m,
        ]
        for k in range(count)
    ]
