"""`fullswarm record start` and `stop`: one recording of a live swarm, which other commands of this user find."""

from __future__ import annotations

import contextlib
import json
import math
import os
import platform
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import IO

import structlog

from fullswarm.bus.endpoint import DEFAULT_HUB, credentials_at
from fullswarm.bus.renewal import renew_later
from fullswarm.bus.zenoh_bus import ZenohBus, use_one_thread
from fullswarm.clock import MonotonicClock, wall_time_s
from fullswarm.errors import ConfigError
from fullswarm.keys import Keys
from fullswarm.launch.journals import code_hash, journal_folder
from fullswarm.launch.processes import RUN, serve, state_folder
from fullswarm.operator.scans import ScanWatch
from fullswarm.operator.session import CONNECT_S, Target
from fullswarm.output import progress
from fullswarm.portability import lock
from fullswarm.record.recorder import Recorder, journals_in, no_journals
from fullswarm.record.recording import Attachment, Recording
from fullswarm.runtime import Mailbox, Runtime

log = structlog.get_logger()
NAME = "recorder"
"""Of its certificate, where the hub is secured; its role is ``observer``, which can send nothing."""
MB = 1_000_000
LOOK_S = 5.0
HUB_UP_S = 60.0
"""A recorder that is started together with the hub waits for it so long."""


@dataclass(frozen=True, slots=True)
class Running:
    """A recording that runs on this computer: the process, the swarm, the file, the hub."""

    pid: int
    swarm: str
    file: str
    hub: str = ""


def start(
    target: Target,
    out: Path | None,
    fleet: Path | None,
    limit_mb: float,
    keep: int,
    with_parent: bool,
    ranges_hz: float = 0.0,
) -> int:
    """Record until Ctrl-C, SIGTERM, `stop` or the parent's end.

    Parameters
    ----------
    out : the file; None: named by swarm and time of day, in the working folder
    fleet : goes into the file, if it is given
    limit_mb, keep : size from which on a new file is begun, and how many of them are kept; 0: no limit

    ranges_hz : how often robots are asked for their range scans; 0: what others ask for is recorded

    Raises
    ------
    ConfigError
        The file is there already or cannot be written, the fleet file cannot be read, or this hub lets no recorder ask.
    Unreachable
        No hub answers.
    """
    runtime = Runtime(MonotonicClock(), Mailbox())
    attachments = [] if fleet is None else [_attached(fleet)]
    hub = target.hub or DEFAULT_HUB
    credentials = credentials_at(hub, target.swarm, NAME, "observer")
    if ranges_hz > 0.0 and credentials is not None:
        raise ConfigError(
            "a recorder is an observer, which can ask robots for nothing at a secured hub", where="--ranges",
            hint="leave it out and select the robots on the console: the scans that it asks for are recorded",
        )  # fmt: skip
    use_one_thread()
    bus = ZenohBus(runtime.mailbox, hub=hub, credentials=credentials)
    try:
        bus.wait_connected(HUB_UP_S if with_parent else CONNECT_S)
        renew_later(bus, runtime, Keys(target.swarm), credentials)
        began_s = wall_time_s()
        path = out or Path(f"{target.swarm}-{datetime.fromtimestamp(began_s).astimezone():%Y%m%d-%H%M%S}.mcap")
        path = _free(path) if with_parent else path  # after a crash the recording goes on in another file
        recording = Recording(path, about(target.swarm), attachments, round(limit_mb * MB), keep)
        run = os.environ.get(RUN, "") if with_parent else ""
        recorder = Recorder(
            bus,
            Keys(target.swarm),
            runtime,
            recording,
            round(1e9 * began_s),
            Path(run) if run else None,
            lambda problem: _fail(problem, path, runtime),
            journals_in(journal_folder(Path(run))) if run else no_journals,
        )
        nodes: list[Recorder | ScanWatch] = [recorder]
        if ranges_hz > 0.0:
            source = f"recorder {platform.node()[:40]} {os.getpid()}"
            watch = ScanWatch(bus, Keys(target.swarm), runtime, source, lambda _: None)
            watch.ask(None, ranges_hz)
            nodes.append(watch)
        if not with_parent:
            progress(f"recording swarm '{target.swarm}' to {path}; Ctrl-C or `fullswarm record stop` ends it")
        found = Running(os.getpid(), target.swarm, str(path.absolute()), hub)
        with contextlib.nullcontext() if with_parent else _announced(found):  # that of `up` ends with `up`
            serve(runtime, nodes, with_parent)
    finally:
        bus.close()
    took_s = wall_time_s() - began_s
    size = sum(each.stat().st_size for each in recording.files if each.exists()) / MB
    progress(f"{path}: {recording.messages} messages in {took_s:.0f} s, {size:.1f} MB")
    return 1 if recorder.failed else 0


def stop(swarm: str) -> int:
    """End the recordings of a swarm that run on this computer, as Ctrl-C would.

    Raises
    ------
    ConfigError
        There is none.
    """
    found = [each for each in running() if each.swarm == swarm]
    if not found:
        raise ConfigError(f"no recording of swarm '{swarm}' runs on this computer", hint="see --swarm")
    for each in found:
        with contextlib.suppress(ProcessLookupError):
            os.kill(each.pid, signal.SIGINT)
        progress(f"ends: {each.file}")
    return 0


def running() -> Iterator[Running]:
    """Yield the recordings of this user that run here; forget those whose process has died."""
    for path in sorted(_folder().glob("*.json")):
        with contextlib.suppress(OSError, ValueError, TypeError), path.open("r+b") as file:
            try:
                lock(file.fileno(), wait=False)
            except BlockingIOError:  # its recorder holds the lock as long as it lives
                yield Running(**json.loads(file.read()))
            else:
                path.unlink(missing_ok=True)


class RecordingFinder:
    """Finds the recording that is made of a swarm on this computer.

    Parameters
    ----------
    given : the file of `up --record`, which announces none
    """

    def __init__(self, target: Target, given: Path | None) -> None:
        self._wanted = target.swarm, target.hub or DEFAULT_HUB  # swarms at different hubs may share a name
        self._given, self._clock = given, MonotonicClock()
        self._found: Path | None = None
        self._looked_s = -math.inf

    def __call__(self) -> Path | None:
        """Return its file, as of `LOOK_S` ago at most; None: there is none."""
        if self._given is not None:
            return self._given if self._given.exists() else None
        if self._clock.now_s() - self._looked_s >= LOOK_S:
            self._looked_s = self._clock.now_s()
            files = (Path(each.file) for each in running() if (each.swarm, each.hub) == self._wanted)
            self._found = next(files, None)
        return self._found


@contextmanager
def _announced(found: Running) -> Iterator[None]:
    """Have `running` find this recording while it lasts."""
    folder, file = _folder(), None
    path = folder / f"{found.pid}.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = path.open("w+b")
        lock(file.fileno(), wait=False)
        _write(file, found)
    except OSError as error:
        log.warning("`fullswarm record stop` will not find this recording", reason=str(error))
    try:
        yield
    finally:
        if file is not None:
            path.unlink(missing_ok=True)
            file.close()


def _write(file: IO[bytes], found: Running) -> None:
    file.write(json.dumps(asdict(found)).encode())
    file.flush()


def _folder() -> Path:
    return state_folder() / "recordings"


def _free(path: Path) -> Path:
    """Return `path`, or one with the first number that is not taken."""
    number, found = 2, path
    while found.exists():
        found, number = path.with_name(f"{path.stem}-{number}{path.suffix}"), number + 1
    return found


def _attached(fleet: Path) -> Attachment:
    try:
        return Attachment("fleet.toml", "application/toml", fleet.read_bytes())
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", where=str(fleet)) from None


def about(swarm: str) -> dict[str, str]:
    """Return what a recording says of itself: swarm, versions, the code."""
    system = f"{platform.system()} {platform.machine()}"
    return {"swarm": swarm, "python": platform.python_version(), "system": system, "code": code_hash()}


def _fail(problem: str, path: Path, runtime: Runtime) -> None:
    progress(f"error: {path}: {problem}")
    runtime.stop()
