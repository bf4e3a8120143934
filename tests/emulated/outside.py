"""Installs an example package of `examples/` as pip would, into a folder of its own, and runs modules with it."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

EXAMPLES = Path(__file__).parents[2] / "examples"


def install(package: Path, module: str, folder: Path) -> Path:
    """Return `folder`, with what pip would put there: the package and its entry points."""
    project = tomllib.loads((package / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (folder / module).symlink_to(package / module)
    record = folder / f"{module}-{project['version']}.dist-info"
    record.mkdir()
    head = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    (record / "METADATA").write_text(head, encoding="utf-8")
    lines = [f"[{group}]\n{name} = {target}\n" for group, table in project["entry-points"].items()
             for name, target in table.items()]  # fmt: skip
    (record / "entry_points.txt").write_text("".join(lines), encoding="utf-8")
    return folder


def paths(installed: Path, package: Path) -> dict[str, str]:
    """Return the environment in which the package is installed."""
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(installed), str(package), str(package.parents[1])])}


def python(installed: Path, package: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a module with the package installed."""
    return subprocess.run(
        [sys.executable, "-m", *arguments], cwd=package, env=paths(installed, package), check=False,
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
