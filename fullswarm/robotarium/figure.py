"""Draws the testbed with matplotlib while a script runs; the script may draw into the same axes."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle, Rectangle

from fullswarm.clock import MonotonicClock
from fullswarm.kernels import Array

BODY, EDGE = "#ffd54a", "#222222"
RIM_M = 0.1
"""Around the arena."""
ABOVE = 2
"""Robots cover what a script draws with matplotlib's usual orders."""


class ArenaFigure:
    """A window with arena and robots; without a display a figure in memory.

    Parameters
    ----------
    poses : (3, N)
    boundaries : x, y of the lower left corner, width and height, m

    Attributes
    ----------
    figure, axes : matplotlib's; the current ones of ``pyplot``
    bodies : a circle per robot
    """

    def __init__(self, poses: Array, boundaries: tuple[float, float, float, float], radius_m: float) -> None:
        self.figure, self.axes = plt.subplots()
        x, y, width, height = boundaries
        self._radius_m, self._clock = radius_m, MonotonicClock()
        self._due_s = self._clock.now_s()
        self.axes.set_axis_off()
        self.axes.set_aspect("equal")
        self.axes.set_xlim(x - RIM_M, x + width + RIM_M)
        self.axes.set_ylim(y - RIM_M, y + height + RIM_M)
        self.figure.subplots_adjust(left=0.0, right=1.0, bottom=0.0, top=1.0)
        self.axes.add_patch(Rectangle((x, y), width, height, fill=False, edgecolor=EDGE))
        self.bodies = [Circle((0.0, 0.0), radius_m, facecolor=BODY, edgecolor=EDGE, zorder=ABOVE) for _ in poses.T]
        self._headings: list[Any] = [self.axes.plot([], [], color=EDGE, zorder=ABOVE + 1)[0] for _ in poses.T]
        for body in self.bodies:
            self.axes.add_patch(body)
        self._place(poses)
        if self.figure.canvas.required_interactive_framework is not None:
            plt.ion()
            plt.show()

    def update(self, poses: Array, period_s: float) -> None:
        """Draw the robots at their poses (3, N), and wait until `period_s` have passed since the call before.

        A window that was closed is not drawn any more, and nothing waits.
        """
        if not plt.fignum_exists(self.figure.number):
            return
        self._place(poses)
        canvas: Any = self.figure.canvas
        canvas.draw_idle()
        canvas.flush_events()
        now_s = self._clock.now_s()
        self._due_s = max(self._due_s + period_s, now_s)
        if self._due_s > now_s:
            canvas.start_event_loop(self._due_s - now_s)

    def _place(self, poses: Array) -> None:
        ends = poses[:2] + self._radius_m * np.stack([np.cos(poses[2]), np.sin(poses[2])])
        for body, line, (x, y), (end_x, end_y) in zip(self.bodies, self._headings, poses[:2].T, ends.T, strict=True):
            body.center = (x, y)
            line.set_data([x, end_x], [y, end_y])
