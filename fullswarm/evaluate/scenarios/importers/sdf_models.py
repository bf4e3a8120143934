"""Finds and reads the files of models that an SDF world includes, in the folders that Gazebo searches.

They are the world's own folder, ``models`` in it, and those of the variables in `VARIABLES`. Nothing outside of them is
read, and nothing is downloaded.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from fullswarm.errors import ConfigError
from fullswarm.evaluate.scenarios.importers.files import Node, read_xml

VARIABLES = ("GZ_SIM_RESOURCE_PATH", "IGN_GAZEBO_RESOURCE_PATH", "SDF_PATH", "GAZEBO_MODEL_PATH")
CONFIG, MODEL = "model.config", "model.sdf"
MOST_INCLUDES = 5000
"""Of one world: models that include one another twice each would multiply without end."""


@dataclass(slots=True)
class Models:
    """The models that a world may include."""

    folders: tuple[Path, ...]
    _read: dict[Path, Node | str] = field(default_factory=dict)
    _open: list[str] = field(default_factory=list)
    _count: int = 0

    @classmethod
    def beside(cls, world: Path) -> Models:
        """Return the models of the folders that are searched for a world's file."""
        listed = [Path(each) for name in VARIABLES for each in os.environ.get(name, "").split(os.pathsep) if each]
        found = [world.parent, world.parent / "models", *listed]
        return cls(tuple(each.resolve() for each in found if each.is_dir()))

    def find(self, uri: str, where: str) -> Node | str:
        """Return the model that a URI names, or why it was not read.

        Raises
        ------
        ConfigError
            The file is there and broken, or there are too many includes.
        """
        self._count += 1
        if self._count > MOST_INCLUDES:
            raise ConfigError(f"more than {MOST_INCLUDES} models are included", where=where)
        scheme, separator, rest = uri.partition("://")
        if not separator:
            scheme, rest = "", uri
        if scheme not in ("", "model", "file"):
            return f"what {scheme} names is not downloaded"
        name = PurePosixPath(rest)
        if not rest or ".." in name.parts or (name.is_absolute() and scheme != "file"):
            return "it is no name of a model"
        for folder in self.folders:
            path = self._file_of((folder / name).resolve(), folder)
            if path is not None:
                if path not in self._read:
                    self._read[path] = _model_in(path)
                return self._read[path]
        return f"it was not found beside the world, in models/ there, or in the folders of {', '.join(VARIABLES)}"

    @contextmanager
    def inside(self, uri: str, where: str) -> Iterator[None]:
        """Keep in mind that a model is being read, which must not include itself."""
        if uri in self._open:
            raise ConfigError(f"the model '{uri}' includes itself", where=where)
        self._open.append(uri)
        try:
            yield
        finally:
            self._open.pop()

    def _file_of(self, path: Path, folder: Path) -> Path | None:
        """Return the SDF file that a path names, or that the model's folder names; None: not in this folder."""
        if path.is_dir():
            config = path / CONFIG
            named = [node.text.strip() for node in read_xml(config, "model").all("sdf")] if config.is_file() else []
            path = (path / (named[-1] if named else MODEL)).resolve()  # by custom the newest version is the last
        return path if path.is_relative_to(folder) and path.is_file() else None


def _model_in(path: Path) -> Node | str:
    root = read_xml(path, "SDF model")
    model = root if root.tag == "model" else root.child("model")
    return model if model is not None else f"{path.name} holds no <model>"
