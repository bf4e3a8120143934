from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fullswarm.bringup import info
from fullswarm.cli.main import app

SECRET = "hush-hush-token"


@pytest.fixture
def _home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("FULLSWARM_TOKEN", SECRET)
    monkeypatch.setattr(info, "HUB_S", 0.1)


def run(*words: str) -> str:
    result = CliRunner().invoke(app, ["info", "--hub", "tcp/127.0.0.1:9", *words])
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.mark.usefixtures("_home")
def test_it_says_what_a_bug_report_needs_and_no_more(tmp_path: Path) -> None:
    found = json.loads(run("--json"))
    assert found["fullswarm"]["version"]
    assert found["packages"]["numpy"][0].isdigit()
    assert found["packages"]["eclipse-zenoh"]
    assert found["extras"]["(base)"] == "complete"
    assert found["swarm"] == {"hub": "none on this machine: no hub answers"}
    assert found["folders"]["cache"].startswith("~/")
    assert SECRET not in json.dumps(found)
    assert str(tmp_path) not in json.dumps(found)


@pytest.mark.usefixtures("_home")
def test_it_is_markdown_for_people() -> None:
    text = run()
    assert text.startswith("### fullswarm\n\n| | |\n|---|---|\n| version | ")
    for section in ("machine", "packages", "extras", "folders", "swarm", "ports"):
        assert f"\n### {section}\n" in text


def test_the_home_is_shortened_and_only_the_home(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/ann")
    assert info.short("/home/ann") == "~"
    assert info.short("/home/ann/lab") == "~/lab"
    assert info.short("/home/anna/lab") == "/home/anna/lab"


def test_an_incomplete_extra_names_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = ["numpy>=2", 'no-such-package>=1; extra == "can"', 'fullswarm[can]; extra == "all"']
    monkeypatch.setattr("importlib.metadata.requires", lambda _: wanted)
    packages, extras = info.requirements()
    assert list(packages) == ["numpy"]
    assert extras == {"(base)": "complete", "can": "missing: no-such-package"}
