"""Writes the trials of a results folder into MLflow: a run per trial below one per experiment.

A run is found again by its tag ``fullswarm.trial`` or ``fullswarm.experiment``, and by the digest of what was written:
what has not changed is left alone, what has changed replaces its run, and a run that was cut short is written anew.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import msgspec

from fullswarm.errors import ConfigError, MissingExtra, Unreachable
from fullswarm.evaluate.results.export import about_trial
from fullswarm.evaluate.results.folder import Folder, StoredTrial
from fullswarm.evaluate.results.quantities import is_dull, values_of
from fullswarm.evaluate.trial_folder import PROVENANCE_FILE, RESULT_FILE, TRIAL_FILE
from fullswarm.units import unit_of

if TYPE_CHECKING:
    from mlflow.tracking import MlflowClient

TRIAL_TAG, EXPERIMENT_TAG, DIGEST_TAG = "fullswarm.trial", "fullswarm.experiment", "fullswarm.digest"
PARENT_TAG, NAME_TAG = "mlflow.parentRunId", "mlflow.runName"
"""With them MLflow's page shows runs below their parent."""
ARTEFACTS = (RESULT_FILE, TRIAL_FILE, PROVENANCE_FILE)
LARGEST_BYTES = 1_000_000
"""Larger files stay where they are: MLflow is for looking and comparing, the results folder is the source."""
PARAM_CHARACTERS = 6000
"""MLflow's longest value of a parameter."""
PAGE = 1000
DATABASE, ARTEFACTS_FOLDER = "mlflow.db", "mlartifacts"
EXTRA = "pip install 'fullswarm[mlflow]'"


@dataclass(slots=True)
class Written:
    """What an export did: trials that are new, replaced, and left alone because they are there."""

    experiment: str
    new: int = 0
    replaced: int = 0
    kept: int = 0


def export_mlflow(folder: Folder, target: str) -> Written:
    """Write all trials of a results folder into the tracking store `target`: a URI, or a folder for a database.

    Raises
    ------
    ConfigError
        There is no trial, or MLflow cannot use `target`.
    MissingExtra
        MLflow is not installed, or for a database SQLAlchemy.
    Unreachable
        The tracking server does not answer.
    """
    if not folder.trials:
        raise ConfigError("there is no readable trial to export", where=str(folder.path))
    with _mlflow_errors(target):
        client = _client(target)
        name = folder.asked.name or folder.trials[0].record.experiment or folder.path.name
        found = client.get_experiment_by_name(name)
        experiment = found.experiment_id if found else client.create_experiment(name, _artefacts_of(target))
        there = _runs(client, experiment)
        written = Written(name)
        parents: dict[str, str] = {}
        for stored in folder.trials:
            of = stored.record.experiment or name
            if of not in parents:
                parents[of] = _parent(client, experiment, there, of, folder)
            _write(client, experiment, there, stored, parents[of], written)
    return written


def _client(target: str) -> MlflowClient:
    try:
        from mlflow.tracking import MlflowClient
    except ImportError as error:
        raise MissingExtra("exporting to MLflow needs mlflow-skinny", hint=EXTRA) from error
    # What the user has set wins. Else a server that does not answer is reported in seconds, not after minutes of
    # retries, and an export sends nothing to anyone else.
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    if urlsplit(target).scheme:
        return MlflowClient(tracking_uri=target)
    # MLflow keeps runs in files only under protest: a folder gets a database.
    folder = Path(target).resolve()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot make the folder: {error.strerror or error}", where=target) from error
    return MlflowClient(tracking_uri=f"sqlite:///{folder / DATABASE}")


def _artefacts_of(target: str) -> str | None:
    """Return where a new experiment keeps its files: beside its database; None: the server decides."""
    scheme = urlsplit(target).scheme
    if scheme == "sqlite":
        database = Path(target.partition("://")[2].partition("?")[0].removeprefix("/") or ".").resolve()
        return (database.parent / ARTEFACTS_FOLDER).as_uri()
    return None if scheme else (Path(target).resolve() / ARTEFACTS_FOLDER).as_uri()


@contextmanager
def _mlflow_errors(target: str) -> Iterator[None]:
    """Turn errors of MLflow, its database and its connection into ours."""
    try:
        yield
    except (ConfigError, MissingExtra):
        raise
    except ImportError as error:
        raise MissingExtra(f"MLflow needs {error.name} for this store", where=target, hint=EXTRA) from error
    except Exception as error:
        text = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        module = type(error).__module__.partition(".")[0]
        if module in ("requests", "urllib3") or "HTTP" in text or "Connection" in text:
            what = "does not answer" if "Max retries" in text else f"refuses: {text[:200]}"
            raise Unreachable(
                f"the tracking server {what}", where=target, hint="is it the server's address?"
            ) from error
        if isinstance(error, OSError) or module in ("mlflow", "sqlalchemy", "alembic"):
            hint = "a folder, sqlite:///FILE.db, or http://HOST:5000"
            raise ConfigError(f"MLflow cannot write there: {text[:300]}", where=target, hint=hint) from error
        raise


def _runs(client: MlflowClient, experiment: str) -> dict[tuple[str, str], list[Any]]:
    """Return the runs of earlier exports by tag and value."""
    found: dict[tuple[str, str], list[Any]] = {}
    token = None
    while True:
        page = client.search_runs([experiment], max_results=PAGE, page_token=token)
        for run in page:
            for tag in (TRIAL_TAG, EXPERIMENT_TAG):
                if tag in run.data.tags:
                    found.setdefault((tag, run.data.tags[tag]), []).append(run)
        token = page.token
        if not token:
            return found


def _parent(
    client: MlflowClient, experiment: str, there: dict[tuple[str, str], list[Any]], of: str, folder: Folder
) -> str:
    """Return the run that stands for an experiment; the oldest one if there are several."""
    known = there.get((EXPERIMENT_TAG, of))
    if known:
        return str(min(known, key=lambda run: run.info.start_time).info.run_id)
    started = [_milliseconds(each.provenance.started) for each in folder.trials]
    tags = {EXPERIMENT_TAG: of, NAME_TAG: of, "mlflow.note.content": folder.asked.description}
    run = client.create_run(experiment, start_time=min(filter(None, started), default=0), tags=tags, run_name=of)
    client.set_terminated(run.info.run_id, "FINISHED")
    return str(run.info.run_id)


def _write(
    client: MlflowClient,
    experiment: str,
    there: dict[tuple[str, str], list[Any]],
    stored: StoredTrial,
    parent: str,
    written: Written,
) -> None:
    digest = _digest(stored, parent)
    known = there.get((TRIAL_TAG, stored.record.id), [])
    same = [run for run in known if run.data.tags.get(DIGEST_TAG) == digest and run.info.status != "RUNNING"]
    for run in known:
        if not same or run.info.run_id != same[0].info.run_id:
            client.delete_run(run.info.run_id)
    if same:
        written.kept += 1
        return
    _new_run(client, experiment, stored, parent, digest)
    written.replaced += bool(known)
    written.new += not known


def _new_run(client: MlflowClient, experiment: str, stored: StoredTrial, parent: str, digest: str) -> None:
    from mlflow.entities import Metric, Param

    record, started = stored.record, _milliseconds(stored.provenance.started)
    tags = {TRIAL_TAG: record.id, PARENT_TAG: parent, NAME_TAG: record.trial.label}
    if record.failure:
        tags["fullswarm.failure"] = record.failure
    run = client.create_run(experiment, start_time=started or None, tags=tags, run_name=record.trial.label)
    run_id = run.info.run_id
    about = {name: value for name, value in about_trial(stored).items() if name not in ("trial", "failure", "wall_s")}
    parameters = [
        Param(name, str(value)[:PARAM_CHARACTERS]) for name, value in about.items() if value not in (None, "")
    ]
    ended = started + round(1000.0 * stored.provenance.wall_s)
    metrics = [Metric(name, value, ended, 0) for name, value in metrics_of(stored).items()]
    client.log_batch(run_id, metrics=metrics, params=parameters)
    for name in ARTEFACTS:
        path = stored.path / name
        if path.is_file() and path.stat().st_size <= LARGEST_BYTES:
            client.log_artifact(run_id, str(path))
    # Last: a run without the digest was cut short, and is written anew by the next export.
    client.set_tag(run_id, DIGEST_TAG, digest)
    client.set_terminated(run_id, "FINISHED" if record.outcome is not None else "FAILED", ended or None)


def metrics_of(stored: StoredTrial) -> dict[str, float]:
    """Return a trial's figures by names that MLflow takes, with the unit at the end unless the name has it."""
    metrics = {"wall_s": stored.provenance.wall_s}
    for (source, name), value in values_of(stored.record).items():
        if not is_dull(name):
            metrics[_metric_name(source, name)] = value
    return metrics


def _metric_name(source: str, name: str) -> str:
    unit = unit_of(name)
    text = re.sub(r"[^A-Za-z0-9_\-. /]+", "_", f"{source}/{name}")
    return text if not unit or "_" in name else f"{text} {re.sub(r'[^A-Za-z0-9]+', '_', unit)}"


def _digest(stored: StoredTrial, parent: str) -> str:
    """Return a hash of all that is written of a trial, and below which run."""
    digest = hashlib.sha256(parent.encode())
    digest.update(msgspec.json.encode((stored.record, stored.provenance)))
    return digest.hexdigest()


def _milliseconds(started: str) -> int:
    try:
        return round(1000.0 * datetime.fromisoformat(started).timestamp())
    except ValueError:
        return 0
