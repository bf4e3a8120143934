"""Real releases: fullswarm's own packages from the index, for robots of another processor, run on a bare Python."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from fullswarm.deploy.release import manifest
from fullswarm.deploy.release.contents import OWN
from fullswarm.deploy.release.keys import Keys, verify_release
from fullswarm.deploy.release.manifest import Manifest
from fullswarm.deploy.release.packages import requirements, run_uv
from fullswarm.deploy.release.targets import THIS_PYTHON
from fullswarm.errors import Unreachable

MEGABYTE = 1_000_000
NEVER = {"pybullet", "numba", "matplotlib"}


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return the environment of a base of its own; skip without a package index."""
    place = tmp_path_factory.mktemp("base")
    (place / "wanted.in").write_text("tomlkit\n")
    try:
        run_uv(place, "pip", "compile", "--quiet", "--refresh", "wanted.in", why="ask the index")
    except Unreachable as error:
        pytest.skip(f"no package index can be reached; connect this machine to one: {error}")
    source = place / "source"
    shutil.copytree(OWN, source / "fullswarm", ignore=shutil.ignore_patterns("__pycache__"))
    for each in ("pyproject.toml", "LICENSE"):
        shutil.copy(OWN.parent / each, source)
    return {
        **os.environ,
        "PYTHONPATH": str(source),
        "FULLSWARM_KEYS": str(place / "keys"),
        "FULLSWARM_RELEASES": str(place / "releases"),
    }


def _bundle(base: dict[str, str], *options: str) -> dict[str, Any]:
    command = [sys.executable, "-P", "-m", "fullswarm", "bundle", "--json", *options]
    done = subprocess.run(command, env=base, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout))


def _bare(release: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a module of a release as a robot does: nothing but its two layers, no environment of this one."""
    path = f"{release / 'app'}{os.pathsep}{release / 'lib'}"
    python = Path(sys.base_prefix) / "bin" / f"python{THIS_PYTHON}"
    command = [str(python), "-s", "-S", "-P", *words]
    variables = {"PATH": "/usr/bin:/bin", "PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(command, env=variables, cwd="/", capture_output=True, text=True, check=False)


def test_a_pi_gets_a_small_release_and_then_only_what_changed(base: dict[str, str]) -> None:
    first = _bundle(base, "--target", "rpi-arm64", "--with", "mavlink,can")
    release = Path(first["folder"])
    verify_release(release, Keys(Path(base["FULLSWARM_KEYS"])).allowed_signers())
    lowest = requirements().lowest(("can", "mavlink"))
    assert set(lowest) <= set(first["packages"])
    assert not (NEVER | {"scipy", "lxml"}) & set(first["packages"])
    assert first["bytes"] < 110 * MEGABYTE
    assert first["changed_bytes_gzipped"] < 35 * MEGABYTE
    node = Path(base["PYTHONPATH"]) / "fullswarm" / "agent" / "node.py"
    node.write_text(node.read_text() + "# a change\n")
    second = _bundle(base, "--target", "rpi-arm64", "--with", "mavlink,can")
    assert second["since"] == first["id"] != second["id"]
    assert second["packages"] == first["packages"]
    assert second["changed_bytes_gzipped"] < MEGABYTE
    place = Path(second["folder"])
    fresh = [each for each in manifest.files_of(place) if (place / each).stat().st_nlink == 1]
    assert sum((place / each).stat().st_size for each in fresh) < MEGABYTE, "bytes that the disk holds for it alone"


@pytest.mark.slow
def test_this_machines_release_runs_on_a_bare_python(base: dict[str, str]) -> None:
    release = Path(_bundle(base, "--target", "x86_64", "--with", "mavlink,can")["folder"])
    assert _bare(release, "-m", "fullswarm", "agent", "--help").returncode == 0
    modules = (
        "fullswarm.launch.processes, fullswarm.launch.nodes, fullswarm.agent.node, pymavlink.dialects.v20.ardupilotmega"
    )
    drivers = "fullswarm.drivers.create_oi.driver, fullswarm.drivers.mavlink.driver, fullswarm.drivers.can, can, zenoh"
    done = _bare(
        release, "-c", f"import {modules}, {drivers}; print(zenoh.__file__, zenoh.open(zenoh.Config()).close())"
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(release / "lib"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "must"),
    [
        (("--target", "rpi-arm64", "--python", "3.13"), "numpy"),
        (("--target", "jetson", "--python", "3.11", "--with", "core"), "osqp"),
        (("--target", "x86_64", "--python", "3.14"), "eclipse-zenoh"),
    ],
)
def test_other_computers(base: dict[str, str], options: tuple[str, ...], must: str) -> None:
    made = _bundle(base, *options)
    assert must in made["packages"]
    assert not NEVER & set(made["packages"])
    assert Manifest.read(Path(made["folder"])).target.name == options[1]


@pytest.mark.slow
def test_an_installed_fullswarm_bundles_as_a_checkout_does(base: dict[str, str], tmp_path: Path) -> None:
    source, place = Path(base["PYTHONPATH"]), tmp_path / "installed"
    (source / "README.md").touch()
    run_uv(tmp_path, "build", "--quiet", "--wheel", "--out-dir", tmp_path, source, why="build fullswarm")
    wheel = next(tmp_path.glob("*.whl"))
    run_uv(tmp_path, "pip", "install", "--quiet", "--no-deps", "--target", place, wheel, why="install it")
    there = {**base, "FULLSWARM_RELEASES": str(tmp_path / "one"), "PYTHONPATH": str(place)}
    here = {**base, "FULLSWARM_RELEASES": str(tmp_path / "two")}
    assert _bundle(there, "--target", "rpi-arm64")["id"] == _bundle(here, "--target", "rpi-arm64")["id"]


@pytest.mark.slow
def test_the_examples_go_on_board(base: dict[str, str]) -> None:
    examples = OWN.parent / "examples"
    options = [f"--package={examples / each}" for each in ("outside_driver", "outside_behaviour")]
    release = Path(_bundle(base, "--target", "x86_64", *options)["folder"])
    ask = "from fullswarm import registry; print(registry.driver_class('acme://127.0.0.1:1').__name__)"
    done = _bare(release, "-c", ask)
    assert done.stdout.strip() == "AcmeDriver", done.stderr
