"""Runs ``ssh-keygen``, the one tool that makes, signs and verifies here, as it does on the robots."""

from __future__ import annotations

import shutil
import subprocess

from fullswarm.errors import ConfigError

TOOL = "ssh-keygen"


def run(*arguments: str, feed: bytes = b"", why: str) -> bytes:
    """Run ssh-keygen with `feed` as its stdin; return its stdout.

    Raises
    ------
    ConfigError
        It is not installed, or it refuses; `why` says in the message what was wanted of it.
    """
    tool = shutil.which(TOOL)
    if tool is None:
        raise ConfigError(f"cannot {why}: {TOOL} is not installed", hint="sudo apt install openssh-client")
    done = subprocess.run([tool, *arguments], input=feed, capture_output=True, check=False)  # noqa: S603 - no shell, our words
    if done.returncode != 0:
        words = (done.stderr or done.stdout).decode(errors="replace").strip().splitlines()
        raise ConfigError(f"cannot {why}: {TOOL} says: {words[-1] if words else f'exit {done.returncode}'}")
    return done.stdout
