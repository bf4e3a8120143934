"""Trials by Dask: the same as by the pool, and a worker that is killed is survived."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fullswarm.errors import ConfigError, Unreachable
from fullswarm.evaluate.experiment.run import Options, run
from fullswarm.evaluate.trial_folder import PROVENANCE_FILE, TRIALS
from tests.unit.experiment_work import Trouble

pytest.importorskip("distributed")
pytestmark = pytest.mark.slow

CELL = "robots=4,empty,move_to_goal_bc"


def options(out: Path, dask: str | None, seeds: str = "0-3", timeout_s: float = 60.0) -> Options:
    return Options(
        "paper", seeds, (CELL,), folder=out, engine="kinematic", as_json=True, dask=dask, timeout_s=timeout_s
    )


def files(out: Path) -> dict[Path, bytes]:
    found = [each for each in (out / TRIALS).rglob("*") if each.is_file() and each.name != PROVENANCE_FILE]
    return {each.relative_to(out): each.read_bytes() for each in found}


def test_dask_gives_what_the_pool_gives(tmp_path: Path) -> None:
    assert run(options(tmp_path / "pool", None)) == 0
    assert run(options(tmp_path / "dask", "local")) == 0
    assert len(files(tmp_path / "pool")) == 4 * 5
    assert files(tmp_path / "dask") == files(tmp_path / "pool")
    about = json.loads(next((tmp_path / "dask" / TRIALS).rglob(PROVENANCE_FILE)).read_text())
    assert about["runner"] == "dask"


def test_lost_workers_and_trials_that_hang(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trouble = Trouble(tmp_path / "notes", killed=1, raises=2, hangs=3)
    assert run(options(tmp_path / "out", "local", "0-5", timeout_s=4.0), trouble) == 1
    document = json.loads(capsys.readouterr().out)
    assert (document["trials_done"], document["trials_failed"]) == (4, 2)
    (cell,) = document["cells"]
    first, second = cell["failures"]
    assert first == "ValueError: no law of nature"
    assert second.startswith("its workers died or ran out of time")
    assert len(trouble.tries(1)) == 2
    assert len(trouble.tries(3)) == 2
    assert len(list((tmp_path / "out" / TRIALS).iterdir())) == 6


def test_nobody_there(tmp_path: Path) -> None:
    with pytest.raises(Unreachable, match="no Dask scheduler answers"):
        run(options(tmp_path / "out", "tcp://127.0.0.1:9"))
    with pytest.raises(ConfigError, match="--dask"):
        run(options(tmp_path / "out", "nonsense://x"))
