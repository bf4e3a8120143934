"""Pictures and videos of trials: the world from above. Needs matplotlib; videos also pillow or imageio-ffmpeg.

``replay.py``    `fullswarm experiment replay`: find a trial, then draw it or make a video
``scene.py``     the world from above at a moment, its colours, and a trial as one picture
``ink.py``       the dark parts of a picture as points
``film.py``      a trial as a video: GIF through pillow, MP4 (H.264) through ffmpeg
``recording.py`` a part of a recording as a trajectory, for films
``timeline.py``  a trajectory at any time: poses between its samples, contacts, events so far
"""

from __future__ import annotations

from fullswarm.evaluate.pictures.film import FILM_ENDINGS, Film, write_film
from fullswarm.evaluate.pictures.scene import STILL_ENDINGS, Scene, svg_text, write_still
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
