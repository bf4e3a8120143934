"""Other simulators' worlds as scenarios. In: a file. Out: `Imported`, a scenario and notes on what was omitted.

Each importer is a module with ``read(path) -> Imported`` and its lines in `FORMATS`, `_ROOTS` and `_ENDINGS` below. XML
and YAML are read by defusedxml and PyYAML's safe loader, of the extra [experiments].

``sdf.py``     Gazebo's SDF worlds; Gazebo classic's ``.world`` files are SDF too
``sdf_models.py``  the files of models that an SDF world includes
``argos.py``   ARGoS experiments (``.argos``)
``stage.py``   Stage worlds, with what they include and their bitmaps
``player.py``  Player configurations (``.cfg``) with the Stage world that they load
``menge.py``   Menge crowd scenes (XML)
``irsim.py``   IR-SIM worlds (YAML)
``ros_map.py`` Maps of ROS's map_server (YAML and a picture)
``draft.py``   collects what an importer finds, and converts it to a scenario: shapes become boxes
``files.py``   reads files: bytes, XML with line numbers, numbers; errors that name the line
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.evaluate.scenarios.importers import argos, irsim, menge, player, ros_map, sdf, stage
from fullswarm.evaluate.scenarios.importers.draft import Imported
from fullswarm.evaluate.scenarios.importers.files import read_text
from fullswarm.maps.ros_map import is_ros_map

__all__ = ["FORMATS", "Imported", "guess_format", "read_world"]

FORMATS: Mapping[str, Callable[[Path], Imported]] = MappingProxyType(
    {
        "sdf": sdf.read,
        "argos": argos.read,
        "stage": stage.read,
        "player": player.read,
        "menge": menge.read,
        "irsim": irsim.read,
        "map": ros_map.read,
    }
)

_ROOTS = {
    "sdf": "sdf",
    "gazebo": "sdf",
    "world": "sdf",
    "argos-configuration": "argos",
    "Experiment": "menge",
    "Project": "menge",
}
_ENDINGS = {
    ".sdf": "sdf",
    ".argos": "argos",
    ".world": "stage",
    ".inc": "stage",
    ".cfg": "player",
    ".yaml": "irsim",
    ".yml": "irsim",
}
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
        known = "map" if is_ros_map(text) else _ENDINGS.get(path.suffix.lower())
    if known is None:
        raise ConfigError(
            "this is no world of a known format",
            where=str(path),
            hint=f"or name it with --format: {', '.join(FORMATS)}",
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
