"""A results folder whose experiment, scenario or code has changed since: no figure mixes old and new."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment import Experiment, load_experiment, on_network, parse_experiment, plan
from fullswarm.evaluate.experiment.run import Options, check_behaviours, run
from fullswarm.evaluate.provenance import Provenance
from fullswarm.evaluate.results import read_folder
from fullswarm.evaluate.results.folder import Asked, configuration_of, open_folder, other_code, read_asked
from fullswarm.evaluate.scenarios import load_scenario
from fullswarm.evaluate.scenarios.model import scenario_to_toml
from fullswarm.evaluate.trial import Keeper
from fullswarm.evaluate.trial_folder import PROVENANCE_FILE, TRIALS, trial_id
from tests.unit.experiment_work import answer

TEXT = """
name = "mine"
seeds = "0-1"
[limits.slow]
speed_limit_m_s = 0.5
turn_limit_rad_s = 2.0
[[groups]]
name = "only"
behaviours = [{ name = "move_to_goal_bc" }]
scenarios = ["hall.toml", "empty"]
robots = [4]
engines = ["kinematic"]
limits = ["slow"]
"""


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    hall(20.0)
    Path("mine.toml").write_text(TEXT)
    return tmp_path


def hall(time_limit_s: float) -> None:
    scenario = load_scenario("empty").model_copy(update={"time_limit_s": time_limit_s})
    Path("hall.toml").write_text(scenario_to_toml(scenario))


def mine(**changes: str) -> Experiment:
    text = TEXT
    for old, new in changes.items():
        text = text.replace(old, new)
    return parse_experiment(text, "mine.toml")


def asked(experiment: Experiment) -> Asked:
    return Asked(name=experiment.name, configuration=configuration_of(experiment))


def test_a_scenario_s_file_belongs_to_the_configuration() -> None:
    before = configuration_of(mine())
    assert configuration_of(mine()) == before
    hall(10.0)
    assert configuration_of(mine()) != before
    Path("hall.toml").unlink()
    assert configuration_of(mine()) != before  # and is no error: its cells may not be asked for


def test_parts_of_one_experiment_add_up_and_another_version_begins_anew(here: Path) -> None:
    experiment = mine()
    parts = [
        plan(experiment, (0,)),
        plan(experiment, (5,), ("hall.toml",)),
        plan(on_network(experiment, "loss=5%"), (0,)),
    ]
    for part in parts:
        now, _ = open_folder(here / "out", asked(experiment), part)
    assert now.trials == tuple(trial_id(trial) for part in parts for trial in part)
    hall(10.0)
    now, _ = open_folder(here / "out", asked(experiment), plan(experiment, (0,)))
    assert len(now.trials) == 2


def test_after_an_edit_the_readers_count_what_the_run_does(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = Options("mine.toml", "0", jobs=1, folder=here / "out")
    assert run(options, answer) == 0
    Path("mine.toml").write_text(TEXT.replace("speed_limit_m_s = 0.5", "speed_limit_m_s = 0.25"))
    capsys.readouterr()
    assert run(options, answer) == 0
    out, err = capsys.readouterr()
    assert "2 trials done" in out
    assert "2 trials of older settings are in no figure; another --out keeps them apart" in err
    folder = read_folder(here / "out")
    assert (len(folder.trials), folder.older) == (2, 2)
    assert {dict(each.record.trial.body)["speed_limit_m_s"] for each in folder.trials} == {0.25}
    assert "of older settings: in no other figure" in (here / "out" / "report.html").read_text("utf-8")


def test_resuming_with_other_code_says_so(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trials = plan(mine(), (0,))
    for trial in trials:
        Keeper(here, "mine", answer)(trial)
    assert other_code(here, trials) == {}
    file = here / TRIALS / trial_id(trials[0]) / PROVENANCE_FILE
    about = msgspec.json.decode(file.read_bytes(), type=Provenance)
    file.write_bytes(msgspec.json.encode(msgspec.structs.replace(about, fullswarm="0.0.1", git="abc")))
    assert other_code(here, trials) == {"fullswarm 0.0.1 abc": 1}
    assert run(Options("mine.toml", "0", jobs=1, folder=here), answer) == 0
    err = capsys.readouterr().err
    assert "2 of 2 trials are in" in err
    assert "1 of them were run by other code (fullswarm 0.0.1 abc); another --out runs them anew" in err


def test_the_folder_says_how_to_run_it_again(here: Path) -> None:
    options = Options("mine.toml", "0", ("empty",), jobs=1, folder=here / "out", network="")
    assert run(options, answer) == 0
    kept = read_asked(here / "out")
    assert kept is not None
    assert (kept.file, kept.network, kept.fleet) == (str(here / "mine.toml"), "", None)
    text = (here / "out" / "report.html").read_text("utf-8")
    assert f"experiment run {here / 'mine.toml'} --cells empty --seeds 0 --network &#39;&#39; --out" in text


@pytest.mark.parametrize("file", ["experiment.json", "trials/ID/result.json"])
def test_a_folder_that_is_not_utf_8_is_named(here: Path, file: str) -> None:
    trials = plan(mine(), (0,), ("empty",))
    Keeper(here, "mine", answer)(trials[0])
    path = here / file.replace("ID", trial_id(trials[0]))
    path.write_bytes(b'{"name": "\xff"}')
    if file == "experiment.json":
        with pytest.raises(ConfigError, match="not the file of an experiment"):
            read_asked(here)
    else:
        assert run(Options("mine.toml", "0", ("empty",), jobs=1, folder=here), answer) == 0  # it is run again


# ---------------------------------------------------------------------------------------------------- behaviours
@pytest.mark.parametrize(
    ("behaviour", "words"),
    [
        ('{ name = "mov_to_goal_bc" }', "unknown behaviour 'mov_to_goal_bc' (did you mean 'move_to_goal_bc'"),
        ('{ name = "move_to_goal_bc", parameters = { gian = 1.0 } }', "parameter 'gian' is unknown"),
        ('{ name = "move_to_goal_bc", parameters = { gain = -1.0 } }', "gain = -1"),
    ],
)
def test_what_the_core_would_refuse_is_refused_before_any_trial(here: Path, behaviour: str, words: str) -> None:
    Path("mine.toml").write_text(TEXT.replace('{ name = "move_to_goal_bc" }', behaviour))
    with pytest.raises(ConfigError) as caught:
        run(Options("mine.toml", jobs=1, folder=here / "out"), answer)
    assert words in str(caught.value)
    line = 1 + Path("mine.toml").read_text().partition(behaviour)[0].count("\n")
    assert str(caught.value).startswith(f"mine.toml:{line}: groups[0].behaviours[0]: ")
    assert len(str(caught.value).splitlines()) == 1
    assert not (here / "out").exists()


@pytest.mark.parametrize("name", ["paper", "safety"])
def test_the_behaviours_of_the_package_s_experiments_are_right(name: str) -> None:
    check_behaviours(plan(load_experiment(name), (0,)), name)


def test_a_crowd_that_does_not_fit_hides_no_mistake() -> None:
    (trial, *_) = plan(mine(), (0,))
    crowd = replace(trial, cell=replace(trial.cell, robots=500))
    check_behaviours([crowd], "mine")
    wrong = replace(trial, cell=replace(trial.cell, parameters=(("gian", 1.0),)))
    with pytest.raises(ConfigError, match="gian"):
        check_behaviours([replace(wrong, cell=replace(wrong.cell, robots=500)), wrong], "mine")


def test_json_of_a_folder_reads_as_before(here: Path) -> None:
    open_folder(here, asked(mine()), [])
    kept = json.loads((here / "experiment.json").read_text())
    for name in ("file", "network", "fleet"):
        del kept[name]
    (here / "experiment.json").write_text(json.dumps(kept))
    assert read_asked(here) is not None
