"""Pictures and films of trials: the world from above. Needs matplotlib; films also pillow or imageio-ffmpeg."""

from __future__ import annotations

from fullswarm.perf.pictures.film import FILM_ENDINGS, Film, write_film
from fullswarm.perf.pictures.scene import Scene
from fullswarm.perf.pictures.still import STILL_ENDINGS, svg_text, write_still
from fullswarm.perf.pictures.timeline import Moment, Timeline

__all__ = [
    "FILM_ENDINGS",
    "STILL_ENDINGS",
    "Film",
    "Moment",
    "Scene",
    "Timeline",
    "svg_text",
    "write_film",
    "write_still",
]
