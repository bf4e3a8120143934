"""Whole bundles from a folder of wheels: what is in them, that they repeat, what an update carries."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from fullswarm.deploy.release import contents, manifest, packages, targets
from fullswarm.deploy.release.bundle import BundleRequest, make, plan
from fullswarm.deploy.release.keys import Keys, verify_release
from fullswarm.deploy.release.manifest import Manifest
from fullswarm.deploy.release.packages import run_uv
from fullswarm.deploy.release.store import Store, plain_archive
from fullswarm.errors import ConfigError
from tests.unit import wheelhouse

PI = targets.target("rpi-arm64")


@pytest.fixture(autouse=True)
def ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of the code that stands for fullswarm's."""
    place = wheelhouse.small_fullswarm(tmp_path / "fullswarm")
    monkeypatch.setattr(contents, "OWN", place)
    return place


@pytest.fixture
def keys(tmp_path: Path) -> Keys:
    return Keys(tmp_path / "keys")


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")


@pytest.fixture
def house(tmp_path: Path) -> Path:
    return wheelhouse.fill(tmp_path / "wheels")


def test_a_release_holds_what_the_design_says(store: Store, keys: Keys, house: Path) -> None:
    told: list[str] = []
    made = make(BundleRequest(PI, wheels=house), store, keys, told.append)
    verify_release(made, keys.allowed_signers())
    facts = Manifest.read(made)
    assert facts.id == made.name
    assert facts.target == PI
    assert facts.packages["numpy"] == "90.0"
    files = set(manifest.read_sums(made))
    assert {"lib/numpy/core.so", "lib/numpy/__init__.py"} <= files
    assert "lib/numpy/tests/test_it.py" not in files
    assert {each for each in files if each.startswith(("app/fullswarm/", "robot/"))} == {
        "app/fullswarm/__init__.py",
        "app/fullswarm/agent/node.py",
        "app/fullswarm/core/behaviours.toml",
        "app/fullswarm/deploy/robot/support_package.py",
        "robot/install.sh",
        "robot/agent.service",
    }
    assert (made / "robot/install.sh").stat().st_mode & 0o777 == 0o755
    assert (made / "robot/agent.service").stat().st_mode & 0o777 == 0o644
    assert len(told) == 3


def test_a_store_is_named_from_where_one_stands(
    tmp_path: Path, keys: Keys, house: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    made = make(BundleRequest(PI, wheels=Path("wheels")), Store(Path("near")), keys)
    assert {"lib/numpy/core.so", "app/fullswarm/agent/node.py"} <= set(manifest.read_sums(made))
    far = make(BundleRequest(PI, wheels=house), Store(tmp_path / "far"), keys)
    assert made.name == far.name


def test_what_was_not_unpacked_is_not_signed(
    store: Store, keys: Keys, house: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = run_uv

    def lose(folder: Path, *arguments: str | Path, why: str) -> str:
        return "" if "exact.txt" in arguments else real(folder, *arguments, why=why)

    monkeypatch.setattr(packages, "run_uv", lose)
    with pytest.raises(ConfigError, match=r"these packages were not unpacked: .*numpy"):
        make(BundleRequest(PI, wheels=house), store, keys)
    assert store.ids() == []


def test_two_bases_make_the_same_bytes(tmp_path: Path, keys: Keys, house: Path) -> None:
    elsewhere = wheelhouse.fill(tmp_path / "another" / "house")
    stores = (Store(tmp_path / "one"), Store(tmp_path / "deep" / "er" / "two"))
    first, second = (
        make(BundleRequest(PI, wheels=each), store, keys)
        for each, store in zip((house, elsewhere), stores, strict=True)
    )
    assert first.name == second.name
    paths = [*manifest.files_of(first), manifest.SUMS, manifest.SIGNATURE]
    assert b"".join(plain_archive(first, paths)) == b"".join(plain_archive(second, paths))
    assert [(first / each).stat().st_mode for each in paths] == [(second / each).stat().st_mode for each in paths]


def test_versions_stay_until_somebody_wants_newer_ones(store: Store, keys: Keys, house: Path) -> None:
    make(BundleRequest(PI, wheels=house), store, keys)
    wheelhouse.fill(house, version="91.0")
    assert set(plan(BundleRequest(PI, wheels=house), store).values()) == {"90.0"}
    assert set(plan(BundleRequest(PI, wheels=house, upgrade=True), store).values()) == {"91.0"}


def test_a_version_that_is_gone_does_not_stop_a_bundle(store: Store, keys: Keys, house: Path) -> None:
    make(BundleRequest(PI, wheels=house), store, keys)
    shutil.rmtree(house)
    wheelhouse.fill(house, version="91.0")
    assert set(plan(BundleRequest(PI, wheels=house), store).values()) == {"91.0"}


def test_a_change_of_fullswarm_carries_only_itself(store: Store, keys: Keys, house: Path, ours: Path) -> None:
    first = make(BundleRequest(PI, wheels=house), store, keys)
    (ours / "agent" / "node.py").write_text("RATE_HZ = 30\n")
    second = make(BundleRequest(PI, wheels=house), store, keys)
    old, new = manifest.read_sums(first), manifest.read_sums(second)
    assert {path for path in new if old.get(path) != new[path]} == {"manifest.json", "app/fullswarm/agent/node.py"}
    assert old.keys() == new.keys()
    linked = [path for path in new if (first / path).stat().st_ino == (second / path).stat().st_ino]
    assert len(linked) == len(new) - 2


def test_an_ancient_zenoh_stops_the_bundle_and_is_named(store: Store, keys: Keys, house: Path) -> None:
    next(house.glob("eclipse_zenoh-*")).unlink()
    wheelhouse.wheel(house, "eclipse-zenoh", "0.10.0", arch="aarch64")
    with pytest.raises(ConfigError, match=r"eclipse-zenoh.*1\.10"):
        make(BundleRequest(PI, wheels=house), store, keys)
    assert store.ids() == []


def test_wheels_for_another_processor_are_not_taken(store: Store, keys: Keys, tmp_path: Path) -> None:
    house = wheelhouse.fill(tmp_path / "x86", arch="x86_64")
    with pytest.raises(ConfigError, match="rpi-arm64"):
        make(BundleRequest(PI, wheels=house), store, keys)
    assert "numpy" in plan(BundleRequest(targets.target("x86_64", "3.11"), wheels=house), store)


def test_a_wheel_that_lies_about_its_processor_is_found_out(store: Store, keys: Keys, house: Path) -> None:
    next(house.glob("numpy-*")).unlink()
    wheelhouse.wheel(house, "numpy", "90.0", arch="aarch64", lib="x86_64")
    with pytest.raises(ConfigError, match="not for aarch64") as caught:
        make(BundleRequest(PI, wheels=house), store, keys)
    assert caught.value.where == "numpy/core.so"


def test_the_extras_bring_their_packages(store: Store, keys: Keys, house: Path) -> None:
    wheelhouse.fill(house, extras=("can", "mavlink"))
    made = make(BundleRequest(PI, ("mavlink", "can", "can"), wheels=house), store, keys)
    facts = Manifest.read(made)
    assert facts.extras == ("can", "mavlink")
    assert {"pymavlink", "python-can", "msgpack"} <= set(facts.packages)


def test_what_pymavlink_generates_dialects_with_is_left_out(store: Store, house: Path) -> None:
    wheelhouse.fill(house, extras=("mavlink",))
    next(house.glob("pymavlink-*")).unlink()
    wheelhouse.wheel(house, "pymavlink", "90.0", requires=("lxml", "fastcrc"))
    wheelhouse.wheel(house, "fastcrc", "1.0")
    assert set(plan(BundleRequest(PI, ("mavlink",), wheels=house), store)) >= {"pymavlink", "fastcrc"}


def test_a_folder_of_wheels_that_is_not_there(store: Store, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such folder"):
        plan(BundleRequest(PI, wheels=tmp_path / "none"), store)
