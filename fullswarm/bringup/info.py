"""Runs `fullswarm info`, for bug reports: versions, machine, extras, ports. No address, no environment, no home."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import fullswarm
from fullswarm import output
from fullswarm.errors import FullswarmError
from fullswarm.launch.run_folder import user_path

HUB_S = 0.5
LISTEN_S = 1.0
_WORD = re.compile(r"[A-Za-z0-9._-]+")
_EXTRA = re.compile(r"extra\s*==\s*['\"]([^'\"]+)['\"]")
SELF_REFERENCE = "fullswarm"
"""An extra such as `all` is made of others: their packages are listed there."""


@dataclass(frozen=True, slots=True)
class Info:
    """All of it; each section is a name → text table."""

    fullswarm: dict[str, str]
    machine: dict[str, str]
    packages: dict[str, str]
    extras: dict[str, str]
    folders: dict[str, str]
    swarm: dict[str, str]
    ports: dict[str, str]


def run(hub: str | None, swarm: str, *, as_json: bool) -> int:
    """Print the facts of this installation and machine."""
    found = asdict(collect(hub, swarm))
    if as_json:
        output.data_json(found)
    else:
        output.data("\n".join(markdown(found)))
    return 0


def collect(hub: str | None, swarm: str) -> Info:
    """Collect everything; what is unknown is reported as such."""
    installed, extras = requirements()
    return Info(
        fullswarm={
            "version": fullswarm.__version__,
            "commit": _commit(),
            "folder": short(Path(fullswarm.__file__).parent),
        },
        machine=_machine(),
        packages=installed,
        extras=extras,
        folders=_folders(),
        swarm=_swarm(hub, swarm),
        ports=_ports(),
    )


def markdown(found: dict[str, dict[str, str]]) -> Iterator[str]:
    """Return it as tables that an issue tracker shows."""
    for section, table in found.items():
        yield f"### {section}\n"
        yield "| | |\n|---|---|"
        yield from (f"| {name} | {_cell(text)} |" for name, text in table.items())
        yield ""


def short(path: Path | str) -> str:
    """Return a path with the user's home as ~."""
    text, home = str(path), str(Path.home())
    return "~" + text[len(home) :] if text == home or text.startswith(home.rstrip("/") + "/") else text


def requirements() -> tuple[dict[str, str], dict[str, str]]:
    """Return the versions of all packages that fullswarm may use, and what is missing of each extra."""
    installed: dict[str, str] = {}
    missing: dict[str, list[str]] = {}
    try:
        wanted = importlib.metadata.requires("fullswarm") or []
    except importlib.metadata.PackageNotFoundError:  # run from a folder, not installed
        return {"python": platform.python_version()}, {"?": "unknown: fullswarm is not installed as a package"}
    for each in wanted:
        name, extra = _WORD.match(each), _EXTRA.search(each)
        if name is None or name[0] == SELF_REFERENCE:
            continue
        group = missing.setdefault(extra[1] if extra else "(base)", [])
        try:
            installed[name[0]] = importlib.metadata.version(name[0])
        except importlib.metadata.PackageNotFoundError:
            group.append(name[0])
    extras = {extra: f"missing: {', '.join(names)}" if names else "complete" for extra, names in missing.items()}
    return dict(sorted(installed.items(), key=lambda item: item[0].lower())), extras


def _commit() -> str:
    from fullswarm.evaluate.provenance import commit

    return commit() or "not from a checkout"


def _machine() -> dict[str, str]:
    from fullswarm.evaluate import provenance

    return {
        "python": f"{platform.python_version()} {platform.python_implementation()}, {short(sys.executable)}",
        "system": _system(),
        "kernel": f"{platform.system()} {platform.release()}",
        "architecture": f"{platform.machine()}, {platform.architecture()[0]}",
        "processors": f"{os.cpu_count()}, {provenance.machine().partition(' x ')[0]}, load {_load()}",
        "memory": _memory(),
        "terminal": f"{os.environ.get('TERM', 'unknown')}, {'a terminal' if sys.stdout.isatty() else 'into a file'}",
    }


def _load() -> str:
    return f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"


def _memory() -> str:
    try:
        page, *pages = (os.sysconf(f"SC_{name}") for name in ("PAGE_SIZE", "PHYS_PAGES", "AVPHYS_PAGES"))
    except (AttributeError, ValueError):  # Windows has none of them, macOS not the last
        return "unknown"
    return "{:.1f} GiB, {:.1f} GiB free".format(*(page * each / 2**30 for each in pages))


def _system() -> str:
    try:
        return platform.freedesktop_os_release().get("PRETTY_NAME", "unknown")
    except OSError:
        return platform.platform()


def _folders() -> dict[str, str]:
    import platformdirs

    places: dict[str, Any] = {
        "configuration": platformdirs.user_config_path("fullswarm"),
        "cache": platformdirs.user_cache_path("fullswarm"),
        "state (latched e-stops, keys)": platformdirs.user_state_path("fullswarm"),
    }
    found = {name: f"{short(path)}{'' if path.exists() else ', not there'}" for name, path in places.items()}
    return found | {"logs of `fullswarm up`": f"{short(user_path())}/run-*"}


# ---------------------------------------------------------------- what runs, what is plugged in
def _swarm(hub: str | None, swarm: str) -> dict[str, str]:
    from fullswarm.operator import session
    from fullswarm.operator.session import Target
    from fullswarm.operator.view import FleetView

    local = hub is None or "127.0.0.1" in hub or "localhost" in hub
    where = "on this machine" if local else "on another machine"  # its address is private
    try:
        with session.connect(Target(hub, swarm), within_s=HUB_S) as line:
            view = FleetView(line.bus, line.keys, line.runtime)
            line.run(LISTEN_S)
            seen = view.snapshot()
    except FullswarmError as error:
        return {"hub": f"none {where}: {error.what}"}
    versions = sorted({row.health.make for row in seen.robots if row.health})
    nodes = ", ".join(node.node for node in seen.nodes) or "none"
    robots = f"{len(seen.robots)} heard{': ' + ', '.join(versions) if versions else ''}"
    return {"hub": f"answers {where}", "nodes": nodes, "robots": robots}


def _ports() -> dict[str, str]:
    from fullswarm.drivers.can import probe as can_bus
    from fullswarm.drivers.probe import ask

    serial = [f"{each.device} {each.product}".strip() for each in ask.serial_ports()]
    pads = [file.name for file in sorted(Path("/dev/input").glob("js*"))]
    return {
        "serial": ", ".join(serial) or "none",
        "CAN": ", ".join(can_bus.interfaces_up()) or "none up",
        "gamepads": ", ".join(pads) or "none",
    }


def _cell(text: str) -> str:
    return short(text).replace("|", "\\|").replace("\n", " ")
