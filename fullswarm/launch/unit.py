"""What the agent's unit runs on a robot: ``fullswarm agent``, without the parts that only a person at a terminal needs.

``python -m fullswarm agent ROBOT --fleet FILE`` comes here when ``FULLSWARM_HEALTH`` is set. Nothing is imported before
it is known that this is wanted.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from fullswarm.launch import HEALTH


def plain_logs() -> None:
    """Log to stderr for a journal, without colours; and without rich, which structlog imports for screens only.

    With it come pygments and a parser of markdown: 8 MB and half a second that a small computer feels.
    """
    if "structlog" not in sys.modules and "rich" not in sys.modules:
        sys.modules["rich"] = None  # type: ignore[assignment]  # as if it were not installed
        import structlog

        del sys.modules["rich"]
    import structlog

    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.StackInfoRenderer(),
            structlog.dev.ConsoleRenderer(colors=False, exception_formatter=structlog.dev.plain_traceback),
        ],
        logger_factory=lambda *_: structlog.PrintLogger(sys.stderr),
    )


def asked_for(arguments: Sequence[str]) -> tuple[str, str] | None:
    """Return (robot, fleet file) of ``agent ROBOT --fleet FILE`` where a health file is wanted, else None."""
    if not os.environ.get(HEALTH) or len(arguments) != 4 or (arguments[0], arguments[2]) != ("agent", "--fleet"):
        return None
    return arguments[1], arguments[3]


def main(robot: str, fleet: str) -> int:
    """Run the agent of `robot` as its unit does: what ``fullswarm agent`` is, without the rest of the command line."""
    plain_logs()
    from fullswarm.launch.guard import run_guarded

    def command() -> int:
        from fullswarm.config import load_swarm
        from fullswarm.launch import processes

        return processes.agent(load_swarm(fleet), robot, with_parent=False)

    return run_guarded(command)
