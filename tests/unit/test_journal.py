"""Journals: what is noted comes back, in blocks that damage does not pass through, in files that a reader empties."""

from __future__ import annotations

import functools
import math
import zlib
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.clock import SimClock
from fullswarm.drivers.base import FleetReading, Pose, RangeScan
from fullswarm.journal import journal as journals
from fullswarm.journal.feed import Feed, FeedDisk, FeedScheduler, events
from fullswarm.journal.journal import Journal, JournalFile, JournalTail, Kind, compressed, read_block
from fullswarm.journal.naming import difference
from fullswarm.journal.ports import JournalDisk, JournalScheduler, Names, timer_name
from fullswarm.journal.readings import ReadingCopy, ReadingFeed
from fullswarm.runtime import Runtime


def items_of(journal: Journal) -> list[Any]:
    """Return what a journal holds, as it is read again, without its head."""
    return read_block(compressed(journal.take()))[1][1:]


def a_reading(seed: int, bodies: bool = True) -> FleetReading:
    random = np.random.default_rng(seed)
    scan = RangeScan(1.5, random.random(4), np.array([1.0, math.inf, math.nan, 2.0]), 3.0, Pose(0.1, 0.0, -1.0))
    return FleetReading(
        stamp_s=np.array([-math.inf, 2.0]), pose=random.random((2, 3)), odometry=random.random((2, 3)),
        twist=random.random((2, 2)), hazards=np.array([1, 0], np.uint8), contacts=np.array([0, 3]),
        battery=np.array([0.5, -1.0]), obstacles=random.random((3, 6)), position_sigma_m=np.full(2, math.nan),
        odometry_breaks=np.array([0, 7]), bodies=random.random((1, 3)) if bodies else None, ranges=((1, scan),),
    )  # fmt: skip


def test_items_belong_to_the_event_they_came_in() -> None:
    journal = Journal({"kind": "test"})
    journal.note((Kind.ANSWER, "outside", 1))
    journal.run((Kind.CALL, "build"), lambda: journal.note((Kind.ANSWER, "port", 2)))

    def fail() -> None:
        journal.run((Kind.CALL, "within"), lambda: journal.note((Kind.PUBLISH, "key", b"x", "")))
        raise ArithmeticError("no")

    with pytest.raises(ArithmeticError):
        journal.run((Kind.TIMER, "tick"), fail)
    build, tick = events(items_of(journal))
    assert build.cause == (Kind.CALL, "build")
    assert list(build.answers["port"]) == [2]
    assert "outside" not in build.answers
    assert tick.outputs == [(Kind.PUBLISH, "key", b"x", ""), (Kind.RAISED, "ArithmeticError", "no")]


@given(st.binary(max_size=200))
def test_garbage_is_no_block(data: bytes) -> None:
    for each in (data, zlib.compress(data), compressed(msgspec.msgpack.encode([0, [data]]))):
        try:
            number, items = read_block(each)
        except ValueError:
            continue
        assert isinstance(number, int)
        assert isinstance(items, list)


@given(
    st.lists(
        st.recursive(
            st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats() | st.text() | st.binary(),
            lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
            max_leaves=8,
        ),
        max_size=8,
    )
)
def test_values_come_back(values: list[Any]) -> None:
    journal = Journal({})
    journal.items += values
    assert repr(items_of(journal)) == repr(values)


def test_a_block_that_would_fill_the_memory_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journals, "LARGEST_BLOCK", 1000)
    with pytest.raises(ValueError, match="too long"):
        read_block(compressed(msgspec.msgpack.encode([0, ["x" * 2000]])))


def test_arrays_come_back_to_the_bit_and_can_be_written_to() -> None:
    arrays = [
        np.array([math.nan, -0.0, math.inf, 5e-324]), np.zeros((0, 6)), np.arange(6, dtype=np.int8).reshape(2, 3),
        np.array([True, False]), np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    ]  # fmt: skip
    journal = Journal({})
    journal.items += arrays
    for before, after in zip(arrays, items_of(journal), strict=True):
        assert after.dtype == before.dtype
        assert after.shape == before.shape
        assert after.tobytes() == before.tobytes()
        after[...] = 0


def test_readings_come_back_in_the_same_arrays() -> None:
    first, second = a_reading(1), a_reading(2, bodies=False)
    copy = ReadingCopy(first)
    journal = Journal({})
    journal.items.append((Kind.LAYOUT, copy.layout))
    journal.items.append(copy.take(first))
    same = a_reading(3)
    same.obstacles, same.bodies, same.ranges = first.obstacles, first.bodies, first.ranges
    journal.items.append(copy.take(same))
    journal.items.append(copy.take(second))
    (_, layout), *found = items_of(journal)
    feed = ReadingFeed(layout)
    for number, (item, given_then) in enumerate(zip(found, (first, same, second), strict=True)):
        before = feed.reading.pose, feed.reading.obstacles, feed.reading.ranges
        now = feed.give(item)
        for name in ("stamp_s", "pose", "odometry", "twist", "hazards", "contacts", "battery", "odometry_breaks"):
            assert getattr(now, name).tobytes() == getattr(given_then, name).tobytes(), name
        assert now.pose is before[0]
        assert (now.obstacles is before[1]) is (number == 1)
        assert (now.ranges is before[2]) is (number == 1)
        assert now.obstacles.tobytes() == given_then.obstacles.tobytes()
        assert now.charging is None
        (row, scan), (_, then) = now.ranges[0], given_then.ranges[0]
        assert row == 1
        assert scan.mount == then.mount
        assert scan.distances_m.tobytes() == then.distances_m.tobytes()
    assert feed.reading.bodies is None
    with pytest.raises(ValueError, match="does not fit"):
        feed.give((Kind.READING, b"short", 0, 0, 0))


def test_a_reading_is_a_copy() -> None:
    source = a_reading(1)
    copy = ReadingCopy(source)
    copy.take(source)
    source.pose[0, 0] = 99.0
    assert copy.reading.pose[0, 0] != 99.0


def test_a_file_is_read_while_it_is_written_and_removed_when_the_next_one_is_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(journals, "FILE_BYTES", 400)
    journal = Journal({"kind": "test"})
    file, tail = JournalFile(tmp_path, "r1-ab", journal), JournalTail(tmp_path)
    found = []
    for number in range(20):
        journal.run((Kind.CALL, f"call {number} {np.random.default_rng(number).bytes(40).hex()}"), lambda: None)
        file.flush()
        found += list(tail.read(10_000))
    assert len(list(tmp_path.iterdir())) == 1
    file.close()
    assert [process for process, _ in found] == ["r1-ab"] * 20
    assert [read_block(block)[0] for _, block in found] == list(range(20))


def test_a_block_that_is_cut_off_or_damaged_ends_what_is_read_of_its_file(tmp_path: Path) -> None:
    journal = Journal({"kind": "test"})
    file = JournalFile(tmp_path, "r1-ab", journal)
    for _ in range(3):
        journal.run((Kind.CALL, "call"), lambda: None)
        file.flush()
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    starts = [0]
    while starts[-1] < len(whole):
        starts.append(starts[-1] + journals.HEADER.size + journals.HEADER.unpack_from(whole, starts[-1])[0])
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        assert len(list(JournalTail(tmp_path).read(10_000))) == sum(end <= size for end in starts[1:])
    for place in range(journals.HEADER.size, len(whole)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 255]) + whole[place + 1 :])
        blocks = [block for _, block in JournalTail(tmp_path).read(10_000)]
        assert len(blocks) < 3
        assert [read_block(block)[0] for block in blocks] == list(range(len(blocks)))
    tail = JournalTail(tmp_path)
    path.write_bytes(whole[: starts[1] + 5])
    assert len(list(tail.read(10_000))) == 1
    path.write_bytes(whole)
    assert len(list(tail.read(10_000))) == 2  # it goes on where the rest is there


def test_a_disk_that_fails_ends_the_journal_and_not_the_process(tmp_path: Path) -> None:
    journal = Journal({"kind": "test"})
    file = JournalFile(tmp_path / "missing", "r1-ab", journal)
    journal.run((Kind.CALL, "call"), lambda: None)
    file.flush()
    file.close()
    assert not journal.items


def test_a_process_whose_files_nobody_reads_stops_to_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journals, "FILE_BYTES", 1)
    journal = Journal({"kind": "test"})
    file = JournalFile(tmp_path, "r1-ab", journal)
    for _ in range(2 * journals.MOST_FILES):
        journal.run((Kind.CALL, "call"), lambda: None)
        file.flush()
    assert len(list(tmp_path.iterdir())) == journals.MOST_FILES


def test_names_are_the_same_in_the_next_run() -> None:
    names = Names()
    assert [names.of("a"), names.of("b"), names.of("a")] == ["a", "b", "a #2"]
    assert timer_name(functools.partial(print, "x")) == "print"
    assert timer_name(Names().__init__) == "Names.__init__"  # type: ignore[misc]


def test_timers_fire_when_they_fired_and_hear_the_time_they_heard() -> None:
    class Node:
        def __init__(self, scheduler: JournalScheduler | FeedScheduler) -> None:
            self.scheduler, self.heard = scheduler, [scheduler.now_s()]
            scheduler.every(0.1, self.tick)
            scheduler.after(0.25, self.once)

        def tick(self) -> None:
            self.heard.append(self.scheduler.now_s())

        def once(self) -> None:
            self.heard.append(-self.scheduler.now_s())

    runtime, journal, built = Runtime(SimClock(7.0)), Journal({}), []
    scheduler = JournalScheduler(runtime, journal)
    journal.run((Kind.CALL, "build"), lambda: built.append(Node(scheduler)))
    runtime.run(1.05)
    feed, again = Feed(), []
    found = list(events(items_of(journal)))
    for event in found:
        assert feed.run(event, {"build": lambda: again.append(Node(FeedScheduler(feed)))}) == ""
    assert again[0].heard == built[0].heard
    assert len(again[0].heard) == 12
    assert [event.time_s for event in found] == [abs(each) for each in built[0].heard]
    assert [name.rpartition(".")[2] for name in feed.timers] == ["tick"]  # the other one has fired


def test_errors_of_a_disk_come_again() -> None:
    class Full:
        def read(self, file: Path) -> bytes:
            raise FileNotFoundError(2, "No such file or directory")

        def exists(self, file: Path) -> bool:
            return True

        def write(self, file: Path, content: bytes) -> None:
            raise OSError(28, "No space left on device")

        def replace(self, file: Path, content: bytes) -> None:
            pass

        def remove(self, file: Path) -> None:
            pass

    def use(disk: JournalDisk | FeedDisk) -> list[str]:
        seen = [str(disk.exists(Path("a")))]
        for act in (lambda: disk.read(Path("a")), lambda: disk.write(Path("a"), b"x")):
            try:
                act()
            except OSError as error:
                seen.append(f"{type(error).__name__} {error.errno}")
        disk.replace(Path("a"), b"y")
        return seen

    journal, seen = Journal({}), []
    journal.run((Kind.CALL, "use"), lambda: seen.extend(use(JournalDisk(Full(), journal))))
    feed, again = Feed(), []
    (event,) = events(items_of(journal))
    feed.run(event, {"use": lambda: again.extend(use(FeedDisk(feed)))})
    assert again == seen == ["True", "FileNotFoundError 2", "OSError 28"]
    assert difference(event, feed.outputs, "", ()) is None
    feed.run(event, {"use": lambda: FeedDisk(feed).replace(Path("a"), b"z")})
    found = difference(event, feed.outputs, "", ())
    assert found is not None
    assert "disk" in found.what
