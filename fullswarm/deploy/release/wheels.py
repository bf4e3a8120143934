"""Which packages go on board, in which versions, and their files for the target: the layer ``lib/``.

uv is told the target's newest manylinux tag, which stands for all the older ones too (2_17 = 2014, 2_24, 2_27, 2_28).
Not every tool takes it so: one tag of the year 2014 alone makes a resolver take a zenoh of 2022 without a word. So the
result is held against fullswarm's own lower bounds once more, and each library against the target's processor.
"""

from __future__ import annotations

import re
import struct
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fullswarm.deploy.release import own, uv
from fullswarm.deploy.release.manifest import Target
from fullswarm.deploy.release.outside import Outside
from fullswarm.errors import ConfigError

NEVER = frozenset({"matplotlib", "numba", "pybullet"})
"""No robot runs these, whatever asks for them."""
HEAVY = {"scipy": ("core", "estimation")}
"""Only in a release that was asked for one of these extras."""
UNNEEDED = ("lxml", "matplotlib")
"""What pymavlink needs to generate dialects, and filterpy to draw: left out, unless an outside package names it."""
_ELF_MACHINES = {"aarch64": 183, "x86_64": 62}
_PIN = re.compile(r"([A-Za-z0-9._-]+)==([^\s;]+)")


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
        # This interpreter only carries out what is asked: without it uv looks through all that the machine has.
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
        A package has no wheel for the target, or the outcome breaks a rule of ours.
    Unreachable
        No index answers.
    """
    needs = own.requirements()
    code_free = own.wheel(work, needs)
    extras = f"[{','.join(wanted.extras)}]" if wanted.extras else ""
    lines = [f"fullswarm{extras} @ {code_free.as_uri()}"]
    lines += [f"{each.name} @ {each.wheel.as_uri()}" for each in wanted.outside]
    asked = {own.name(line) for each in wanted.outside for line in each.requires}
    _write(work / "wanted.in", lines)
    _write(work / "left-out.txt", [f"{each} ; python_version < '3'" for each in UNNEEDED if each not in asked])
    # What the file holds already is kept wherever it still fits: the versions that robots have on board.
    _write(work / "lib.txt", [f"{name}=={version}" for name, version in (wanted.before or {}).items()])
    uv.run(
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
    plan = {own.name(match[1]): match[2] for match in _PIN.finditer((work / "lib.txt").read_text("utf-8"))}
    check(plan, needs, wanted.extras)
    return plan


def check(plan: Mapping[str, str], needs: own.Requirements, extras: tuple[str, ...]) -> None:
    """Hold resolved versions against fullswarm's own bounds, and against what robots must not carry.

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


def install(wanted: Wanted, plan: Mapping[str, str], work: Path, lib: Path) -> None:
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
    # Copied: a hard link into uv's cache would share the modes that we set, and whatever happens to the release.
    options = (
        "--no-deps",
        "--link-mode",
        "copy",
        "--no-compile-bytecode",
        "--target",
        place.absolute(),
    )  # uv runs in `work`
    uv.run(work, "pip", "install", "--quiet", *options, *wanted.platform(), *what, why=why)


def check_there(folder: Path, plan: Mapping[str, str]) -> None:
    """Check that each planned package lies in `folder`: what is signed must be what the manifest says.

    Raises
    ------
    ConfigError
        One does not.
    """
    there = {own.name(each.name.split("-")[0]) for each in folder.glob("*.dist-info")}
    if missing := sorted(set(map(own.name, plan)) - there):
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
            raise ConfigError(what, where=str(path.relative_to(folder)), hint="bring a wheel that was built there")


def _write(path: Path, lines: list[str]) -> None:
    path.write_text("".join(f"{each}\n" for each in lines), "utf-8")
