"""What robots say is read with care, and shown as one line that says what to do."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from fullswarm.deploy.fleet.commands import _size, json_line, status_of
from fullswarm.deploy.fleet.facts import Facts, Health, bare_facts
from fullswarm.deploy.fleet.login import Address
from fullswarm.deploy.fleet.releases import missing_of
from fullswarm.deploy.fleet.remote import clean, clean_log_line, last_line, strict_json
from fullswarm.deploy.release import manifest
from fullswarm.errors import FullswarmError, MessageError

RELEASE, NEWER = "1.0-0123456789ab", "1.1-0123456789ab"
WAIT = "wait: without a commit it rolls back"
HERE = Address("r1", "10.0.0.1", 22, "me")
GOOD = Health(release=RELEASE, healthy=True)


def test_words_of_a_robot_are_one_printable_line() -> None:
    assert clean(b"\x1b[2Jowned\r\n\x07 by \xe2\x80\xae evil\xff") == "[2Jowned by evil�"
    assert clean("x" * 10_000_000, limit=5) == "xxxx…"
    assert clean_log_line(b"  \x1b]0;title\x07 text\n") == "   ]0;title  text"
    assert last_line(b"first\nlast one\n\n") == "last one"
    assert last_line(b"refused (no signature.\r )\n") == "refused (no signature. )"


@pytest.mark.parametrize(
    "said", [b"", b"nonsense", b"[]", b'{"protocol": "1"}', b"[" * 100_000, b'{"releases": [1]}', b"\xff"]
)
def test_answers_that_are_none(said: bytes) -> None:
    with pytest.raises(MessageError, match="r1: its answer cannot be read"):
        strict_json(said, Facts, "r1")


def test_facts_may_hold_more_than_we_know() -> None:
    said = {
        "protocol": 1,
        "current": RELEASE,
        "pending": None,
        "news": {"a": 1},
        "health": {"moving": True, "behaviour": "flocking"},
    }
    facts = strict_json(json.dumps(said).encode(), Facts, "r1")
    assert (facts.installed, facts.settled, facts.busy_with) == (True, True, "moving (flocking)")


def test_a_bare_computer_says_what_it_is() -> None:
    said = b"arch=aarch64\nglibc=2.36\npython=3.11\npython3.13=yes\ndisk_free_kb=2048\nclock_utc=12\nsystemd=yes\n"
    tools = b"has_ssh-keygen=yes\nhas_tar=yes\nhas_gzip=yes\nhas_awk=yes\n"
    facts = bare_facts(said + tools, "r1")
    assert (facts.arch, facts.pythons, facts.disk_free_bytes, facts.installed) == (
        "aarch64",
        ["3.13"],
        2 * 2**20,
        False,
    )
    with pytest.raises(FullswarmError, match="r1: missing on it: ssh-keygen, tar, gzip, awk"):
        bare_facts(said, "r1")
    with pytest.raises(MessageError):
        bare_facts(b"arch=\nclock_utc=soon\n", "r1")


def test_a_robot_may_ask_for_nothing_outside_the_release(tmp_path: Path) -> None:
    (tmp_path / manifest.SUMS).write_text(f"{'0' * 64}  lib/a.py\n{'1' * 64}  lib/b.py\n")
    assert missing_of(tmp_path, b"lib/b.py\nlib/a.py\nlib/a.py\n", "r1") == ("lib/a.py", "lib/b.py")
    with pytest.raises(MessageError, match="which is not in the release"):
        missing_of(tmp_path, b"lib/a.py\n../../keys/release_ed25519\n", "r1")


@pytest.mark.parametrize(
    ("facts", "wanted", "health", "mend"),
    [
        (Facts(), "", "not installed", "fullswarm deploy r1"),
        (
            Facts(protocol=1, robot="r2"),
            "",
            "another robot",
            "`host` in the fleet file, or `fullswarm deploy --rename`",
        ),
        (Facts(protocol=1, robot="r1"), "", "no release", "fullswarm deploy r1"),
        (Facts(protocol=1, robot="r1", current=RELEASE, pending=RELEASE), "", "pending", WAIT),
        (Facts(protocol=1, robot="r1", current=RELEASE), "", "silent", "fullswarm logs r1"),
        (Facts(protocol=1, robot="r1", current=RELEASE, health=Health()), "", "not healthy", "fullswarm logs r1"),
        (Facts(protocol=1, robot="r1", current=RELEASE, health=GOOD), RELEASE, "healthy", ""),
        (Facts(protocol=1, robot="r1", current=RELEASE, health=GOOD), NEWER, "healthy", "fullswarm update r1"),
    ],
)  # fmt: skip
def test_each_state_says_what_to_do(facts: Facts, wanted: str, health: str, mend: str) -> None:
    told = status_of(HERE, facts, wanted)
    assert (told.health, told.mend) == (health, mend)
    assert (told.exit_code == 0) == (health == "healthy" and not told.skew)


def test_warnings_stand_beside_a_healthy_robot() -> None:
    facts = Facts(
        protocol=1, robot="r1", current=RELEASE, health=GOOD, temperature_c=84.0, disk_free_bytes=1_000_000,
        clock_utc=time.time() - 3600,
    )  # fmt: skip
    told = status_of(HERE, facts, RELEASE)
    assert told.why == "clock off by -3600 s; 1 MB of disk free; 84 °C"


def test_sizes_for_people() -> None:
    assert [_size(each) for each in (0, 999, 99_000, 40_800_000)] == ["-", "999 B", "99 kB", "40.8 MB"]


def test_a_line_of_the_journal_as_json() -> None:
    said = {"MESSAGE": "hub\x1b[2J lost", "__REALTIME_TIMESTAMP": "1800000000500000", "PRIORITY": "4"}
    assert json.loads(json_line(json.dumps(said).encode())) == {
        "time_s": 1.8e9 + 0.5, "priority": 4, "text": "hub [2J lost",
    }  # fmt: skip
    assert json.loads(json_line(b"sudo: no tty \xff")) == {"text": "sudo: no tty \ufffd"}
    assert json.loads(json_line(b'{"MESSAGE": [1, 2], "__REALTIME_TIMESTAMP": 1}'))["text"] == "binary data"
