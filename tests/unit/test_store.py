from __future__ import annotations

import itertools
import math
import os
import sqlite3
import stat
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.errors import ConfigError
from fullswarm.messages import ParamEntry
from fullswarm.store import CHANGES_KEPT, Store, Stored


def ticking() -> itertools.count[float]:
    return itertools.count(1000.0)


def test_values_authors_times_and_history() -> None:
    wall = ticking()
    store = Store(None, lambda: next(wall))
    assert store.get("a", 7) == 7
    store.set("a", 1, "ann")
    store.set("a", [1.0, [2.0, 3.0]], "bob")
    assert store.get("a") == [1.0, [2.0, 3.0]]
    assert [(each.value, each.author, each.changed) for each in store.history("a")] == [
        (1, "ann", 1000.0),
        ([1.0, [2.0, 3.0]], "bob", 1001.0),
    ]
    store.close()
    store.close()


def test_the_newest_changes_of_each_key_are_kept(tmp_path: Path) -> None:
    store = Store(tmp_path / "core.db")
    store.set("rare", 0, "ann")
    for number in range(CHANGES_KEPT + 30):
        store.set_many({"often": number, "half" if number % 2 else "other": number}, "bob")
    assert [each.value for each in store.history("often")] == list(range(30, CHANGES_KEPT + 30))
    assert len(store.history("half")) == len(store.history("other")) == CHANGES_KEPT // 2 + 15
    assert [(each.value, each.author) for each in store.history("rare")] == [(0, "ann")]
    store.close()
    again = Store(tmp_path / "core.db")
    again.set("often", "new", "cid")
    assert [each.value for each in again.history("often")] == [*range(31, CHANGES_KEPT + 30), "new"]
    assert again.get("often") == "new"
    again.close()


def test_a_history_from_before_there_was_a_bound_is_cut_with_its_next_change(tmp_path: Path) -> None:
    store = Store(tmp_path / "core.db")
    rows = [("a", str(number), "ann", 1000.0 + number) for number in range(3 * CHANGES_KEPT)]
    store._db.executemany("INSERT INTO history (key, value, author, changed) VALUES (?, ?, ?, ?)", rows)
    store.set("b", 1, "bob")
    assert len(store.history("a")) == 3 * CHANGES_KEPT
    store.set("a", "new", "bob")
    assert [each.value for each in store.history("a")] == [*range(2 * CHANGES_KEPT + 1, 3 * CHANGES_KEPT), "new"]
    store.close()


def test_list_goes_by_prefix_and_forgets_what_was_taken_away() -> None:
    store = Store()
    store.set_many({"b/2": 2, "b/1": 1, "b%": 3, "c": 4}, "ann")
    assert [each.key for each in store.list("b/")] == ["b/1", "b/2"]
    store.set("b/1", None, "ann")
    assert [each.key for each in store.list("b/")] == ["b/2"]
    assert store.get("b/1", 5) == 5
    assert [each.key for each in store.history("b/*")] == ["b/2", "b/1", "b/1"]
    store.close()


def test_seed_replaces_its_own_values_only() -> None:
    store = Store()
    assert store.seed({"mine": 1, "theirs": 1, "same": [1, 2], "gone": 1}) == ("mine", "theirs", "same", "gone")
    store.set("theirs", 5, "ann")
    store.set("gone", None, "ann")
    assert store.seed({"mine": 2, "theirs": 2, "same": [1, 2], "gone": 2}) == ("mine",)
    assert (store.get("mine"), store.get("theirs"), store.get("gone")) == (2, 5, None)
    store.close()


def test_survives_a_restart_and_closes_cleanly(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "core.db"
    first = Store(path)
    first.set("a", {"x": [1, 2]}, "ann")
    first.close()
    assert [each.name for each in path.parent.iterdir()] == ["core.db"]  # no log left beside it
    second = Store(path)
    assert second.get("a") == {"x": [1, 2]}
    assert len(second.history("a")) == 1
    second.close()


def test_a_change_is_whole_or_not_at_all(tmp_path: Path) -> None:
    store = Store(tmp_path / "a.db")
    store.set("a", 1, "ann")
    with pytest.raises(ConfigError, match="b: "):
        store.set_many({"a": 2, "b": math.nan}, "ann")
    assert store.get("a") == 1
    other = Store(tmp_path / "a.db")
    other._db.execute("BEGIN IMMEDIATE")
    store._db.execute("PRAGMA busy_timeout=1")
    with pytest.raises(ConfigError, match="another process holds it"):
        store.set("a", 3, "ann")
    other._db.execute("ROLLBACK")
    store.set("a", 3, "ann")
    assert other.get("a") == 3
    assert len(other.history("a")) == 2
    store.close()
    other.close()


def test_what_could_not_be_written_is_written_later_with_the_newest_values(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fullswarm.store.BUSY_S", 0.02)
    path = tmp_path / "core.db"
    store = Store(path)
    store.set_many({"a": 0, "gone": 1, "away": 2}, "ann")
    other = sqlite3.connect(path, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    store.keep({"a": 1, "never": None, "gone": None}, "core 1")
    store.keep({"a": 2, "b": [3]}, "core 1")
    store.keep({"bad": math.nan}, "core 1")  # nothing of it waits
    store.forget("away")
    with pytest.raises(ConfigError, match="locked"):
        store.set("b", 4, "ann")
    store.save(wait=False)
    assert waits(store)
    other.execute("ROLLBACK")
    store.set("b", 5, "ann")  # is newer than what waits
    store.save(wait=False)
    assert not waits(store)
    other.close()
    again = Store(path)
    assert {each.key: each.value for each in again.list()} == {"a": 2, "b": 5}
    assert not again.history("away")
    again.close()
    store.keep({"c": 6}, "core 1")
    assert not waits(store)
    store.close()


def waits(store: Store) -> bool:
    return store.unsaved


def test_what_is_no_database_is_said_so(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("not a database, but long enough to look at " * 10)
    with pytest.raises(ConfigError, match="name another file") as caught:
        Store(path)
    assert caught.value.where == str(path)


def test_watchers_hear_each_change_once_in_order() -> None:
    store = Store()
    heard: list[ParamEntry] = []
    unwatch = store.watch(heard.append)
    store.set_many({"a": 1, "b": 2}, "ann")
    unwatch()
    store.set("c", 3, "ann")
    assert [(each.key, each.value) for each in heard] == [("a", 1), ("b", 2)]
    store.close()


plain = st.recursive(
    st.booleans() | st.integers(-(2**53), 2**53) | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)


@given(st.dictionaries(st.text(), plain, max_size=4))
@settings(max_examples=30, deadline=None)
def test_what_is_written_is_read(values: dict[str, Stored]) -> None:
    store = Store()
    if values:
        store.set_many(values, "ann")
    assert {each.key: each.value for each in store.list()} == values
    store.close()


@pytest.mark.parametrize("value", ["{not json", "", "NaN", "[1.0, Infinity]", b"\xff\xfe", "[" * 100_000])
def test_a_value_that_is_not_json_is_named_with_what_to_do(tmp_path: Path, value: object) -> None:
    path = tmp_path / "core.sqlite"
    store = Store(path)
    store.set("wanted/r1", {"behaviour": "stop"}, "core")
    store.set("a", 1.0, "anna")
    store.close()
    database = sqlite3.connect(path)
    for table in ("entry", "history"):
        database.execute(f"UPDATE {table} SET value = ? WHERE key = 'wanted/r1'", (value,))
    database.commit()
    store = Store(path)
    for read in (lambda: store.get("wanted/r1"), lambda: store.list("wanted/"), lambda: store.history("*")):
        with pytest.raises(ConfigError, match=r"core\.sqlite: the value of 'wanted/r1' is not JSON") as caught:
            read()
    assert store.get("a") == 1.0
    statement = caught.value.hint.partition('"')[2].rstrip('"')
    database.executescript(statement)  # what the hint says
    database.close()
    assert store.get("wanted/r1") is None
    assert len(store.history("*")) == 1
    store.close()


def test_files_are_for_this_user_only(tmp_path: Path) -> None:
    old = os.umask(0)
    try:
        for path in (tmp_path / "new.db", tmp_path / "old.db"):
            if path.name == "old.db":
                Store(path).close()
                path.chmod(0o644)  # as an older version made it
            store = Store(path)
            store.set("a", 1, "ann")
            modes = {each.name: stat.S_IMODE(each.stat().st_mode) for each in tmp_path.glob(f"{path.name}*")}
            assert modes == dict.fromkeys((path.name, f"{path.name}-wal", f"{path.name}-shm"), 0o600)
            store.close()
    finally:
        os.umask(old)
