"""The kinematic engine: unicycles on exact arcs, solid discs, boxes and walls; no masses, no friction.

A list of pairs that may meet soon (`Candidates`) is kept until bodies have moved far enough to change it; each
substep moves all bodies along their arcs, then pushes overlapping ones apart (see :func:`advance`).

Scratch columns of a body: 0, 1 cos and sin of its heading; 2, 3 those of half a substep's turn; 4 chord of one
substep (m); 5, 6 sum of the pushes it got in this step (m); 7 the last pass that pushed it. A candidate is (row,
other row or -1-k for obstacle k, unused, scratch). Bodies are of equal mass: both of a pair are pushed equally far.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

import fullswarm
from fullswarm.config import WorldConfig
from fullswarm.kernels import Array, Index, bound, kernel
from fullswarm.simulation.contacts import Candidates, ContactReferee, Judged, Solids, list_near, radii_of, sweep
from fullswarm.simulation.movers import solid_rows
from fullswarm.simulation.obstacles import obstacle_gap, with_trigonometry

SCRATCH_COLUMNS = 8
SETTLED_M = 1e-5  # an overlap that need not be pushed out within the same substep
PASSES = 12.0  # of pushing per substep; a free pair needs one, a pile more


class Moving(NamedTuple):
    """The n bodies in motion."""

    pose: Array  # (n, 3) x, y, heading
    twist: Array  # (n, 2) measured
    path: Array  # (2 parts + 1, n, 2) of the step
    scratch: Array  # (n, 8)


class KinematicEngine:
    """An :class:`~fullswarm.simulation.engine.Engine` over arrays."""

    def __init__(self, config: WorldConfig, starts: Array, bodies: Sequence[WorldConfig]) -> None:
        n = len(starts)
        self.firmware = f"kinematic {fullswarm.__version__}"
        self.pose = np.array(starts, dtype=float).reshape(n, 3)
        self.twist = np.zeros((n, 2))
        obstacles = with_trigonometry(solid_rows(config))
        self._substeps = int(config.substeps)
        self._dt_s = 1.0 / config.rate_hz
        self._movers_m_s = max((each.speed_m_s for each in config.movers), default=0.0)
        # Each substep has two parts: bodies move, then they are pushed apart at once.
        part_s = np.repeat(np.arange(1, self._substeps + 1, dtype=np.float64), 2) * (self._dt_s / self._substeps)
        self.referee = ContactReferee(config, obstacles, radii_of(bodies), part_s, len(config.movers))
        self._candidates: Candidates | None = None
        self._run: Callable[[float, int, float, Array], bool]
        self._moving = Moving(self.pose, self.twist, self.referee.path, np.zeros((n, SCRATCH_COLUMNS)))

    def step(self, twists: Array) -> None:
        """Advance one world step."""
        while not self._advance(twists):
            # Nothing was changed yet: the list of candidates did not fit.
            self.referee.allocate(2 * len(self.referee.candidates.pairs))
        self.referee.publish()

    def _advance(self, twists: Array) -> bool:
        referee = self.referee
        if referee.candidates is not self._candidates:
            self._candidates = referee.candidates
            self._run = bound(
                partial(advance.run, self._moving, referee.solids, referee.candidates, referee.judged, referee.touch_m)
            )
        return self._run(self._dt_s, self._substeps, self._movers_m_s, twists)

    def place_movers(self, places: Array) -> None:
        """Put the movers there before the next step."""
        self.referee.place_movers(places)

    def close(self) -> None:
        """Do nothing: there is nothing to release."""


@kernel
def shift(pose: Array, scratch: Array, i: int, dx: float, dy: float, turn: float) -> None:
    """Move body `i`, add up the push, and note in which pass (`turn`) it moved."""
    pose[i, 0] += dx
    pose[i, 1] += dy
    scratch[i, 5] += dx
    scratch[i, 6] += dy
    scratch[i, 7] = turn


@kernel
def push(pose: Array, scratch: Array, solids: Solids, i: int, j: int, turn: float) -> float:
    """Push body `i` and body (or obstacle) `j` apart if they overlap; return the gap before (m)."""
    if j < 0:
        gap, nx, ny = obstacle_gap(pose[i, 0], pose[i, 1], solids.obstacles, -1 - j)
        gap -= float(solids.radius[i])
        if gap < 0.0:
            shift(pose, scratch, i, -gap * nx, -gap * ny, turn)
        return gap
    dx, dy = pose[i, 0] - pose[j, 0], pose[i, 1] - pose[j, 1]
    distance = math.sqrt(dx * dx + dy * dy)
    gap = distance - float(solids.radius[i] + solids.radius[j])
    if gap < 0.0:
        nx, ny = 1.0, 0.0
        if distance > 1e-12:
            nx, ny = dx / distance, dy / distance
        shift(pose, scratch, i, -0.5 * gap * nx, -0.5 * gap * ny, turn)
        shift(pose, scratch, j, 0.5 * gap * nx, 0.5 * gap * ny, turn)
    return gap


@kernel
def first_pass(pose: Array, scratch: Array, solids: Solids, pairs: Index, count: int, close_m: float) -> int:
    """Push every overlapping candidate apart; list those nearer than `close_m`, return how many.

    The list is kept in the candidates' last column.
    """
    radius = solids.radius
    close = 0
    for c in range(count):
        i, j = pairs[c, 0], pairs[c, 1]
        if j >= 0:
            dx, dy, far = pose[i, 0] - pose[j, 0], pose[i, 1] - pose[j, 1], radius[i] + radius[j] + close_m
            if dx * dx + dy * dy > far * far:
                continue
        gap = push(pose, scratch, solids, i, j, 1.0)
        if gap < close_m:
            pairs[close, 3] = c
            close += 1
    return close


@kernel
def relax(pose: Array, scratch: Array, solids: Solids, pairs: Index, close: int) -> None:
    """Go on pushing what the first pass pushed into each other, at most `PASSES` times."""
    turn, moved = 1.0, True
    while moved and turn < PASSES:
        turn += 1.0
        moved = False
        for at in range(close):
            # Back and forth, so that a push travels along a chain of bodies in either direction.
            c = pairs[close - 1 - at if turn % 2.0 == 0.0 else at, 3]
            i, j = pairs[c, 0], pairs[c, 1]
            if scratch[i, 7] < turn - 1.0 and (j < 0 or scratch[j, 7] < turn - 1.0):
                continue
            if push(pose, scratch, solids, i, j, turn) < -SETTLED_M:
                moved = True


@kernel
def prepare(pose: Array, twists: Array, scratch: Array, step_s: float) -> float:
    """Fill the scratch columns for substeps of `step_s`; return the highest speed (m/s)."""
    fastest = 0.0
    for i in range(pose.shape[0]):
        half = 0.5 * twists[i, 1] * step_s
        scratch[i, 0], scratch[i, 1] = math.cos(pose[i, 2]), math.sin(pose[i, 2])
        c, s = math.cos(half), math.sin(half)
        scratch[i, 2], scratch[i, 3] = c, s
        # The chord of the arc; near half = 0 the series avoids 0 / 0.
        ratio = s / half if abs(half) > 1e-4 else 1.0 - half * half / 6.0
        scratch[i, 4] = twists[i, 0] * step_s * ratio
        scratch[i, 5], scratch[i, 6] = 0.0, 0.0
        fastest = max(fastest, abs(twists[i, 0]))
    return fastest


@kernel
def move(pose: Array, scratch: Array) -> None:
    """Move every body along its arc by one substep; the heading itself is set at the end of the step."""
    for i in range(pose.shape[0]):
        c, s, half_c, half_s = scratch[i, 0], scratch[i, 1], scratch[i, 2], scratch[i, 3]
        middle_c, middle_s = c * half_c - s * half_s, s * half_c + c * half_s
        scratch[i, 7] = 0.0
        pose[i, 0] += scratch[i, 4] * middle_c
        pose[i, 1] += scratch[i, 4] * middle_s
        scratch[i, 0] = middle_c * half_c - middle_s * half_s
        scratch[i, 1] = middle_s * half_c + middle_c * half_s


@kernel
def note(pose: Array, path: Array, at: int) -> None:
    """Write where the bodies are as point `at` of their paths."""
    for i in range(pose.shape[0]):
        path[at, i, 0], path[at, i, 1] = pose[i, 0], pose[i, 1]


@kernel
def advance(
    moving: Moving, solids: Solids, listed: Candidates, judged: Judged, touch: float, dt: float, substeps: int,
    movers_m_s: float, twists: Array,
) -> bool:  # fmt: skip
    """Advance all bodies by `dt` seconds in `substeps` parts, and judge their paths (see `sweep`).

    Parameters
    ----------
    movers_m_s : no obstacle was moved by more than `dt` of this speed since the last call

    Returns
    -------
    bool
        False if there is no room for all candidates, with nothing changed.
    """
    pose, path, scratch, pairs = moving.pose, moving.path, moving.scratch, listed.pairs
    n = pose.shape[0]
    fastest = max(prepare(pose, twists, scratch, dt / substeps), movers_m_s)
    # A pushed body moves no faster than the one that pushes: twice the free way covers it.
    ahead = 2.0 * fastest * dt + 1e-3
    if 2.0 * (listed.slack[0] + ahead) > listed.slack[1] and not list_near(pose, solids, 2.5 * ahead, listed):
        return False
    count = listed.used[0]
    close_m = 4.0 * fastest * dt / substeps + 1e-3
    note(pose, path, 0)
    for part in range(substeps):
        move(pose, scratch)
        note(pose, path, 2 * part + 1)
        if count > 0:
            close = first_pass(pose, scratch, solids, pairs, count, close_m)
            if close > 0:
                relax(pose, scratch, solids, pairs, close)
        note(pose, path, 2 * part + 2)
    # Twice the way that two bodies can close: pushed ones move, too.
    sweep(path, solids, touch, ahead + touch, pairs, count, judged)
    pushed = 0.0
    for i in range(n):
        px, py = scratch[i, 5], scratch[i, 6]
        moving.twist[i, 0] = twists[i, 0] + (px * scratch[i, 0] + py * scratch[i, 1]) / dt
        moving.twist[i, 1] = twists[i, 1]
        heading = pose[i, 2] + twists[i, 1] * dt
        if heading > math.pi or heading < -math.pi:
            heading = math.atan2(math.sin(heading), math.cos(heading))
        pose[i, 2] = heading
        pushed = max(pushed, abs(px) + abs(py))
    listed.slack[0] += fastest * dt + pushed
    return True
