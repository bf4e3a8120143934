"""Other people's behaviours and drivers in a release."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import fullswarm
from fullswarm.deploy.release import contents, manifest, targets
from fullswarm.deploy.release.bundle import BundleRequest, make, plan
from fullswarm.deploy.release.keys import Keys
from fullswarm.deploy.release.manifest import Manifest
from fullswarm.deploy.release.store import Store
from fullswarm.errors import ConfigError
from tests.unit import wheelhouse

PI = targets.target("rpi-arm64")
EXAMPLE = Path(__file__).parents[2] / "examples" / "outside_driver"
BACKEND = """
import zipfile

def build_wheel(place, config_settings=None, metadata_directory=None):
    name, info = "orbit-0.3-py3-none-any.whl", "orbit-0.3.dist-info"
    with zipfile.ZipFile(f"{place}/{name}", "w") as file:
        file.write("orbit/__init__.py")
        file.writestr(f"{info}/METADATA", "Metadata-Version: 2.1\\nName: orbit\\nVersion: 0.3\\n")
        file.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\\nRoot-Is-Purelib: true\\nTag: py3-none-any\\n")
        file.writestr(f"{info}/RECORD", "")
    return name
"""


@pytest.fixture(autouse=True)
def _ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contents, "OWN", wheelhouse.small_fullswarm(tmp_path / "fullswarm"))


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")


@pytest.fixture
def house(tmp_path: Path) -> Path:
    return wheelhouse.fill(tmp_path / "wheels")


def test_a_wheel_goes_into_the_app_layer_and_its_needs_below(store: Store, house: Path, tmp_path: Path) -> None:
    mine = wheelhouse.wheel(tmp_path, "acme-scout", "1.2", requires=("fullswarm>=0.1", "tinylib"))
    wheelhouse.wheel(house, "tinylib", "3.0")
    made = make(BundleRequest(PI, packages=(mine,), wheels=house), store, Keys(tmp_path / "keys"))
    files = manifest.read_sums(made)
    assert {"app/acme_scout/__init__.py", "app/acme_scout-1.2.dist-info/METADATA", "lib/tinylib/__init__.py"} <= set(
        files
    )
    assert not [each for each in files if each.endswith(("direct_url.json", "RECORD"))]
    assert Manifest.read(made).packages["acme-scout"] == "1.2"


def example_wheel(folder: Path) -> Path:
    """Return the wheel of examples/outside_driver, with the files and entry points that its project names."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    info, path = f"fullswarm_acme-{project['version']}.dist-info", folder / "fullswarm_acme-0.1.0-py3-none-any.whl"
    groups = project["entry-points"].items()
    points = "".join(f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in table.items()) for group, table in groups)
    head = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\nRequires-Dist: fullswarm\n"
    with zipfile.ZipFile(path, "w") as file:
        for each in sorted((EXAMPLE / "fullswarm_acme").glob("*.py")):
            file.write(each, f"fullswarm_acme/{each.name}")
        file.writestr(f"{info}/METADATA", head)
        file.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        file.writestr(f"{info}/entry_points.txt", points)
        file.writestr(f"{info}/RECORD", "")
    return path


def test_a_robot_finds_the_make_of_an_outside_driver_in_its_release(store: Store, house: Path, tmp_path: Path) -> None:
    made = make(BundleRequest(PI, packages=(example_wheel(tmp_path),), wheels=house), store, Keys(tmp_path / "keys"))
    code = (
        "from fullswarm import registry; from fullswarm.drivers.make import make_of; url = 'acme://192.168.7.20:7700'; "
        "print(make_of(url).name, make_of(url).guarded, registry.driver_class(url).__module__)"
    )
    repository = Path(fullswarm.__file__).parents[1]
    # The release's own fullswarm is a stand-in here: this one's makes look for the package beside it.
    command = [sys.executable, "-c", code]
    paths = os.pathsep.join([str(repository), str(made / "app")])
    run = subprocess.run(command, env={"PYTHONPATH": paths}, check=False, capture_output=True, text=True)
    assert run.stdout.strip() == "acme True fullswarm_acme.driver", run.stderr


def test_a_package_for_another_fullswarm_is_refused(store: Store, house: Path, tmp_path: Path) -> None:
    mine = wheelhouse.wheel(tmp_path, "acme-scout", "1.2", requires=("fullswarm>=99",))
    with pytest.raises(ConfigError, match="fullswarm>=99"):
        plan(BundleRequest(PI, packages=(mine,), wheels=house), store)


def test_a_package_cannot_bring_a_simulator_on_board(store: Store, house: Path, tmp_path: Path) -> None:
    mine = wheelhouse.wheel(tmp_path, "acme-scout", "1.2", requires=("pybullet",))
    wheelhouse.wheel(house, "pybullet", "3.2")
    with pytest.raises(ConfigError, match="pybullet must not be on a robot"):
        plan(BundleRequest(PI, packages=(mine,), wheels=house), store)


def test_a_package_that_names_what_is_usually_left_out_gets_it(store: Store, house: Path, tmp_path: Path) -> None:
    mine = wheelhouse.wheel(tmp_path, "acme-scout", "1.2", requires=("lxml",))
    wheelhouse.wheel(house, "lxml", "6.0")
    assert plan(BundleRequest(PI, packages=(mine,), wheels=house), store)["lxml"] == "6.0"


@pytest.mark.parametrize("name", ["nothing-there", "empty", "text.whl"])
def test_what_is_no_package_is_named(store: Store, house: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.whl").write_text("no zip")
    with pytest.raises(ConfigError, match="not a") as caught:
        plan(BundleRequest(PI, packages=(tmp_path / name,), wheels=house), store)
    assert name in caught.value.where


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a package in a folder, whose build backend lies beside it: nothing is fetched to build it."""
    project = tmp_path / "orbit"
    (project / "orbit").mkdir(parents=True)
    (project / "orbit" / "__init__.py").write_text("RADIUS_M = 1.0\n")
    (project / "build").mkdir()
    (project / "build" / "stale.py").touch()
    (project / "pyproject.toml").write_text(
        '[build-system]\nrequires = []\nbuild-backend = "backend"\nbackend-path = ["."]\n[project]\nname = "orbit"\n'
        'version = "0.3"\n'
    )
    (project / "backend.py").write_text(BACKEND)
    return project


def test_a_folder_is_built_and_left_as_it_was(store: Store, house: Path, tmp_path: Path, folder: Path) -> None:
    before = sorted(folder.rglob("*"))
    made = make(BundleRequest(PI, packages=(folder,), wheels=house), store, Keys(tmp_path / "keys"))
    assert (made / "app/orbit/__init__.py").read_text() == "RADIUS_M = 1.0\n"
    assert sorted(folder.rglob("*")) == before
    again = make(BundleRequest(PI, packages=(folder,), wheels=house), store, Keys(tmp_path / "keys"))
    assert again == made, "building it once more gives the same release"


def test_a_folder_with_compiled_parts_is_refused(store: Store, house: Path, folder: Path) -> None:
    backend = folder / "backend.py"
    backend.write_text(backend.read_text().replace("py3-none-any", "cp311-cp311-linux_x86_64"))
    with pytest.raises(ConfigError, match="compiled parts"):
        plan(BundleRequest(PI, packages=(folder,), wheels=house), store)
