"""Makes the folder of an emulated serial port, which only this user can enter."""

from __future__ import annotations

from pathlib import Path


def make_folder(path: str) -> None:
    """Create the folder of the port at `path` where it does not exist."""
    folder = Path(path).parent
    if not folder.exists():
        folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
