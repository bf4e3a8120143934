"""What each robot of a swarm should run, kept on the base: a robot that was away converges with the next update."""

from __future__ import annotations

import fcntl
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import platformdirs

from fullswarm import output
from fullswarm.deploy.release import manifest


@dataclass(frozen=True, slots=True)
class Desired:
    """One file per swarm: ``{robot: release}``."""

    file: Path

    @classmethod
    def of(cls, swarm: str) -> Desired:
        """Return the one of a swarm, in this user's state folder."""
        return cls(platformdirs.user_state_path("fullswarm") / "desired" / f"{swarm}.json")

    def read(self) -> dict[str, str]:
        """Return what was asked for; a file that cannot be read says nothing."""
        try:
            raw = json.loads(self.file.read_text("utf-8"))
        except (OSError, ValueError):
            return {}
        if not isinstance(raw, dict):
            return {}
        return {robot: each for robot, each in raw.items() if isinstance(each, str) and manifest.is_id(each)}

    def want(self, releases: Mapping[str, str]) -> None:
        """Remember releases of some robots, and leave the others as they are.

        When nothing can be written there it only warns: the robots have done their part, and what became of each is
        still to be told.
        """
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            with self.file.with_suffix(".lock").open("a") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)  # two terminals, two halves of a fleet
                fresh = self.file.with_suffix(".fresh")
                fresh.write_text(json.dumps({**self.read(), **releases}, indent=1, sort_keys=True) + "\n", "utf-8")
                fresh.replace(self.file)
        except OSError as error:
            output.progress(f"warning: {self.file}: cannot keep what robots should run: {error.strerror}")
