"""Whatever happens to an experiment: nothing is lost, nothing counted twice, each trouble has a name."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import msgspec
import psutil
import pytest

from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment import load_experiment, plan
from fullswarm.evaluate.experiment.run import Options, run
from fullswarm.evaluate.trial_folder import RESULT_FILE, TRIALS, Record, trial_id
from tests.unit.experiment_work import Trouble, answer
from tests.waiting import until

CELL = "robots=4,empty,move_to_goal_bc"
PROGRAM = """
import signal
import sys
from pathlib import Path
from fullswarm.evaluate.experiment.run import Options, run
from tests.unit.experiment_work import Trouble
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever runs the tests may ignore it
    out = Path(sys.argv[1])
    options = Options("paper", "0-19", ("robots=4,empty,move_to_goal_bc",), folder=out, engine="kinematic")
    sys.exit(run(options, Trouble(out.with_name("notes"), slow_s=0.1, late=10)))
"""


def options(out: Path, seeds: str, **changes: object) -> Options:
    usual = Options("paper", seeds, (CELL,), folder=out, engine="kinematic", as_json=True)
    return replace(usual, **changes)  # type: ignore[arg-type]  # names are given by the test


def records(out: Path) -> dict[int, Record]:
    """Return the trials of a folder by seed; every directory in it must be whole."""
    found: dict[int, Record] = {}
    for folder in (out / TRIALS).iterdir():
        assert not folder.name.startswith("."), folder
        record = msgspec.json.decode((folder / RESULT_FILE).read_bytes(), type=Record)
        assert record.id == folder.name
        assert record.trial.seed not in found
        found[record.trial.seed] = record
    return found


def fill_disk(path: Path) -> None:
    with path.open("wb", buffering=0) as file, suppress(OSError):
        while file.write(bytes(4096)):
            continue


def gone(pid: int) -> bool:
    try:
        return bool(psutil.Process(pid).status() == psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return True


def test_workers_that_die_hang_and_raise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trouble = Trouble(tmp_path / "notes", killed=1, raises=2, hangs=3)
    asked = options(tmp_path / "out", "0-5", timeout_s=6.0)
    assert run(asked, trouble) == 1
    out, err = capsys.readouterr()
    (cell,) = json.loads(out)["cells"]
    assert (json.loads(out)["trials_done"], json.loads(out)["trials_failed"]) == (4, 2)
    assert cell["failures"] == ["ValueError: no law of nature", "it took longer than 6 s (2 times)"]
    assert "seed 2: ValueError: no law of nature" in err
    assert "Traceback" not in err
    found = records(tmp_path / "out")
    assert sorted(found) == list(range(6))
    assert {seed for seed, each in found.items() if each.outcome is None} == {2, 3}
    assert found[3].failure == "it took longer than 6 s (2 times)"
    assert [len(trouble.tries(seed)) for seed in range(6)] == [1, 2, 1, 2, 1, 1]
    assert gone(int((tmp_path / "notes.child").read_text()))  # what a trial has started ends with it

    healed = replace(trouble, raises=-1, hangs=-1)
    assert run(asked, healed) == 0
    out, err = capsys.readouterr()
    assert "4 of 6 trials are in" in err
    assert (json.loads(out)["trials_done"], json.loads(out)["trials_failed"]) == (6, 0)
    assert all(each.outcome is not None for each in records(tmp_path / "out").values())
    assert [len(trouble.tries(seed)) for seed in range(6)] == [1, 2, 2, 3, 1, 1]


def test_a_worker_that_is_killed_every_time_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = options(tmp_path / "out", "0-1", retries=0)
    assert run(asked, Trouble(tmp_path / "notes", killed=0)) == 1
    (cell,) = json.loads(capsys.readouterr().out)["cells"]
    assert cell["failures"] == ["its process was killed by SIGKILL"]
    assert records(tmp_path / "out")[0].failure == "its process was killed by SIGKILL"


def test_a_full_disk(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trouble = Trouble(tmp_path / "notes", full=1)
    asked = options(tmp_path / "out", "0-3", jobs=1)
    assert run(asked, trouble) == 1
    out, err = capsys.readouterr()
    (cell,) = json.loads(out)["cells"]
    assert cell["failed"] == 1
    assert "cannot keep the trial: File too large" in cell["failures"][0]
    assert "seed 1" in err
    assert sorted(records(tmp_path / "out")) == [0, 2, 3]  # nothing half-written
    assert run(asked, answer) == 0
    assert sorted(records(tmp_path / "out")) == [0, 1, 2, 3]
    assert len(trouble.tries()) == 4


def test_a_disk_that_is_full_from_the_start(tmp_path: Path) -> None:
    out = tmp_path / "small"
    out.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(out)]
    if os.getuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("cannot mount a small disk")
    try:
        results = run(options(out, "0-19"), answer)
        found = records(out)
        assert results == 1
        assert 0 < len(found) < 20
        for each in ("experiment.json", "report.html"):
            (out / each).unlink(missing_ok=True)
        fill_disk(out / "filler")
        with pytest.raises(ConfigError, match="No space left on device"):
            run(options(out, "0-19"), answer)
        assert records(out) == found
    finally:
        subprocess.run(["umount", str(out)], check=True)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_supervisor_that_is_ended_in_mid_sweep(tmp_path: Path, number: signal.Signals) -> None:
    out, notes = tmp_path / "out", Trouble(tmp_path / "notes")
    command = [sys.executable, "-c", PROGRAM, str(out)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    with process:
        until(lambda: len(notes.tries()) >= 6, 30.0)
        process.send_signal(number)
        _, err = process.communicate(timeout=10.0)
    until(lambda: all(gone(pid) for pid in notes.tries()), 10.0)
    if number == signal.SIGINT:
        assert process.returncode == 130
        assert f"of 20 trials are done, they are in {out}; the same command goes on from there" in err
        assert "Traceback" not in err
        whole = set(records(out))
    else:
        assert process.returncode == -signal.SIGKILL
        whole = {int(each.name.split("-s")[1].split("-")[0]) for each in (out / TRIALS).glob("[!.]*")}
    assert 2 <= len(whole) < 20
    before = len(notes.tries())
    notes.notes.with_suffix(".go").touch()
    (out / TRIALS / f".half-{os.uname().nodename}-{process.pid}").mkdir()
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert f"{len(whole)} of 20 trials are in {out} already" in done.stderr
    assert "half-written trial" in done.stderr
    assert sorted(records(out)) == list(range(20))
    assert len(notes.tries()) - before == 20 - len(whole)


def test_shards_together_are_the_whole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two shards, then one run in two processes: the same directories, byte by byte, but for their provenance."""
    whole, halves = tmp_path / "whole", tmp_path / "halves"
    seeds = "0-2"
    assert run(options(whole, seeds)) == 0
    for shard in ("1/2", "2/2"):
        assert run(options(halves, seeds, shard=shard, jobs=1)) == 0
    counts = [
        each["trials_done"] for each in map(json.loads, capsys.readouterr().out.replace("}\n{", "}\0{").split("\0"))
    ]
    assert counts == [3, 2, 1]
    files = {each.relative_to(whole) for each in (whole / TRIALS).rglob("*") if each.is_file()}
    assert files == {each.relative_to(halves) for each in (halves / TRIALS).rglob("*") if each.is_file()}
    assert len(files) == 6 * 3
    for each in files:
        if each.name != "provenance.json":
            assert (whole / each).read_bytes() == (halves / each).read_bytes(), each
    planned = plan(load_experiment("paper"), (0, 1, 2), (CELL,), engine="kinematic")
    for out in (whole, halves):
        asked = json.loads((out / "experiment.json").read_text())
        assert (asked["name"], asked["trials"]) == ("paper", [trial_id(trial) for trial in planned])


# That kinematic trials repeat, test_shards_together_are_the_whole shows.
def test_a_trial_repeats_to_the_byte_in_another_process(tmp_path: Path) -> None:
    assert run(options(tmp_path / "out", "3", engine="pybullet", cells=("robots=8,uniform,move_to_goal_bc",))) == 0
    (folder,) = (tmp_path / "out" / TRIALS).iterdir()
    program = "from fullswarm.cli.experiment import experiment_app; experiment_app()"
    command = [sys.executable, "-c", program, "trial", str(folder), "--out", str(tmp_path / "again"), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert "the same result as before" in done.stderr
    again = tmp_path / "again" / TRIALS / folder.name
    for name in ("trial.toml", "result.json", "trajectory.npz", "coverage.npz"):
        assert (again / name).read_bytes() == (folder / name).read_bytes(), name
    assert json.loads(done.stdout) == json.loads((folder / RESULT_FILE).read_text())


def test_a_folder_of_another_experiment_is_not_touched(tmp_path: Path) -> None:
    assert run(options(tmp_path / "out", "0"), answer) == 0
    before = records(tmp_path / "out")
    other = tmp_path / "other.toml"
    other.write_text(
        'name = "other"\nseeds = "0"\n[limits.x]\nspeed_limit_m_s = 1.0\nturn_limit_rad_s = 1.0\n'
        '[[groups]]\nname = "g"\nbehaviours = [{ name = "move_to_goal" }]\nscenarios = ["empty"]\n'
        'robots = [4]\nengines = ["kinematic"]\n'
        'limits = ["x"]\n'
    )
    with pytest.raises(ConfigError, match="holds the experiment 'paper'"):
        run(Options(str(other), folder=tmp_path / "out"), answer)
    with pytest.raises(ConfigError, match="lockstep, not live"):
        run(options(tmp_path / "out", "0", live=True))
    assert records(tmp_path / "out") == before


@pytest.mark.parametrize("text", ["0/2", "3/2", "1", "a/b", "1/0", "7/7"])
def test_a_wrong_shard(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError, match="--shard"):
        run(options(tmp_path / "out", "0-5", shard=text), answer)
