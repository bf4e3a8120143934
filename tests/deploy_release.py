"""A tiny signed release through the real code, for tests that need one but no package index."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from fullswarm.deploy.release import bundle
from fullswarm.deploy.release.contents import copy_robot_files
from fullswarm.deploy.release.keys import Keys
from fullswarm.deploy.release.manifest import Manifest, Target
from fullswarm.deploy.release.store import Store

FILES = MappingProxyType({"app/hello.py": "print('hello')\n", "lib/words/__init__.py": "WORDS = 3\n"})
X86_64 = Target("x86_64", "x86_64", "2.28", "3.11")


def tiny_release(
    folder: Path,
    keys: Keys,
    version: str = "0.1.0",
    files: Mapping[str, str | bytes] = FILES,
    *,
    target: Target = X86_64,
    with_robot: bool = False,
) -> Path:
    """Make a release of a few `files` in the store `folder`, `with_robot` the real files of ``deploy/robot`` too.

    `target` decides what the robot compares with its own arch, glibc and Python.
    """
    store = Store(folder)
    with bundle.staging(store) as scratch:
        for path, content in files.items():
            place = scratch / path
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(content.encode() if isinstance(content, str) else content)
        if with_robot:
            copy_robot_files(scratch / "robot")
        return bundle.seal(scratch, Manifest("", version, target), store, keys)
