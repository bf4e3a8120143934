"""Shows a laboratory in a window while it runs, where there is a display."""

from __future__ import annotations

import math
from typing import Any

from fullswarm.errors import FullswarmError, MissingExtra
from fullswarm.evaluate.pictures import Scene, Timeline
from fullswarm.lab.lab import Lab

FRAME_S = 0.05
TRAIL_S = 10.0
WIDTH_PX = 720


def open_window(title: str) -> Any:
    """Return an empty figure of matplotlib in a window; None: there is no display, or nothing to draw windows with.

    Raises
    ------
    MissingExtra
        matplotlib is not installed.
    """
    try:
        from matplotlib import pyplot as plt
    except ImportError as error:
        raise MissingExtra("pictures need matplotlib", hint="pip install 'fullswarm[experiments]'") from error
    try:
        figure = plt.figure(title)
    except ImportError:  # MPLBACKEND names a toolkit that is not installed or finds no display
        return None
    if getattr(figure.canvas, "required_interactive_framework", None) is None:
        plt.close(figure)
        return None
    return figure


def show(figure: Any, lab: Lab, duration_s: float, speed: float, caption: str = "") -> None:
    """Run a laboratory in a window for `duration_s` simulated seconds; return when the window is closed.

    Parameters
    ----------
    figure : of :func:`open_window`
    speed : simulated seconds per second

    Raises
    ------
    FullswarmError
        What the laboratory raises; the window is closed.
    """
    from matplotlib import pyplot as plt
    from matplotlib.animation import FuncAnimation

    failed: list[FullswarmError] = []
    timeline = Timeline(lab.record)
    scene = Scene(timeline, caption, WIDTH_PX)
    scene.update(timeline.end_s)
    figure.set_size_inches(scene.width_px / figure.dpi, scene.height_px / figure.dpi)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    image = axes.imshow(scene.frame())
    end_s = lab.time_s + duration_s

    def frame(_: int) -> tuple[Any]:
        try:
            lab.run(min(speed * FRAME_S, max(0.0, end_s - lab.time_s)))
        except FullswarmError as error:  # raised here it would end in the toolkit, which prints it
            failed.append(error)
            plt.close(figure)
        timeline = Timeline(lab.record)
        scene.follow(timeline)
        scene.update(timeline.end_s, trail_s=TRAIL_S)
        image.set_data(scene.frame())
        return (image,)

    film = FuncAnimation(
        figure, frame, frames=math.ceil(duration_s / (speed * FRAME_S)), init_func=lambda: (image,),
        interval=1000.0 * FRAME_S, repeat=False, cache_frame_data=False,
    )  # fmt: skip
    plt.show()
    del film  # matplotlib stops one that nothing holds
    if failed:
        raise failed[0]
