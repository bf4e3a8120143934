"""The audit log as files: the chain, what breaks it, rotation, a full disk, crashes."""

from __future__ import annotations

import errno
import json
import os
import stat
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.audit.log import FIRST, AuditLog, Event, Head, files_of, record, unlocked
from fullswarm.audit.read import Reader, Selection, since
from fullswarm.audit.verify import verify
from fullswarm.clock import SimClock
from fullswarm.errors import ConfigError


def log_in(folder: Path, clock: SimClock | None = None, **options: object) -> AuditLog:
    clock = clock or SimClock()
    return AuditLog(folder, "core-1", clock.now_s, lambda: 1.7e9 + clock.now_s(), **options)  # type: ignore[arg-type]  # passed on


def written(folder: Path, count: int = 6, **options: object) -> Path:
    audit = log_in(folder, None, **options)
    for number in range(count):
        audit.append(Event("request", {"id": f"q{number}"}, ("r1",), "accepted", "operator", "anna@lab", "cli"))
    audit.close()
    return folder


def lines(folder: Path) -> list[bytes]:
    return [line for path in files_of(folder) for line in path.read_bytes().splitlines(keepends=True)]


def test_whole_log_is_found_whole_and_an_entry_says_who_what_and_when(tmp_path: Path) -> None:
    found = verify(written(tmp_path / "log"))
    assert (found.problems, found.notes, found.entries, found.first, found.last) == ([], [], 6, 1, 6)
    first = json.loads(lines(tmp_path / "log")[0])
    assert first.pop("hash") != FIRST
    assert first == {
        "n": 1, "time": "2023-11-14T22:13:20.000000+00:00", "mono_s": 0.0, "run": "core-1", "act": "request",
        "sender": "operator", "operator": "anna@lab", "source": "cli", "robots": ["r1"], "what": {"id": "q0"},
        "result": "accepted", "previous": FIRST,
    }  # fmt: skip


def test_files_and_folder_are_for_this_user_only(tmp_path: Path) -> None:
    old = os.umask(0)
    try:
        written(tmp_path / "log")
    finally:
        os.umask(old)
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "log").iterdir()}
    assert set(modes.values()) == {0o600}
    assert len(modes) == 2
    assert stat.S_IMODE((tmp_path / "log").stat().st_mode) == 0o700


def change(old: list[bytes]) -> list[bytes]:
    return [*old[:2], old[2].replace(b'"q2"', b'"qX"'), *old[3:]]


def change_and_hash(old: list[bytes]) -> list[bytes]:
    import hashlib

    start = old[2].replace(b'"q2"', b'"qX"').partition(b',"hash":')[0]
    return [*old[:2], start + b',"hash":"' + hashlib.sha256(start).hexdigest().encode() + b'"}\n', *old[3:]]


BREAKS: list[tuple[Callable[[list[bytes]], list[bytes]], str]] = [
    (change, "entry 3 was changed"),
    (change_and_hash, "entry 4 does not follow entry 3: one of them was replaced"),
    (lambda old: [*old[:2], *old[3:]], "entry 3 is missing before entry 4"),
    (lambda old: [*old[:2], *old[4:]], "entries 3 to 4 are missing before entry 5"),
    (lambda old: [*old[:2], old[3], old[2], *old[4:]], "entry 3 is missing before entry 4"),
    (lambda old: [*old[:3], *old[2:]], "entry 3 comes after entry 3: repeated or moved"),
    (lambda old: old[1:], "entry 1 is missing at the start"),
    (lambda old: old[:-1], "head.json names entry 6, but the log ends with entry 5: cut off at the end"),
    (lambda _: [], "the log has no entries"),
    (lambda old: [*old[:2], b"nonsense\n", *old[3:]], "the entry after 2 is no entry of an audit log"),
    (lambda old: [*old[:-1], old[-1].replace(b'"q5"', b'"qX"')], "entry 6 was changed"),
]


@pytest.mark.parametrize(("break_it", "says"), BREAKS)
def test_first_broken_entry_is_named(tmp_path: Path, break_it: Callable[[list[bytes]], list[bytes]], says: str) -> None:
    folder = written(tmp_path / "log")
    (path,) = files_of(folder)
    path.write_bytes(b"".join(break_it(lines(folder))))
    assert verify(folder).problems[0].endswith(says)


@given(at=st.integers(0, 10_000), byte=st.integers(0, 255))
@settings(max_examples=150)
def test_no_changed_byte_passes(tmp_path_factory: pytest.TempPathFactory, at: int, byte: int) -> None:
    folder = written(tmp_path_factory.mktemp("audit") / "log")
    (path,) = files_of(folder)
    data = bytearray(path.read_bytes())
    at %= len(data)
    same = data[at] == byte
    data[at] = byte
    path.write_bytes(data)
    assert bool(verify(folder).problems) != same


def test_log_that_was_cut_off_with_its_note_is_missed_by_the_note_of_another_place(tmp_path: Path) -> None:
    folder = written(tmp_path / "log")
    whole = verify(folder)
    (path,) = files_of(folder)
    path.write_bytes(b"".join(lines(folder)[:4]))
    fifth = verify(folder)
    (folder / "head.json").write_text(json.dumps({"n": 4, "hash": fifth.head}))
    assert verify(folder).problems == []  # the limit that the documentation states
    assert "cut off" in verify(folder, expect={6: whole.head}).problems[0]
    assert "replaced" in verify(folder, expect={4: whole.head}).problems[0]
    assert verify(folder, expect={4: fifth.head}).problems == []


def test_missing_note_is_a_problem(tmp_path: Path) -> None:
    folder = written(tmp_path / "log")
    (folder / "head.json").unlink()
    assert "head.json" in verify(folder).problems[0]


def test_chain_goes_on_after_a_restart_and_a_torn_line_is_cut_and_stated(tmp_path: Path) -> None:
    folder = written(tmp_path / "log")
    (path,) = files_of(folder)
    with path.open("ab") as file:
        file.write(b'{"n":7,"time":"20')
    written(folder, 1)
    found = verify(folder)
    assert (found.problems, found.last) == ([], 8)
    assert found.notes == ['entry 7 states a gap: {"torn_bytes": 17}']


def test_entries_that_were_cut_off_stay_missing_when_the_log_goes_on(tmp_path: Path) -> None:
    folder = written(tmp_path / "log")
    (path,) = files_of(folder)
    path.write_bytes(b"".join(lines(folder)[:3]))
    written(folder, 2)
    assert "entries 4 to 6 are missing before entry 7" in verify(folder).problems[0]
    assert [json.loads(line)["n"] for line in lines(folder)] == [1, 2, 3, 7, 8, 9]
    assert json.loads(lines(folder)[3])["what"] == {"missing": [4, 6]}


def test_entries_that_another_place_remembers_stay_missing_too(tmp_path: Path) -> None:
    folder = written(tmp_path / "log")
    whole = verify(folder)
    (path,) = files_of(folder)
    path.write_bytes(b"".join(lines(folder)[:3]))
    (folder / "head.json").unlink()
    written(folder, 1, anchor=Head(6, whole.head))
    assert "entries 4 to 6 are missing before entry 7" in verify(folder).problems[0]


def test_files_are_rotated_with_the_chain_and_the_oldest_is_removed_as_the_log_states(tmp_path: Path) -> None:
    folder = written(tmp_path / "log", 40, file_bytes=1500, files=3)
    found, kept = verify(folder), files_of(folder)
    assert len(kept) == 3
    assert all(path.stat().st_size <= 1500 for path in kept)
    assert found.problems == []
    assert found.first == int(kept[0].stem) > 1
    assert f"entries 1 to {found.first - 1} were removed with their files, as the log states" in found.notes
    kept[0].unlink()
    assert "missing at the start" in verify(folder).problems[0]


def test_statement_of_removed_files_cannot_be_sent_by_somebody(tmp_path: Path) -> None:
    audit = log_in(tmp_path / "log")
    audit.append(Event("stop"))
    second = audit.head
    audit.append(Event("stop"))
    audit.append(Event("request", {"act": "retention", "what": {"until": 1, "hash": second.hash}}))
    audit.append(Event("request", {"x": {"act": "retention", "until": 1, "hash": second.hash}}))
    audit.close()
    (path,) = files_of(tmp_path / "log")
    path.write_bytes(b"".join(lines(tmp_path / "log")[1:]))
    assert "entry 1 is missing at the start" in verify(tmp_path / "log").problems[0]


class Disk:
    """Fails the writes of a log as a full disk does: some bytes of a line are written, then none."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.full = False
        self._write = os.write
        monkeypatch.setattr(os, "write", self.write)

    def write(self, descriptor: int, data: bytes) -> int:
        if not self.full:
            return self._write(descriptor, data)
        if len(data) > 50:
            return self._write(descriptor, data[:50])
        raise OSError(errno.ENOSPC, "No space left on device")


def test_full_disk_is_counted_and_stated_afterwards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, disk = SimClock(), Disk(monkeypatch)
    audit = log_in(tmp_path / "log", clock)
    audit.append(Event("request"))
    disk.full = True
    for _ in range(5):
        assert not audit.append(Event("request"))
        clock.advance_to(clock.now_s() + 0.5)
    assert audit.lost == 5
    disk.full = False
    clock.advance_to(10.0)
    assert audit.append(Event("stop"))
    assert audit.lost == 0
    audit.close()
    found = verify(tmp_path / "log")
    assert (found.problems, found.last) == ([], 3)
    assert found.notes == ['entry 2 states a gap: {"not_written": 5, "reason": "No space left on device"}']


def test_folder_that_cannot_be_made_ends_nothing(tmp_path: Path) -> None:
    clock = SimClock()
    (tmp_path / "file").touch()
    audit = log_in(tmp_path / "file" / "log", clock)
    assert not audit.append(Event("stop"))
    (tmp_path / "file").unlink()
    clock.advance_to(2.0)
    assert audit.append(Event("stop"))
    audit.close()
    assert verify(tmp_path / "file" / "log").last == 2


def test_second_writer_gets_another_folder_or_counts(tmp_path: Path) -> None:
    first, clock = log_in(tmp_path / "log"), SimClock()
    first.append(Event("stop"))
    assert unlocked(tmp_path / "log") == tmp_path / "log-2"
    second = log_in(tmp_path / "log", clock)
    assert not second.append(Event("stop"))
    first.close()
    clock.advance_to(2.0)
    assert second.append(Event("stop"))
    second.close()
    assert unlocked(tmp_path / "log") == tmp_path / "log"
    assert verify(tmp_path / "log").problems == []


def test_link_in_place_of_the_file_is_not_followed(tmp_path: Path) -> None:
    folder = tmp_path / "log"
    folder.mkdir()
    (folder / "000000000001.jsonl").symlink_to(tmp_path / "elsewhere")
    audit = log_in(folder)
    assert not audit.append(Event("stop"))
    assert not (tmp_path / "elsewhere").exists()


def test_values_of_any_size_make_an_entry_of_bounded_size(tmp_path: Path) -> None:
    deep: list[object] = []
    for _ in range(500):
        deep = [deep]
    audit = log_in(tmp_path / "log")
    huge = {"text": "x" * 10**6, "deep": deep, "nan": float("nan"), "many": list(range(10**5)), "bytes": b"x" * 10**5}
    audit.append(
        Event("request", huge | {f"k{number}": "y" * 300 for number in range(60)}, ["r" * 1000] * 1000, "z" * 10**6)
    )
    audit.append(Event("request", {"name": "\x1b[2J\n\u2028\ud800"}))
    audit.close()
    assert all(len(line) <= 8300 for line in lines(tmp_path / "log"))
    assert verify(tmp_path / "log").problems == []


def test_one_entry_can_be_recorded_by_a_command(tmp_path: Path) -> None:
    for name in ("r1", "r2"):
        record(tmp_path / "keys", "keys", Event("key", {"name": name}, result="issued", operator="anna@lab"))
    found = verify(tmp_path / "keys")
    assert (found.problems, found.last) == ([], 2)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="audit log cannot be written"):
        record(tmp_path / "file" / "keys", "keys", Event("key"))


def test_entries_are_selected_and_followed(tmp_path: Path) -> None:
    clock = SimClock()
    audit = log_in(tmp_path / "log", clock)
    reader_of = Reader(tmp_path / "log") if files_of(tmp_path / "log") else None
    audit.append(Event("request", {}, ("r1",), operator="anna@lab"))
    clock.advance_to(100.0)
    audit.append(Event("request", {}, ("r2",), operator="ben@lab"))
    audit.append(Event("stop", {}, (), source="console@desk:1/1:ben"))
    assert reader_of is not None
    entries = list(reader_of.read())
    assert [each["n"] for each in entries] == [1, 2, 3]

    def numbers(selection: Selection) -> list[int]:
        return [each["n"] for each in entries if selection.wants(each)]

    assert numbers(Selection(robot="r1")) == [1, 3]  # a stop of all concerns it
    assert numbers(Selection(operator="anna")) == numbers(Selection(operator="anna@lab")) == [1]
    assert numbers(Selection(operator="ben")) == [2, 3]
    assert numbers(Selection(since=datetime.fromtimestamp(1.7e9 + 50, UTC))) == [2, 3]
    audit.append(Event("stop"))
    assert [each["n"] for each in reader_of.read()] == [4]
    assert list(reader_of.read()) == []


def test_times_are_read() -> None:
    now = datetime(2026, 11, 25, 12, tzinfo=UTC)
    assert since("90m", now) == datetime(2026, 11, 25, 10, 30, tzinfo=UTC)
    assert since("2026-11-25T10:30:00+00:00", now) == since("90m", now)
    for wrong in ("yesterday", "-1h", "999999999999d", ""):
        with pytest.raises(ConfigError, match="invalid time"):
            since(wrong, now)
    with pytest.raises(ConfigError, match="there is no audit log"):
        Reader(Path("/nonexistent"))
