"""What fullswarm itself asks of a robot's computer: its requirements, as a wheel without code for the resolver."""

from __future__ import annotations

import importlib.metadata
import re
import tomllib
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fullswarm import __version__
from fullswarm.deploy.release.layers import OWN
from fullswarm.drivers.make import built_in
from fullswarm.errors import ConfigError, did_you_mean

ONBOARD: Mapping[str, str] = {
    **{each.extra: each.robots for each in built_in() if each.extra and not each.simulated},
    "estimation": "agent.estimator = 'ekf' (brings SciPy: 25 MB)",
    "core": "the behaviour `navigate` (brings SciPy and OSQP: 30 MB)",
}
"""The extras that a robot may need, and what for. Simulators, plots and gamepads belong to the base."""
_EXTRA = re.compile(r"""^(?P<requirement>[^;]+);\s*extra\s*==\s*["'](?P<extra>[^"']+)["']\s*$""")
_LOWEST = re.compile(r">=\s*([0-9][0-9.]*)")


@dataclass(frozen=True, slots=True)
class Requirements:
    """Of fullswarm: `always`, and `extras` by name; each is ``name>=version``."""

    always: tuple[str, ...]
    extras: Mapping[str, tuple[str, ...]]

    def lowest(self, extras: tuple[str, ...]) -> dict[str, str]:
        """Return ``{package: oldest version}`` for what a release with some extras must hold."""
        lines = [*self.always, *(each for extra in extras for each in self.extras[extra])]
        found = ((name(each), _LOWEST.search(each)) for each in lines)
        return {package: match.group(1) for package, match in found if match}


def requirements() -> Requirements:
    """Return what this fullswarm requires: by its checkout, where it runs from one, else as it was installed."""
    project = OWN.parent / "pyproject.toml"
    if project.is_file():
        table = tomllib.loads(project.read_text("utf-8")).get("project", {})
        if table.get("name") == "fullswarm":  # what was installed in a checkout may be older than its pyproject
            extras = table.get("optional-dependencies", {})
            return Requirements(tuple(table["dependencies"]), {key: tuple(extras[key]) for key in ONBOARD})
    try:
        lines = importlib.metadata.requires("fullswarm") or []
    except importlib.metadata.PackageNotFoundError as error:
        hint = "pip install fullswarm, or run in a checkout"
        raise ConfigError("what fullswarm requires is not known: it is not installed", hint=hint) from error
    parts = [(line, _EXTRA.match(line)) for line in lines]
    extras = {
        key: tuple(each["requirement"].strip() for _, each in parts if each is not None and each["extra"] == key)
        for key in ONBOARD
    }
    return Requirements(tuple(line.strip() for line, match in parts if match is None and ";" not in line), extras)


def check_extras(extras: tuple[str, ...]) -> None:
    """Refuse extras that no robot runs.

    Raises
    ------
    ConfigError
        One is unknown, or belongs to the base.
    """
    for each in extras:
        if each not in ONBOARD:
            near = did_you_mean(each, ONBOARD)
            raise ConfigError(f"'{each}' is not an extra for robots", where="--with", hint=near)


def name(requirement: str) -> str:
    """Return the normal form of a requirement's package: ``Jinja2>=3.1`` → ``jinja2``."""
    match = re.match(r"\s*([A-Za-z0-9][A-Za-z0-9._-]*)", requirement)
    return re.sub(r"[-_.]+", "-", match.group(1)).lower() if match else ""


def wheel(folder: Path, needs: Requirements) -> Path:
    """Write a wheel that has fullswarm's name and requirements but no code.

    With it the resolver sees fullswarm as any other package: it reports what does not fit in fullswarm's name, and an
    outside package's ``fullswarm>=0.1`` is held against the version that goes on board.
    """
    lines = ["Metadata-Version: 2.4", "Name: fullswarm", f"Version: {__version__}", "License-Expression: Apache-2.0"]
    lines += [f"Requires-Dist: {each}" for each in needs.always]
    for extra, added in needs.extras.items():
        lines += [f"Provides-Extra: {extra}", *(f'Requires-Dist: {each} ; extra == "{extra}"' for each in added)]
    info = f"fullswarm-{__version__}.dist-info"
    content = {
        f"{info}/METADATA": "\n".join(lines) + "\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: fullswarm\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{info}/licenses/LICENSE": _licence(),
    }
    content = {path: text for path, text in content.items() if text}
    record = "".join(f"{path},,\n" for path in [*content, f"{info}/RECORD"])
    path = folder / f"fullswarm-{__version__}-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as file:
        for place, text in {**content, f"{info}/RECORD": record}.items():
            file.writestr(place, text)
    return path


def _licence() -> str:
    """Return the text of our licence, or nothing where it did not come along."""
    beside = OWN.parent / "LICENSE"
    if beside.is_file():
        return beside.read_text("utf-8")
    try:
        return importlib.metadata.distribution("fullswarm").read_text("licenses/LICENSE") or ""
    except importlib.metadata.PackageNotFoundError:
        return ""
