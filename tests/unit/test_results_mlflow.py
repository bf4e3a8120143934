"""The export to MLflow, read back by MLflow's own client from a database."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import msgspec
import pytest
from typer.testing import CliRunner

from fullswarm.cli.results import results_app
from fullswarm.errors import ConfigError
from fullswarm.evaluate.results import read_folder, read_records
from fullswarm.evaluate.results.mlflow import export_mlflow, metrics_of
from fullswarm.evaluate.trial_folder import RESULT_FILE
from tests.unit.results_fixture import FAILURE, a_record, a_trial, write_trial

tracking = pytest.importorskip("mlflow.tracking")
pytest.importorskip("sqlalchemy")

pytestmark = pytest.mark.filterwarnings("ignore")  # of MLflow, its database and what they import


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with an empty database: MLflow needs seconds to make one."""
    folder = tmp_path_factory.mktemp("mlflow")
    tracking.MlflowClient(tracking_uri=f"sqlite:///{folder / 'mlflow.db'}").search_experiments()
    return folder


@pytest.fixture
def target(store: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(store, tmp_path / "mlflow"))


@pytest.fixture
def results(tmp_path: Path) -> Path:
    out = tmp_path / "results"
    for seed in range(2):
        for behaviour in ("move_to_goal", "move_to_goal_bc"):
            write_trial(out, a_trial(behaviour, "empty", 4, seed), samples=2)
    write_trial(out, a_trial("move_to_goal", "empty", 4, 2), FAILURE)
    return out


def runs(target: Path) -> tuple[Any, list[Any], list[Any]]:
    """Return the client, the parents and the trials."""
    client = tracking.MlflowClient(tracking_uri=f"sqlite:///{target / 'mlflow.db'}")
    experiment = client.get_experiment_by_name("paper")
    found = list(client.search_runs([experiment.experiment_id]))
    parents = [each for each in found if "mlflow.parentRunId" not in each.data.tags]
    return client, parents, [each for each in found if each not in parents]


def test_each_trial_is_a_run_below_its_experiment(results: Path, target: Path) -> None:
    written = export_mlflow(read_folder(results), str(target))
    assert (written.new, written.replaced, written.kept) == (5, 0, 0)
    client, parents, trials = runs(target)
    assert [each.info.run_name for each in parents] == ["paper"]
    assert {each.data.tags["mlflow.parentRunId"] for each in trials} == {parents[0].info.run_id}
    records = {each.record.id: each for each in read_records(results)}
    assert {each.data.tags["fullswarm.trial"] for each in trials} == set(records)
    for run in trials:
        stored = records[run.data.tags["fullswarm.trial"]]
        assert run.data.params["behaviour"] == stored.record.trial.cell.behaviour
        assert run.data.params["seed"] == str(stored.record.trial.seed)
        assert run.data.metrics == pytest.approx(metrics_of(stored))
        files = {each.path for each in client.list_artifacts(run.info.run_id)}
        assert files == {"result.json", "trial.toml", "provenance.json"}
        assert run.info.status == ("FAILED" if stored.record.failure else "FINISHED")
    failed = next(each for each in trials if each.info.status == "FAILED")
    assert failed.data.tags["fullswarm.failure"] == FAILURE
    one = next(each for each in trials if each.info.status == "FINISHED")
    text = Path(client.download_artifacts(one.info.run_id, "result.json")).read_bytes()
    assert text == (results / "trials" / one.data.tags["fullswarm.trial"] / RESULT_FILE).read_bytes()
    assert (target / "mlartifacts").is_dir()


def test_a_second_export_doubles_nothing_and_replaces_what_changed(results: Path, target: Path) -> None:
    export_mlflow(read_folder(results), str(target))
    again = export_mlflow(read_folder(results), str(target))
    assert (again.new, again.replaced, again.kept) == (0, 0, 5)
    trial = a_trial("move_to_goal", "empty", 4, 2)  # the failed one, run once more
    kept = a_record(trial)
    path = results / "trials" / kept.id / RESULT_FILE
    path.write_bytes(msgspec.json.encode(kept))
    third = export_mlflow(read_folder(results), str(target))
    assert (third.new, third.replaced, third.kept) == (0, 1, 4)
    _, parents, trials = runs(target)
    assert (len(parents), len(trials)) == (1, 5)
    assert {each.info.status for each in trials} == {"FINISHED"}


def test_a_run_that_was_cut_short_is_written_anew(results: Path, target: Path) -> None:
    export_mlflow(read_folder(results), str(target))
    client, _, trials = runs(target)
    client.delete_tag(trials[0].info.run_id, "fullswarm.digest")
    again = export_mlflow(read_folder(results), str(target))
    assert (again.new, again.replaced, again.kept) == (0, 1, 4)
    assert len(runs(target)[2]) == 5


def test_the_command_and_what_it_cannot_use(results: Path, target: Path, tmp_path: Path) -> None:
    said = CliRunner().invoke(results_app, ["export", str(results), "--mlflow", f"sqlite:///{target / 'mlflow.db'}"])
    assert said.exit_code == 0, said.output
    assert "paper: 5 runs written, 0 replaced, 0 unchanged" in said.output
    (tmp_path / "file").write_text("")
    for wrong in ("nosuchscheme://x", str(tmp_path / "file" / "below")):
        with pytest.raises(ConfigError):
            export_mlflow(read_folder(results), wrong)
