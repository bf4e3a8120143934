"""Colours that also colour-blind people tell apart (Okabe and Ito 2008), and the palette of GIF films."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

ROBOTS = ("#0072B2", "#56B4E9", "#009E73", "#CC79A7")
"""Blue, sky, green, purple: robots take them in turn. Orange and yellow are too near to the two below."""
CONTACT = "#D55E00"
GOAL, GOAL_EDGE = "#FBF3B0", "#B8A400"
BOX, BOX_EDGE = "#B5B5B5", "#6E6E6E"
INK, FAINT = "#222222", "#777777"
FLOOR, OUTSIDE = "#FFFFFF", "#F1F1F1"

SHARES = 9
"""Steps between two colours, for soft edges."""


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green, blue, 0 to 255, of ``#rrggbb``."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def palette() -> NDArray[np.uint8]:
    """Return at most 255 colours (k, 3): all that a scene is drawn in, and their blends at soft edges.

    The same for every film: colours do not flicker from frame to frame, and no rare one is lost.
    """
    shares = np.linspace(0.0, 1.0, SHARES)[:, None]
    behind = {FLOOR: (*ROBOTS, CONTACT, INK, BOX, GOAL_EDGE), GOAL: (*ROBOTS, CONTACT, INK, GOAL_EDGE), OUTSIDE: (INK,)}
    pairs = [pair for back, fronts in behind.items() for pair in product((back,), fronts)]
    pairs += [(BOX, BOX_EDGE), (INK, CONTACT), *product((INK,), ROBOTS), (FLOOR, FAINT), (OUTSIDE, FAINT)]
    exact = [rgb(colour) for pair in pairs for colour in pair]
    blends = np.concatenate([shares * rgb(front) + (1.0 - shares) * np.array(rgb(back)) for back, front in pairs])
    colours = np.concatenate((np.array(exact), np.rint(blends))).astype(np.uint8)
    _, first = np.unique(colours, axis=0, return_index=True)
    chosen: NDArray[np.uint8] = colours[np.sort(first)][:255]
    return chosen
