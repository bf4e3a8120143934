"""A trial as one picture: the ways of all robots, and where they are at a time."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment.record import Trajectory
from fullswarm.evaluate.pictures.scene import WIDTH_PX, Scene
from fullswarm.evaluate.pictures.timeline import Timeline
from fullswarm.evaluate.pictures.whole_file import whole_file

STILL_ENDINGS = (".png", ".svg")


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
    kind = path.suffix.lower()
    if kind not in STILL_ENDINGS:
        raise ConfigError(f"a picture ends in {' or '.join(STILL_ENDINGS)}", where=str(path))
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
