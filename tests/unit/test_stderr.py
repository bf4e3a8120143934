"""A log on a full disk must not end the process that writes it."""

from __future__ import annotations

import errno
import io
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from fullswarm.stderr import LossyText

FULL = Path("/dev/full")
"""Each write to it fails as on a full disk."""
PROGRAM = """
import sys, structlog, typer
from fullswarm.logs import log_to_stderr
from fullswarm.stderr import survive_full_disk
survive_full_disk()
log_to_stderr()
for number in range(1000):
    structlog.get_logger().warning("a line that finds no room", number=number)
    typer.echo("nor this", err=True)
    print("nor this", file=sys.stderr, flush=True)
print("alive")
"""


class Disk(io.RawIOBase):
    """Takes what is written while `error` is 0."""

    def __init__(self) -> None:
        self.error, self.text = errno.ENOSPC, b""

    def writable(self) -> bool:
        return True

    def write(self, data: Any, /) -> int:
        if self.error:
            raise OSError(self.error, os.strerror(self.error))
        self.text += bytes(data)
        return len(data)


@pytest.mark.skipif(not FULL.exists(), reason="no /dev/full here")
def test_a_process_goes_on_when_its_log_finds_no_room() -> None:
    with FULL.open("w") as full:
        ran = subprocess.run([sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, stderr=full, check=False)
    assert (ran.returncode, ran.stdout) == (0, b"alive\n")


def test_it_is_written_again_once_there_is_room() -> None:
    disk = Disk()
    stream = LossyText(io.BufferedWriter(disk), line_buffering=True)
    for number in range(2000):
        assert stream.write(f"lost {number}\n") > 5
    disk.error = 0
    stream.write("kept\n")
    stream.flush()
    assert disk.text.endswith(b"kept\n")
    assert len(disk.text) < 20_000


def test_a_reader_that_has_gone_is_still_an_error() -> None:
    disk = Disk()
    disk.error = errno.EPIPE
    stream = LossyText(io.BufferedWriter(disk), line_buffering=True)
    with pytest.raises(BrokenPipeError):
        stream.write("nobody reads this\n")
    disk.error = 0
    stream.flush()
