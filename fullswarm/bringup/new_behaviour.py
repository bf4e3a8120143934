"""Runs `fullswarm behaviours new NAME`: writes a control law, its record and its test into the package around here.

Where there is no package, it makes a lab as `fullswarm init` does, and writes them there.
"""

from __future__ import annotations

import keyword
import os
import re
import sys
import tomllib
from pathlib import Path
from typing import Any

from fullswarm import output, registry
from fullswarm.bringup.init import TEMPLATES, lab_files, write
from fullswarm.core.behaviours import load_records
from fullswarm.errors import ConfigError

PROJECT = "pyproject.toml"
NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*\Z")
LONGEST_NAME = 60  # with `_bc` behind it a name of the bus


def run(name: str, *, centralised: bool, folder: Path) -> int:
    """Write the files and print them.

    Raises
    ------
    ConfigError
        The name is not valid or taken, a file exists, or the package's `pyproject.toml` cannot be extended.
    """
    law = name.replace("-", "_")
    project = _project_of(folder)
    _check_name(law, name)
    if project is None:
        project = folder / f"{law.replace('_', '-')}-lab"
        if project.exists():
            raise ConfigError(
                "exists already", where=str(project), hint="name another behaviour, or run this inside it"
            )
        files = {project / path: text for path, text in lab_files(project.name, str(project)).items()}
    else:
        files = {project / PROJECT: _read(project / PROJECT)}
    package = _package(files[project / PROJECT], project, files)
    text = _with_entry(files[project / PROJECT], package, law, centralised=centralised, where=str(project / PROJECT))
    files[project / PROJECT] = text
    new = _law_files(law, package, centralised=centralised)
    places = {_package_folder(project, package) / file: body for file, body in new.items() if "test_" not in file}
    places |= {project / "tests" / file: body for file, body in new.items() if "test_" in file}
    for path in places:
        if path.exists():
            raise ConfigError("exists already", where=str(path), hint="name another behaviour; nothing was written")
    write(files | places)
    for path in files | places:
        output.data(os.path.relpath(path))
    output.progress(_next_steps(law, project, centralised=centralised))
    return 0


def _check_name(law: str, name: str) -> None:
    if not NAME.match(law) or len(law) > LONGEST_NAME or keyword.iskeyword(law):
        hint = "lower case: a letter first, then letters, digits and '_'; e.g. fullswarm behaviours new orbit"
        raise ConfigError(f"'{name}' is not a valid name of a behaviour", hint=hint)
    if law in (*registry.law_names(), *registry.centralised_names()) or law in load_records():
        raise ConfigError(f"a behaviour '{law}' exists already", hint="give yours another name")


def _project_of(folder: Path) -> Path | None:
    """Return the nearest folder at or above `folder` that is a Python package's; None: there is none."""
    here = folder.resolve()
    for each in (here, *here.parents):
        if (each / PROJECT).is_file():
            return each
    return None


def _read(path: Path) -> str:
    try:
        return path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot be read: {error}", where=str(path)) from error


def _parsed(text: str, where: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(str(error), where=where, hint="correct the file first") from error


def _package(text: str, project: Path, files: dict[Path, str]) -> str:
    """Return the name of the importable package: of its entry points, or the only one that there is."""
    parsed = _parsed(text, str(project / PROJECT))
    groups = parsed.get("project", {}).get("entry-points", {})
    for group in (registry.BEHAVIOUR_GROUP, registry.CENTRALISED_GROUP):
        for target in groups.get(group, {}).values():
            return str(target).partition(":")[0].partition(".")[0]
    roots = [project / "src"] if (project / "src").is_dir() else [project]
    found = sorted({path.parent.name for root in roots for path in root.glob("*/__init__.py")} - {"tests", "docs"})
    found += [path.parent.name for path in files if path.name == "__init__.py" and path.parent.name not in found]
    if len(found) != 1:
        what = f"several packages: {', '.join(found)}" if found else "no package (a folder with __init__.py)"
        raise ConfigError(
            f"there is {what}", where=str(project),
            hint="run this where there is no pyproject.toml, and it makes one, or add the entry point of a behaviour "
            "to tell it which",
        )  # fmt: skip
    return found[0]


def _package_folder(project: Path, package: str) -> Path:
    return project / "src" / package if (project / "src" / package).is_dir() else project / package


def _with_entry(text: str, package: str, law: str, *, centralised: bool, where: str) -> str:
    """Return a `pyproject.toml` with one more entry point, and with records among the package's data."""
    group = registry.CENTRALISED_GROUP if centralised else registry.BEHAVIOUR_GROUP
    declared = _parsed(text, where).get("project", {}).get("entry-points", {})
    if any(law in each for each in declared.values()):
        raise ConfigError(f"a behaviour '{law}' exists already", where=where, hint="give yours another name")
    header, entry = f'[project.entry-points."{group}"]', f'{law} = "{package}.{law}"'
    lines = text.splitlines()
    if header in [line.strip() for line in lines]:
        at = [line.strip() for line in lines].index(header) + 1
        while at < len(lines) and lines[at].strip() and not lines[at].lstrip().startswith("["):
            at += 1
        lines.insert(at, entry)
    else:
        lines += ["", header, entry]
    setuptools = _parsed(text, where).get("tool", {}).get("setuptools", {})
    if "package-data" not in setuptools and "setuptools" in str(_parsed(text, where).get("build-system", {})):
        lines += ["", "[tool.setuptools.package-data]", f'{package} = ["*.toml"]']
    extended = "\n".join(lines) + "\n"
    groups = _parsed(extended, where)["project"].get("entry-points", {})
    if groups.get(group, {}).get(law) != f"{package}.{law}":
        raise ConfigError("cannot be extended", where=where, hint=f"add {entry} below {header} yourself")
    return extended


def _law_files(law: str, package: str, *, centralised: bool) -> dict[str, str]:
    stem = "central" if centralised else "law"
    made = {}
    for template, file in (
        (f"{stem}.py", f"{law}.py"),
        (f"{stem}.toml", f"{law}.toml"),
        (f"test_{stem}.py", f"test_{law}.py"),
    ):
        text = (TEMPLATES / f"{template}.in").read_text("utf-8")
        title = law.replace("_", " ").capitalize()
        made[file] = text.replace("@LAW@", law).replace("@PACKAGE@", package).replace("@TITLE@", title)
    return made


def _next_steps(law: str, project: Path, *, centralised: bool) -> str:
    where = "" if project == Path.cwd() else f"  cd {os.path.relpath(project)}\n"
    values = "--set start=2,4 --set end=6,4" if centralised else "--set goal=4,4"
    return (
        f"Next:\n{where}"
        f"  {Path(sys.executable).name} -m pytest tests/test_{law}.py    # if there is no pytest: pip install pytest\n"
        "  fullswarm up lab.toml --reload        # loads the law again whenever you save it; --console: shows a page\n"
        "and in another terminal\n"
        f"  fullswarm request {law}_bc {values} --wait\n"
        "For robots and other users: pip install -e ."
    )
