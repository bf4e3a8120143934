"""``python -m fullswarm``: the same entry point as the ``fullswarm`` command, and that of the agent's unit on a robot.

``python -m fullswarm agent ROBOT --fleet FILE`` runs the agent without the rest of the command line when
``FULLSWARM_HEALTH`` is set; ``fullswarm.cli`` is then not imported. ``python -m fullswarm spare`` is a process of a
supervisor that becomes another one when that has died (:mod:`fullswarm.launch.spare`).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from fullswarm.launch import HEALTH
from fullswarm.stderr import survive_full_disk


def import_structlog() -> None:
    """Import it without rich, which it takes for screens only.

    With rich come pygments and a parser of markdown: 8 MB, and half a second on a small computer.
    """
    if "structlog" not in sys.modules and "rich" not in sys.modules:
        sys.modules["rich"] = None  # type: ignore[assignment]  # as if it were not installed
        import structlog  # noqa: F401

        del sys.modules["rich"]


def plain_logs() -> None:
    """Log to stderr for a journal, without colours and times."""
    import_structlog()
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


def run_agent(robot: str, fleet: str) -> int:
    """Run the agent of `robot` as its unit does: what ``fullswarm agent`` is, without the rest of the command line."""
    survive_full_disk()
    plain_logs()
    from fullswarm.output import run_guarded

    def command() -> int:
        from fullswarm.config import load_swarm
        from fullswarm.launch import processes

        return processes.agent(load_swarm(fleet), robot, with_parent=False)

    return run_guarded(command)


if __name__ == "__main__":
    if "--with-parent" in sys.argv:  # its log is a file, and when it has died it must be back soon
        import_structlog()
    if sys.argv[1:2] == ["spare"]:
        from fullswarm.launch.spare import wait_for_order

        sys.argv[1:] = wait_for_order()
    if on_board := asked_for(sys.argv[1:]):
        sys.exit(run_agent(*on_board))
    from fullswarm.cli.main import main

    main()
