"""Checks the machine for `fullswarm doctor`: Python, extras, ports, gamepads, clocks, disk, processor."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import shutil
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from fullswarm import __version__
from fullswarm.bringup.checks import Check, Status
from fullswarm.errors import MissingExtra
from fullswarm.operator.joystick import devices

OLDEST_PYTHON = (3, 11)
EXTRAS = {  # extra: modules it must bring
    "core": ("osqp", "scipy", "shapely"),
    "sim": ("numba", "pybullet"),
    "mavlink": ("pymavlink",),
    "can": ("can", "msgpack"),
    "camera": ("cv2",),
    "joystick": ("sdl2",),
}
LEAST_DISK, LITTLE_DISK = 100e6, 1e9
HIGH_LOAD = 0.9
MOST_DRIFT = 0.05
"""Share by which the two clocks may differ over some tenths of a second; a stepped clock differs by far more."""
OLDEST_WALL_S = 1.735e9  # December 2024: a board without a battery-backed clock wakes up in 1970
SLOW_FTDI_MS = 4
INTERFERERS = {
    "ModemManager": "it talks to new serial ports: sudo systemctl disable --now ModemManager",
    "brltty": "it takes USB serial ports for Braille displays: sudo apt remove brltty",
}
_PADS = "gamepad"


def python() -> Check:
    """Check the interpreter."""
    what = f"{platform.python_version()} on {platform.machine()}, fullswarm {__version__}"
    if sys.version_info[:2] < OLDEST_PYTHON:
        return Check("python", "failure", what, "install Python 3.11 or newer")
    if sys.maxsize <= 2**32:
        return Check("python", "failure", f"{what}, 32 bit", "install a 64-bit system")
    return Check("python", "ok", what)


def extras(needed: frozenset[str] = frozenset()) -> Iterator[Check]:
    """Check which optional packages are there; one in `needed` that is not is a failure."""
    for extra, modules in EXTRAS.items():
        missing = [each for each in modules if importlib.util.find_spec(each) is None]
        name = f"extra [{extra}]"
        if missing:
            status: Status = "failure" if extra in needed else "warning"
            what = f"{', '.join(missing)} not installed{'' if extra in needed else '; fine if not used'}"
            yield Check(name, status, what, f"pip install 'fullswarm[{extra}]'")
        else:
            yield Check(name, "ok", ", ".join(f"{each} {_version(each)}" for each in modules))


def _version(module: str) -> str:
    packages = importlib.metadata.packages_distributions().get(module, [])
    return importlib.metadata.version(packages[0]) if packages else "?"


# ---------------------------------------------------------------- serial ports
def serial_ports() -> Iterator[Check]:
    """Check that this user may open the serial ports that are plugged in."""
    from fullswarm.drivers.probe import ask

    ports = ask.serial_ports()
    if not ports:
        yield Check("serial ports", "ok", "none is plugged in")
    for port in ports:
        yield access(port.path)
        yield from _latency(Path(port.device).name)


def access(path: str) -> Check:
    """Check that this user may read and write a port, and say what to do if not."""
    try:
        facts = Path(path).stat()
    except OSError as error:
        return Check("port", "failure", f"{path}: {error.strerror}", "plug it in")
    mode, group = stat.filemode(facts.st_mode), _group(facts.st_gid)
    what = f"{path}: {mode}, group {group}"
    if os.access(path, os.R_OK | os.W_OK):
        return Check("port", "ok", what)
    if facts.st_mode & stat.S_IRGRP and facts.st_mode & stat.S_IWGRP and facts.st_gid != 0:
        user = _user()
        if user in _members(facts.st_gid):
            return Check("port", "failure", f"{what}: {user} is in it, but not in this session", "log out and in again")
        return Check("port", "failure", what, f"sudo usermod -aG {group} {user}   # then log out and in again")
    return Check(
        "port", "failure", what, f"sudo chmod g+rw {path} && sudo chgrp dialout {path}   # lasting: a udev rule"
    )


def _group(number: int) -> str:
    try:
        import grp

        return grp.getgrgid(number).gr_name
    except KeyError:
        return str(number)


def _members(number: int) -> list[str]:
    try:
        import grp

        return grp.getgrgid(number).gr_mem
    except KeyError:
        return []


def _user() -> str:
    try:
        import pwd

        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:  # a container's user without a name
        return str(os.getuid())


def _latency(device: str) -> Iterator[Check]:
    """FTDI adapters hold bytes back for 16 ms as delivered: longer than a frame of the Create."""
    setting = Path(f"/sys/bus/usb-serial/devices/{device}/latency_timer")
    if not setting.is_file():
        return
    waits_ms = int(setting.read_text())
    if waits_ms > SLOW_FTDI_MS:
        what = f"/dev/{device}: the adapter holds bytes back for {waits_ms} ms"
        yield Check("port latency", "warning", what, f"echo 1 | sudo tee {setting}")


def interferer() -> Check:
    """Check for programs that are known to seize serial ports."""
    for process in Path("/proc").glob("[0-9]*"):
        try:
            name = (process / "comm").read_text().strip()
        except OSError:
            continue  # ended meanwhile
        if name in INTERFERERS:
            return Check("other programs", "warning", f"{name} runs (pid {process.name})", INTERFERERS[name])
    return Check("other programs", "ok", "none that is known to seize serial ports")


# ---------------------------------------------------------------- time, disk, processor
def clocks(passed_s: float, passed_wall_s: float, wall_s: float) -> Check:
    """Compare the monotonic with the wall clock over the same span."""
    if wall_s < OLDEST_WALL_S:
        return Check("clock", "failure", "the wall clock is years behind", "sudo timedatectl set-ntp true")
    if passed_s <= 0.0:
        return Check("clock", "failure", "the monotonic clock stands still", "restart this machine")
    if abs(passed_wall_s - passed_s) > max(MOST_DRIFT * passed_s, 0.02):
        what = f"the wall clock went {passed_wall_s:.3f} s in {passed_s:.3f} s: it is being set"
        return Check("clock", "warning", what, "wait until network time has settled")
    return Check("clock", "ok", f"monotonic and wall clock agree over {passed_s:.1f} s")


def network_time() -> Check:
    """Ask systemd whether the wall clock is synchronised; logs of several machines are compared by it."""
    command = shutil.which("timedatectl")
    if command is None:
        return Check("network time", "ok", "unknown: no timedatectl here")
    try:
        answer = subprocess.run(  # noqa: S603  (a fixed command, no user input)
            [command, "show", "--property=NTPSynchronized", "--value"],
            capture_output=True, text=True, timeout=3.0, check=False,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return Check("network time", "ok", "unknown: timedatectl does not answer")
    if answer.stdout.strip() == "yes":
        return Check("network time", "ok", "synchronised")
    if answer.returncode or not answer.stdout.strip():
        return Check("network time", "ok", "unknown: timedatectl does not answer")
    return Check("network time", "warning", "not synchronised", "sudo timedatectl set-ntp true")


def resources() -> Iterator[Check]:
    """Check disk and processor."""
    here = Path.cwd()
    free = shutil.disk_usage(here).free
    status: Status = "failure" if free < LEAST_DISK else "warning" if free < LITTLE_DISK else "ok"
    yield Check("disk", status, f"{free / 1e9:.1f} GB free in {here}", "" if status == "ok" else "make room")
    count = os.cpu_count() or 1
    load = os.getloadavg()[0] / count
    what = f"{count} processors, {load:.0%} busy in the last minute"
    if load > HIGH_LOAD:
        yield Check("cpu", "warning", what, "find the process with: top")
    else:
        yield Check("cpu", "ok", what)


# ---------------------------------------------------------------- gamepads
def gamepads(folder: Path = devices.INPUT, listing: Path = devices.LIST) -> Iterator[Check]:
    """Check that SDL is there, and that this user may read the gamepads that are plugged in."""
    from fullswarm.operator.joystick.pads import load_sdl

    found = devices.gamepads(folder, listing)
    try:
        load_sdl()
    except MissingExtra as error:
        # Without a pad it is not needed, and the line on extras has named how to get it.
        yield Check(_PADS, "warning", error.what, error.hint) if found else Check(_PADS, "ok", "none is plugged in")
        return
    if not found:
        yield Check(_PADS, "ok", "none is plugged in" if folder.is_dir() else f"none: there is no {folder}")
    for each in found:
        if each.readable:
            yield Check(_PADS, "ok", f"{each.name} ({each.path})")
        else:
            yield Check(_PADS, "warning", devices.problem((each,)), devices.ACCESS)
