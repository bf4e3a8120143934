"""A backend of matplotlib with windows, timers and a main loop, but without a screen.

``MPLBACKEND=module://tests.unit.screenless_backend``. Its main loop fires timers without waiting, until none runs.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.backend_bases import FigureManagerBase, TimerBase, _Backend
from matplotlib.backends.backend_agg import FigureCanvasAgg

shown: list[Any] = []
"""What windows showed after each firing of a timer: pictures (height, width, 4)."""
close_after = 10**6
"""The user closes all windows after so many firings."""


class Timer(TimerBase):
    """A timer that the main loop fires."""

    running: ClassVar[list[Timer]] = []

    def _timer_start(self) -> None:
        if self not in self.running:
            self.running.append(self)

    def _timer_stop(self) -> None:
        if self in self.running:
            self.running.remove(self)


class Window(FigureManagerBase):
    """A window that nobody sees."""

    def show(self) -> None:
        """Draw for the first time."""
        self.canvas.draw()

    @classmethod
    def start_main_loop(cls) -> None:
        """Fire timers until none runs or no window is open."""
        while Timer.running and plt.get_fignums():
            for each in list(Timer.running):
                each._on_timer()  # type: ignore[attr-defined]
            shown.extend(plt.figure(number).canvas.copied() for number in plt.get_fignums())  # type: ignore[attr-defined]
            if len(shown) >= close_after:
                plt.close("all")
        Timer.running.clear()


class Canvas(FigureCanvasAgg):
    """A canvas of such a window."""

    manager_class = Window
    required_interactive_framework = "headless"
    _timer_cls = Timer

    def new_timer(self, interval: int | None = None, callbacks: Any = None) -> Timer:
        """Return a timer."""
        return Timer(interval, callbacks)

    def draw_idle(self, *_: Any, **__: Any) -> None:
        """Draw at once."""
        self.draw()  # type: ignore[no-untyped-call]

    def copied(self) -> Any:
        """Return what the window shows."""
        return np.array(self.buffer_rgba())  # type: ignore[no-untyped-call]


@_Backend.export
class _Screenless(_Backend):
    FigureCanvas = Canvas
    FigureManager = Window
    mainloop = Window.start_main_loop
