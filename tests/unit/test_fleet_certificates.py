"""`doctor` and `status` say what certificates lack before it happens, with the command that mends it."""

from __future__ import annotations

from pathlib import Path

import pytest

from fullswarm.bringup.certificates import check_certificates, issue_all, names_of, warnings_of
from fullswarm.bringup.checks import Check
from fullswarm.clock import wall_time_s
from fullswarm.config import SwarmConfig
from fullswarm.identity.authority import Authority, copy_to, revoke
from fullswarm.identity.certificates import DAY_S, read_certificate
from fullswarm.identity.folder import IDENTITY, KeysFolder

FLEET = SwarmConfig.model_validate(
    {"swarm": "lab", "hub": {"endpoint": "tls/10.0.0.1:7447"}, "robot": [{"id": "r1"}, {"id": "r2"}]}
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> KeysFolder:
    monkeypatch.setenv(IDENTITY, str(tmp_path / "identity"))
    return KeysFolder.of("lab")


def at(folder: KeysFolder, days: float) -> Authority:
    """Return the authority as it was (or will be) `days` from now."""
    return Authority.make(folder, wall_s=lambda: wall_time_s() + days * DAY_S)


def issue(folder: KeysFolder, days: float = 0.0) -> None:
    assert all(each.state == "issued" for each in issue_all(at(folder, days), FLEET))


def problems() -> dict[str, Check]:
    return {each.name: each for each in check_certificates(FLEET) if each.status != "ok"}


def test_a_plain_fleet_needs_no_certificates(folder: KeysFolder) -> None:
    assert list(check_certificates(SwarmConfig())) == []


def test_a_fleet_with_all_its_certificates_is_one_line(folder: KeysFolder) -> None:
    issue(folder)
    (line,) = check_certificates(FLEET)
    assert line.status == "ok"
    assert "10.0.0.1" in read_certificate(folder.certificate_path("hub")).hosts


def test_what_is_missing_revoked_damaged_or_expires_names_its_command(folder: KeysFolder) -> None:
    issue(folder)
    revoke(folder, "r1")
    folder.certificate_path("r2").write_text("torn")
    folder.key_path("console").chmod(0o644)
    folder.certificate_path("core").unlink()
    folder.key_path("core").unlink()
    at(folder, -24.0).renew("world")
    found = problems()
    assert found["certificate r1"].mend == "fullswarm keys issue r1 --role robot --swarm lab"
    assert "damaged" in found["certificate r2"].what
    assert found["certificate console"].mend.startswith("chmod 600")
    assert found["certificate core"].mend == "fullswarm keys issue core --role core --swarm lab"
    assert found["certificate world"].status == "warning"
    assert found["certificate world"].mend == "fullswarm keys renew world --swarm lab"
    assert len(found) == 5


def test_an_expired_robot_is_renewed_and_deployed(folder: KeysFolder) -> None:
    issue(folder)
    at(folder, -31.0).renew("r1")
    check = problems()["certificate r1"]
    assert (check.status, "expired" in check.what) == ("failure", True)
    assert check.mend == "fullswarm keys renew r1 --swarm lab; then fullswarm deploy r1 --fleet FLEET.toml"


def test_without_any_keys_init_is_named(folder: KeysFolder) -> None:
    (check,) = problems().values()
    assert "fullswarm keys init" in check.mend


def test_a_computer_of_an_operator_is_checked_for_the_operator_only(
    folder: KeysFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    issue(folder)
    operator = names_of(FLEET)[-1][0]
    copy_to(folder, operator, tmp_path / "laptop")
    monkeypatch.setenv(IDENTITY, str(tmp_path / "laptop"))
    assert [each.status for each in check_certificates(FLEET)] == ["ok"]


@pytest.mark.parametrize(("days", "verb"), [(22.0, ""), (24.0, "expires"), (31.0, "expired")])
def test_status_warns_a_week_before(folder: KeysFolder, days: float, verb: str) -> None:
    at(folder, 0.0).issue("r1", "robot")
    lines = list(warnings_of("lab", wall_time_s() + days * DAY_S))
    assert len(lines) == bool(verb)
    assert all(f"r1 {verb} 2" in line and "fullswarm keys renew r1 --swarm lab" in line for line in lines)


def test_what_is_revoked_need_not_be_renewed(folder: KeysFolder) -> None:
    at(folder, 0.0).issue("r1", "robot")
    revoke(folder, "r1")
    assert list(warnings_of("lab", wall_time_s() + 31 * DAY_S)) == []
    assert list(warnings_of("other", 0.0)) == []
