"""Keys are made once, for this user only, and never twice at the same time."""

from __future__ import annotations

import stat
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from fullswarm.deploy.release.keys import Keys, fingerprint, public
from fullswarm.errors import ConfigError
from fullswarm.identity.folder import KEYS


@pytest.fixture
def keys(tmp_path: Path) -> Keys:
    return Keys(tmp_path / "keys")


def test_a_key_is_made_on_first_use_and_kept(keys: Keys) -> None:
    first = keys.release_key().read_bytes()
    assert keys.release_key().read_bytes() == first
    assert public(keys.release_key()).startswith("ssh-ed25519 ")
    assert fingerprint(keys.release_key()).startswith("SHA256:")


def test_only_this_user_can_read_them(keys: Keys) -> None:
    assert stat.S_IMODE(keys.fleet_key().stat().st_mode) == 0o600
    assert stat.S_IMODE(keys.folder.stat().st_mode) == 0o700


def test_a_key_that_others_can_read_is_refused(keys: Keys) -> None:
    keys.release_key().chmod(0o644)
    with pytest.raises(ConfigError, match="other users") as caught:
        keys.release_key()
    assert "chmod 600" in caught.value.hint


@pytest.mark.parametrize("method", ["exists", "stat", "read_text"])
def test_keys_that_root_has_left_are_named_with_what_gives_them_back(
    keys: Keys, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys.release_key()

    def refuse(path: Path, *_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, method, refuse)
    file = r"(release_ed25519(\.pub)?|1\.root|trust)"
    with pytest.raises(ConfigError, match=rf"{file}: cannot be read or written") as caught:
        keys.allowed_signers()
    assert "sudo chown" in caught.value.hint


def test_each_robot_has_a_host_key_of_its_own(keys: Keys) -> None:
    made = {keys.host_key("lab", "r1"), keys.host_key("lab", "r2"), keys.host_key("hall", "r1")}
    assert len({public(each) for each in made}) == 3
    assert keys.host_key("lab", "r1") == keys.folder / "hosts" / "lab" / "r1_ed25519"


@pytest.mark.parametrize("name", ["", "..", "../r1", "a/b", "-f"])
def test_a_robot_cannot_name_a_file_elsewhere(keys: Keys, name: str) -> None:
    with pytest.raises(ConfigError):
        keys.host_key("lab", name)


def test_two_commands_at_the_same_time_get_the_same_key(keys: Keys) -> None:
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda _: keys.release_key(), range(8)))
    # The two halves belong together: ssh-keygen derives the public one again.
    derived = subprocess.run(["ssh-keygen", "-y", "-f", keys.release_key()], capture_output=True, text=True, check=True)
    assert derived.stdout.split()[1] == public(keys.release_key()).split()[1]
    assert not [each for each in keys.folder.iterdir() if each.is_dir()], "scratch folders are gone"


def test_the_public_half_is_found_again_when_its_file_is_lost(keys: Keys) -> None:
    whole = public(keys.release_key()).split()[:2]
    Path(f"{keys.release_key()}.pub").unlink()
    assert public(keys.release_key()).split()[:2] == whole


def test_the_environment_names_the_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(KEYS, str(tmp_path / "elsewhere"))
    assert Keys.default().folder == tmp_path / "elsewhere"
    monkeypatch.delenv(KEYS)
    assert Keys.default().folder.name == "keys"


def test_without_openssh_the_package_is_named(keys: Keys, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match="not installed") as caught:
        keys.release_key()
    assert "openssh-client" in caught.value.hint


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="keys cannot be stored"):
        Keys(tmp_path / "file" / "keys").release_key()
