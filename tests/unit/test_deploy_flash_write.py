"""Writing: one stream, many cards, each with its own boot partition; what fails says what to do and stops no other."""

from __future__ import annotations

import errno
import hashlib
import os
import random
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.deploy.flash import write
from fullswarm.deploy.flash.image import CHUNK_BYTES
from fullswarm.deploy.flash.write import Job, write_jobs


def quiet(_name: str, _what: str, _done: int) -> None:
    pass


def pieces(data: bytes) -> list[bytes]:
    return [data[at : at + CHUNK_BYTES] for at in range(0, len(data), CHUNK_BYTES)]


def job(folder: Path, name: str, edited: bytes = b"", at: int = 0, target: Path | None = None) -> Job:
    file = folder / f"{name}.edited"
    file.write_bytes(edited)
    target = target or folder / name
    if not target.exists():
        target.touch()
    return Job(name, target, file, at)


def noise(size: int, seed: int = 1) -> bytes:
    return random.Random(seed).randbytes(size)


@settings(max_examples=40)
@given(st.integers(1, 60), st.integers(0, 70), st.integers(0, 30), st.integers(1, 20))
def test_the_edited_part_lies_exactly_where_it_belongs(size: int, at: int, length: int, chunk: int) -> None:
    data, patch = bytes(range(size)), b"\xff" * min(length, max(0, size - at))
    number = os.memfd_create("patch")
    try:
        os.write(number, patch)
        got = b"".join(
            write._overlay(data[begin : begin + chunk], begin, number, at) for begin in range(0, size, chunk)
        )
    finally:
        os.close(number)
    assert got == data[:at] + patch + data[at + len(patch) :]


def test_two_cards_get_the_same_image_and_each_its_own_boot_partition(tmp_path: Path) -> None:
    data = noise(3_000_000) + bytes(6_000_000) + noise(100_000, 2)
    at = CHUNK_BYTES - 1000  # across two chunks
    jobs = [job(tmp_path, f"r{each}", bytes([each]) * 5000, at) for each in (1, 2)]
    for each, outcome in zip(jobs, write_jobs(pieces(data), jobs, quiet), strict=True):
        assert outcome.error is None
        wanted = data[:at] + each.edited.read_bytes() + data[at + 5000 :]
        assert each.target.read_bytes() == wanted
        assert (outcome.bytes, outcome.sha256) == (len(wanted), hashlib.sha256(wanted).hexdigest())
        assert each.target.stat().st_blocks * 512 < 4_500_000  # the zeros take no room


def test_a_card_that_is_full_says_so_and_stops_no_other(tmp_path: Path) -> None:
    data = noise(9_000_000)
    jobs = [job(tmp_path, "full", target=Path("/dev/full")), job(tmp_path, "good")]
    bad, good = write_jobs(pieces(data), jobs, quiet)
    assert "is full after 0 MB" in str(bad.error)
    assert "use a larger card" in str(bad.error)
    assert good.error is None
    assert (tmp_path / "good").read_bytes() == data


def test_a_bit_that_flips_on_the_card_is_found_and_located(tmp_path: Path) -> None:
    data = noise(13_000_000)
    one = job(tmp_path, "flips")

    def flip(_name: str, what: str, done: int) -> None:
        if what == "read back" and done == CHUNK_BYTES:
            with one.target.open("r+b") as file:
                file.seek(9_000_000)
                file.write(bytes([data[9_000_000] ^ 1]))

    (outcome,) = write_jobs(pieces(data), [one], flip)
    assert "from 8 MB on" in str(outcome.error)
    assert "use another one" in str(outcome.error)


def test_a_target_that_is_not_there_or_not_ours_is_explained(tmp_path: Path) -> None:
    gone = Job("gone", tmp_path / "none" / "x", job(tmp_path, "x").edited, 0)
    (outcome,) = write_jobs([b"x"], [gone], quiet)
    assert "is gone" in str(outcome.error)
    for number, words in (
        (errno.EACCES, "permission denied.*sudo -E"),
        (errno.EBUSY, "unmount it"),
        (errno.EIO, "fails at 7 MB.*another card, then another reader"),
        (errno.ENOMEDIUM, "was the card removed"),
    ):
        error = write.explain(OSError(number, os.strerror(number)), Path("/dev/sdb"), 7_000_000)
        with pytest.raises(type(error), match=words):
            raise error


def test_short_writes_are_finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = os.pwrite
    monkeypatch.setattr(os, "pwrite", lambda file, data, at: real(file, bytes(data)[:70_001], at))
    data = noise(1_000_000)
    (outcome,) = write_jobs(pieces(data), [job(tmp_path, "short")], quiet)
    assert outcome.error is None
    assert (tmp_path / "short").read_bytes() == data


def test_an_error_of_the_device_in_the_middle_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real, told = os.pwrite, threading.Event()

    def failing(file: int, data: bytes, at: int) -> int:
        if at >= CHUNK_BYTES:
            told.set()
            raise OSError(errno.EIO, "Input/output error")
        return real(file, data, at)

    monkeypatch.setattr(os, "pwrite", failing)
    (outcome,) = write_jobs(pieces(noise(9_000_000)), [job(tmp_path, "worn")], quiet)
    assert told.is_set()
    assert "fails at 4 MB: Input/output error" in str(outcome.error)


def test_ctrl_c_ends_all_writers_and_leaves_no_thread(tmp_path: Path) -> None:
    def stream() -> Iterator[bytes]:
        yield noise(CHUNK_BYTES)
        raise KeyboardInterrupt

    before = threading.active_count()
    with pytest.raises(KeyboardInterrupt):
        write_jobs(stream(), [job(tmp_path, "a"), job(tmp_path, "b")], quiet)
    assert threading.active_count() == before


@pytest.fixture
def loop_card(tmp_path: Path) -> Iterator[Path]:
    """A block device of 8 MB."""
    losetup = shutil.which("losetup", path=f"{os.environ['PATH']}:/usr/sbin:/sbin")
    if losetup is None or os.geteuid() != 0:
        pytest.skip("needs losetup and root, for a block device of its own")
    backing = tmp_path / "backing"
    backing.touch()
    os.truncate(backing, 8_000_000)
    done = subprocess.run([losetup, "-f", "--show", backing], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        pytest.skip(f"needs a loop device: {done.stderr.strip()}")
    device = Path(done.stdout.strip())
    yield device
    subprocess.run([losetup, "-d", device], check=True)


def test_a_block_device_is_written_and_a_small_one_is_full(tmp_path: Path, loop_card: Path) -> None:
    data = noise(5_000_192)
    (outcome,) = write_jobs(pieces(data), [job(tmp_path, "card", b"edit" * 100, 512, loop_card)], quiet)
    assert outcome.error is None
    wanted = data[:512] + b"edit" * 100 + data[912:]
    with loop_card.open("rb") as file:
        assert file.read(len(data)) == wanted
    (outcome,) = write_jobs(pieces(noise(9_000_000)), [job(tmp_path, "small", b"", 0, loop_card)], quiet)
    assert "is full after 4 MB" in str(outcome.error)
