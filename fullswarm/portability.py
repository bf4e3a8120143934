"""Does what operating systems do differently: locks, the number of a user; names what needs Linux or macOS.

Modules that only some systems have are imported where they are used, so that every other module imports everywhere.
"""

from __future__ import annotations

import os
import sys
from typing import Literal

from fullswarm.errors import ConfigError


def need_posix(what: str) -> None:
    """Refuse something that Windows has no means for: terminals, descriptors of other processes, signals.

    Raises
    ------
    ConfigError
        This is Windows.
    """
    if os.name != "posix":
        hint = "use Linux, or WSL 2 on this computer; docs/how-to-install.md says what works on which system"
        raise ConfigError(f"{what} does not work on this operating system", where=sys.platform, hint=hint)


def need_linux(what: str) -> None:
    """Refuse something that only Linux has the means for.

    Raises
    ------
    ConfigError
        This is another system.
    """
    if not sys.platform.startswith("linux"):
        hint = "use Linux, or a virtual machine with it; docs/how-to-install.md says what works on which system"
        raise ConfigError(f"{what} works on Linux only", where=sys.platform, hint=hint)


def check_system(what: str, needs: Literal["posix", "linux"]) -> None:
    """Call :func:`need_posix` or :func:`need_linux` for `what`."""
    if needs == "posix":
        need_posix(what)
    else:
        need_linux(what)


def lock(descriptor: int, *, wait: bool) -> None:
    """Lock an open file against other processes, until it is closed or this process has ended.

    On Windows it must be a file open for writing, and its first byte is locked; elsewhere it may be a folder.

    Raises
    ------
    BlockingIOError
        Another process holds the lock, and `wait` is False.
    OSError
        The file cannot be locked; on Windows also when another process holds the lock for longer than 10 s.
    """
    if sys.platform == "win32":
        import msvcrt

        os.lseek(descriptor, 0, os.SEEK_SET)
        try:
            msvcrt.locking(descriptor, msvcrt.LK_LOCK if wait else msvcrt.LK_NBLCK, 1)
        except PermissionError as error:
            raise BlockingIOError(error.errno, "another process holds the lock") from error
    else:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))


def user_id() -> str:
    """Return the number of this process's user; on Windows, which has none, the name of the user."""
    if sys.platform == "win32":
        import getpass

        return getpass.getuser()
    return str(os.getuid())


def seen_by_others(mode: int) -> bool:
    """Tell whether a file of this `mode` may be read or written by other users.

    Always False on Windows: a mode says nothing there, and a folder of a user is closed to others by its access list.
    """
    return os.name == "posix" and bool(mode & 0o077)
