"""Other simulators' worlds as scenarios. In: a file. Out: `Imported`, a scenario and notes of what did not fit.

Gazebo SDF, ARGoS, Stage, Menge and IR-SIM; each module has ``read(path) -> Imported``. XML and YAML are read by
defusedxml and PyYAML's safe loader, of the extra [experiments].

Files:

``argos.py``         ARGoS experiments (``.argos``): arena, boxes, cylinders, robots, and ``<distribute>``
``draft.py``         What the importers collect, and the scenario that comes of it
``files.py``         Reading other simulators' files: bytes, XML with line numbers, numbers; and errors that say where
``irsim.py``         IR-SIM worlds (YAML, ir-sim.readthedocs.io): world, obstacles, robots and their goals
``menge.py``         Menge crowd scenes (XML): explicit obstacle sets, agents of explicit and grid generators, goals
``sdf.py``           Gazebo's SDF worlds (sdformat.org/spec; Gazebo classic's ``.world`` files are SDF too)
``sdf_poses.py``     Poses of an SDF file in the world: 4 x 4 transforms, composed along the frames that they are told
                     in
``shapes.py``        Discs, polygons and lines as boxes: all that a scenario knows
``stage.py``         Stage worlds (rtv.github.io/Stage): floor plan, models with blocks, robots, ``define`` and
                     ``include``
``stage_bitmap.py``  Bitmaps of floor plans as rectangles: dark pixels (127 of 255 or less) are solid, as in Stage
``stage_syntax.py``  The syntax of Stage's world files: properties, entities in parentheses, ``define``, ``include``
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.evaluate.scenarios.importers import argos, irsim, menge, sdf, stage
from fullswarm.evaluate.scenarios.importers.draft import Imported
from fullswarm.evaluate.scenarios.importers.files import read_text

__all__ = ["FORMATS", "Imported", "guess_format", "read_world"]

FORMATS: Mapping[str, Callable[[Path], Imported]] = MappingProxyType(
    {"sdf": sdf.read, "argos": argos.read, "stage": stage.read, "menge": menge.read, "irsim": irsim.read}
)

_ROOTS = {
    "sdf": "sdf",
    "gazebo": "sdf",
    "world": "sdf",
    "argos-configuration": "argos",
    "Experiment": "menge",
    "Project": "menge",
}
_ENDINGS = {".sdf": "sdf", ".argos": "argos", ".world": "stage", ".inc": "stage", ".yaml": "irsim", ".yml": "irsim"}
_FIRST_ELEMENT = re.compile(r"<([A-Za-z][\w-]*)")


def guess_format(path: Path) -> str:
    """Return the format of a file: by its first XML element, else by its ending.

    Raises
    ------
    ConfigError
        Not readable, or none of the formats.
    """
    text = re.sub(r"<!--.*?-->", "", read_text(path, "world")[:100_000], flags=re.DOTALL)
    if text.lstrip().startswith("<"):
        element = _FIRST_ELEMENT.search(text)
        known = _ROOTS.get(element[1]) if element else None
    else:
        known = _ENDINGS.get(path.suffix.lower())
    if known is None:
        raise ConfigError(
            "this is no world of a known format", where=str(path), hint=f"or say which: {', '.join(FORMATS)}"
        )
    return known


def read_world(path: Path, form: str | None = None) -> Imported:
    """Return a world's file as a scenario; `form` is one of `FORMATS`, None: guessed.

    Raises
    ------
    ConfigError
        Not readable, not of the format, or nothing of which a scenario can be made.
    MissingExtra
        The reader of XML or YAML is not installed.
    """
    chosen = guess_format(path) if form is None else form
    if chosen not in FORMATS:
        raise ConfigError(f"there is no format '{chosen}'", where="--format", hint=did_you_mean(chosen, FORMATS))
    return FORMATS[chosen](path)
