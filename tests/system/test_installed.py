"""The wheel as a user installs it: everything is in it, and it works without the checkout."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
import tarfile
import urllib.request
import zipfile
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest

ROOT = Path(__file__).parents[2]
FOR_DEVELOPERS = ("README.md", ".d.ts")
"""Endings of files beside the code that are of no use where it is installed."""


def run(*words: object, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [str(each) for each in words],
        cwd=folder, env={**os.environ, **environment},
        capture_output=True, text=True, timeout=120.0, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def tracked() -> list[str]:
    return run("git", "ls-files", "-z", folder=ROOT).stdout.split("\0")[:-1]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory, tracked: list[str]) -> Path:
    """Build in a copy: a checkout may hold files of an earlier build, which setuptools would take along."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    for name in tracked:
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", out, source, folder=out)
    return out


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory, built: Path) -> Path:
    """Install the wheel into an environment of its own, which borrows only the dependencies of this one."""
    folder = tmp_path_factory.mktemp("environment")
    run(sys.executable, "-m", "venv", "--without-pip", folder, folder=folder)
    python = folder / "bin" / "python"
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", python, "install", "--quiet")
    run(*pip, "--no-deps", "--no-index", "--no-compile", *built.glob("*.whl"), folder=folder)
    packages = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", folder=folder).stdout.strip()
    # A path in a .pth file is only searched: the .pth by which the checkout is installed there has no effect here.
    (Path(packages) / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return python


@pytest.fixture
def fullswarm(python: Path, tmp_path: Path) -> Iterator[list[str]]:
    """Return the installed command, and check that nothing of it comes from the checkout."""
    found = run(python, "-c", "import fullswarm; print(fullswarm.__file__)", folder=tmp_path).stdout
    assert Path(found).is_relative_to(python.parents[1])
    yield [str(python.parent / "fullswarm")]
    assert not any(path.suffix == ".py" for path in tmp_path.rglob("*"))


def plain(command: list[str], *words: str, folder: Path) -> str:
    """Run the installed command with plain kernels: compiling takes longer than what is run."""
    return run(*command, *words, folder=folder, NUMBA_DISABLE_JIT="1").stdout


def test_the_wheel_holds_what_git_tracks_and_nothing_else(built: Path, tracked: list[str]) -> None:
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as file:
        inside = {name for name in file.namelist() if ".dist-info/" not in name}
    wanted = {each for each in tracked if each.startswith("fullswarm/") and (ROOT / each).is_file()}
    assert inside == {each for each in wanted if not each.endswith(FOR_DEVELOPERS)}


def test_the_source_archive_holds_the_same_and_no_tests(built: Path) -> None:
    (archive,) = built.glob("*.tar.gz")
    with tarfile.open(archive) as file:
        inside = {"/".join(name.split("/")[1:]) for name in file.getnames()}
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as packed:
        assert inside >= {name for name in packed.namelist() if ".dist-info/" not in name}
    tops = {name.split("/")[0] for name in inside if name}
    assert tops == {
        "LICENSE",
        "PKG-INFO",
        "README.md",
        "fullswarm",
        "fullswarm.egg-info",
        "pyproject.toml",
        "setup.cfg",
    }


def test_what_only_prints(fullswarm: list[str], python: Path, tmp_path: Path) -> None:
    version = run(python, "-c", "import importlib.metadata as m; print(m.version('fullswarm'))", folder=tmp_path).stdout
    assert plain(fullswarm, "--version", folder=tmp_path) == version
    assert "agent" in plain(fullswarm, "guide", folder=tmp_path)
    assert json.loads(plain(fullswarm, "schema", "RobotStates", "--json", folder=tmp_path))


def test_a_demo_and_an_experiment_in_lockstep(fullswarm: list[str], tmp_path: Path) -> None:
    show = json.loads(plain(fullswarm, "demo", "--lockstep", "--seconds", "5", "--json", folder=tmp_path))
    assert len(show["robots"]) == 8
    cell = ("--small", "--seeds", "0", "--cells", "behaviour=move_to_goal_bc,scenario=empty,robots=8", "--jobs", "1")
    done = json.loads(plain(fullswarm, "experiment", "run", "paper", *cell, "--json", folder=tmp_path))
    assert (done["trials_done"], done["trials_failed"]) == (1, 0)


def test_the_console_serves_its_page_and_each_script(fullswarm: list[str], tmp_path: Path, tracked: list[str]) -> None:
    process = subprocess.Popen(
        [*fullswarm, "console", "--listen", "127.0.0.1:0", "--hub", "tcp/127.0.0.1:9", "--json"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        address = urlsplit(json.loads(process.stdout.readline())["url"])
        page = "fullswarm/operator/console/page/"
        files = [each for each in tracked if each.startswith(page) and each.endswith((".js", ".css", ".svg"))]
        served = {"/": f"{page}index.html"} | {f"/page/{each.removeprefix(page)}": each for each in files}
        for place, file in served.items():
            with urllib.request.urlopen(f"http://{address.netloc}{place}", timeout=10) as answer:
                assert answer.read() == (ROOT / file).read_bytes()
    finally:
        process.terminate()
        process.communicate(timeout=20)
