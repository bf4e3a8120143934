"""Pictures and animations of a laboratory: a notebook shows them, and they can be saved."""

from __future__ import annotations

import base64
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fullswarm.evaluate.pictures import Film, Scene, Timeline, write_film, write_still
from fullswarm.evaluate.trial_folder import Trajectory


@dataclass(frozen=True, repr=False)
class Picture:
    """The world from above: robots where they are, and their ways."""

    trajectory: Trajectory
    caption: str = ""
    width_px: int = 720
    from_s: float | None = None

    @property
    def figure(self) -> Any:
        """The picture as a figure of matplotlib, to draw into."""
        timeline = Timeline(self.trajectory)
        scene = Scene(timeline, self.caption, self.width_px)
        scene.update(timeline.end_s, trail_s=timeline.end_s - (self.from_s or 0.0))
        return scene.figure

    def save(self, path: Path | str) -> Path:
        """Write a .png or .svg; return its path."""
        write_still(
            self.trajectory, Path(path), caption=self.caption, width_px=self.width_px, from_s=self.from_s
        )  # fmt: skip
        return Path(path)

    def __repr__(self) -> str:
        return f"<Picture of {len(self.trajectory.ids)} robots>"

    def _repr_png_(self) -> bytes:
        """Return what a notebook shows."""
        return _bytes(self.save, ".png")


@dataclass(frozen=True, repr=False)
class Animation:
    """What has happened as a film."""

    trajectory: Trajectory
    film: Film

    def save(self, path: Path | str) -> Path:
        """Write a .gif or .mp4; return its path."""
        write_film(self.trajectory, Path(path), self.film)
        return Path(path)

    def __repr__(self) -> str:
        return f"<Animation of {len(self.trajectory.ids)} robots>"

    def _repr_html_(self) -> str:
        """Return what a notebook shows: a GIF, which every viewer of notebooks plays."""
        data = base64.b64encode(_bytes(self.save, ".gif")).decode()
        return f'<img alt="The swarm from above" src="data:image/gif;base64,{data}">'


def film_for(duration_s: float, film: Film, fits_s: float = 15.0) -> Film:
    """Return a film whose speed lets `duration_s` fit into `fits_s` seconds, unless it has a speed already."""
    return film if film.speed > 0.0 else replace(film, speed=max(1.0, duration_s / fits_s))


def _bytes(save: Any, ending: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        found: bytes = save(Path(folder) / f"picture{ending}").read_bytes()
        return found
