"""Records of behaviours that other packages bring: their law is an entry point, their record lies beside the law."""

from __future__ import annotations

import tomllib
from pathlib import Path

from fullswarm import registry
from fullswarm.core.records import Raw, load_records, make_record
from fullswarm.errors import ConfigError


def all_records() -> dict[str, Raw]:
    """Return the records of the package and of all others that are installed, each checked.

    Raises
    ------
    ConfigError
        A record is broken, or has a name that is taken; says in which file.
    """
    tables = load_records()
    owner: dict[str, Path] = {}
    for file in registry.record_files():
        found = _read(file)
        for name in found:
            if name in tables:
                taken = f"by {owner[name]}" if name in owner else "by fullswarm itself"
                raise ConfigError(f"'{name}' is taken {taken}", where=str(file), hint="give the behaviour another name")
        tables |= found
        owner |= dict.fromkeys(found, file)
        for name in found:
            try:
                make_record(name, tables)
            except ConfigError as error:
                raise ConfigError(f"{error.where}: {error.what}", where=str(file), hint=error.hint) from error
    return tables


def _read(file: Path) -> dict[str, Raw]:
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(str(error), where=str(file), hint="mend it, or uninstall its package") from error
