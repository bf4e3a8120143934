"""The fleet in its usual state, the releases that the tests switch between, and what they measure."""

from __future__ import annotations

import secrets
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from tests.fleet.lab import Done, Lab
from tests.fleet.tools import until

MODULE = "fullswarm/agent/node.py"
"""What releases of tests differ in: the agent cannot start without it, and `bundle` does not import it."""
BROKEN = "\nimport a_module_that_is_not_there\n"


@dataclass
class Figures:
    """Name, value and what is aimed at, in the order in which they came."""

    rows: list[tuple[str, str, str]] = field(default_factory=list)

    def note(self, what: str, value: str, target: str = "") -> None:
        """Write one down."""
        self.rows.append((what, value, target))

    def lines(self) -> list[str]:
        """Return the table."""
        width = max(len(what) for what, _, _ in self.rows)
        return [f"{what:{width}}  {value:>12}  {target}".rstrip() for what, value, target in self.rows]


class Fleet:
    """Robots that were deployed once, at the start; `first` is the release that they got."""

    def __init__(self, lab: Lab, figures: Figures) -> None:
        self.lab, self.figures = lab, figures
        self.first = lab.bundle()
        before = self.moved_bytes()
        self.deployed = lab.cli("deploy", "--json")
        self.ready_s = lab.wait_ready()
        self.deployed_releases = lab.releases()
        self.deployed_bytes = self.moved_bytes() - before

    # ------------------------------------------------------------------ releases
    @cached_property
    def second(self) -> str:
        """A release that differs from the first by a line of the app."""
        return self.changed("second")

    @cached_property
    def broken(self) -> str:
        """A release whose agent cannot be imported."""
        return self.lab.bundle({MODULE: BROKEN})

    def changed(self, name: str, *, kilobytes: int = 0) -> str:
        """Make a release that differs from the first by a line, and by so much that cannot be packed.

        A test that wants robots to lack the release makes its own: who had `second` before may still have it.
        """
        ballast = f"_BALLAST = '{secrets.token_hex(512 * kilobytes)}'\n" if kilobytes else ""
        return self.lab.bundle({MODULE: f"\n# {name}\n{ballast}"})

    # ------------------------------------------------------------------ states
    def settle(self) -> None:
        """Heal everything and bring all robots to the first release."""
        self.lab.heal()
        self.lab.cli("deploy", "--release", self.first, "--allow-older")
        self.lab.wait_ready()

    def runs(self, robot: str) -> str | None:
        """Return the release of the agent that runs on a robot, looked up past its network; None: none is ready."""
        computer = self.lab.computers[robot]
        if not computer.up:
            return None
        told = computer.do("/opt/fullswarm/bin/fullswarm-robot", "health", check=False)
        facts = computer.facts() if told else {}
        agent = facts.get("agent")
        return str(facts["current"]) if isinstance(agent, dict) and agent["active"] else None

    def wait_runs(self, robot: str, release: str, timeout_s: float, what: str) -> float:
        """Wait until a robot's agent runs this release and nothing is pending; return how long that took, in s."""
        mark = self.lab.computers[robot].root / "opt/fullswarm/pending"
        return until(
            lambda: not mark.exists() and self.runs(robot) == release, timeout_s, what, lambda: self.lab.story([robot])
        )

    def listing(self) -> dict[str, str]:
        """Return what lies in each robot's folder of releases, without the record of what it has refused."""
        find = ("find", "/opt/fullswarm", "-maxdepth", "2", "!", "-path", "*/trust/refused", "-printf", "%P %i\n")
        return {robot: computer.do(*find) for robot, computer in self.lab.computers.items()}

    def moved_bytes(self) -> int:
        """Return what SSH has moved so far, both ways and to and from all robots; the swarm's own talk is not in it."""
        return self.lab.network.ssh_bytes()


def results(done: Done) -> dict[str, str]:
    """Return what became of each robot in the words of the command."""
    return {row["robot"]: row["result"] for row in done.json["robots"]}


def row_of(done: Done, robot: str) -> dict[str, Any]:
    """Return all that the command says of one robot."""
    found: dict[str, Any] = next(row for row in done.json["robots"] if row["robot"] == robot)
    return found
