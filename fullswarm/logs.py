"""Loggers that load structlog with their first line, and where the lines go.

structlog loads rich and asyncio: a fifth of the time that a shell command takes, and few of them log anything.
"""

from __future__ import annotations

import logging
import sys
from typing import Any

_when_loaded: bool | None = None
"""What :func:`log_to_stderr` was called with while structlog was not loaded; None: it was not."""


class Logger:
    """A logger of structlog: its methods are those of ``structlog.get_logger(*names)``."""

    def __init__(self, *names: str) -> None:
        self._names = names

    def __getattr__(self, method: str) -> Any:
        import structlog

        if _when_loaded is not None:
            log_to_stderr(warnings_only=_when_loaded)
        return getattr(structlog.get_logger(*self._names), method)


def log_to_stderr(*, warnings_only: bool = False, at_once: bool = True) -> None:
    """Send log lines to stderr: structlog's default is stdout, which is for data.

    Not `at_once`: with the first line of a :class:`Logger`, where structlog is not loaded yet.
    """
    global _when_loaded
    if not at_once and "structlog" not in sys.modules:
        _when_loaded = warnings_only
        return
    _when_loaded = None
    import structlog

    # Looked up at each line: a redirected stderr, a test's for one, may be closed again.
    structlog.configure(
        logger_factory=lambda *_: structlog.PrintLogger(sys.stderr),
        wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING if warnings_only else logging.NOTSET),
    )


def quiet() -> None:
    """Log nothing, unless the program has set its log up: for a library whose errors are raised."""
    import structlog

    if not structlog.is_configured():
        structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
