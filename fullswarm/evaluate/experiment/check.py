"""Behaviours of an experiment, asked of the core's own rules before any trial is run: else each trial would say it."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

from fullswarm.core.behaviours import Library
from fullswarm.core.settings import seeds
from fullswarm.errors import ConfigError, RequestRefused
from fullswarm.evaluate.experiment import Trial, scenario_of
from fullswarm.evaluate.scenarios import Scenario
from fullswarm.evaluate.trial import configure, parameters
from fullswarm.store import Store


def check_behaviours(trials: Iterable[Trial], where: str) -> None:
    """Ask for each behaviour with its parameters once, as a trial would.

    Raises
    ------
    ConfigError
        The core would refuse some of them: all reasons, a line each; `where` names the experiment.
    """
    first: dict[tuple[object, ...], Trial] = {}
    arena = cache(Scenario.model_validate_json)
    for trial in sorted(trials, key=lambda trial: trial.cell.robots):  # few robots fit more easily
        first.setdefault((trial.cell.label, arena(trial.arena, strict=True).goal.antipodal), trial)
    reasons = dict.fromkeys(reason for reason in map(_refusal, first.values()) if reason)
    if reasons:
        raise ConfigError("\n".join(f"{where}: {reason}" for reason in reasons))


def _refusal(trial: Trial) -> str:
    """Return why the core would refuse what a trial asks for; empty: it would not."""
    scenario = scenario_of(trial)
    try:
        config, goals = configure(trial, scenario)
    except ConfigError:
        return ""  # so many robots do not fit: only a trial of that size fails, and says so
    store = Store()
    try:
        store.seed(seeds(config))
        library = Library(store)
        record = library.get(trial.cell.behaviour)
        library.resolve(record, parameters(trial, scenario, goals), [each.id for each in config.robot])
    except RequestRefused as error:
        return f"behaviour '{trial.cell.label}': {error.what}{f' ({error.hint})' if error.hint else ''}"
    finally:
        store.close()
    return ""
