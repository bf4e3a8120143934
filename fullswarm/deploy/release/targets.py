"""Defines the computers that releases are made for, and the errors for those that are not supported."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from types import MappingProxyType

from fullswarm.deploy.release.manifest import Target
from fullswarm.errors import ConfigError, did_you_mean

GLIBC = "2.28"
"""Of 2018. zenoh's and NumPy's wheels need it; every system with Python 3.11 that robots run has it."""
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
THIS_PYTHON = f"{sys.version_info.major}.{sys.version_info.minor}"
TARGETS: Mapping[str, Target] = MappingProxyType(
    {
        # Raspberry Pi OS and Debian: Bookworm has Python 3.11, Trixie 3.13.
        "rpi-arm64": Target("rpi-arm64", "aarch64", GLIBC, "3.11"),
        # JetPack 7 is Ubuntu 24.04 with Python 3.12; JetPack 6 is Ubuntu 22.04 with 3.10, see `_HINTS`.
        "jetson": Target("jetson", "aarch64", GLIBC, "3.12"),
        "x86_64": Target("x86_64", "x86_64", GLIBC, THIS_PYTHON),
    }
)
_32_BIT = ("arm32", "armhf", "armv6", "armv7", "armv8l", "i386", "i686", "rpi-arm32", "rpi-armhf", "rpi-armv7", "x86")
_HINTS = {
    "jetson": "JetPack 6 has 3.10: `sudo apt install python3.11` there, and --python 3.11; JetPack 7 has 3.12",
    "rpi-arm64": "Raspberry Pi OS Bookworm has 3.11, Trixie 3.13",
}


def target(name: str, python: str | None = None) -> Target:
    """Return a target by its name, for another Python than its usual one if `python` names it.

    Raises
    ------
    ConfigError
        There is no such target, it is a 32-bit one, or its Python is too old or unknown.
    """
    if name in _32_BIT or name.startswith(("armv6", "armv7")):
        what = f"'{name}': releases are for 64-bit systems only: NumPy and msgspec have no wheels for 32 bit"
        raise ConfigError(what, where="--target", hint="a Raspberry Pi 3, 4, 5 or Zero 2 W runs the 64-bit system")
    if name not in TARGETS:
        raise ConfigError(f"unknown target '{name}'", where="--target", hint=did_you_mean(name, TARGETS))
    usual = TARGETS[name]
    chosen = usual.python if python is None else python
    if chosen not in PYTHONS:
        what = f"no release for Python {chosen}: fullswarm runs on {', '.join(PYTHONS)}"
        raise ConfigError(what, where="--python", hint=_HINTS.get(name, "see `python3 --version` on the robot"))
    return Target(usual.name, usual.arch, usual.glibc, chosen)
