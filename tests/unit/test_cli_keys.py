"""`fullswarm keys`: two commands suffice for a fleet, doing it again is harmless, mistakes are one line and exit 2."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fullswarm.cli.main import app
from fullswarm.identity.folder import KeysFolder, certificate_name
from fullswarm.operator.session import usual_name

RUNNER = CliRunner()
FLEET = 'swarm = "lab"\n[[robot]]\nid = "r1"\ndriver = "sim:"\n[[robot]]\nid = "r2"\ndriver = "sim:"\n'


@pytest.fixture(autouse=True)
def fleet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FULLSWARM_KEYS", str(tmp_path / "keys"))
    monkeypatch.delenv("FULLSWARM_IDENTITY", raising=False)
    monkeypatch.delenv("FULLSWARM_KEYS_PASSPHRASE", raising=False)
    path = tmp_path / "lab.toml"
    path.write_text(FLEET)
    return path


def run(*words: object, code: int = 0) -> str:
    done = RUNNER.invoke(app, ["keys", *map(str, words)])
    assert done.exit_code == code, (done.stdout, done.stderr)
    assert "Traceback" not in done.stderr
    return done.stdout if code != 2 else done.stderr


def listed(swarm: str = "lab", code: int = 0) -> dict[str, str]:
    rows = json.loads(run("list", "--swarm", swarm, "--json", code=code))
    return {each["name"]: each["state"] for each in rows}


def test_one_command_makes_all_that_a_fleet_needs(fleet: Path) -> None:
    run("init", fleet)
    operator = certificate_name(usual_name())
    base = ("core", "centralised", "hub", "world", "console")
    assert listed() == dict.fromkeys(sorted((*base, "r1", "r2", operator)), "valid")
    folder = KeysFolder.of("lab")
    for name in listed():
        folder.credentials(name)


def test_doing_it_again_adds_a_new_robot_only(fleet: Path) -> None:
    run("init", fleet)
    before = KeysFolder.of("lab").grants()
    fleet.write_text(FLEET + '[[robot]]\nid = "r3"\ndriver = "sim:"\n')
    rows = json.loads(run("init", fleet, "--json"))
    assert [each["name"] for each in rows if each["new"]] == ["r3"]
    assert set(before) < set(KeysFolder.of("lab").grants())


def test_a_revoked_robot_gets_another_certificate(fleet: Path) -> None:
    run("init", fleet)
    assert run("revoke", "r2", "--swarm", "lab") == "r2: revoked\n"
    assert run("revoke", "r2", "--swarm", "lab") == "r2: was revoked already\n"
    assert listed()["r2"] == "revoked"
    run("issue", "r2", "--role", "robot", "--swarm", "lab")
    assert listed()["r2"] == "valid"


def test_init_leaves_a_revoked_name_revoked(fleet: Path) -> None:
    run("init", fleet)
    run("revoke", "r2", "--swarm", "lab")
    done = RUNNER.invoke(app, ["keys", "init", str(fleet)])
    assert (done.exit_code, "r2: revoked (robot)" in done.stdout) == (0, True)
    assert "fullswarm keys issue r2 --role robot --swarm lab" in done.stderr
    assert listed()["r2"] == "revoked"


def test_an_operator_elsewhere_gets_a_folder(fleet: Path, tmp_path: Path) -> None:
    run("init", fleet)
    out = tmp_path / "stick"
    for _ in range(2):
        run("issue", "anna", "--role", "operator", "--swarm", "lab", "--out", out)
    KeysFolder.of("lab", out).credentials("anna", "operator")


def test_renewing_all_leaves_revoked_ones_out(fleet: Path) -> None:
    run("init", fleet)
    run("revoke", "r2", "--swarm", "lab")
    lines = run("renew", "--days", "60", "--swarm", "lab").splitlines()
    assert [line.split(":")[0] for line in lines] == sorted(set(listed()) - {"r2"})
    rows = json.loads(run("list", "--swarm", "lab", "--json"))
    assert all(each["expires_s"] - each["issued_s"] == 60 * 86400 for each in rows if each["name"] != "r2")


def test_a_passphrase_is_needed_to_sign_but_not_to_revoke(fleet: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FULLSWARM_KEYS_PASSPHRASE", "correct horse")
    run("init", fleet, "--passphrase")
    monkeypatch.setenv("FULLSWARM_KEYS_PASSPHRASE", "wrong")
    assert "wrong passphrase" in run("renew", "--swarm", "lab", code=2)
    monkeypatch.delenv("FULLSWARM_KEYS_PASSPHRASE")
    assert "needs a passphrase" in run("issue", "anna", "--role", "operator", "--swarm", "lab", code=2)
    run("revoke", "r1", "--swarm", "lab")
    assert listed()["r1"] == "revoked"


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("issue", "r9", "--role", "pilot", "--swarm", "lab"), "'pilot' is not a role"),
        (("issue", "a.b", "--role", "robot", "--swarm", "lab"), "cannot be the name"),
        (("issue", "r1", "--role", "operator", "--swarm", "lab"), "has a certificate as robot"),
        (("issue", "r9", "--role", "robot", "--swarm", "lab", "--address", "10.0.0.1"), "only a hub has addresses"),
        (("issue", "r9", "--role", "robot", "--swarm", "lab", "--days", "0"), "cannot be valid for 0 days"),
        (("issue", "r9", "--role", "robot", "--swarm", "other"), "not on this computer"),
        (("renew", "r9", "--swarm", "lab"), "'r9' has no certificate"),
        (("revoke", "r9", "--swarm", "lab"), "'r9' has no certificate"),
        (("list", "--swarm", "other"), "no certificates of swarm 'other'"),
        (("list", "--swarm", "a/b"), "cannot name a swarm"),
        (("issue", "r9"), "Missing option"),
        (("--json", "list"), "options go behind 'list'"),
    ],
)
def test_mistakes_are_one_line_and_exit_2(fleet: Path, words: tuple[str, ...], reason: str) -> None:
    run("init", fleet)
    assert reason in " ".join(run(*words, code=2).split())


@pytest.mark.parametrize("robot", ["core", "hub", "x" * 60])
def test_a_robot_whose_name_cannot_be_certified_is_named(fleet: Path, robot: str) -> None:
    fleet.write_text(f'swarm = "lab"\n[[robot]]\nid = "{robot}"\ndriver = "sim:"\n')
    assert robot in run("init", fleet, code=2)


def test_one_that_has_expired_or_is_damaged_is_exit_1(fleet: Path) -> None:
    run("init", fleet)
    KeysFolder.of("lab").certificate_path("r1").write_text("torn")
    assert listed(code=1)["r1"] == "this file is incomplete or damaged"
