"""The SQLite index: made of the directories alone, and anew whenever they differ."""

from __future__ import annotations

import os
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from fullswarm.errors import ConfigError
from fullswarm.evaluate.results.index import INDEX_FILE, is_fresh, open_index, rebuild
from fullswarm.evaluate.trial_folder import PROVENANCE_FILE, RESULT_FILE, TRIALS
from tests.unit.results_fixture import a_trial, write_folder, write_trial


def count(out: Path, table: str = "trials") -> int:
    with open_index(out) as connection:
        return int(connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0])


def content(out: Path) -> list[tuple[object, ...]]:
    with open_index(out) as connection:
        rows = connection.execute("SELECT * FROM trials ORDER BY id").fetchall()
        return rows + connection.execute("SELECT * FROM metrics ORDER BY trial, source, name").fetchall()


def test_a_missing_index_is_made(tmp_path: Path) -> None:
    write_folder(tmp_path)
    assert not is_fresh(tmp_path)
    assert count(tmp_path) == 32
    assert is_fresh(tmp_path)
    with open_index(tmp_path) as connection:
        query = """SELECT sum(value) FROM metrics JOIN trials ON trial = id
            WHERE source = 'outcome' AND name = 'events' AND behaviour = ?"""
        assert connection.execute(query, ("move_to_goal_bc",)).fetchone() == (0.0,)
        assert connection.execute(query, ("move_to_goal",)).fetchone()[0] > 0.0
        assert connection.execute("SELECT count(*) FROM trials WHERE failed").fetchone() == (1,)


def test_a_fresh_index_is_used_as_it_is(tmp_path: Path) -> None:
    write_folder(tmp_path, seeds=1)
    rebuild(tmp_path)
    before = (tmp_path / INDEX_FILE).stat()
    count(tmp_path)
    after = (tmp_path / INDEX_FILE).stat()
    assert (before.st_ino, before.st_mtime_ns) == (after.st_ino, after.st_mtime_ns)


def test_a_rebuilt_index_holds_the_same(tmp_path: Path) -> None:
    write_folder(tmp_path, seeds=2)
    first = content(tmp_path)
    (tmp_path / INDEX_FILE).unlink()
    assert content(tmp_path) == first


def test_new_gone_and_changed_trials_are_noticed(tmp_path: Path) -> None:
    path = write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 0))
    assert count(tmp_path) == 1
    other = write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 1))
    assert not is_fresh(tmp_path)
    assert count(tmp_path) == 2
    for each in other.iterdir():
        each.unlink()
    other.rmdir()
    assert count(tmp_path) == 1
    os.utime(path / RESULT_FILE, ns=(1, 1))
    assert not is_fresh(tmp_path)
    (path / PROVENANCE_FILE).write_text("{")
    assert count(tmp_path, "problems") == 1


@pytest.mark.parametrize("damage", [b"", b"not a database", None])
def test_a_broken_index_is_made_again(tmp_path: Path, damage: bytes | None) -> None:
    write_folder(tmp_path, seeds=2)
    rebuild(tmp_path)
    path = tmp_path / INDEX_FILE
    if damage is None:  # a page in the middle is lost
        text = bytearray(path.read_bytes())
        text[4096:-4096] = b"\xff" * (len(text) - 8192)
        path.write_bytes(text)
    else:
        path.write_bytes(damage)
    assert not is_fresh(tmp_path)
    assert count(tmp_path) == 16


def test_an_index_of_another_format_is_made_again(tmp_path: Path) -> None:
    write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 0))
    rebuild(tmp_path)
    with closing(sqlite3.connect(tmp_path / INDEX_FILE)) as connection, connection:
        connection.execute("UPDATE meta SET value = 'fullswarm.index/0' WHERE key = 'format'")
    assert not is_fresh(tmp_path)
    assert count(tmp_path) == 1
    assert is_fresh(tmp_path)


def test_nothing_is_left_beside_the_index(tmp_path: Path) -> None:
    write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 0))
    rebuild(tmp_path)
    assert sorted(each.name for each in tmp_path.iterdir()) == [INDEX_FILE, TRIALS]


def test_where_nothing_can_be_written_the_index_lives_in_memory(tmp_path: Path) -> None:
    write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 0))
    (tmp_path / INDEX_FILE).mkdir()  # cannot be replaced, also not by root
    assert count(tmp_path) == 1
    with pytest.raises(ConfigError, match="cannot write"):
        rebuild(tmp_path)


def test_broken_directories_are_listed(tmp_path: Path) -> None:
    path = write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 0))
    (path / RESULT_FILE).write_text("{")
    with open_index(tmp_path) as connection:
        ((directory, reason),) = connection.execute("SELECT * FROM problems").fetchall()
    assert directory == f"{TRIALS}/{path.name}"
    assert RESULT_FILE in reason
