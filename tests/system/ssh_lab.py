"""A base station with keys and a store, and the command line that visits its robots."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from typer.testing import CliRunner, Result

from fullswarm.cli.main import app
from fullswarm.deploy.release.keys import Keys, public
from fullswarm.deploy.release.store import Store
from tests.system.ssh_robots import SshRobot, fleet_file, make_release, make_robot


class Lab:
    """A base with keys and a store, and robots behind sshds."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.keys = Keys(folder / "keys")
        self.store = Store(folder / "releases")
        self.robots: list[SshRobot] = []
        self.fleet = folder / "lab.toml"

    def add(self, count: int, *, start: bool = True) -> list[SshRobot]:
        let_in = public(self.keys.fleet_key())
        fresh = [make_robot(self.folder, f"r{len(self.robots) + 1 + i}", let_in) for i in range(count)]
        self.robots += fresh
        self.fleet = fleet_file(self.folder, self.robots)
        for each in fresh if start else ():
            each.start()
        return fresh

    def release(self, version: str, **facts: Any) -> str:
        return make_release(self.store, self.keys, version, **facts)

    def run(self, *words: str) -> Result:
        result = CliRunner().invoke(app, [words[0], "--fleet", str(self.fleet), *words[1:]])
        assert "Traceback" not in result.stderr
        return result

    def ask(self, *words: str) -> dict[str, dict[str, Any]]:
        """Run with ``--json``; return the robots' lines, and the exit code under ``""``."""
        result = self.run(*words, "--json")
        assert result.stdout, result.stderr
        rows = json.loads(result.stdout)["robots"]
        return {"": {"exit_code": result.exit_code}} | {each["robot"]: each for each in rows}

    def deploy(self, *words: str) -> dict[str, dict[str, Any]]:
        return self.ask("deploy", "--accept-new-host-keys", "--guard", "15", *words)
