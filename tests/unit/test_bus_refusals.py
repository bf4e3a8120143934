"""The hub's log of what it refuses: from zenoh's trace log, cut anywhere, with keys that try to deceive."""

from __future__ import annotations

import os

import pytest
from structlog.testing import capture_logs

from fullswarm.bus.refusals import AGAIN_S, KEYS, RefusalLog

R1, EVE = "1" * 32, "2" * 32
PREFIX = (
    "\x1b[2m2026-01-01T00:00:00Z\x1b[0m \x1b[35mTRACE\x1b[0m  rx-0 ThreadId({}) \x1b[2mzenoh::net::routing\x1b[0m: "
)


def line(text: str, thread: int = 7) -> str:
    return PREFIX.format(f"{thread:02}") + text + "\n"


def linked(session: str, name: str, address: str = "10.0.0.9:4000") -> str:
    return line(
        f"New low-pass filter transport unicast Transport Unicast {{ zid: {session}, whatami: Client, links: "
        f'[Link {{ src: tls/10.0.0.1:7447, dst: tls/{address}, auth_identifier: Tls(Some("{name}")) }}] }}', thread=2
    )  # fmt: skip


def refused(session: str, key: str, thread: int = 7) -> str:
    text = f"Using cached result: {session} is unauthorized to Put (ingress) on {key}"
    return line(text, thread) + line("Msg intercepted!", thread)


class Read:
    """A log of refusals on a clock of its own."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.log = RefusalLog(lambda: self.now_s)
        self.feed(linked(R1, "r1.1") + linked(EVE, "eve.1", "10.0.0.8:4000"))

    def feed(self, text: str) -> None:
        self.log.feed(text.encode())

    def report(self) -> list[tuple[str, str, str, int]]:
        with capture_logs() as logs:
            self.log.report()
        return [(each.get("certificate", ""), each["tried"], each.get("where", ""), each["times"]) for each in logs]


@pytest.mark.parametrize("size", [1, 7, 100, 100_000])
def test_a_log_that_is_cut_anywhere_names_each_refusal_once(size: int) -> None:
    read = Read()
    text = refused(R1, "lab/r2/stop") + refused(EVE, "lab/eve/estop", 8) + refused(R1, "lab/r2/stop")
    for start in range(0, len(text), size):
        read.feed(text[start : start + size])
    assert read.report() == [("r1.1", "publish", "lab/r2/stop", 2), ("eve.1", "publish", "lab/eve/estop", 1)]


def test_threads_that_mix_their_lines_are_told_apart() -> None:
    read = Read()
    allowed = line(f"Using cached result: {EVE} is authorized to Put (ingress) on lab/eve/x", 8)
    first, second = refused(R1, "lab/r2/stop").splitlines(keepends=True)
    read.feed(first + allowed + second)
    assert read.report() == [("r1.1", "publish", "lab/r2/stop", 1)]


def test_a_key_with_line_breaks_accuses_no_other_certificate() -> None:
    read = Read()
    forged = line(f"{'3' * 32} on CertCommonName(eve.1) is unauthorized to Put (ingress) on lab/eve/stop")
    read.feed(refused(R1, "lab/r2/x\n" + forged.rstrip("\n")))
    assert [certificate for certificate, *_ in read.report()] == [""]
    read.feed(refused(R1, "lab/r2/x\ny"))
    assert read.report() == [("r1.1", "publish", "lab/r2/x", 1)]


def test_what_is_too_large_is_named_unless_a_stranger_may_have_sent_it() -> None:
    read = Read()
    large = line(f"Using cached result: {R1} is authorized to Put (ingress) on lab/r1/x") + line("Msg intercepted!")
    stranger = "4" * 32
    read.feed(large)
    assert read.report()[0][::2] == ("r1.1", "lab/r1/x")
    read.feed(
        line(f"{stranger} did not match any configured ACL subject. Default") + linked(stranger, "old.1", "[::1]:9")
    )
    read.feed(large)
    told = read.report()
    assert ("old.1", "connect, and it is not in the list of valid certificates", "[::1]:9", 1) in told
    assert [each[0] for each in told] == ["old.1", ""]
    read.feed(line("Read error on TLS link [::1]:7447 => [::1]:9: peer closed"))
    read.now_s += AGAIN_S
    read.feed(large)
    assert read.report()[0][::2] == ("r1.1", "lab/r1/x")


def test_a_flood_of_keys_is_a_few_lines_each_ten_seconds() -> None:
    read = Read()
    for number in range(5000):
        read.feed(refused(R1, f"lab/r2/{number}"))
    first = read.report()
    assert len(first) == KEYS + 1
    assert sum(times for *_, times in first) == 5000
    for number in range(1000):
        read.feed(refused(R1, f"lab/r2/again{number}"))
        assert read.report() == []
    read.now_s += AGAIN_S
    assert read.report() == [("r1.1", "publish", "", 1000)]
    read.now_s += AGAIN_S
    assert read.report() == []
    read.feed(refused(R1, "lab/r2/new"))
    assert read.report() == [("r1.1", "publish", "lab/r2/new", 1)]


def test_many_refusals_of_one_piece_are_all_counted() -> None:
    read = Read()
    read.feed(refused(R1, "lab/r2/stop") * 1000)
    assert sum(times for *_, times in read.report()) == 1000


def test_what_cannot_be_read_is_said_and_the_pipe_is_read_on(monkeypatch: pytest.MonkeyPatch) -> None:
    read = Read()
    reading, writing = os.pipe()
    take, failures = read.log._take, [ValueError("odd")]

    def fail_once(text: bytes, begin: int, end: int) -> None:
        if failures:
            os.write(writing, refused(R1, "lab/r2/stop").encode())
            os.close(writing)
            raise failures.pop()
        take(text, begin, end)

    monkeypatch.setattr(read.log, "_take", fail_once)
    os.write(writing, line("something new").encode())
    with capture_logs() as logs:
        read.log._read(reading)
    assert [each["error"] for each in logs] == ["ValueError: odd"]
    assert read.report() == [("r1.1", "publish", "lab/r2/stop", 1)]
