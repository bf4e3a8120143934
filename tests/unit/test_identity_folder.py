"""The keys folder: private, complete, replaced in one step; what `deploy` installed replaces what is older."""

from __future__ import annotations

from pathlib import Path

import pytest

from fullswarm.errors import ConfigError
from fullswarm.identity import Credentials, Grant
from fullswarm.identity.authority import Authority, revoke
from fullswarm.identity.certificates import DAY_S
from fullswarm.identity.folder import (
    AUTHORITY,
    CERTIFICATE,
    IDENTITY,
    ISSUED,
    KEY,
    KEYS,
    KeysFolder,
    certificate_name,
    credentials_for,
    grants_file,
    identity_folder,
)
from fullswarm.identity.private import LONGEST_NAME
from fullswarm.keys import ROBOT_ID

NOW_S = 1_800_000_000.0


@pytest.fixture
def authority(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Authority:
    monkeypatch.setenv(IDENTITY, str(tmp_path / "identity"))
    made = Authority.make(KeysFolder.of("lab"), wall_s=lambda: NOW_S)
    made.issue("r1", "robot")
    return made


def test_the_environment_names_the_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv(IDENTITY, raising=False)
    monkeypatch.setenv(KEYS, str(tmp_path / "keys"))
    assert identity_folder() == tmp_path / "keys" / "identity"
    assert grants_file("lab") == tmp_path / "keys" / "identity" / "lab" / "grants.json"
    monkeypatch.setenv(IDENTITY, str(tmp_path / "other"))
    assert identity_folder() == tmp_path / "other"


def test_a_process_finds_its_files_and_its_role(authority: Authority) -> None:
    folder = authority.folder
    found = credentials_for("lab", "r1")
    assert found == Credentials(
        "r1", "robot", folder.authority_path, folder.certificate_path("r1"), folder.key_path("r1")
    )


def test_what_is_missing_is_named_with_the_command_that_mends_it(authority: Authority) -> None:
    with pytest.raises(ConfigError, match="'r2' has no certificate") as error:
        credentials_for("lab", "r2", "robot")
    assert error.value.hint == "fullswarm keys issue r2 --role robot --swarm lab"
    with pytest.raises(ConfigError, match="no certificates for swarm 'other'") as error:
        credentials_for("other", "r2", "robot")
    assert "fullswarm keys init" in error.value.hint
    authority.folder.key_path("r1").unlink()
    with pytest.raises(ConfigError, match="file is missing") as error:
        credentials_for("lab", "r1", "robot")
    assert error.value.where == str(authority.folder.key_path("r1"))


@pytest.mark.parametrize("what", ["folder", "key", "certificate", "authority"])
@pytest.mark.parametrize("mode", [0o040, 0o004, 0o020])
def test_a_folder_or_file_that_others_can_read_is_refused(authority: Authority, what: str, mode: int) -> None:
    folder = authority.folder
    path = {
        "folder": folder.path,
        "key": folder.key_path("r1"),
        "certificate": folder.certificate_path("r1"),
        "authority": folder.authority_path,
    }[what]
    path.chmod(path.stat().st_mode | mode)
    with pytest.raises(ConfigError, match="other users can read this") as error:
        credentials_for("lab", "r1", "robot")
    assert error.value.where == str(path)
    assert f"chmod {'700' if what == 'folder' else '600'}" in error.value.hint


@pytest.mark.parametrize("name", [CERTIFICATE, KEY])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.95])
def test_a_torn_file_is_refused(authority: Authority, name: str, share: float) -> None:
    path = authority.folder.path / "r1" / name
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ConfigError, match="incomplete or damaged"):
        credentials_for("lab", "r1", "robot")


def test_a_list_of_grants_that_names_one_twice_is_not_written(authority: Authority) -> None:
    before = authority.folder.grants()
    with pytest.raises(ConfigError, match="listed twice"):
        authority.folder.write_grants([*before, Grant(before[0].common_name, "r9", "operator")])
    assert authority.folder.grants() == before


@pytest.mark.parametrize("name", ["anna@lab.local", "ä ö", "a/b*c", "x" * 200, "r1"])
def test_every_operator_has_a_name_for_a_certificate(name: str) -> None:
    made = certificate_name(name)
    assert ROBOT_ID.match(made)
    assert len(made) <= LONGEST_NAME
    assert certificate_name(made) == made


# ---------------------------------------------------------------- what deploy installed
def install(authority: Authority, folder: Path, name: str = "r1") -> Path:
    folder.mkdir(exist_ok=True)
    paths = {
        AUTHORITY: authority.folder.authority_path,
        CERTIFICATE: authority.folder.certificate_path(name),
        KEY: authority.folder.key_path(name),
    }
    for file, source in paths.items():
        (folder / file).write_bytes(source.read_bytes())
        (folder / file).chmod(0o600)
    return folder


@pytest.fixture
def board(authority: Authority, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> KeysFolder:
    """A robot's own folder, empty, beside what `deploy` installed."""
    monkeypatch.setenv(ISSUED, str(install(authority, tmp_path / "issued")))
    monkeypatch.setenv(IDENTITY, str(tmp_path / "board"))
    return KeysFolder.of("lab")


def files(folder: KeysFolder) -> tuple[bytes, ...]:
    paths = (folder.authority_path, folder.certificate_path("r1"), folder.key_path("r1"))
    return tuple(path.read_bytes() for path in paths)


def test_a_robot_takes_what_deploy_installed(authority: Authority, board: KeysFolder) -> None:
    found = credentials_for("lab", "r1", "robot")
    assert found.certificate == board.certificate_path("r1")
    assert files(board) == files(authority.folder)


def test_a_renewed_certificate_stays_until_deploy_brings_a_later_one(
    authority: Authority, board: KeysFolder, tmp_path: Path
) -> None:
    credentials_for("lab", "r1", "robot")
    later = Authority.open(authority.folder, wall_s=lambda: NOW_S + 20 * DAY_S)
    later.renew("r1")
    renewed = authority.folder.certificate_path("r1").read_bytes()
    board.write(board.certificate_path("r1"), renewed)
    credentials_for("lab", "r1", "robot")
    assert board.certificate_path("r1").read_bytes() == renewed
    Authority.open(authority.folder, wall_s=lambda: NOW_S + 40 * DAY_S).renew("r1")
    install(authority, tmp_path / "issued")
    credentials_for("lab", "r1", "robot")
    assert files(board) == files(authority.folder)


def test_a_new_key_replaces_a_revoked_one(authority: Authority, board: KeysFolder, tmp_path: Path) -> None:
    credentials_for("lab", "r1", "robot")
    revoke(authority.folder, "r1")
    authority.issue("r1", "robot")
    install(authority, tmp_path / "issued")
    credentials_for("lab", "r1", "robot")
    assert files(board) == files(authority.folder)


@pytest.mark.parametrize("torn", [CERTIFICATE, KEY])
def test_a_power_cut_while_files_were_replaced_is_repaired(authority: Authority, board: KeysFolder, torn: str) -> None:
    credentials_for("lab", "r1", "robot")
    path = board.path / "r1" / torn
    path.write_bytes(path.read_bytes()[:50])
    credentials_for("lab", "r1", "robot")
    assert files(board) == files(authority.folder)


def test_a_torn_installation_names_deploy(board: KeysFolder, tmp_path: Path) -> None:
    path = tmp_path / "issued" / KEY
    path.write_bytes(b"-----BEGIN")
    with pytest.raises(ConfigError, match="incomplete or damaged") as error:
        credentials_for("lab", "r1", "robot")
    assert "fullswarm deploy r1" in error.value.hint
