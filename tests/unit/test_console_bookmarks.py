"""Bookmarks: what is kept beside a recording, and what is not read; clips: what is refused before any is made."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fullswarm.clock import SimClock
from fullswarm.operator.console import bookmarks as marks
from fullswarm.operator.console.bookmarks import Bookmarks, file_of, read
from fullswarm.operator.console.clips import NO_RECORDING, Clips
from fullswarm.runtime import Runtime
from tests.unit.console_bench import ConsoleBench, Page


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


def test_they_are_there_when_the_recording_is_opened_again(recording: Path) -> None:
    kept = Bookmarks(lambda: recording)
    assert kept.add(1000.0, "b", "anna") == ""
    assert kept.add(900.0, "a", "bert") == ""
    assert file_of(recording).stat().st_mode & 0o777 == 0o600
    found = Bookmarks(lambda: recording).shown(5.0, 1005.0)
    assert [(each["name"], each["at"], each["by"]) for each in found] == [("a", -100.0, "bert"), ("b", 0.0, "anna")]
    assert kept.delete(str(found[0]["id"])) == ""
    assert [each.name for each in read(recording)] == ["b"]
    assert "gone" in kept.delete("x")


def test_without_a_recording_they_last_as_long_as_the_console(tmp_path: Path) -> None:
    kept = Bookmarks(lambda: None)
    assert kept.add(1.0, "a", "") == ""
    assert len(kept.shown(0.0, 0.0)) == 1
    assert list(tmp_path.iterdir()) == []


def test_there_are_only_so_many(recording: Path) -> None:
    kept = Bookmarks(lambda: None)
    for number in range(marks.MOST):
        assert kept.add(float(number), "a", "") == ""
    assert "delete one" in kept.add(0.0, "b", "")


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"[]", b'{"format":"other"}', b'{"format":"fullswarm.bookmarks/1","bookmarks":5}', b"\xff",
     b'{"format":"fullswarm.bookmarks/1","bookmarks":[{"id":"a"}]}', b" " * (marks.LARGEST_FILE + 1)],
)  # fmt: skip
def test_a_damaged_file_is_not_read(recording: Path, content: bytes) -> None:
    file_of(recording).write_bytes(content)
    assert read(recording) == ()


def test_a_file_that_cannot_be_written_is_reported(recording: Path) -> None:
    kept = Bookmarks(lambda: recording.parent / "gone" / "run.mcap")
    assert "kept until this console ends" in kept.add(1.0, "a", "")
    assert len(kept.shown(0.0, 0.0)) == 1


def test_pages_see_each_others_bookmarks() -> None:
    bench = ConsoleBench()
    page, session = bench.join()
    other, _ = bench.join("session-2", "bert")
    assert bench.say(session, page, "mark", op="add", at=100.0, name="  the\n stop ")["ok"]
    (mark,) = other.last("bookmarks")["bookmarks"]
    assert (mark["name"], mark["at"]) == ("the stop", pytest.approx(100.0, abs=0.02))
    assert mark["by"] == session.name
    for name in ("", "  ", "\x07", "x" * 81):
        assert not bench.say(session, page, "mark", op="add", at=100.0, name=name)["ok"]
    assert bench.say(session, page, "mark", op="delete", id=mark["id"])["ok"]
    assert other.last("bookmarks")["bookmarks"] == []
    assert json.loads(json.dumps(other.last("bookmarks")))["clips"] == NO_RECORDING


def test_observers_and_public_screens_set_none() -> None:
    bench = ConsoleBench(read_only=True)
    page, session = bench.join()
    assert not bench.say(session, page, "mark", op="add", at=100.0, name="a")["ok"]
    assert not bench.say(session, page, "clip", begin=1.0, end=2.0, kind="gif")["ok"]
    assert bench.say(session, page, "look", at=100.0)["ok"]  # but may look


def test_without_a_recording_there_is_no_clip() -> None:
    clips = Clips(lambda: None, Runtime(SimClock()))
    assert clips.refusal() == NO_RECORDING
    assert clips.make(1.0, 2.0, "gif", Page()) == NO_RECORDING
    assert clips.download("x") is None
    clips.close()


@pytest.mark.parametrize("fields", [{"kind": "exe"}, {"begin": "x"}, {"end": 1e13}, {"begin": 3.0}, {"kind": "../x"}])
def test_a_clip_of_nonsense_is_refused(fields: dict[str, object]) -> None:
    bench = ConsoleBench()
    page, session = bench.join()
    assert not bench.say(session, page, "clip", **{"begin": 1.0, "end": 2.0, "kind": "mcap", **fields})["ok"]
