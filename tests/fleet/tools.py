"""Running programs, waiting with a deadline, and what this machine lacks."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path

PACKAGES = {
    "systemd-nspawn": "systemd-container",
    "mmdebstrap": "mmdebstrap",
    "nft": "nftables",
    "ip": "iproute2",
    "nsenter": "util-linux",
    "ssh-keygen": "openssh-client",
}
ENVIRONMENT = {**os.environ, "PATH": f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin", "LC_ALL": "C"}
POLL_S = 0.05


class Missing(Exception):
    """This machine cannot run a fleet; the text says what it lacks and how to get it."""


def missing() -> str:
    """Return what this machine lacks for a fleet of containers; empty if nothing."""
    if os.geteuid() != 0:
        return "not root: containers and network namespaces need it"
    lacking = sorted({PACKAGES[tool] for tool in PACKAGES if shutil.which(tool, path=ENVIRONMENT["PATH"]) is None})
    if lacking:
        return f"not installed: {' '.join(lacking)} (apt-get install {' '.join(lacking)})"
    if "overlay" not in Path("/proc/filesystems").read_text():
        return "this kernel has no overlay file system"
    return ""


def run(
    *command: str | Path,
    text: str | None = None,
    feed: Path | None = None,
    check: bool = True,
    timeout_s: float = 120.0,
) -> str:
    """Run a program and return what it prints; its stdin is a text or a file.

    Raises
    ------
    AssertionError
        It failed; says what it printed.
    """
    words = [str(each) for each in command]
    with (feed or Path("/dev/null")).open("rb") as file:
        stdin = {"input": text} if text is not None else {"stdin": file}
        done = subprocess.run(
            words, **stdin, capture_output=True, text=True, check=False, env=ENVIRONMENT, timeout=timeout_s
        )
    assert not (check and done.returncode), f"{' '.join(words)}: exit {done.returncode}\n{done.stdout}{done.stderr}"
    return str(done.stdout)


def start(command: Sequence[str | Path], log: Path, environment: dict[str, str] | None = None) -> subprocess.Popen[str]:
    """Start a program that goes on; what it prints goes to a file."""
    with log.open("a") as file:
        return subprocess.Popen(
            [str(each) for each in command], stdin=subprocess.DEVNULL, stdout=file, stderr=file, text=True,
            env=environment or ENVIRONMENT, start_new_session=True,
        )  # fmt: skip


def end(process: subprocess.Popen[str], patience_s: float = 5.0) -> None:
    """End a program: asked first, then made to."""
    process.terminate()
    try:
        process.wait(patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def until(condition: Callable[[], object], timeout_s: float, what: str, story: Callable[[], str] = str) -> float:
    """Wait until a condition holds and return how long that took, in s; fail with the story if it never does."""
    began_s = time.monotonic()
    while not condition():
        took_s = time.monotonic() - began_s
        assert took_s < timeout_s, f"waited {took_s:.1f} s for: {what}\n{story()}"
        time.sleep(POLL_S)
    return time.monotonic() - began_s
