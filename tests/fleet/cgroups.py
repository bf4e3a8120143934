"""A control group for each robot: without one all containers' systemds would take each other's services for theirs."""

from __future__ import annotations

from pathlib import Path

from tests.fleet.network import PREFIX


def hierarchies() -> list[Path]:
    """Return where systemd keeps its groups on this machine."""
    found = []
    for line in Path("/proc/self/mountinfo").read_text().splitlines():
        place, (kind, _, options) = line.split()[4], line.split(" - ", 1)[1].split(maxsplit=2)
        if kind == "cgroup2" or (kind == "cgroup" and "name=systemd" in options):
            found.append(Path(place))
    return found


def entering(name: str) -> str:
    """Make a robot's groups, and return the shell's words that move a process into them."""
    words = []
    for hierarchy in hierarchies():
        group = hierarchy / f"{PREFIX}-{name}"
        group.mkdir(exist_ok=True)
        words.append(f"echo $$ > {group}/cgroup.procs")
    return " && ".join([*words, ":"])


def remove(name: str = "*") -> None:
    """Remove a robot's groups; all processes in them have ended."""
    for hierarchy in hierarchies():
        for group in hierarchy.glob(f"{PREFIX}-{name}"):
            for each in sorted((each for each in group.rglob("*") if each.is_dir()), reverse=True):
                each.rmdir()
            group.rmdir()
