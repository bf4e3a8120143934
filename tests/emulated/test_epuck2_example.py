"""The serial driver in `examples/`, as its users meet it: installed elsewhere, found, emulated and checked there."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.emulated.outside import EXAMPLES, install, python

PACKAGE = EXAMPLES / "epuck2"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return install(PACKAGE, "fullswarm_epuck2", tmp_path_factory.mktemp("installed"))


def test_its_own_tests_pass_with_the_published_check_among_them(installed: Path) -> None:
    run = python(installed, PACKAGE, "pytest", "-q", "-rs", "-p", "no:cacheprovider", "tests")
    assert run.returncode == 0, run.stdout + run.stderr
    assert "passed" in run.stdout
    assert "skipped" not in run.stdout


def test_one_command_emulates_it_and_a_fleet_file_too(installed: Path, tmp_path: Path) -> None:
    run = python(installed, PACKAGE, "fullswarm", "emulate", "epuck2", "--seconds", "0.2", "--json")
    assert run.returncode == 0, run.stdout + run.stderr
    assert json.loads(run.stdout.splitlines()[0])["url"].startswith("epuck2:///")
    fleet = tmp_path / "fleet.toml"
    fleet.write_text('[[robot]]\nid = "e1"\nemulate = "epuck2"\n', encoding="utf-8")
    looked = json.loads(python(installed, PACKAGE, "fullswarm", "doctor", str(fleet), "--json").stdout)
    told = {each["name"]: each for each in looked["checks"]}
    assert told["robot e1"]["what"] == "emulated by the world: epuck2"
    assert "never on hardware" in told["evidence for epuck2"]["what"]
