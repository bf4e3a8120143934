"""Chooses the Python packages of a release, and unpacks their wheels for the target: ``lib/`` and outside packages.

Fullswarm's own requirements go to the resolver as a wheel without code; outside packages (``--package``) are wheels as
they are, or folders that are built into wheels first. uv resolves for another machine than this one, never from
sources. It gets the target's newest manylinux tag, which stands for all the older ones too (2_17 = 2014, 2_24, 2_27,
2_28). Not every tool takes it so: with one tag of 2014 alone a resolver silently takes a zenoh of 2022. So the result
is compared with fullswarm's own lower bounds once more, and each library with the target's processor.
"""

from __future__ import annotations

import email
import importlib.metadata
import os
import re
import shutil
import struct
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fullswarm import __version__
from fullswarm.deploy.release.contents import OWN
from fullswarm.deploy.release.manifest import Target
from fullswarm.drivers.make import built_in
from fullswarm.errors import ConfigError, MissingExtra, Unreachable, did_you_mean

ONBOARD: Mapping[str, str] = {
    **{each.extra: each.robots for each in built_in() if each.extra and not each.simulated},
    "gnss": 'a GNSS receiver on board, `fixes = "gnss:///dev/…"`',
    "tof": 'time-of-flight sensors on board, `ranges = "vl53l1x:///dev/i2c-1?…"`',
    "core": "the behaviour `navigate` (brings SciPy and OSQP: 30 MB)",
    "keys": "a hub with certificates, `tls/…` (brings cryptography: 16 MB)",
}
"""The extras that a robot may need, and what for. Simulators, plots and gamepads belong to the base."""
_EXTRA = re.compile(r"""^(?P<requirement>[^;]+);\s*extra\s*==\s*["'](?P<extra>[^"']+)["']\s*$""")
_LOWEST = re.compile(r">=\s*([0-9][0-9.]*)")
_LEAVE = shutil.ignore_patterns(".*", "__pycache__", "build", "dist", "*.egg-info", "venv", "node_modules")
NEVER = frozenset({"matplotlib", "numba", "pybullet"})
"""Never on a robot, whatever requires them."""
HEAVY = {"scipy": ("core",)}
"""Only in a release with one of these extras."""
UNNEEDED = ("lxml",)
"""What pymavlink needs to generate dialects: left out, unless an outside package names it."""
_ELF_MACHINES = {"aarch64": 183, "x86_64": 62}
_PIN = re.compile(r"([A-Za-z0-9._-]+)==([^\s;]+)")
_HERE = Path(sys.executable).parent
_OFFLINE = ("failed to fetch", "error sending request", "could not connect", "dns error", "network connectivity")


@dataclass(frozen=True, slots=True)
class Requirements:
    """Of fullswarm: `always`, and `extras` by name; each is ``name>=version``."""

    always: tuple[str, ...]
    extras: Mapping[str, tuple[str, ...]]

    def lowest(self, extras: tuple[str, ...]) -> dict[str, str]:
        """Return ``{package: oldest version}`` for what a release with some extras must hold."""
        lines = [*self.always, *(each for extra in extras for each in self.extras[extra])]
        found = ((package_name(each), _LOWEST.search(each)) for each in lines)
        return {package: match.group(1) for package, match in found if match}


def requirements() -> Requirements:
    """Return what this fullswarm requires: by its checkout, where it runs from one, else as it was installed."""
    project = OWN.parent / "pyproject.toml"
    if project.is_file():
        table = tomllib.loads(project.read_text("utf-8")).get("project", {})
        if table.get("name") == "fullswarm":  # the installed metadata may be older than the checkout
            extras = table.get("optional-dependencies", {})
            return Requirements(tuple(table["dependencies"]), {key: tuple(extras[key]) for key in ONBOARD})
    try:
        lines = importlib.metadata.requires("fullswarm") or []
    except importlib.metadata.PackageNotFoundError as error:
        hint = "pip install fullswarm, or run in a checkout"
        raise ConfigError("the requirements of fullswarm are unknown: it is not installed", hint=hint) from error
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


def package_name(requirement: str) -> str:
    """Return the normal form of a requirement's package: ``Jinja2>=3.1`` → ``jinja2``."""
    match = re.match(r"\s*([A-Za-z0-9][A-Za-z0-9._-]*)", requirement)
    return re.sub(r"[-_.]+", "-", match.group(1)).lower() if match else ""


def code_free_wheel(folder: Path, needs: Requirements) -> Path:
    """Write a wheel that has fullswarm's name and requirements but no code.

    With it the resolver treats fullswarm as any other package: conflicts are reported in its name, and an outside
    package's ``fullswarm>=0.1`` is compared with the version that goes on board.
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
    """Return the text of our licence, or an empty text where it is missing."""
    beside = OWN.parent / "LICENSE"
    if beside.is_file():
        return beside.read_text("utf-8")
    try:
        return importlib.metadata.distribution("fullswarm").read_text("licenses/LICENSE") or ""
    except importlib.metadata.PackageNotFoundError:
        return ""


# ---------------------------------------------------------------- packages of others (--package)
@dataclass(frozen=True, slots=True)
class Outside:
    """One package: its normal name, its version, its wheel, its requirements."""

    name: str
    version: str
    wheel: Path
    requires: tuple[str, ...]


def find_outside(path: Path, work: Path, wheels: Path | None) -> Outside:
    """Return the package that a wheel or a folder with a ``pyproject.toml`` is; `work` is a scratch folder.

    Raises
    ------
    ConfigError
        It is neither, cannot be built, or a folder's package has parts that are compiled.
    """
    path = path.absolute()
    if path.is_dir() and (path / "pyproject.toml").is_file():
        return _read(_build(path, work, wheels))
    if path.is_file() and path.suffix == ".whl":
        return _read(path)
    hint = "a .whl, or a folder with a pyproject.toml"
    raise ConfigError("not a package", where=f"--package {path}", hint=hint)


def _build(folder: Path, work: Path, wheels: Path | None) -> Path:
    # A copy: building leaves folders behind, and stale files of an old `build/` would get into the wheel.
    number = sum(1 for each in work.glob("built-*"))
    source, out = work / f"source-{number}" / folder.name, work / f"built-{number}"
    shutil.copytree(folder, source, ignore=_LEAVE)
    offline: list[str | Path] = [] if wheels is None else ["--no-index", "--find-links", wheels]
    run_uv(
        work,
        "build",
        "--quiet",
        "--wheel",
        "--python",
        sys.executable,
        *offline,
        "--out-dir",
        out,
        source,
        why=f"build {folder}",
    )
    made = list(out.glob("*.whl"))
    if len(made) != 1 or not made[0].name.endswith("-any.whl"):
        what = "it has compiled parts, which would be for this machine instead of the robot"
        raise ConfigError(
            what, where=f"--package {folder}", hint="build its wheel on such a robot, and give that wheel"
        )
    return made[0]


def _read(wheel: Path) -> Outside:
    try:
        with zipfile.ZipFile(wheel) as file:
            inside = next(each for each in file.namelist() if re.fullmatch(r"[^/]+\.dist-info/METADATA", each))
            facts = email.message_from_bytes(file.read(inside))
        return Outside(
            package_name(facts["Name"]), facts["Version"], wheel, tuple(facts.get_all("Requires-Dist") or ())
        )
    except (zipfile.BadZipFile, StopIteration, KeyError, TypeError) as error:
        raise ConfigError("not a wheel", where=f"--package {wheel}", hint="build it again") from error


# ---------------------------------------------------------------- resolve and unpack
@dataclass(frozen=True, slots=True)
class Wanted:
    """What to resolve: for which target, with which extras and outside packages, near which versions of before.

    ``wheels`` is a folder to take all wheels from instead of an index.
    """

    target: Target
    extras: tuple[str, ...] = ()
    outside: tuple[Outside, ...] = ()
    before: Mapping[str, str] | None = None
    wheels: Path | None = None

    def platform(self) -> list[str | Path]:
        """Return uv's options for the target."""
        # Named, because uv would otherwise search all interpreters of the machine.
        options: list[str | Path] = ["--python", sys.executable, "--python-platform", self.target.manylinux]
        options += ["--python-version", self.target.python, "--only-binary", ":all:"]
        if self.wheels is not None:
            options += ["--no-index", "--find-links", self.wheels]
        return options


def resolve(wanted: Wanted, work: Path) -> dict[str, str]:
    """Return ``{package: version}`` of all that goes into ``lib/``; `work` is a scratch folder.

    Raises
    ------
    ConfigError
        A package has no wheel for the target, or the result breaks a rule below.
    Unreachable
        No package index answers.
    """
    needs = requirements()
    code_free = code_free_wheel(work, needs)
    extras = f"[{','.join(wanted.extras)}]" if wanted.extras else ""
    lines = [f"fullswarm{extras} @ {code_free.as_uri()}"]
    lines += [f"{each.name} @ {each.wheel.as_uri()}" for each in wanted.outside]
    asked = {package_name(line) for each in wanted.outside for line in each.requires}
    _write(work / "wanted.in", lines)
    _write(work / "left-out.txt", [f"{each} ; python_version < '3'" for each in UNNEEDED if each not in asked])
    # Versions in the file are kept wherever they fit: those that robots have on board.
    _write(work / "lib.txt", [f"{name}=={version}" for name, version in (wanted.before or {}).items()])
    run_uv(
        work,
        *("pip", "compile", "--quiet", "wanted.in", "--output-file", "lib.txt", "--override", "left-out.txt"),
        *("--no-header", "--no-annotate", "--no-strip-extras", *wanted.platform()),
        *(
            part
            for each in ("fullswarm", *(one.name for one in wanted.outside))
            for part in ("--no-emit-package", each)
        ),
        why=f"find the packages for {wanted.target.name} with Python {wanted.target.python}",
    )
    plan = {package_name(match[1]): match[2] for match in _PIN.finditer((work / "lib.txt").read_text("utf-8"))}
    check_versions(plan, needs, wanted.extras)
    return plan


def check_versions(plan: Mapping[str, str], needs: Requirements, extras: tuple[str, ...]) -> None:
    """Compare resolved versions with fullswarm's own bounds, and with what must not be on a robot.

    Raises
    ------
    ConfigError
        A package is too old or missing, or one that does not belong on board.
    """
    wrong = []
    for package, lowest in needs.lowest(extras).items():
        found = plan.get(package)
        if found is None and package not in UNNEEDED:
            wrong.append(f"{package} is missing")
        elif found is not None and _numbers(found) < _numbers(lowest):
            wrong.append(f"{package} {found} is too old: fullswarm needs {lowest} or newer")
    wrong += [f"{each} must not be on a robot" for each in sorted(NEVER & set(plan))]
    for package, by in HEAVY.items():
        if package in plan and not set(by) & set(extras):
            wrong.append(f"{package} must not be on a robot, unless asked for: --with {by[-1]}")
    if wrong:
        hint = "an outside package may ask for it; or the index has no newer wheel for this target"
        raise ConfigError(f"the packages found do not do: {'; '.join(wrong)}", hint=hint)


def _numbers(version: str) -> tuple[int, ...]:
    """Return the leading numbers of a version: ``0.10.0rc0`` → (0, 10, 0)."""
    match = re.match(r"[0-9]+(\.[0-9]+)*", version)
    numbers = [int(each) for each in match[0].split(".")] if match else []
    while numbers and numbers[-1] == 0:
        numbers.pop()  # 1.10.0 is not newer than 1.10
    return tuple(numbers)


def install_packages(wanted: Wanted, plan: Mapping[str, str], work: Path, lib: Path) -> None:
    """Unpack the planned packages to `lib`."""
    _write(work / "exact.txt", [f"{name}=={version}" for name, version in sorted(plan.items())])
    _unpack(wanted, work, lib, "-r", "exact.txt", why="get the packages")
    check_there(lib, plan)
    check_machine(lib, wanted.target)


def install_outside(wanted: Wanted, work: Path, app: Path) -> None:
    """Unpack outside packages, and fullswarm's own name and licence, to `app`."""
    wheels = [work / path.name for path in sorted(work.glob("fullswarm-*.whl"))] + [
        each.wheel for each in wanted.outside
    ]
    _unpack(wanted, work, app, *wheels, why="unpack the outside packages")
    check_there(app, {each.name: each.version for each in wanted.outside})
    check_machine(app, wanted.target)


def _unpack(wanted: Wanted, work: Path, place: Path, *what: str | Path, why: str) -> None:
    # Copied: a hard link into uv's cache would share modes and later changes with the release.
    options = (
        "--no-deps",
        "--link-mode",
        "copy",
        "--no-compile-bytecode",
        "--target",
        place.absolute(),
    )  # uv runs in `work`
    run_uv(work, "pip", "install", "--quiet", *options, *wanted.platform(), *what, why=why)


def check_there(folder: Path, plan: Mapping[str, str]) -> None:
    """Check that each planned package is in `folder`: what is signed must match the manifest.

    Raises
    ------
    ConfigError
        One does not.
    """
    there = {package_name(each.name.split("-")[0]) for each in folder.glob("*.dist-info")}
    if missing := sorted(set(map(package_name, plan)) - there):
        raise ConfigError(f"these packages were not unpacked: {', '.join(missing)}", where=str(folder))


def check_machine(folder: Path, target: Target) -> None:
    """Check that every native library is for the target's processor.

    Raises
    ------
    ConfigError
        One is not.
    """
    for path in folder.rglob("*.so*"):
        with path.open("rb") as file:
            head = file.read(20)
        if head[:4] == b"\x7fELF" and struct.unpack_from("<H", head, 18)[0] != _ELF_MACHINES[target.arch]:
            what = f"this library is not for {target.arch}"
            raise ConfigError(what, where=str(path.relative_to(folder)), hint="use a wheel that was built for it")


def _write(path: Path, lines: list[str]) -> None:
    path.write_text("".join(f"{each}\n" for each in lines), "utf-8")


# ---------------------------------------------------------------- uv
def run_uv(folder: Path, *arguments: str | Path, why: str) -> str:
    """Run uv in `folder` and return its stdout; `why` is the purpose, for errors.

    Raises
    ------
    MissingExtra
        uv is not installed.
    Unreachable
        The package index does not answer.
    ConfigError
        uv fails, for instance because a package has no wheel for the target.
    """
    tool = shutil.which("uv", path=f"{_HERE}{os.pathsep}{os.environ.get('PATH', '')}")
    if tool is None:
        raise MissingExtra(f"cannot {why}: uv is not installed", hint="pip install 'fullswarm[deploy]'")
    settings = {**os.environ, "UV_PYTHON_DOWNLOADS": "never", "UV_NO_PROGRESS": "1", "NO_COLOR": "1"}
    done = subprocess.run(  # noqa: S603  (uv itself; no shell)
        [tool, *map(str, arguments)], cwd=folder, env=settings, capture_output=True, text=True, check=False
    )
    if done.returncode == 0:
        return done.stdout
    words = " ".join(done.stderr.split()).removeprefix("error: ") or f"uv ended with {done.returncode}"
    if any(each in words.lower() for each in _OFFLINE):
        hint = "connect, or give a folder of wheels: --wheels DIR"
        raise Unreachable(f"cannot {why}: no package index answers: {words}", hint=hint)
    raise ConfigError(f"cannot {why}: {words}")
