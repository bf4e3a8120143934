"""A bridge on the base, a cable to each robot's network namespace; cables can be cut and can lose frames.

A cut is silent, as with a radio: no end sees its link go down, frames just do not arrive.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

from tests.fleet.tools import Missing, run

PREFIX = "fswt"
"""What interfaces, namespaces and tables of this lab are called."""

BRIDGE = f"{PREFIX}0"
SUBNET = "10.213.77"
BASE = f"{SUBNET}.1"
FIRST = 11
RULES = f"""
table bridge {PREFIX} {{
  set cut {{ type ifname; }}
  map losing {{ type ifname : verdict; }}
  counter ssh {{ }}
  chain lose {{ }}
  chain arrives {{
    type filter hook prerouting priority 0;
    iifname @cut drop
    iifname vmap @losing
    tcp sport 22 counter name ssh
  }}
  chain forwarded {{
    type filter hook forward priority 0;
    oifname @cut drop
    oifname vmap @losing
  }}
  chain leaves {{
    type filter hook output priority 0;
    oifname @cut drop
    oifname vmap @losing
    tcp dport 22 counter name ssh
  }}
}}
"""


class Network:
    """The cables of some robots. Raises :class:`~tests.fleet.tools.Missing` where the kernel cannot do it."""

    def __init__(self, robots: Iterable[str]) -> None:
        remove()
        self.address = {robot: f"{SUBNET}.{FIRST + row}" for row, robot in enumerate(robots)}
        try:
            run("ip", "-batch", "-", text=f"link add {BRIDGE} type bridge\naddr add {BASE}/24 dev {BRIDGE}\n"
                f"link set {BRIDGE} up\n")  # fmt: skip
            run("nft", "-f", "-", text=RULES)
        except AssertionError as error:
            remove()
            raise Missing(f"this kernel has no bridge, or nft cannot filter on one: {error}") from error
        for robot, address in self.address.items():
            _plug(name(robot), address)

    def namespace(self, robot: str) -> Path:
        """Return what a process enters to be on a robot's network."""
        return Path("/run/netns") / name(robot)

    def cut(self, *robots: str) -> None:
        """Let nothing pass to and from these robots."""
        run("nft", "add", "element", "bridge", PREFIX, "cut", _elements(robots))

    def mend(self, *robots: str) -> None:
        """Let everything pass again; to and from these robots, or all and without loss."""
        if robots:
            for robot in robots:
                run("nft", "delete", "element", "bridge", PREFIX, "cut", _elements([robot]), check=False)
            return
        run("nft", "flush", "set", "bridge", PREFIX, "cut")
        run("nft", "flush", "map", "bridge", PREFIX, "losing")
        run("nft", "flush", "chain", "bridge", PREFIX, "lose")

    def lose(self, percent: int, *robots: str) -> None:
        """Lose this share of frames to these robots, and of those from them; one share at a time."""
        run("nft", "flush", "chain", "bridge", PREFIX, "lose")
        run("nft", f"add rule bridge {PREFIX} lose numgen random mod 100 < {percent} drop")
        elements = ", ".join(f'"{name(robot)}" : jump lose' for robot in robots)
        run("nft", f"add element bridge {PREFIX} losing {{ {elements} }}")

    def ssh_bytes(self) -> int:
        """Return how many bytes of SSH have gone to and come from all robots."""
        said = run("nft", "-j", "list", "counter", "bridge", PREFIX, "ssh")
        return int(next(each["counter"]["bytes"] for each in json.loads(said)["nftables"] if "counter" in each))


def name(robot: str) -> str:
    """Return what a robot's cable and namespace are called."""
    return f"{PREFIX}-{robot}"


def remove() -> None:
    """Remove all that this or an earlier run has left."""
    run("nft", "delete", "table", "bridge", PREFIX, check=False)
    for line in run("ip", "netns", "list", check=False).splitlines():
        if line.startswith(f"{PREFIX}-"):
            run("ip", "netns", "delete", line.split()[0])
    for each in Path("/sys/class/net").iterdir():
        if each.name.startswith(f"{PREFIX}-"):
            run("ip", "link", "delete", each.name, check=False)  # one end takes the other along
    run("ip", "link", "delete", BRIDGE, check=False)


def _plug(cable: str, address: str) -> None:
    run("ip", "netns", "add", cable)
    outside = (f"link add {cable} type veth peer name eth0 netns {cable}", f"link set {cable} master {BRIDGE} up")
    run("ip", "-batch", "-", text="\n".join(outside) + "\n")
    inside = ("link set lo up", f"addr add {address}/24 dev eth0", "link set eth0 up", f"route add default via {BASE}")
    run("ip", "-netns", cable, "-batch", "-", text="\n".join(inside) + "\n")


def _elements(robots: Iterable[str]) -> str:
    return "{ " + ", ".join(f'"{name(robot)}"' for robot in robots) + " }"
