"""Makes folders for what lasts as long as a run (logs, sockets, ports) in a folder that only this user may enter.

All of it is below ``fullswarm-UID`` in the system's folder for temporary files. Every user may write there, so it is
used only if it is a real folder, of this user, that no other user can have written to. The folder ``XDG_RUNTIME_DIR``
is not used: it is removed when the user logs out, and a swarm started with ``nohup`` goes on.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

from fullswarm.clock import wall_time_s
from fullswarm.errors import ConfigError
from fullswarm.portability import lock as lock_file
from fullswarm.portability import need_posix, user_id

RUNS = "run-"
KEPT = "kept"
"""A file in the folder of a run whose logs an error has named."""
KEPT_S = 7 * 86400.0


def user_path() -> Path:
    """Return where :func:`user_folder` is, made or not."""
    return Path(tempfile.gettempdir()) / f"fullswarm-{user_id()}"


def user_folder() -> Path:
    """Return the folder of this user for what lasts as long as a run; make it if it is missing.

    Raises
    ------
    ConfigError
        This system is not one of POSIX; what is there is a link, belongs to another user, or others may write to it.
    """
    need_posix("a swarm of processes on this computer")
    path = user_path()
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700)
    found = path.lstat()
    if not stat.S_ISDIR(found.st_mode):
        problem = "is not a folder"
    elif found.st_uid != os.getuid():
        problem = "belongs to another user"
    elif found.st_mode & 0o022:
        problem = "can be written by other users"
    else:
        if found.st_mode & 0o055:  # made by an older version
            path.chmod(0o700)
        return path
    hint = "remove it, or name another folder for temporary files: TMPDIR=FOLDER"
    raise ConfigError(f"{problem}: the swarm's logs and sockets cannot go there", where=str(path), hint=hint)


class RunFolder:
    """A new folder for one run. It must be closed, which removes it; after a crash the next run removes it.

    Attributes
    ----------
    path : the folder
    """

    def __init__(self) -> None:
        parent = user_folder()
        _remove_left(parent)
        new = Path(tempfile.mkdtemp(prefix=".", dir=parent))
        # Held as long as this process lives, whatever ends it; before others can find the folder by its name.
        self._lock = os.open(new, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        lock_file(self._lock, wait=True)
        self.path = new.rename(parent / f"{RUNS}{new.name[1:]}")

    def keep(self) -> None:
        """Have the folder stay at the end, for `KEPT_S`: an error names it."""
        with contextlib.suppress(OSError):
            (self.path / KEPT).touch()

    def close(self) -> None:
        """Remove the folder, unless it is to be kept; closing twice is fine."""
        if self._lock >= 0:
            if not (self.path / KEPT).exists():
                shutil.rmtree(self.path, ignore_errors=True)
            os.close(self._lock)
            self._lock = -1


def running() -> Iterator[Path]:
    """Yield the folders of this user's runs that go on now; raises as `user_folder`."""
    folder = user_folder()
    import fcntl

    for path in sorted(folder.glob(f"{RUNS}*")):
        with contextlib.suppress(OSError):  # removed meanwhile
            lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)  # shared: two programs may look at once
            except BlockingIOError:
                yield path
            finally:
                os.close(lock)


def _remove_left(parent: Path) -> None:
    """Remove the folders of runs that have ended without removing theirs."""
    for path in parent.glob(f"{RUNS}*"):
        try:
            lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        except OSError:
            continue  # removed meanwhile
        try:
            lock_file(lock, wait=False)
            if not _is_kept(path):
                shutil.rmtree(path, ignore_errors=True)
        except BlockingIOError:
            pass  # of a run that goes on
        finally:
            os.close(lock)


def _is_kept(path: Path) -> bool:
    try:
        return wall_time_s() - (path / KEPT).stat().st_mtime < KEPT_S
    except OSError:
        return False


def bound_log(path: Path, most_bytes: int) -> None:
    """Move the content of a log that has become too long to ``NAME.1``, whose old content goes.

    The process that writes the log keeps its file, so it survives this process, and this process survives it. Lines
    that it writes between the copy and the cut are lost.
    """
    with contextlib.suppress(OSError):
        if path.stat().st_size > most_bytes:
            shutil.copyfile(path, path.with_name(f"{path.name}.1"))
            os.truncate(path, 0)
