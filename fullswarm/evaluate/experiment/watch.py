"""`fullswarm experiment watch`: look into the folder each second, until all trials have ended."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.live import Live

from fullswarm import output
from fullswarm.clock import MonotonicClock, wall_time_s
from fullswarm.evaluate.experiment.watch_folder import ExperimentFolder, Progress, progress_of
from fullswarm.evaluate.experiment.watch_view import view
from fullswarm.runtime import Runtime

REFRESH_S = 1.0
LEFT = "left; the experiment goes on"


@dataclass(frozen=True, slots=True)
class Watch:
    """What the command line says."""

    folder: Path
    once: bool = False
    as_json: bool = False


def watch(wanted: Watch, runtime: Runtime | None = None, wall_s: Callable[[], float] = wall_time_s) -> int:
    """Show how an experiment goes until all its trials have ended or Ctrl-C; return 0.

    Parameters
    ----------
    runtime : its clock and timers
    wall_s : seconds since 1970, as the folder's files have them

    Raises
    ------
    ConfigError
        The folder is missing, unreadable, or no experiment writes there.
    """
    folder = ExperimentFolder(wanted.folder)
    folder.look()
    if wanted.once:
        _tell(progress_of(folder, wall_s()), wall_s(), as_json=wanted.as_json)
        return 0
    runtime = runtime or Runtime(MonotonicClock())
    try:
        if wanted.as_json:
            _lines(folder, runtime, wall_s)
        else:
            _live(folder, runtime, wall_s)
    except KeyboardInterrupt:
        output.progress(LEFT)
    if not wanted.as_json:
        _tell(progress_of(folder, wall_s()), wall_s(), as_json=False)
    return 0


def _tell(progress: Progress, now_s: float, *, as_json: bool) -> None:
    if as_json:
        output.data_json(progress.to_json(now_s))
    else:
        output.data_table(view(progress, now_s), into_file=130)


def _live(folder: ExperimentFolder, runtime: Runtime, wall_s: Callable[[], float]) -> None:
    console = Console(highlight=False)
    # rich's own refreshing would need a thread; the runtime's timer does.
    with Live(console=console, auto_refresh=False, screen=console.is_terminal, transient=True) as live:

        def refresh() -> None:
            folder.look()
            progress = progress_of(folder, wall_s())
            live.update(view(progress, wall_s(), console.size.height), refresh=console.is_terminal)
            if progress.over:
                runtime.stop()

        runtime.every(REFRESH_S, refresh, first_s=0.0)
        runtime.run()


def _lines(folder: ExperimentFolder, runtime: Runtime, wall_s: Callable[[], float]) -> None:
    """Print one line of JSON now and at each change."""
    first = True

    def refresh() -> None:
        nonlocal first
        changed = folder.look() or first
        first = False
        if changed:
            progress = progress_of(folder, wall_s())
            output.data(json.dumps(progress.to_json(wall_s()), allow_nan=False, ensure_ascii=False))
            if progress.over:
                runtime.stop()

    runtime.every(REFRESH_S, refresh, first_s=0.0)
    runtime.run()
