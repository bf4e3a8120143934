"""The tar streams: the same bytes each time, and what the robots' own tar makes of them."""

from __future__ import annotations

import io
import os
import subprocess
import tarfile
from pathlib import Path

import pytest

from fullswarm.deploy.release import manifest
from fullswarm.deploy.release.keys import Keys
from fullswarm.deploy.release.store import gzipped_archive, head_archive, plain_archive
from tests.deploy_release import tiny_release

LONG = "/".join(("lib", "p" * 90, "q" * 90, "module.py"))
FILES: dict[str, str | bytes] = {
    "app/hello.py": "1\n",
    "lib/empty.py": "",
    LONG: b"\0\xff" * 40_000,
    "lib/späße.py": "x",
    "app/with space": "y",
}


@pytest.fixture
def release(tmp_path: Path) -> Path:
    return tiny_release(tmp_path / "store", Keys(tmp_path / "keys"), files=FILES)


def test_the_head_is_what_a_robot_judges_by(release: Path) -> None:
    with tarfile.open(fileobj=io.BytesIO(head_archive(release))) as file:
        assert file.getnames() == ["manifest.json", "SHA256SUMS", "SHA256SUMS.sig", "STATEMENT"]


def test_gnu_tar_unpacks_the_stream_without_a_word(release: Path, tmp_path: Path) -> None:
    place = tmp_path / "unpacked"
    place.mkdir()
    stream = b"".join(gzipped_archive(release, manifest.read_sums(release)))
    done = subprocess.run(["tar", "-xzf", "-"], input=stream, cwd=place, capture_output=True, check=True)
    assert done.stderr == b""
    assert manifest.sums_of(place) == (release / manifest.SUMS).read_text()


def test_only_what_is_asked_for_is_in_it(release: Path) -> None:
    with tarfile.open(fileobj=io.BytesIO(b"".join(plain_archive(release, ["app/hello.py"])))) as file:
        assert file.getnames() == ["app/hello.py"]


def test_times_and_owners_do_not_show(release: Path) -> None:
    first = b"".join(gzipped_archive(release, manifest.read_sums(release)))
    for path in release.rglob("*"):
        os.utime(path, (1e9, 1e9))
    assert b"".join(gzipped_archive(release, manifest.read_sums(release))) == first


def test_programs_stay_programs(tmp_path: Path) -> None:
    release = tiny_release(tmp_path / "store", Keys(tmp_path / "keys"), with_robot=True)
    with tarfile.open(fileobj=io.BytesIO(b"".join(plain_archive(release, manifest.read_sums(release))))) as file:
        modes = {each.name: each.mode for each in file}
    assert set(modes.values()) <= {0o644, 0o755}
    assert modes["manifest.json"] == 0o644
