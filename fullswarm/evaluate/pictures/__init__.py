"""Pictures and films of trials: the world from above. Needs matplotlib; films also pillow or imageio-ffmpeg.

Files:

``colours.py``     Colours that also colour-blind people tell apart (Okabe and Ito 2008), and the palette of GIF films
``film.py``        A trial as a film: GIF through pillow, MP4 (H.264) through ffmpeg
``replay.py``      `fullswarm experiment replay`: find a trial, then draw or film it
``scene.py``       The world from above: what stays is drawn once, what moves is drawn over a copy of it
``still.py``       A trial as one picture: the ways of all robots, and where they are at a time
``timeline.py``    What a trajectory says at any time: poses between its samples, contacts, what has happened so
                   far
``whole_file.py``  Files that appear whole or not at all
"""

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
