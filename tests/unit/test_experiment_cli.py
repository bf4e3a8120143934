"""What the command line hands on, and what it says."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from fullswarm.cli.experiment import experiment_app
from fullswarm.evaluate.experiment import run as experiment


def call(*words: str) -> tuple[int, str]:
    done = CliRunner().invoke(experiment_app, words)
    return done.exit_code, done.stderr


def test_every_option_arrives(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[experiment.Options] = []

    def run(options: experiment.Options) -> int:
        asked.append(options)
        return 7

    monkeypatch.setattr(experiment, "run", run)
    words = f"run paper --seeds 0-3 --cells robots=4 --cells empty --small --jobs 3 --trial-timeout 9 --out {tmp_path}"
    more = "--json --engine kinematic --shard 2/5 --retries 0 --live --emulate create --fleet x.toml --yes"
    more += " --evidence never"
    code, _ = call(*words.split(), *more.split())
    assert code == 7
    assert asked == [
        experiment.Options(
            experiment="paper",
            seeds="0-3",
            cells=("robots=4", "empty"),
            small=True,
            jobs=3,
            timeout_s=9.0,
            folder=tmp_path,
            as_json=True,
            engine="kinematic",
            shard="2/5",
            retries=0,
            live=True,
            emulate="create",
            fleet=Path("x.toml"),
            yes=True,
            evidence="never",
        )
    ]


def test_one_trial(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[tuple[object, ...]] = []

    def run(*words: object) -> int:
        asked.append(words)
        return 0

    monkeypatch.setattr(experiment, "run_again", run)
    assert call("trial", "a/trial.toml", "--out", str(tmp_path), "--json", "--evidence", "always") == (0, "")
    assert asked == [(Path("a/trial.toml"), tmp_path, True, "always")]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("run papre", "did you mean 'paper'"),
        ("run paper --engine kinematik", "did you mean 'kinematic'"),
        ("run paper --shard 5/4", "write 1/4"),
        ("run paper --evidence allways", "did you mean 'always'"),
        ("run paper --live --dask local", "choose one of --dask, --live"),
        ("run paper --emulate create", "--emulate: it needs --live"),
        ("trial nowhere.toml", "nowhere.toml: cannot read the trial"),
    ],
)
def test_usage_errors_are_one_line(words: str, says: str) -> None:
    code, err = call(*words.split())
    assert code == 2
    assert says in err
    assert len(err.strip().splitlines()) == 1
