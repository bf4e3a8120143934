"""Runs all trials of an experiment in worker processes (`fullswarm experiment run`), or one from its file (`trial`)."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import get_args

import msgspec
from rich.table import Table

from fullswarm import output
from fullswarm.clock import MonotonicClock
from fullswarm.config.toml_errors import dotted, line_numbers, parse_toml, read_toml
from fullswarm.core.behaviours import Library
from fullswarm.core.groups import Groups
from fullswarm.core.roles import check_names
from fullswarm.core.settings import seeds
from fullswarm.core.teams import team_of
from fullswarm.errors import ConfigError, FullswarmError, MissingExtra, RequestRefused, did_you_mean
from fullswarm.evaluate.experiment import (
    Experiment,
    Trial,
    TrialResult,
    load_experiment,
    on_network,
    plan,
    scenario_of,
    summarise,
)
from fullswarm.evaluate.experiment.model import EvidenceMode, parse_seeds
from fullswarm.evaluate.experiment.outcomes import closing, table
from fullswarm.evaluate.experiment.pool import Pool
from fullswarm.evaluate.lockstep_swarm import measure
from fullswarm.evaluate.provenance import Provenance, provenance
from fullswarm.evaluate.results.folder import (
    LOCKSTEP,
    Asked,
    configuration_of,
    kept_of,
    older_in,
    older_text,
    open_folder,
    other_code,
)
from fullswarm.evaluate.scenarios import Scenario
from fullswarm.evaluate.trial import Keeper, KeepingEvidence, Measure, configure, parameters, perform, record_of
from fullswarm.evaluate.trial_folder import (
    TRIALS,
    Measurement,
    Record,
    launch_text,
    load_trial,
    read_kept,
    read_record,
    sweep,
    trial_id,
    write_trial,
)
from fullswarm.launch.recorder import can_record
from fullswarm.messages import BehaviourRequest
from fullswarm.store import Store

"""How often progress is printed."""


@dataclass(frozen=True, slots=True)
class Options:
    """The options of the command line."""

    experiment: str
    seeds: str | None = None
    cells: tuple[str, ...] = ()
    small: bool = False
    jobs: int = 2
    timeout_s: float = 600.0
    folder: Path | None = None
    as_json: bool = False
    engine: str | None = None  # instead of all groups' engines
    network: str | None = None  # instead of all groups' conditions of the network
    shard: str | None = None  # "1/4": the first of four parts
    retries: int = 1
    dask: str | None = None  # "local", or a scheduler's address
    live: bool = False  # real processes in real time
    emulate: str | None = None  # with `live`: the make behind whose emulated ports the robots are
    fleet: Path | None = None  # the robots of a fleet file, one trial after the other
    yes: bool = False  # with `fleet`: skip the confirmation prompt
    insecure_network: bool = False  # with `fleet`
    evidence: str | None = None  # instead of the file's `EvidenceMode`
    record: bool | None = None  # into the folder; None: live runs, if what that needs is installed
    parent: int | None = None  # process with which the run ends, as by Ctrl-C; None: with none

    @property
    def recordings(self) -> Path | None:
        """The folder for recordings of trials; None: they are not recorded."""
        wanted = (self.live or self.fleet is not None) and can_record() if self.record is None else self.record
        return self.folder / "recordings" if wanted and self.folder is not None else None


Results = Iterator[tuple[Trial, TrialResult]]


def run(options: Options, run_one: Measure = measure) -> int:
    """Run the experiment; return 0 when no trial failed and none collided but where that was expected, else 1.

    Ctrl-C ends it at once with 130; what is done is kept.

    Raises
    ------
    ConfigError
        The experiment, a behaviour in it, a filter, the seeds, the shard or the folder are wrong.
    """
    _check(options)
    experiment = load_experiment(options.experiment)
    configuration = configuration_of(experiment)  # before --network: that makes other cells, not another experiment
    if options.network is not None:
        experiment = on_network(experiment, options.network)
    if options.evidence is not None:
        experiment = experiment.model_copy(update={"evidence": evidence_mode(options.evidence)})
    everything = plan(experiment, _seeds(options.seeds), options.cells, options.small, options.engine)
    if options.fleet is None:  # the core of a fleet may have behaviours of its own
        check_behaviours(everything, options.experiment)
    trials = shard_of(everything, options.shard)
    results = _kept(options, experiment, configuration, everything, trials)
    clock = MonotonicClock()
    began_s = clock.now_s()
    try:
        for trial, result in _run_all([each for each in trials if each not in results], experiment, options, run_one):
            results[trial] = result
    except KeyboardInterrupt:
        if options.folder is not None:
            with suppress(ConfigError):
                sweep(options.folder)  # the trials that the workers were writing when they were ended
        _print_interrupted(options, results, trials)
        return output.INTERRUPTED
    report = summarise(((trial, results[trial]) for trial in trials if trial in results), clock.now_s() - began_s)
    written = options.folder is None or _finish(options.folder)
    if options.as_json:
        output.data_json(report.to_json())
    else:
        output.data_table(table(report), into_file=130)
        output.data(closing(report))
    return 0 if report.passed and written else 1


def evidence_mode(text: str) -> EvidenceMode:
    """Return which trials keep their motion; `ConfigError` if `text` is no such choice."""
    modes: dict[str, EvidenceMode] = {mode: mode for mode in get_args(EvidenceMode)}
    if text in modes:
        return modes[text]
    raise ConfigError(
        f"'{text}' is no choice", where="--evidence", hint=did_you_mean(text, modes)
    )  # fmt: skip


def shard_of(trials: list[Trial], text: str | None) -> list[Trial]:
    """Return the trials of shard ``"i/n"``: every n-th, from the i-th on; together the n shards are all.

    Raises
    ------
    ConfigError
        It is no shard, or holds no trial.
    """
    if text is None:
        return trials
    part, slash, of = text.partition("/")
    if not (slash and part.isdecimal() and of.isdecimal() and 1 <= int(part) <= int(of)):
        raise ConfigError(f"'{text}' is no shard", where="--shard", hint="write 1/4 for the first of four")
    found = trials[int(part) - 1 :: int(of)]
    if not found:
        raise ConfigError(f"shard {text} of {len(trials)} trials is empty", where="--shard")
    return found


def _check(options: Options) -> None:
    chosen = [name for name in ("dask", "live", "fleet") if getattr(options, name)]
    if len(chosen) > 1:
        raise ConfigError(f"choose one of {', '.join(f'--{name}' for name in chosen)}")
    for name, needed in (("emulate", "live"), ("yes", "fleet")):
        if getattr(options, name) and not getattr(options, needed):
            raise ConfigError(f"it needs --{needed}", where=f"--{name}")
    if options.record and options.folder is None:
        raise ConfigError("it needs --out FOLDER", where="--record")
    if options.record and options.dask is not None:
        raise ConfigError("workers of Dask keep no recordings", where="--record", hint="leave --dask out")
    if options.record and not can_record():
        raise MissingExtra("recordings are not installed", hint="pip install 'fullswarm[record]'")


def _seeds(text: str | None) -> tuple[int, ...] | None:
    try:
        return None if text is None else parse_seeds(text)
    except ValueError as error:
        raise ConfigError(str(error), where="--seeds") from error


def _kept(
    options: Options, experiment: Experiment, configuration: str, everything: list[Trial], trials: list[Trial]
) -> dict[Trial, TrialResult]:
    """Make the folder ready; return the results that it holds."""
    if options.folder is None:
        return {}
    asked = Asked(
        name=experiment.name,
        description=experiment.description,
        configuration=configuration,
        seeds=options.seeds,
        cells=options.cells,
        small=options.small,
        engine=options.engine,
        how=_how(options),
        file=_from_anywhere(options.experiment),
        network=options.network,
        fleet=None if options.fleet is None else str(options.fleet.resolve()),
    )
    asked, swept = open_folder(options.folder, asked, everything)
    if swept:
        output.progress(f"{swept} half-written trials of a run that died are removed")
    older = older_in(options.folder, asked.trials)
    if older:
        output.progress(older_text(older))
    results = kept_of(options.folder, trials)
    if results:
        output.progress(f"{len(results)} of {len(trials)} trials are in {options.folder} already")
    for code, count in other_code(options.folder, results).items():
        output.progress(f"{count} of them were run by other code ({code}); another --out runs them anew")
    return results


def _from_anywhere(experiment: str) -> str:
    """Return what names the experiment from any folder: that of the package by its name, a file by its whole path."""
    return str(Path(experiment).resolve()) if experiment.endswith(".toml") else experiment


def _how(options: Options) -> str:
    if options.fleet is not None:
        return "fleet"
    return f"live {options.emulate or ''}".rstrip() if options.live else LOCKSTEP


# ---------------------------------------------------------------------------------------------------- running
def _run_all(trials: list[Trial], experiment: Experiment, options: Options, run_one: Measure) -> Results:
    """Yield every trial with its result; print the progress on stderr."""
    if not trials:
        return
    collisions = failed = 0
    with (
        output.Progress("trials", len(trials), at_once=True) as progress,
        _runner(
            min(options.jobs, len(trials)), experiment, options, run_one, partial(_idle, progress, options.parent)
        ) as run_trials,
    ):
        progress.at(0)
        for done, (trial, result) in enumerate(run_trials(trials), 1):
            if result.lost and options.folder is not None:
                result = _keep_lost(options.folder, experiment.name, "dask" if options.dask else "pool", trial, result)
            failed += result.outcome is None
            collisions += result.outcome.events if result.outcome and result.outcome.safe_start else 0
            _print_trouble(trial, result, progress.say)
            progress.at(done, f"{collisions} collisions, {failed} failed")
            yield trial, result


def _idle(progress: output.Progress, parent: int | None) -> None:
    """Show the progress; end as by Ctrl-C when the process that started this one is gone."""
    progress.tick()
    if parent is not None and os.getppid() != parent:
        raise KeyboardInterrupt


@contextmanager
def _runner(
    jobs: int, about: Experiment, options: Options, run_one: Measure, idle: Callable[[], None]
) -> Iterator[Callable[[list[Trial]], Results]]:
    """Yield what runs trials: it yields each one with its result as it ends, but those that it cannot run at all.

    While it waits it calls `idle` each second, unless it runs on a cluster or on robots.
    """
    kind, experiment, evidence = "pool", about.name, about.evidence
    if options.fleet is not None:
        from fullswarm.evaluate.fleet_swarm import run_fleet

        fleet = options.fleet
        yield lambda trials: run_fleet(
            trials, fleet, experiment, options.folder,
            yes=options.yes, insecure_network=options.insecure_network, evidence=evidence,
            recordings=options.recordings,
        )  # fmt: skip
        return
    if options.live:
        from fullswarm.evaluate.live_swarm import measure_live

        run_one = partial(measure_live, emulate=options.emulate, recordings=options.recordings)
        kind, jobs = "live", 1  # in real time a machine has no room for two swarms
    elif options.recordings is not None:
        run_one = partial(measure, recordings=options.recordings)
    run_one = KeepingEvidence(run_one, evidence)
    if options.dask is not None:
        from fullswarm.evaluate.experiment.dask import Cluster, Task

        task = Task(experiment, run_one, options.timeout_s)
        with Cluster(options.dask, jobs, task, options.folder, options.retries) as cluster:
            yield cluster.run
        return
    keeper = Keeper(options.folder, experiment, run_one, kind)
    with Pool(jobs, options.timeout_s, keeper, retries=options.retries, idle=idle) as pool:
        yield pool.run


def _keep_lost(out: Path, experiment: str, runner: str, trial: Trial, result: TrialResult) -> TrialResult:
    """Keep a trial whose process could not do so itself any more, as failed; return what counts."""
    kept = read_kept(out, trial)  # it may have died between keeping and answering
    if kept is not None:
        return kept
    try:
        about = provenance(None, result.wall_s, result.attempts, launch_text(trial, experiment), runner)
        write_trial(out, record_of(trial, experiment, result.failure), about)
    except OSError as error:
        output.progress(f"cannot keep that it failed: {trial.label}: {error.strerror or error}")
    return result


def _finish(folder: Path) -> bool:
    """Tidy up and write the report; print what failed."""
    sweep(folder)
    try:
        from fullswarm.evaluate.results import write_report

        output.progress(f"report: {write_report(folder)}")
    except (FullswarmError, ImportError) as error:
        output.progress(f"no report: {error}")
    except OSError as error:
        output.progress(f"no report: {folder}: {error.strerror or error}")
        return False
    return True


def _print_trouble(trial: Trial, result: TrialResult, say: Callable[[str], None]) -> None:
    outcome = result.outcome
    if outcome is None:
        say(f"failed: {trial.label}: {result.failure}")
    elif outcome.events and not trial.cell.collisions_expected:
        apart = "" if outcome.safe_start else " (it began outside the safe set)"
        say(f"{outcome.events} collisions: {trial.label}{apart}")


def _print_interrupted(options: Options, results: dict[Trial, TrialResult], trials: list[Trial]) -> None:
    done = sum(result.outcome is not None for result in results.values())
    if options.folder is None:
        then = "nothing is kept without --out FOLDER"
    else:
        then = f"they are in {options.folder}; the same command goes on from there"
    output.progress(f"interrupted: {done} of {len(trials)} trials are done, {then}")


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
    found = {reason: trial.cell.behaviour for trial in first.values() if (reason := _refusal(trial))}
    if found:
        places = _places(where)
        raise ConfigError("\n".join(f"{places.get(name, where)}: {reason}" for reason, name in found.items()))


def _places(where: str) -> dict[str, str]:
    """Return file, line and key of each behaviour in an experiment's file, by its name; none for one by name."""
    if not where.endswith(".toml") or not Path(where).is_file():  # it may have been read from elsewhere
        return {}
    text = read_toml(Path(where), "experiment file")
    lines, places = line_numbers(text), dict[str, str]()
    for number, group in enumerate(parse_toml(text, where)["groups"]):
        for index, behaviour in enumerate(group["behaviours"]):
            path = ("groups", number, "behaviours", index)
            places.setdefault(str(behaviour["name"]), f"{where}:{lines[path]}: {dotted(path)}")
    return places


def _refusal(trial: Trial) -> str:
    """Return why the core would refuse what a trial asks for; empty: it would not."""
    scenario = scenario_of(trial)
    try:
        config, goals = configure(trial, scenario)
    except ConfigError:
        return ""  # so many robots do not fit: only a trial of that size fails, with that reason
    store = Store()
    try:
        store.seed(seeds(config))
        library = Library(store)
        record = library.get(trial.cell.behaviour)
        wanted = parameters(trial, scenario, goals)
        library.resolve(record, wanted, config.robots)
        check_names(dict(trial.cell.roles), record)
        asked = BehaviourRequest(id="0", behaviour=record.name, parameters=wanted, team=trial.cell.team)
        team_of(asked, record, config.robots, Groups(store))
    except RequestRefused as error:
        return f"behaviour '{trial.cell.label}': {error.what}{f' ({error.hint})' if error.hint else ''}"
    finally:
        store.close()
    return ""


def run_again(
    file: Path,
    folder: Path | None = None,
    as_json: bool = False,
    evidence: str = "contacts",
    run_one: Measure = measure,
) -> int:
    """Run the trial in this process, print its record, and keep it in `folder` if there is one.

    Returns
    -------
    int
        0; 1 when it failed, or collided where that is not expected.

    Raises
    ------
    ConfigError
        The file is not that of a trial, or the folder cannot be written.
    """
    launch = load_trial(file)
    before = read_record(file if file.is_dir() else file.parent)  # now: --out may replace it
    run_one = KeepingEvidence(run_one, evidence_mode(evidence))
    result, found, about = perform(launch.trial, launch.experiment, 1, run_one, "trial")
    record = record_of(launch.trial, launch.experiment, found)
    if folder is not None:
        _keep(folder, record, about, found)
    _compare(before, record)
    if as_json:
        output.data_json(msgspec.to_builtins(record))
    else:
        output.data_table(_table(record))
    if result.outcome is None:
        output.progress(f"failed: {launch.trial.label}: {result.failure}")
        return 1
    return int(result.outcome.events > 0 and not launch.trial.cell.collisions_expected)


def _keep(folder: Path, record: Record, about: Provenance, found: Measurement | str) -> None:
    """Keep the trial, unless it has an outcome there already; print which."""
    there = read_record(folder / TRIALS / record.id)
    if there is not None and there.outcome is not None:
        output.progress(f"not kept: it has a result in {folder / TRIALS / record.id} already, which stays")
        return
    try:
        output.progress(f"kept in {write_trial(folder, record, about, found)}")
    except OSError as error:
        raise ConfigError(f"cannot keep the trial: {error.strerror or error}", where=str(folder)) from error


def _compare(before: Record | None, record: Record) -> None:
    """Print whether it came out as it did before, if a result of it stood beside its file."""
    if before is None or before.id != trial_id(record.trial):
        return
    same = before == record
    output.progress("the same result as before" if same else "not the result that it had before: see its provenance")


def _table(record: Record) -> Table:
    view = output.plain_table("")
    view.add_column("onboard", justify="right")
    view.add_column("truth", justify="right")
    for row in _rows(record):
        view.add_row(*row)
    return view


def _rows(record: Record) -> Iterator[tuple[str, str, str]]:
    yield record.trial.label, "", ""
    yield f"ended: {record.end_reason}", "", ""
    if record.outcome is not None:
        for name, value in msgspec.structs.asdict(record.outcome).items():
            yield f"outcome.{name}", "", f"{value:g}" if isinstance(value, float) else str(value)
    for name in sorted(record.onboard.keys() | record.truth.keys()):
        onboard, truth = (f"{each[name]:.6g}" if name in each else "" for each in (record.onboard, record.truth))
        yield name, onboard, truth
