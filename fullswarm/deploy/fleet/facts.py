"""Reads in one round trip what a robot is and what it runs, before the first install too."""

from __future__ import annotations

import math
import time
from typing import Any

import msgspec

from fullswarm.deploy.fleet.remote import PROGRAM, Remote, clean, root_script, strict_json
from fullswarm.errors import FullswarmError, MessageError

BARE = b"fullswarm-bare\n"
FACTS_S = 30.0
PROBE = r"""
echo fullswarm-bare
echo "arch=$(uname -m)"
echo "glibc=$(getconf GNU_LIBC_VERSION 2>/dev/null | cut -d' ' -f2)"
echo "python=$(python3 -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)"
for d in "${FULLSWARM_ROOT-}/opt" "${FULLSWARM_ROOT:-/}"; do [ -d "$d" ] && break; done
for m in 10 11 12 13 14 15; do command -v python3.$m >/dev/null && printf '%s\n' "python3.$m=yes"; done
echo "disk_free_kb=$(df -Pk "$d" 2>/dev/null | awk 'NR==2 {print $4}')"
echo "clock_utc=$(date -u +%s)"
[ -d /run/systemd/system ] || [ -n "${FULLSWARM_SYSTEMCTL-}" ] && echo systemd=yes
if [ "$(id -u)" -eq 0 ]; then echo root=yes; elif sudo -n true 2>/dev/null; then echo root=sudo
elif command -v sudo >/dev/null; then echo root=password; else echo root=no; fi
for t in ssh-keygen tar gzip awk zstd; do command -v $t >/dev/null && echo "has_$t=yes"; done
exit 0
"""


class Agent(msgspec.Struct, frozen=True):
    """The agent's unit, as systemd sees it."""

    active: bool = False
    state: str = ""
    since_s: float | None = None
    restarts: int = 0


class Health(msgspec.Struct, frozen=True):
    """The agent's health file, written each second; only the fields that are used here."""

    robot: str = ""
    release: str | None = ""
    lifecycle: str | None = ""
    behaviour: str | None = ""
    moving: bool | None = None
    estop: Any = None
    fault: Any = None
    healthy: bool = False
    why: list[str] = []


class Facts(msgspec.Struct, frozen=True):
    """The answer of ``fullswarm-robot facts``; before the first install that of the probe, with protocol 0.

    Sizes in bytes, clocks in seconds since the epoch, temperatures in °C.
    """

    protocol: int = 0
    robot: str = ""
    kit: str | None = ""
    root_version: int | None = None  # of the root metadata; None: the installed tools verify no support package
    arch: str = ""
    glibc: str = ""
    python: str = ""
    os: str = ""
    pythons: list[str] = []
    disk_free_bytes: int | None = None
    disk_writable: bool = True
    clock_utc: float | None = None
    boot_id: str = ""
    current: str | None = None
    previous: str | None = None
    pending: str | None = None  # switched to, neither committed nor rolled back
    releases: list[str] = []
    agent: Agent = Agent()
    health: Health | None = None
    temperature_c: float | None = None
    last_rollback: str | None = None
    zstd: bool = False

    @property
    def installed(self) -> bool:
        """``fullswarm-robot`` is there."""
        return self.protocol > 0

    @property
    def settled(self) -> bool:
        """It runs a committed release."""
        return bool(self.current) and not self.pending

    @property
    def busy_with(self) -> str:
        """What a restart of its agent would end; empty while it is idle, or reports nothing."""
        health = self.health
        if health is None:
            return ""
        behaviour = clean(health.behaviour or "", 64)
        if health.moving:
            return f"moving ({behaviour})" if behaviour else "moving"
        return f"active with '{behaviour}'" if health.lifecycle == "ACTIVE" and behaviour else ""

    @property
    def rollback_reason(self) -> str:
        """Why it rolled back the last time: ``<from> <to> <epoch> <why>`` without the first three."""
        words = (self.last_rollback or "").split(maxsplit=3)
        return clean(words[3]) if len(words) == 4 else ""


def clock_error_s(facts: Facts) -> float:
    """Return how far a robot's clock is ahead of ours, in seconds; NaN when it is not reported."""
    return math.nan if facts.clock_utc is None else facts.clock_utc - time.time()


async def facts_of(remote: Remote) -> Facts:
    """Read the facts of a robot, whether fullswarm is installed there or not.

    Raises
    ------
    MessageError
        The answer is not that of our program.
    Unreachable, NoRoot
        As `Remote.program`.
    """
    root, first = root_script(f"{PROGRAM} facts", remote.sudo_password)
    script = f"if [ -x {PROGRAM} ]; then :; else {PROBE}\nfi\n{root}"
    answer = await remote.script_as_root(script, first=first, within_s=FACTS_S)
    if answer.out.startswith(BARE):
        return bare_facts(answer.out.removeprefix(BARE), remote.robot)
    if answer.code:
        raise FullswarmError(f"fullswarm-robot fails: {answer.words}", where=remote.robot, hint="`fullswarm deploy`")
    return strict_json(answer.out, Facts, remote.robot)


def bare_facts(probe: bytes, robot: str) -> Facts:
    """Read the probe's ``key=value`` lines, and refuse a computer that cannot become a robot.

    Raises
    ------
    MessageError
        They are malformed.
    FullswarmError
        Something is missing there that an install needs.
    """
    values = dict(line.split("=", 1) for line in probe.decode("utf-8", "replace").splitlines() if "=" in line)
    try:
        free = int(values["disk_free_kb"]) * 1024 if values.get("disk_free_kb") else None
        clock = float(values["clock_utc"])
        arch = clean(values["arch"], 40)
    except (KeyError, ValueError):
        raise MessageError("its answer cannot be read", where=robot, hint="is it Linux with a POSIX shell?") from None
    missing = [tool for tool in ("ssh-keygen", "tar", "gzip", "awk") if f"has_{tool}" not in values]
    if missing or "systemd" not in values:
        what = ", ".join([*missing, *([] if "systemd" in values else ["systemd"])])
        raise FullswarmError(f"missing on it: {what}", where=robot, hint="a Debian, Ubuntu or Raspberry Pi OS has them")
    return Facts(
        arch=arch,
        glibc=clean(values.get("glibc", ""), 20),
        python=clean(values.get("python", ""), 20),
        disk_free_bytes=free,
        clock_utc=clock,
        pythons=[name.removeprefix("python") for name in values if name.startswith("python3.")],
        zstd="has_zstd" in values,
    )
