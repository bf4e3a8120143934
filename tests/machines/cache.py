"""What takes long to make and hangs on nothing but its recipe: made once, kept in the user's cache."""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from platformdirs import user_cache_path


def cache_folder() -> Path:
    """Return where it is kept; ``FULLSWARM_TEST_CACHE`` names another place."""
    named = os.environ.get("FULLSWARM_TEST_CACHE")
    return Path(named) if named else user_cache_path("fullswarm-tests")


def cached(name: str, recipe: object, make: Callable[[Path], None]) -> Path:
    """Return the file or folder that `make` makes of `recipe`, at the path that it is given; made once.

    Parameters
    ----------
    name
        What it is, for people who look into the cache.
    recipe
        Its ``repr`` tells one from another.
    """
    folder = cache_folder()
    folder.mkdir(parents=True, exist_ok=True)
    done = folder / f"{name}-{hashlib.sha256(repr(recipe).encode()).hexdigest()[:12]}"
    with (folder / f"{done.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # another test run may be at it
        if not done.exists():
            began_s = time.monotonic()
            work = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=folder))
            try:
                make(work / "made")
                (work / "made").rename(done)
            finally:
                shutil.rmtree(work, ignore_errors=True)
            sys.stderr.write(f"{done.name}: made in {time.monotonic() - began_s:.0f} s, kept in {folder}\n")
    return done
