"""Replacing a file in one step."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from fullswarm.files import replace_file, replacing


@pytest.mark.parametrize("sync", [False, True])
def test_the_file_is_replaced_in_one_step(tmp_path: Path, sync: bool) -> None:
    path = tmp_path / "health.json"
    replace_file(path, "old", sync=sync)
    with path.open() as reader:
        replace_file(path, b"new", sync=sync)
        assert reader.read() == "old"
    assert (path.read_text(), [each.name for each in tmp_path.iterdir()]) == ("new", ["health.json"])


def test_the_new_file_has_the_mode_from_the_first_byte(tmp_path: Path) -> None:
    with replacing(tmp_path / "secret.txt", 0o600) as part:
        assert (part.suffix, stat.S_IMODE(part.stat().st_mode)) == (".txt", 0o600)
    assert stat.S_IMODE((tmp_path / "secret.txt").stat().st_mode) == 0o600


def test_a_failure_keeps_the_old_file_and_leaves_nothing_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    replace_file(path, "old")

    def fail() -> None:
        with replacing(path) as part:
            part.write_text("half")
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert (path.read_text(), list(tmp_path.iterdir())) == ("old", [path])
