"""Pictures and films of trials: the world from above. Needs matplotlib; films also pillow or imageio-ffmpeg."""

from __future__ import annotations

from fullswarm.evaluate.pictures.film import FILM_ENDINGS, Film, write_film
from fullswarm.evaluate.pictures.scene import Scene
from fullswarm.evaluate.pictures.still import STILL_ENDINGS, svg_text, write_still
from fullswarm.evaluate.pictures.timeline import Moment, Timeline

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
