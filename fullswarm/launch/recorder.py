"""Whether recordings can be made and read on this computer, and the recorder as one more process beside a swarm."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING

from fullswarm.errors import ConfigError, MissingExtra

if TYPE_CHECKING:  # the commands that only read recordings load neither
    from fullswarm.launch.supervisor import Supervisor

PACKAGES = ("mcap", "foxglove")


def can_record() -> bool:
    """Tell whether what recordings need is installed."""
    return all(importlib.util.find_spec(each) is not None for each in PACKAGES)


def need_recordings() -> None:
    """Raise `MissingExtra` where recordings can neither be written nor read."""
    if not can_record():
        raise MissingExtra("recordings are not installed", hint="pip install 'fullswarm[record]'")


def check_record(record: Path) -> None:
    """Raise `MissingExtra` where nothing can be recorded, and `ConfigError` where the file cannot be made."""
    need_recordings()
    if record.exists():
        raise ConfigError("this file is there already", where=str(record), hint="name another one with --record")
    if not record.parent.is_dir():
        raise ConfigError("there is no such folder", where=str(record.parent))


def add_recorder(supervisor: Supervisor, record: Path) -> None:
    """Have the supervisor's swarm recorded from its start to its end; before `Supervisor.start`."""
    from fullswarm.launch.journals import journal_folder
    from fullswarm.launch.spare import FLEET
    from fullswarm.launch.supervisor import RECORDER

    config = supervisor.config
    supervisor.journals = journal_folder(supervisor.folder)
    supervisor.journals.mkdir(mode=0o700)
    supervisor.add(
        RECORDER, "record", "start", "--out", str(record.absolute()), "--hub", config.hub.endpoint,
        "--swarm", config.swarm, "--fleet", str(supervisor.folder / FLEET), guest=True,
    )  # fmt: skip
