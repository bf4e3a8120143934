"""Makes clips for pages: `fullswarm record clip` in a process of its own, one at a time, and files to download."""

from __future__ import annotations

import re
import secrets
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

from fullswarm.operator.console import children, frames
from fullswarm.operator.console.sessions import Listener
from fullswarm.runtime import Scheduler

LOOK_S = 0.25
LONGEST_S = 900.0
"""A clip that takes longer is given up."""
KEPT = 4
"""Files that can be downloaded; the oldest makes way for a new one."""
WORDS = 300
NO_RECORDING = (
    "nothing is recorded on this machine, so there is nothing to cut a clip from: start the swarm with "
    "`fullswarm up --record FILE.mcap`, or run `fullswarm record start`"
)
BUSY = "a clip is being made already: wait until it is done"
_DONE = re.compile(rb"(\d+) of (\d+) frames")


@dataclass(slots=True)
class _Job:
    """The clip that is being made."""

    process: subprocess.Popen[bytes]
    log: IO[bytes]
    out: Path
    name: str
    listener: Listener
    began_s: float


@dataclass(frozen=True, slots=True)
class Download:
    """A file to download, and how it is called there."""

    file: Path
    name: str


class Clips:
    """Makes clips of one recording.

    Parameters
    ----------
    recording : returns the recording that is made or shown now; None: there is none
    """

    def __init__(self, recording: Callable[[], Path | None], scheduler: Scheduler) -> None:
        self._recording, self._scheduler = recording, scheduler
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._job: _Job | None = None
        self._downloads: dict[str, Download] = {}
        self._timer = scheduler.every(LOOK_S, self._look)

    def refusal(self) -> str:
        """Return why there can be no clip now; empty: there can."""
        if self._recording() is None:
            return NO_RECORDING
        return BUSY if self._job is not None else ""

    def make(self, from_s: float, to_s: float, kind: str, listener: Listener) -> str:
        """Begin a clip; return why not, or empty.

        Parameters
        ----------
        from_s, to_s : seconds since 1970
        kind : ``mcap``, ``gif`` or ``mp4``
        """
        recording = self._recording()
        if recording is None or self._job is not None:
            return self.refusal()
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="fullswarm-clips-")  # only this user may enter it
        name = f"{recording.stem}-{datetime.fromtimestamp(from_s):%H%M%S}.{kind}"
        out = Path(self._folder.name) / f"{secrets.token_hex(8)}.{kind}"
        command = [
            "record", "clip", str(recording), "--out", str(out),
            "--from", _iso(from_s), "--to", _iso(to_s),
        ]  # fmt: skip
        log = out.with_suffix(".log").open("w+b")
        try:
            process = children.start(command, log)
        except OSError as error:
            log.close()
            return f"no clip: {error.strerror or error}"
        self._job = _Job(process, log, out, name, listener, self._scheduler.now_s())
        return ""

    def download(self, key: str) -> Download | None:
        """Return a file by the key that its page got; None: there is none any more."""
        return self._downloads.get(key)

    def close(self) -> None:
        """End what is being made, and remove all files."""
        self._timer.cancel()
        if self._job is not None:
            self._end(self._job)
        if self._folder is not None:
            self._folder.cleanup()

    def _look(self) -> None:
        job = self._job
        if job is None:
            return
        code = job.process.poll()
        if code is None:
            if self._scheduler.now_s() - job.began_s > LONGEST_S:
                self._end(job)
                self._say(job, "failed", f"it took longer than {LONGEST_S / 60:.0f} minutes: choose a shorter part")
                return
            self._say(job, "running", _progress(children.tail(job.log)))
            return
        said = children.last_line(job.log)
        self._end(job)
        if code == 0 and job.out.exists():
            key = secrets.token_urlsafe(24)
            self._downloads[key] = Download(job.out, job.name)
            while len(self._downloads) > KEPT:
                oldest = self._downloads.pop(next(iter(self._downloads)))
                oldest.file.unlink(missing_ok=True)
            self._say(job, "done", f"{job.name}, {job.out.stat().st_size / 1e6:.1f} MB", f"/clip/{key}")
        else:
            self._say(job, "failed", (said or f"exit code {code}")[:WORDS])

    def _end(self, job: _Job) -> None:
        self._job = None
        children.end(job.process)  # with ffmpeg, which it may have started
        job.log.close()

    def _say(self, job: _Job, state: str, words: str, url: str = "") -> None:
        frame: dict[str, Any] = {"t": "clip", "state": state, "words": words, "url": url, "name": job.name}
        job.listener.put("clip", frames.encode(frame))


def _progress(text: bytes) -> str:
    found = _DONE.findall(text)
    return f"{found[-1][0].decode()} of {found[-1][1].decode()} frames" if found else "reading the recording"


def _iso(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).isoformat()
