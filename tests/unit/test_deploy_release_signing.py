"""Signatures: what was signed here is taken, anything else is refused with its reason."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from fullswarm.deploy.release import manifest
from fullswarm.deploy.release.keys import Keys, sign_release, verify_release
from fullswarm.deploy.release.signatures import ssh_keygen
from fullswarm.errors import ConfigError
from tests.deploy_release import tiny_release


@pytest.fixture
def keys(tmp_path: Path) -> Keys:
    return Keys(tmp_path / "keys")


@pytest.fixture
def release(tmp_path: Path, keys: Keys) -> Path:
    return tiny_release(tmp_path / "store", keys)


def test_our_own_release_is_taken(release: Path, keys: Keys) -> None:
    verify_release(release, keys.allowed_signers())


def test_the_sums_are_what_sha256sum_reads(release: Path) -> None:
    subprocess.run(["sha256sum", "--check", "--strict", "--quiet", manifest.SUMS], cwd=release, check=True)


def test_the_same_release_has_the_same_signature(release: Path, keys: Keys) -> None:
    first = (release / manifest.SIGNATURE).read_bytes()
    sign_release(release, keys)
    assert (release / manifest.SIGNATURE).read_bytes() == first


def _change(release: Path) -> None:
    (release / "app" / "hello.py").write_text("print('hullo')\n")


def _add(release: Path) -> None:
    (release / "lib" / "more.py").touch()


def _lose(release: Path) -> None:
    (release / "app" / "hello.py").unlink()


def _link(release: Path) -> None:
    (release / "lib" / "link.py").symlink_to("/etc/passwd")


def _hide(release: Path) -> None:
    """Change a file and its sum with it: only the signature can tell."""
    _change(release)
    (release / manifest.SUMS).write_text(manifest.sums_of(release))


def _unsign(release: Path) -> None:
    (release / manifest.SIGNATURE).unlink()


def _scribble(release: Path) -> None:
    (release / manifest.SIGNATURE).write_text("-----BEGIN SSH SIGNATURE-----\nAAAA\n-----END SSH SIGNATURE-----\n")


def _sumless(release: Path) -> None:
    (release / manifest.SUMS).unlink()


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (_change, "hello.py was changed"),
        (_add, "more.py is not in the list"),
        (_lose, "hello.py is missing"),
        (_link, "no links"),
        (_hide, "cannot verify the signature"),
        (_unsign, "not signed"),
        (_scribble, "cannot verify the signature"),
        (_sumless, "no checksums"),
    ],
)
def test_a_release_that_was_touched_is_refused(
    release: Path, keys: Keys, damage: Callable[[Path], None], reason: str
) -> None:
    damage(release)
    with pytest.raises(ConfigError, match=reason):
        verify_release(release, keys.allowed_signers())


def test_a_release_of_another_base_is_refused(release: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="verify the signature"):
        verify_release(release, Keys(tmp_path / "stranger").allowed_signers())


def test_a_signature_for_another_purpose_is_refused(release: Path, keys: Keys) -> None:
    text = (release / manifest.SUMS).read_bytes()
    made = ssh_keygen("-q", "-Y", "sign", "-n", "git", "-f", str(keys.release_key()), feed=text, why="sign")
    (release / manifest.SIGNATURE).write_bytes(made)
    with pytest.raises(ConfigError, match="verify the signature"):
        verify_release(release, keys.allowed_signers())


def test_the_signature_of_another_release_does_not_fit(release: Path, keys: Keys, tmp_path: Path) -> None:
    other = tiny_release(tmp_path / "other", keys, files={"app/hello.py": "other"})
    shutil.copy(other / manifest.SIGNATURE, release / manifest.SIGNATURE)
    with pytest.raises(ConfigError, match="verify the signature"):
        verify_release(release, keys.allowed_signers())


@pytest.mark.parametrize("path", ["../x", "/etc/passwd", "a//b", "a/./b", "", "a\rb"])
def test_sums_that_lead_out_of_the_release_are_refused(path: str) -> None:
    with pytest.raises(ConfigError, match="not a line of checksums"):
        manifest.parse_sums(f"{'0' * 64}  {path}\n")


@pytest.mark.parametrize("name", ["new\nline", "back\\slash", "tab\t"])
def test_names_that_tools_misread_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    with pytest.raises(ConfigError, match="name"):
        manifest.sums_of(tmp_path)
