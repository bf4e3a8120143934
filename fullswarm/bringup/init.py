"""Runs `fullswarm init my-lab`: writes a folder with a fleet file, a behaviour and its test."""

from __future__ import annotations

import importlib.util
import keyword
import os
import re
import sys
from pathlib import Path

from fullswarm import output
from fullswarm.errors import ConfigError

TEMPLATES = Path(__file__).with_name("lab")
NAME = re.compile(r"[A-Za-z][A-Za-z0-9]*([_-][A-Za-z0-9]+)*\Z")
LONGEST_NAME = 64
FILES = {  # template: where it goes
    "lab.toml.in": "lab.toml",
    "README.md.in": "README.md",
    "pyproject.toml.in": "pyproject.toml",
    "gitignore.in": ".gitignore",
    "init.py.in": "@PACKAGE@/__init__.py",
    "ring.py.in": "@PACKAGE@/ring.py",
    "ring.toml.in": "@PACKAGE@/ring.toml",
    "test_ring.py.in": "tests/test_ring.py",
}


def run(folder: Path, *, dry_run: bool) -> int:
    """Write the lab into `folder` and print its files; with `dry_run` only print them.

    Raises
    ------
    ConfigError
        The folder is not empty, cannot be written, or its name is not valid for a package.
    """
    folder = Path(os.path.normpath(folder))  # a/../b is b, also when there is no a
    name = folder.resolve().name
    files = {folder / path: text for path, text in lab_files(name, str(folder)).items()}
    _check_empty(folder)
    if not dry_run:
        write(files)
    for path in files:
        output.data(str(path))
    output.progress("nothing was written" if dry_run else next_steps(folder))
    return 0


def lab_files(name: str, where: str = "") -> dict[str, str]:
    """Return the files of a lab called `name`, by their path inside it.

    Raises
    ------
    ConfigError
        `name` is not valid for a package, or one of that name exists.
    """
    package = package_name(name, where or name)

    def filled(text: str) -> str:
        return text.replace("@NAME@", name).replace("@PACKAGE@", package)

    return {filled(path): filled((TEMPLATES / template).read_text("utf-8")) for template, path in FILES.items()}


def package_name(name: str, where: str) -> str:
    """Return the name of the lab's Python package.

    Raises
    ------
    ConfigError
        It could not be imported, or would hide something else.
    """
    package = name.lower().replace("-", "_")
    if not NAME.match(name) or len(name) > LONGEST_NAME or keyword.iskeyword(package):
        hint = "a letter first, then letters, digits, '-' and '_'; e.g. fullswarm init my-lab"
        raise ConfigError(f"'{name}' is not a valid name of a lab", where=where, hint=hint)
    if package in ("tests", *sys.stdlib_module_names) or _installed(package):
        raise ConfigError(f"a Python package '{package}' exists already", where=where, hint="give the lab another name")
    return package


def next_steps(folder: Path) -> str:
    """Return the next commands."""
    place = "" if folder.resolve() == Path.cwd() else f"  cd {folder}\n"
    return (
        "Next:\n"
        f"{place}"
        "  pip install -e '.[test]' && pytest\n"
        "  fullswarm up lab.toml\n"
        "and in another terminal\n"
        "  fullswarm request ring_bc --set centre=4,4 --wait\n"
        "  fullswarm watch"
    )


def _installed(package: str) -> bool:
    # The working folder is on the path of `python -m fullswarm`: a lab that was made there before must not count.
    before = sys.path[:]
    sys.path[:] = [each for each in before if each and Path(each).resolve() != Path.cwd()]
    try:
        return importlib.util.find_spec(package) is not None
    finally:
        sys.path[:] = before


def _check_empty(folder: Path) -> None:
    try:
        holds = sorted(each.name for each in folder.iterdir()) if folder.exists() else []
    except NotADirectoryError:
        raise ConfigError("is a file", where=str(folder), hint="name a new folder") from None
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", where=str(folder), hint="name another folder") from error
    if holds:
        some = ", ".join(holds[:3]) + (", …" if len(holds) > 3 else "")
        raise ConfigError(f"is not empty: {some}", where=str(folder), hint="name a new folder; nothing was written")


def write(files: dict[Path, str]) -> None:
    """Write texts to their files, making folders; ``ConfigError`` for one that cannot be written."""
    for path, text in files.items():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, "utf-8")
        except OSError as error:
            what = f"cannot be written: {error.strerror}"
            raise ConfigError(what, where=str(path), hint="name a folder that you may write to") from error
