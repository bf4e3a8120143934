"""What is asked of a robot's shell as root, and what sudo's answers mean."""

from __future__ import annotations

import asyncio
import subprocess
from pathlib import Path
from typing import Any, cast

import pytest

from fullswarm.deploy.fleet.remote import Answer, NoRoot, Remote, clean, root_script


def test_a_password_is_taken_off_the_input_whether_sudo_reads_it_or_not(tmp_path: Path) -> None:
    script, first = root_script("cat", "s3cret")
    for reads in ('IFS= read -r p; [ "$p" = s3cret ] || exit 1; echo asked >> asked\n', ""):
        sudo = tmp_path / "sudo"
        sudo.write_text(
            f'#!/bin/sh\n{reads}while :; do case $1 in -p) shift 2 ;; -*) shift ;; *) break ;; esac; done\nexec "$@"\n'
        )
        sudo.chmod(0o755)
        plain = script.replace("$(id -u)", "$(echo 1000)")
        done = subprocess.run(
            ["sh", "-c", plain], input=first + b"fullswarm-begins\ndata", capture_output=True, check=False,
            cwd=tmp_path, env={"PATH": f"{tmp_path}:/usr/bin:/bin"},
        )  # fmt: skip
        assert (done.returncode, done.stdout, done.stderr) == (0, b"fullswarm-begins\ndata", b"")
    assert (tmp_path / "asked").read_text() == "asked\n"


def test_root_needs_no_sudo_and_others_are_never_asked_for_a_password() -> None:
    script, first = root_script("cat", None)
    assert first == b""
    assert "sudo -n" in script
    asroot = script.replace("$(id -u)", "$(echo 0)")
    done = subprocess.run(
        ["sh", "-c", asroot], input=b"data", capture_output=True, check=True, env={"PATH": "/usr/bin:/bin"}
    )
    assert done.stdout == b"data"


HOSTNAME = b"sudo: unable to resolve host r1: Name or service not known\n"


def heard(answer: Answer, monkeypatch: pytest.MonkeyPatch) -> Answer:
    """Let a robot answer a command that shall run as root."""

    async def run(*_: object, **__: object) -> Answer:
        return answer

    monkeypatch.setattr(Remote, "run", run)
    return asyncio.run(Remote("r1", cast(Any, None)).program("health"))


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (1, b"sudo: a password is required\n"),
        (1, b"Sorry, try again.\nsudo: no password was provided\nsudo: 1 incorrect password attempt\n"),
        (1, HOSTNAME + b"Sorry, try again.\nsudo: 3 incorrect password attempts\n"),
        (1, b"pi is not in the sudoers file.  This incident will be reported.\n"),
        (1, b"Sorry, user pi is not allowed to execute '/bin/sh' as root on r1.\n"),
        (1, b"Sorry, user pi may not run sudo on r1.\n"),
        (1, b"sudo: sorry, you must have a tty to run sudo\n"),
        (1, b"sudo-rs: interactive authentication is required\n"),
        (127, b"sh: 1: exec: sudo: not found\n"),
        (127, b"bash: sudo: command not found\n"),
    ],
)
def test_sudo_that_refuses_is_no_root(code: int, said: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(NoRoot) as caught:
        heard(Answer(code, b"", said), monkeypatch)
    assert caught.value.what == f"may not become root there: {clean(said.splitlines()[-1])}"


@pytest.mark.parametrize(
    ("code", "out", "said", "why"),
    [
        (1, b"", b"fullswarm-robot: no health yet\n", "fullswarm-robot: no health yet"),
        (1, b"", HOSTNAME + b"fullswarm-robot: 9 s old\n", "fullswarm-robot: 9 s old"),
        (1, b"", b"sudo: no tty\nfullswarm-robot: 9 s old\n", "fullswarm-robot: 9 s old"),
        (1, b"", HOSTNAME + b"install.sh: cannot write /opt\n", "install.sh: cannot write /opt"),
        (1, b"lib/a.py\n", HOSTNAME, "sudo: unable to resolve host r1: Name or service not known"),
        (1, b"", HOSTNAME, "sudo: unable to resolve host r1: Name or service not known"),
        (1, b"", b"sudo: x: command not found\n", "sudo: x: command not found"),
        (127, b"", HOSTNAME + b"sh: 1: exec: x: not found\n", "sh: 1: exec: x: not found"),
        (3, b"", HOSTNAME + b"fullswarm-robot: refused: moving\n", "fullswarm-robot: refused: moving"),
    ],
)  # fmt: skip
def test_what_ran_as_root_is_heard_whatever_sudo_warned_of(
    code: int, out: bytes, said: bytes, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = heard(Answer(code, out, said), monkeypatch)
    assert (answer.code, answer.words) == (code, why)
