"""`fullswarm signing`: keys that sign releases are replaced and revoked by a threshold of root keys."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from fullswarm.cli.main import app
from fullswarm.deploy.release import manifest, signatures
from fullswarm.deploy.release.keys import Keys, fingerprint, sign_release, verify_release
from fullswarm.deploy.release.signatures import STATEMENT_NAMESPACE, sign
from fullswarm.deploy.release.trust import Root, Statement, check_successor
from fullswarm.errors import ConfigError
from tests.deploy_release import tiny_release


@pytest.fixture
def keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Keys:
    monkeypatch.setenv("FULLSWARM_KEYS", str(tmp_path / "keys"))
    monkeypatch.delenv("SSH_AUTH_SOCK", raising=False)
    signatures._passphrase.cache_clear()
    return Keys.default()


@pytest.fixture
def release(tmp_path: Path, keys: Keys) -> Path:
    return tiny_release(tmp_path / "store", keys)


def signing(*words: str, code: int = 0) -> Result:
    result = CliRunner().invoke(app, ["signing", *words])
    assert result.exit_code == code, result.stderr
    return result


def listed() -> list[dict[str, object]]:
    found: list[dict[str, object]] = json.loads(signing("list", "--json").stdout)["keys"]
    return found


def states() -> list[object]:
    return [each["state"] for each in listed() if each["role"] == "release"]


# ---------------------------------------------------------------- the first keys
def test_two_of_three_root_keys_replace_keys_and_they_can_be_moved_away(keys: Keys, tmp_path: Path) -> None:
    root = keys.root()
    assert (root.version, root.threshold, len(root.roots), len(root.releases)) == (1, 2, 3, 1)
    assert len(root.signers_of(keys.roots()[0])) == 3
    shutil.move(keys.folder / "root", tmp_path / "sticks")
    assert keys.root() == root
    refused = signing("rotate", code=2)
    assert "signed by 0 of the 2 root keys" in refused.stderr
    assert keys.root() == root
    one, two = (str(tmp_path / f"sticks/{each}_ed25519") for each in (1, 2))
    assert "signed by 1 of the 2" in signing("rotate", "--root-key", one, code=2).stderr
    signing("rotate", "--root-key", one, "--root-key", two)
    assert keys.root().version == 2


def test_the_list_says_where_private_keys_are(keys: Keys) -> None:
    shown = signing("list")
    assert fingerprint(keys.release_key()) in shown.stdout
    assert "move the root keys" in shown.stderr
    (keys.folder / "root/1_ed25519").unlink()
    (keys.folder / "root/2_ed25519").unlink()
    assert "move the root keys" not in signing("list").stderr
    assert [bool(each["file"]) for each in listed()] == [True, False, False, True]


def test_a_base_that_lost_a_version_of_the_root_metadata_says_so(keys: Keys) -> None:
    keys.rotate_release_key()
    (keys.folder / "trust/1.root").rename(keys.folder / "trust/1.bak")
    with pytest.raises(ConfigError, match=r"1\.root: a version of the root metadata is missing"):
        keys.roots()


# ---------------------------------------------------------------- rotate, revoke, root keys
def test_a_rotated_key_holds_until_it_expires_and_a_revoked_one_does_not(keys: Keys, release: Path) -> None:
    signing("rotate")
    assert states() == ["signs", "accepted"]
    verify_release(release, keys.allowed_signers())
    old = next(
        str(each["fingerprint"]) for each in listed() if each["state"] == "accepted" and each["role"] == "release"
    )
    signing("revoke", old, "--yes")
    assert states()[0] == "signs"
    assert "revoked" in states()
    with pytest.raises(ConfigError, match="cannot verify the signature"):
        verify_release(release, keys.allowed_signers())
    sign_release(release, keys)
    verify_release(release, keys.allowed_signers())


def test_revoking_without_a_name_replaces_the_key_that_signs(keys: Keys) -> None:
    before = fingerprint(keys.release_key())
    assert "Aborted" in CliRunner().invoke(app, ["signing", "revoke"], input="n\n").stderr
    assert fingerprint(keys.release_key()) == before
    signing("revoke", "--yes")
    assert fingerprint(keys.release_key()) != before
    assert states() == ["signs", "revoked"]
    assert "trust no release key" in signing("revoke", "SHA256:none", "--yes", code=2).stderr


def test_a_stolen_root_key_is_replaced_by_the_two_others(keys: Keys, tmp_path: Path) -> None:
    keys.root()
    stolen = keys.folder / "root/1_ed25519"
    name = fingerprint(stolen)
    stolen.rename(tmp_path / "stolen")
    Path(f"{stolen}.pub").rename(tmp_path / "stolen.pub")
    fresh = Keys(tmp_path / "other").fleet_key()
    signing("root", "--remove", name, "--add", f"{fresh}.pub")
    root = keys.root()
    assert (root.version, len(root.roots), root.threshold) == (2, 3, 2)
    assert name not in [each["fingerprint"] for each in listed()]
    check_successor(Root.parse(keys.roots()[0]), keys.roots()[1])


def test_a_threshold_that_cannot_be_met_is_refused(keys: Keys) -> None:
    assert "threshold of 4" in signing("root", "--threshold", "4", code=2).stderr
    assert keys.root().version == 1


def test_a_change_that_stopped_half_way_is_made_good_by_the_next(keys: Keys) -> None:
    key = keys.release_key()
    keys.rotate_release_key()
    shutil.copyfile(keys.folder / "old/release-until-2_ed25519", key)  # it died before the new key got its name
    shutil.copyfile(keys.folder / "old/release-until-2_ed25519.pub", f"{key}.pub")
    keys.rotate_release_key(revoked=[keys.root().releases[0].key])
    sign_key = keys.signing_key()
    assert keys.root().releases[0].key in Path(f"{sign_key}.pub").read_text()


def test_a_key_that_robots_do_not_trust_signs_nothing(keys: Keys, release: Path) -> None:
    for end in ("", ".pub"):
        (keys.folder / f"release_ed25519{end}").unlink()
    with pytest.raises(ConfigError, match="robots do not trust this release key"):
        sign_release(release, keys)


def test_an_expired_key_says_so_before_any_work_is_done(
    keys: Keys, release: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    soon = time.time() + 3 * 365 * 86_400
    monkeypatch.setattr(time, "time", lambda: soon)
    with pytest.raises(ConfigError, match="this release key expired on"):
        sign_release(release, keys)
    with pytest.raises(ConfigError, match="cannot verify the signature"):
        verify_release(release, keys.allowed_signers())


# ---------------------------------------------------------------- statements
def test_numbers_grow_even_when_the_clock_goes_back(keys: Keys, monkeypatch: pytest.MonkeyPatch) -> None:
    first = keys.next_number()
    monkeypatch.setattr(time, "time", lambda: 60.0)
    assert [keys.next_number(), keys.next_number()] == [first + 1, first + 2]


def test_a_frozen_release_does_not_leave_this_base(keys: Keys, release: Path) -> None:
    statement = Statement.parse((release / manifest.STATEMENT).read_text(), "test")
    text = replace(statement, expires_s=int(time.time()) - 1).text
    (release / manifest.STATEMENT).write_text(text + sign(text.encode(), STATEMENT_NAMESPACE, keys.release_key()))
    with pytest.raises(ConfigError, match="expired on") as caught:
        verify_release(release, keys.allowed_signers())
    assert "--allow-older" in caught.value.hint


def test_a_release_of_an_older_fullswarm_is_named_with_what_to_do(keys: Keys, release: Path) -> None:
    (release / manifest.STATEMENT).unlink()
    with pytest.raises(ConfigError, match="no signed statement") as caught:
        verify_release(release, keys.allowed_signers())
    assert "fullswarm bundle" in caught.value.hint
    sign_release(release, keys, older=True)
    verify_release(release, keys.allowed_signers())


def test_signing_anew_moves_no_release_to_the_front(keys: Keys, release: Path) -> None:
    before = release.stat().st_mtime_ns
    sign_release(release, keys, older=True)
    assert release.stat().st_mtime_ns == before


# ---------------------------------------------------------------- passphrases
@pytest.fixture
def protected(keys: Keys, release: Path, tmp_path: Path) -> Iterator[Path]:
    made = tmp_path / "protected"
    command = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "secret words", "-f", str(made)]
    subprocess.run(command, check=True, capture_output=True)
    signing("rotate", "--key", str(made))
    yield keys.release_key()
    signatures._passphrase.cache_clear()


def test_a_passphrase_is_asked_once(
    protected: Path, keys: Keys, release: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def answer(prompt: str) -> str:
        asked.append(prompt)
        return "secret words"

    monkeypatch.setattr("getpass.getpass", answer)
    for _ in range(2):
        sign_release(release, keys)
    verify_release(release, keys.allowed_signers())
    assert asked == [f"Passphrase of {protected}: "]


def test_a_wrong_passphrase_signs_nothing(
    protected: Path, keys: Keys, release: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = (release / manifest.STATEMENT).read_bytes()
    monkeypatch.setattr("getpass.getpass", lambda _: "wrong")
    with pytest.raises(ConfigError, match="cannot sign with"):
        sign_release(release, keys)
    assert (release / manifest.STATEMENT).read_bytes() == before


def test_a_script_without_a_terminal_is_told_of_the_agent(
    protected: Path, keys: Keys, release: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_terminal(_: str) -> str:
        raise EOFError

    monkeypatch.setattr("getpass.getpass", no_terminal)
    with pytest.raises(ConfigError, match="needs its passphrase") as caught:
        sign_release(release, keys)
    assert f"ssh-add {protected}" in caught.value.hint


def test_an_agent_that_has_the_key_is_enough(
    protected: Path, keys: Keys, release: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    socket = tmp_path / "agent"
    agent = subprocess.Popen(["ssh-agent", "-D", "-a", str(socket)], stdout=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 10.0
        while not socket.exists():
            assert time.monotonic() < deadline
        askpass = tmp_path / "askpass"
        askpass.write_text("#!/bin/sh\necho secret words\n")
        askpass.chmod(0o700)
        environment = {
            **os.environ,
            "SSH_AUTH_SOCK": str(socket),
            "SSH_ASKPASS": str(askpass),
            "SSH_ASKPASS_REQUIRE": "force",
        }
        subprocess.run(["ssh-add", str(protected)], env=environment, check=True, capture_output=True)
        monkeypatch.setenv("SSH_AUTH_SOCK", str(socket))
        sign_release(release, keys)
        verify_release(release, keys.allowed_signers())
    finally:
        agent.terminate()
        agent.wait()
