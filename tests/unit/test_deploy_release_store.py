"""The store: releases side by side, what they share is on the disk once, and damage does not spread."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from fullswarm.deploy.release.keys import Keys, verify_release
from fullswarm.deploy.release.store import ENVIRONMENT, Store
from fullswarm.errors import ConfigError
from tests.deploy_release import X86_64, tiny_release

BIG = "x = 1\n" * 50_000


@pytest.fixture
def keys(tmp_path: Path) -> Keys:
    return Keys(tmp_path / "keys")


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")


def _make(store: Store, keys: Keys, app: str) -> Path:
    return tiny_release(store.folder, keys, files={"app/a.py": app, "lib/big.py": BIG})


def _disk_bytes(folder: Path) -> int:
    files = {each.stat().st_ino: each.stat().st_size for each in folder.rglob("*") if each.is_file()}
    return sum(files.values())


def test_what_did_not_change_is_on_the_disk_once(store: Store, keys: Keys) -> None:
    first = _make(store, keys, "1")
    alone = _disk_bytes(store.folder)
    second = _make(store, keys, "2")
    assert (first / "lib/big.py").stat().st_ino == (second / "lib/big.py").stat().st_ino
    assert (first / "app/a.py").stat().st_ino != (second / "app/a.py").stat().st_ino
    assert _disk_bytes(store.folder) - alone < 2000
    for each in (first, second):
        verify_release(each, keys.allowed_signers())


def test_damage_of_the_release_before_does_not_spread(store: Store, keys: Keys) -> None:
    first = _make(store, keys, "1")
    (first / "lib/big.py").write_text(BIG.replace("1", "2", 1))
    second = _make(store, keys, "2")
    verify_release(second, keys.allowed_signers())
    with pytest.raises(ConfigError, match="was changed"):
        verify_release(first, keys.allowed_signers())


def test_the_same_input_makes_the_same_release_and_mends_a_damaged_one(store: Store, keys: Keys) -> None:
    first = _make(store, keys, "1")
    (first / "lib/big.py").write_text("")
    assert _make(store, keys, "1") == first
    assert store.ids() == [first.name]
    verify_release(first, keys.allowed_signers())


def test_the_latest_is_the_one_made_last_even_if_made_before(store: Store, keys: Keys) -> None:
    first, second = _make(store, keys, "1"), _make(store, keys, "2")
    assert store.latest() == second
    _make(store, keys, "1")
    assert store.latest() == first
    assert store.ids() == [second.name, first.name]


def test_the_latest_of_a_target(store: Store, keys: Keys) -> None:
    arm = replace(X86_64, name="rpi-arm64", arch="aarch64")
    first = tiny_release(store.folder, keys, target=arm)
    tiny_release(store.folder, keys)
    assert store.latest("rpi-arm64") == first
    assert store.latest("rpi-arm64", "3.13") is None
    assert store.latest("jetson") is None


def test_a_release_is_found_by_id_and_by_folder(store: Store, keys: Keys) -> None:
    made = _make(store, keys, "1")
    assert store.get(made.name) == made
    assert store.get(str(made)) == made


def test_an_unknown_release_says_what_there_is(store: Store, keys: Keys) -> None:
    with pytest.raises(ConfigError, match="no release") as caught:
        store.get("0.1.0-000000000000")
    assert "fullswarm bundle" in caught.value.hint
    made = _make(store, keys, "1")
    with pytest.raises(ConfigError) as caught:
        store.get(made.name[:-1] + "_")
    assert made.name in caught.value.hint


def test_half_made_releases_are_not_seen_and_not_left(store: Store, keys: Keys) -> None:
    with pytest.raises(ConfigError):
        tiny_release(store.folder, keys, files={"app/bad\nname": ""})
    assert store.ids() == []
    assert list(store.folder.iterdir()) == []


def test_the_environment_names_the_store(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(ENVIRONMENT, str(tmp_path))
    assert Store.default().folder == tmp_path


def test_a_store_that_cannot_be_written_is_named(tmp_path: Path, keys: Keys) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="no release can be made here"):
        tiny_release(tmp_path / "file" / "store", keys)
