"""Writes the core's memory: a disk that is full or locked is complained about, and must not end the core."""

from __future__ import annotations

from collections.abc import Mapping

import structlog

from fullswarm.errors import ConfigError
from fullswarm.store import Store, Stored

log = structlog.get_logger()


def keep(store: Store, values: Mapping[str, Stored], author: str) -> None:
    """Write `values`; None takes one away, where there is one."""
    try:
        wanted = {key: value for key, value in values.items() if value is not None or store.get(key) is not None}
        if wanted:
            store.set_many(wanted, author)
    except ConfigError as error:
        log.error("a restart of the core would not know this", error=str(error), keys=sorted(values)[:5])
