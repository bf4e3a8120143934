"""The commands ``bundle`` and ``keys``: what they print, and how they end."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fullswarm.cli.main import app
from fullswarm.deploy.release import contents, packages
from tests.unit import wheelhouse

RUNNER = CliRunner()


@pytest.fixture(autouse=True)
def _base(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FULLSWARM_KEYS", str(tmp_path / "keys"))
    monkeypatch.setenv("FULLSWARM_RELEASES", str(tmp_path / "releases"))
    monkeypatch.setattr(contents, "OWN", wheelhouse.small_fullswarm(tmp_path / "fullswarm"))


def test_a_bundle_prints_its_folder_and_tells_what_an_update_carries(tmp_path: Path) -> None:
    house = wheelhouse.fill(tmp_path / "wheels")
    words = ["bundle", "--target", "rpi-arm64", "--wheels", str(house)]
    first = RUNNER.invoke(app, words)
    assert first.exit_code == 0, first.stderr
    assert first.stdout.startswith(str(tmp_path / "releases"))
    assert "a first install carries" in first.stderr
    (tmp_path / "fullswarm" / "agent" / "node.py").write_text("RATE_HZ = 30\n")
    second = json.loads(RUNNER.invoke(app, [*words, "--json"]).stdout)
    assert second["since"] == Path(first.stdout.strip()).name
    assert second["changed_files"] == 2
    assert 0 < second["changed_bytes_gzipped"] < 20_000
    third = RUNNER.invoke(app, words)
    assert "nothing changed" in third.stderr
    assert Path(third.stdout.strip()).name == second["id"]


def test_a_dry_run_makes_nothing(tmp_path: Path) -> None:
    house = wheelhouse.fill(tmp_path / "wheels")
    done = RUNNER.invoke(app, ["bundle", "--target", "jetson", "--python", "3.11", "--wheels", str(house), "--dry-run"])
    assert done.exit_code == 0, done.stderr
    assert "numpy 90.0" in done.stdout.splitlines()
    assert not (tmp_path / "releases").exists()
    assert not (tmp_path / "keys").exists()


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--target", "armhf"], "64-bit systems only"),
        (["--target", "rpi-arm64", "--with", "can,sim"], "'sim' is not an extra for robots"),
        (["--target", "rpi-arm64", "--package", "nowhere"], "not a package"),
        (["--target", "rpi-arm64", "--python", "3.9"], "no release for Python 3.9"),
    ],
)
def test_mistakes_are_one_line_and_exit_2(words: list[str], reason: str) -> None:
    done = RUNNER.invoke(app, ["bundle", *words])
    assert done.exit_code == 2
    assert reason in done.stderr
    assert [each for each in done.stderr.splitlines() if "error" in each] == done.stderr.splitlines()[-1:]


def test_without_uv_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:

    monkeypatch.setattr(packages, "_HERE", tmp_path)
    monkeypatch.setenv("PATH", "/nowhere")
    done = RUNNER.invoke(app, ["bundle", "--target", "rpi-arm64", "--dry-run"])
    assert done.exit_code == 2
    assert "pip install 'fullswarm[deploy]'" in done.stderr


def test_keys_are_shown_and_the_private_halves_are_not(tmp_path: Path) -> None:
    told = RUNNER.invoke(app, ["keys"])
    assert told.exit_code == 0, told.stderr
    assert told.stdout.count("ssh-ed25519 ") == 2
    facts = json.loads(RUNNER.invoke(app, ["keys", "--json"]).stdout)
    assert facts["release"]["fingerprint"] in told.stdout
    assert facts["allowed_signers"].startswith(
        'fullswarm namespaces="fullswarm-release,fullswarm-statement,fullswarm-support" ssh-ed25519 '
    )
    private = (tmp_path / "keys" / "release_ed25519").read_text().splitlines()[1]
    assert private not in told.stdout + json.dumps(facts)
