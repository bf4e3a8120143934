"""Mistakes of a new user: each error states what is wrong, where, and what to do."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from fullswarm.bringup.init import lab_files
from fullswarm.bus.endpoint import DEFAULT_HUB
from fullswarm.cli.main import app
from fullswarm.operator import session

MISTAKES = [
    (
        "status",
        3,
        "no hub answers (start a swarm with `fullswarm up FLEET.toml`, or give the address of its hub with --hub)",
    ),
    (
        "status --hub localhost:7447",
        2,
        f"is not the address of a hub (write tcp/<host>:<port>, like {DEFAULT_HUB}, or tls/",
    ),
    ("status --swarm a.b", 2, "'a.b' cannot name a swarm (use letters, digits"),
    ("request flocking --set goal", 2, "--set: 'goal' is not key=value (e.g. --set speed=0.3)"),
    ("request flocking --set goal=[1", 2, "--set goal: '[1' does not end (check brackets and quotes)"),
    ("request flocking --robots r1;r2", 2, "'r1;r2' cannot name a robot (e.g. --robots r1,r2)"),
    ("stop @scouts", 2, "'@scouts' is a group, and this order goes straight to the robots"),
    (
        "up nothere.toml",
        2,
        "nothere.toml: no such file (in that folder: group.toml, lab.toml, pyproject.toml, typo.toml)",
    ),
    ("up typo.toml", 2, "typo.toml:1: not valid TOML: Illegal character"),
    ("up group.toml", 2, "group.toml:4: groups.scouts[0]: no robot 'r2' in this file"),
    ("up lab.toml --set agent.control_rate=3", 2, "unknown key, did you mean 'control_rate_hz'?"),
    ("up lab.toml --set robot.r9.driver=sim", 2, "there is no such place in lab.toml (known: r1, r2, r3, r4)"),
    ("agent r9 --fleet lab.toml", 2, "has no robot 'r9' (known: r1, r2, r3, r4)"),
    ("robots test creat:///dev/ttyUSB0", 2, "no driver for 'creat' (did you mean 'create'?)"),
    ("robots test create:///dev/ttyUSB77 --yes", 3, "/dev/ttyUSB77: there is no such port (plug the robot in"),
    ("emulate create1", 2, "'create1' is not one of 'create'"),
    ("scenario show concav", 2, "there is no scenario 'concav' (did you mean 'concave'?)"),
    ("experiment run papr", 2, "there is no experiment 'papr' (did you mean 'paper'?)"),
    ("experiment trial nothere", 2, "nothere: cannot read the trial: No such file or directory (name a trial.toml"),
    ("results list .", 2, "not a results folder: it has no directory 'trials' (fullswarm experiment run NAME --out"),
    ("demo --network loss=2", 2, "'2' is not a share (write 0% to 100%"),
    ("hub --listen tcp/0.0.0.0:17598", 2, "any computer on that network could drive the robots"),
    ("fixes --listen 127.0.0.1", 2, "expected HOST:PORT (like 127.0.0.1:9870)"),
    ("init .", 2, "is not empty"),
    ("mcp --fleet nothere.toml", 2, "--fleet nothere.toml: there is no such file or folder"),
    ("mcp --operator a;b", 2, "'a;b' cannot name an operator (64 characters at most"),
    ("schema Pong", 2, "schema: no message 'Pong' (did you mean 'Ping'?)"),
    ("requst flocking", 2, "Did you mean 'request'"),
]


@pytest.fixture
def _lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = lab_files("my-lab")
    for name in ("lab.toml", "pyproject.toml"):
        (tmp_path / name).write_text(files[name])
    (tmp_path / "typo.toml").write_text('swarm = "lab\n')
    (tmp_path / "group.toml").write_text('[[robot]]\nid = "r1"\n[groups]\nscouts = ["r2"]\n')
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(session, "CONNECT_S", 0.1)
    for name in ("FULLSWARM_FLEET", "FULLSWARM_SWARM"):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.usefixtures("_lab")
@pytest.mark.parametrize(("words", "code", "says"), MISTAKES, ids=[each[0] for each in MISTAKES])
def test_an_error_states_what_to_do(words: str, code: int, says: str) -> None:
    result = CliRunner().invoke(app, words.split(), env={"COLUMNS": "200", "FULLSWARM_HUB": "tcp/127.0.0.1:9"})
    assert (result.exit_code, result.stdout) == (code, ""), result.output
    assert says in result.stderr
    assert "Traceback" not in result.stderr
