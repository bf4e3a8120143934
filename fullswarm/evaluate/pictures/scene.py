"""Draws the world from above, and a trial as one picture: what stays is drawn once, what moves over a copy of it."""

from __future__ import annotations

import io
import math
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import ConfigError, MissingExtra
from fullswarm.evaluate.pictures.timeline import Moment, Timeline
from fullswarm.evaluate.trial_folder import Trajectory, whole_file
from fullswarm.kernels import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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


WIDTH_PX = 720
NARROWEST_PX, WIDEST_PX = 320, 3840
BASE_DPI, LOWEST_DPI = 100.0, 80.0
LEFT, RIGHT, BOTTOM, TOP = 0.52, 0.16, 0.40, 0.54
"""Margins in inches: for the ticks, and above for two lines of text."""
TALLEST, FLATTEST = 1.6, 0.12
"""Height of the arena's drawing, of its width; beyond that the arena does not fill it."""
NOSE = 1.7
"""Length of the heading's line, of the robot's radius."""
RING = 1.9
"""Radius of the ring around a robot that touches, as a multiple of its own."""


class Scene:
    """Draws moments of one trajectory.

    Parameters
    ----------
    timeline : of the trajectory
    caption : a line of text above
    width_px : of the picture; its height follows from the arena. Both are made even, as H.264 wants it

    Raises
    ------
    ConfigError
        It would be narrower than `NARROWEST_PX` or wider than `WIDEST_PX`.
    MissingExtra
        matplotlib is not installed.
    """

    def __init__(self, timeline: Timeline, caption: str = "", width_px: int = WIDTH_PX) -> None:
        if not NARROWEST_PX <= width_px <= WIDEST_PX:
            raise ConfigError(
                f"a picture cannot be {width_px} px wide", where="--width", hint=f"{NARROWEST_PX} to {WIDEST_PX}"
            )
        try:
            from matplotlib.backends.backend_agg import FigureCanvasAgg
            from matplotlib.figure import Figure
        except ImportError as error:
            raise MissingExtra("pictures need matplotlib", hint="pip install 'fullswarm[experiments]'") from error
        self._timeline = timeline
        trajectory = timeline.trajectory
        dpi = max(LOWEST_DPI, BASE_DPI * width_px / WIDTH_PX)
        view = _view(trajectory)
        self.width_px = width_px - width_px % 2
        across_px = self.width_px - dpi * (LEFT + RIGHT)
        shape = (view[3] - view[1]) / (view[2] - view[0])
        height_px = int(across_px * min(TALLEST, max(FLATTEST, shape)) + dpi * (BOTTOM + TOP))
        self.height_px = height_px - height_px % 2
        # A hundredth of a pixel more: matplotlib cuts off what is left of the product after the point.
        size = ((self.width_px + 0.01) / dpi, (self.height_px + 0.01) / dpi)
        self.figure = Figure(figsize=size, dpi=dpi, facecolor="white")
        self._canvas: Any = FigureCanvasAgg(self.figure)  # half of it is untyped
        width, height = size
        place = (LEFT / width, BOTTOM / height, 1.0 - (LEFT + RIGHT) / width, 1.0 - (BOTTOM + TOP) / height)
        self._axes = self.figure.add_axes(place)
        _draw_axes(self._axes, view)
        _draw_world(self._axes, trajectory)
        across = int((self.width_px / dpi - LEFT - RIGHT) * 14)  # letters of this size in one line
        text = caption if len(caption) <= across else f"{caption[: across - 1]}…"
        self._text((0.0, 21.0), text, colour=FAINT, size=8.0)
        self._moving = _Moving(self._axes, trajectory)
        self._status = self._text((0.0, 6.0), "", colour=INK, size=9.5)
        self._contacts = self._text((0.0, 6.0), "", colour=CONTACT, size=9.5, right=True)
        self._background: Any = None

    def follow(self, timeline: Timeline) -> None:
        """Draw moments of a longer trajectory of the same robots and world from now on."""
        self._timeline = timeline

    def update(self, time_s: float, since_s: float | None = None, trail_s: float = math.inf) -> Moment:
        """Put everything that moves to its place at a time.

        Parameters
        ----------
        since_s : a robot that touched anything after it is marked, until `time_s`
        trail_s : how much of the way is shown, up to the whole
        """
        moment = self._timeline.at(time_s, since_s)
        self._moving.update(moment, self._timeline.trails(time_s - trail_s, moment))
        aimed = np.isfinite(self._timeline.trajectory.goals).any()
        arrived = f"    arrived {moment.arrived}/{self._timeline.robots}" if aimed else ""
        self._status.set_text(f"{time_s:.1f} s{arrived}")
        self._contacts.set_text(f"contacts {moment.contacts}" if moment.contacts else "")
        return moment

    def frame(self) -> NDArray[np.uint8]:
        """Return the picture (height, width, 4) RGBA; the next frame overwrites it."""
        artists = (*self._moving.artists, self._status, self._contacts)
        if self._background is None:
            for each in artists:
                each.set_animated(True)  # left out of the background
            self._canvas.draw()
            self._background = self._canvas.copy_from_bbox(self.figure.bbox)
        self._canvas.restore_region(self._background)
        for each in artists:
            self._axes.draw_artist(each)
        picture: NDArray[np.uint8] = np.asarray(self._canvas.buffer_rgba())
        return picture

    def pixel(self, x_m: float, y_m: float) -> tuple[int, int]:
        """Return the row and column of a frame at which a place of the world is."""
        column, up = self._axes.transData.transform((x_m, y_m))
        return int(self.height_px - up), int(column)

    def _text(self, offset: tuple[float, float], text: str, *, colour: str, size: float, right: bool = False) -> Any:
        """Write above the drawing; `offset` in points. The axes themselves may be narrower."""
        width, height = self.figure.get_size_inches()
        return self._axes.annotate(
            text,
            (1.0 - RIGHT / width if right else LEFT / width, 1.0 - TOP / height),
            xycoords="figure fraction",
            xytext=offset,
            textcoords="offset points",
            ha="right" if right else "left",
            va="bottom",
            color=colour,
            fontsize=size,
            annotation_clip=False,
            parse_math=False,
        )


class _Moving:
    """The artists that change from frame to frame, lowest first."""

    def __init__(self, axes: Axes, trajectory: Trajectory) -> None:
        from matplotlib.collections import LineCollection

        robots = len(trajectory.ids)
        self._radius_m = np.asarray(trajectory.radius_m, np.float64)
        self._colours = np.array([ROBOTS[row % len(ROBOTS)] for row in range(robots)])
        self._trails = LineCollection([], colors=self._colours, linewidths=1.1, capstyle="round")
        (self._marks,) = axes.plot([], [], "x", color=CONTACT, markersize=4.5, markeredgewidth=1.0)
        nowhere = np.full((robots, 2), np.nan)
        self._discs = _discs(axes, nowhere, self._radius_m, facecolors=self._colours, edgecolors=INK, linewidths=0.6)
        self._noses = LineCollection([], colors=INK, linewidths=1.1, capstyle="round")
        self._rings = _discs(
            axes, nowhere, RING * self._radius_m, facecolors="none", edgecolors=CONTACT, linewidths=1.6
        )
        for lines in (self._trails, self._noses):
            axes.add_collection(lines, autolim=False)
        self.artists: tuple[Any, ...] = (self._trails, self._discs, self._noses, self._marks, self._rings)
        for order, each in enumerate(self.artists):
            each.set_zorder(10 + order)

    def update(self, moment: Moment, trails: list[Array]) -> None:
        """Move them."""
        position, heading = moment.pose[:, :2], moment.pose[:, 2]
        ahead = np.stack((np.cos(heading), np.sin(heading)), axis=1) * (NOSE * self._radius_m[:, None])
        self._trails.set_segments(trails)
        self._discs.set_offsets(position)
        self._discs.set_facecolor(np.where(moment.touching, CONTACT, self._colours).tolist())
        self._noses.set_segments(list(np.stack((position, position + ahead), axis=1)))
        self._rings.set_offsets(np.where(moment.touching[:, None], position, np.nan))
        self._marks.set_data(moment.marks[:, 0], moment.marks[:, 1])


def _view(trajectory: Trajectory) -> tuple[float, float, float, float]:
    """Return x_min, y_min, x_max, y_max in metres of what is shown: the arena with a little around it."""
    x_min, y_min, x_max, y_max = (float(each) for each in trajectory.bounds_m)
    rim = 0.015 * max(x_max - x_min, y_max - y_min)
    return x_min - rim, y_min - rim, x_max + rim, y_max + rim


def _draw_axes(axes: Axes, view: tuple[float, float, float, float]) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.set_xlim(view[0], view[2])
    axes.set_ylim(view[1], view[3])
    axes.set_aspect("equal", anchor="C")
    axes.set_facecolor(OUTSIDE)
    axes.set_axisbelow(True)
    box, figure = axes.get_position(), axes.get_figure(root=True)
    width, height = (0.0, 0.0) if figure is None else figure.get_size_inches()
    for axis, length in ((axes.xaxis, box.width * width), (axes.yaxis, box.height * height)):
        axis.set_major_locator(MaxNLocator(nbins=max(1, min(8, int(2.2 * length))), steps=[1, 2, 5, 10]))
    axes.tick_params(labelsize=7.5, colors=FAINT, length=2.5, width=0.6, pad=2.0)
    axes.set_xlabel("m", fontsize=7.5, color=FAINT, labelpad=0.0, loc="right")
    for spine in axes.spines.values():
        spine.set_visible(False)


def _draw_world(axes: Axes, trajectory: Trajectory) -> None:
    """Draw what stays: floor and walls, goals, boxes, where robots began."""
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import Rectangle

    x_min, y_min, x_max, y_max = (float(each) for each in trajectory.bounds_m)
    extent = ((x_min, y_min), x_max - x_min, y_max - y_min)
    floor = axes.add_patch(Rectangle(*extent, facecolor=FLOOR, edgecolor="none", zorder=1))
    axes.add_patch(Rectangle(*extent, facecolor="none", edgecolor=INK, linewidth=1.6, zorder=4))
    goals = np.unique(trajectory.goals[np.isfinite(trajectory.goals).all(axis=1)], axis=0)
    discs = _discs(
        axes,
        goals.reshape(-1, 2),
        np.full(len(goals), trajectory.goal_radius_m),
        facecolors=GOAL,
        edgecolors=GOAL_EDGE,
        linewidths=1.0,
        linestyles="dashed",
        zorder=2,
    )
    discs.set_clip_path(floor)  # no robot arrives beyond the walls
    boxes = PolyCollection(
        list(corners(trajectory.boxes)), facecolors=BOX, edgecolors=BOX_EDGE, linewidths=0.8, zorder=3
    )
    axes.add_collection(boxes, autolim=False)
    starts = trajectory.pose[0, :, :2]
    axes.plot(starts[:, 0], starts[:, 1], "o", ms=4.0, mfc="none", mec=FAINT, mew=0.8, zorder=5)


def _discs(axes: Axes, centre: Array, radius_m: Array, **style: Any) -> Any:
    """Add discs in metres."""
    from matplotlib.collections import EllipseCollection

    size_m = 2.0 * radius_m
    found = EllipseCollection(
        size_m, size_m, np.zeros(len(size_m)), units="xy", offsets=centre, offset_transform=axes.transData, **style
    )
    return axes.add_collection(found, autolim=False)


def corners(boxes: Array) -> Array:
    """Return the corners (k, 4, 2) in metres of boxes (k, 5): centre x, y, size x, y, yaw."""
    rows = np.asarray(boxes, np.float64).reshape(-1, 5)
    signs = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
    local = signs[None] * rows[:, None, 2:4]
    cos, sin = np.cos(rows[:, 4, None]), np.sin(rows[:, 4, None])
    turned = np.stack((cos * local[..., 0] - sin * local[..., 1], sin * local[..., 0] + cos * local[..., 1]), axis=-1)
    found: Array = turned + rows[:, None, :2]
    return found


STILL_ENDINGS = (".png", ".svg")


def check_still(path: Path) -> str:
    """Return the ending of a picture's file.

    Raises
    ------
    ConfigError
        There is no picture with that ending.
    """
    kind = path.suffix.lower()
    if kind not in STILL_ENDINGS:
        raise ConfigError(f"a picture ends in {' or '.join(STILL_ENDINGS)}", where=str(path))
    return kind


def write_still(
    trajectory: Trajectory,
    path: Path,
    *,
    caption: str = "",
    width_px: int = WIDTH_PX,
    from_s: float | None = None,
    until_s: float | None = None,
) -> None:
    """Write a PNG or SVG: robots where they are at `until_s` (default: the end), their ways since `from_s`.

    Raises
    ------
    ConfigError
        Another ending, nothing was recorded then, or the file cannot be written.
    MissingExtra
        matplotlib is not installed.
    """
    kind = check_still(path)
    scene = _scene(trajectory, caption, width_px, from_s, until_s)
    with whole_file(path) as beside:
        _save(scene, beside, kind[1:])


def svg_text(trajectory: Trajectory, *, caption: str = "", width_px: int = WIDTH_PX) -> str:
    """Return the whole way of a trial as an SVG document, for a report. Equal input, equal text."""
    buffer = io.BytesIO()
    _save(_scene(trajectory, caption, width_px, None, None), buffer, "svg")
    return buffer.getvalue().decode()


def _scene(trajectory: Trajectory, caption: str, width_px: int, from_s: float | None, until_s: float | None) -> Scene:
    timeline = Timeline(trajectory)
    first_s, last_s = timeline.window(from_s, until_s)
    scene = Scene(timeline, caption, width_px)
    scene.update(last_s, trail_s=last_s - first_s if from_s is not None else math.inf)
    return scene


def _save(scene: Scene, file: Any, kind: str) -> None:
    import matplotlib as mpl

    # Dates and random ids would make equal pictures differ.
    metadata = {"Date": None} if kind == "svg" else {"Software": None}
    with mpl.rc_context({"svg.hashsalt": "fullswarm"}):
        scene.figure.savefig(file, format=kind, dpi=scene.figure.dpi, metadata=metadata)


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
