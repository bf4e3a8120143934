"""The authority: what it issues states name, role and life; renewals keep name and key; revoked names stay revoked."""

from __future__ import annotations

import ssl
import stat
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.audit.read import Reader
from fullswarm.audit.verify import verify
from fullswarm.errors import ConfigError
from fullswarm.identity import ROLES, Role
from fullswarm.identity.authority import AUDIT, Authority, copy_to, list_certificates, revoke
from fullswarm.identity.certificates import (
    DAY_S,
    check_signed,
    make_key,
    make_request,
    parse_certificate,
    parse_request,
    read_certificate,
)
from fullswarm.identity.credentials import FIXED, UNNAMED
from fullswarm.identity.folder import KeysFolder
from fullswarm.identity.private import LONGEST_NAME, read_pem
from fullswarm.keys import TRUTH

TAKEN = {*FIXED, UNNAMED, TRUTH}
NOW_S = 1_800_000_000.0
NAMES = st.from_regex(rf"\A[A-Za-z0-9_-]{{1,{LONGEST_NAME}}}\Z")


class Wall:
    """A wall clock that a test sets."""

    def __init__(self, now_s: float = NOW_S) -> None:
        self.now_s = now_s

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def wall() -> Wall:
    return Wall()


@pytest.fixture
def authority(tmp_path: Path, wall: Wall) -> Authority:
    return Authority.make(KeysFolder.of("lab", tmp_path / "identity"), wall_s=wall)


def common_names(folder: KeysFolder) -> set[str]:
    return {each.common_name for each in folder.grants()}


# ---------------------------------------------------------------- issuing
@settings(max_examples=40, deadline=None)
@given(name=NAMES.filter(lambda name: name not in TAKEN), role=st.sampled_from(ROLES), days=st.floats(0.01, 3000.0))
def test_names_roles_and_lives_survive_the_way_through_a_certificate(
    tmp_path_factory: pytest.TempPathFactory, name: str, role: Role, days: float
) -> None:
    name = role if role in FIXED else name
    folder = KeysFolder.of("lab", tmp_path_factory.mktemp("keys"))
    made, new = Authority.make(folder, wall_s=Wall()).issue(name, role, days=days)
    found = read_certificate(made.certificate)
    assert new
    assert (found.name, found.role, found.swarm, made.role) == (name, role, "lab", role)
    assert found.issued_s == NOW_S
    assert found.expires_s == int(NOW_S + days * DAY_S)
    assert found.due_s == pytest.approx(NOW_S + days * DAY_S * 2 / 3, abs=1.0)
    assert [(each.common_name, each.name, each.role) for each in folder.grants()] == [(found.common_name, name, role)]
    assert folder.credentials(name) == made


@pytest.mark.parametrize("name", ["", "a.b", "a/b", "a*", "..", "ä", "x" * (LONGEST_NAME + 1), "r1\n"])
def test_a_name_that_no_key_can_have_gets_no_certificate(authority: Authority, name: str) -> None:
    with pytest.raises(ConfigError, match="cannot be the name in a certificate"):
        authority.issue(name, "robot")
    assert authority.folder.grants() == ()


def test_all_files_are_for_this_user_only(authority: Authority) -> None:
    authority.issue("r1", "robot")
    root = authority.folder.path.parent
    for path in [root, *root.rglob("*")]:
        assert stat.S_IMODE(path.stat().st_mode) & 0o077 == 0, path


def test_issuing_twice_changes_nothing(authority: Authority) -> None:
    made, _ = authority.issue("r1", "robot")
    before = {path: path.read_bytes() for path in (made.certificate, made.key, authority.folder.grants_path)}
    assert authority.issue("r1", "robot") == (made, False)
    assert {path: path.read_bytes() for path in before} == before


def test_a_name_has_one_role(authority: Authority) -> None:
    authority.issue("r1", "robot")
    with pytest.raises(ConfigError, match="has a certificate as robot") as error:
        authority.issue("r1", "operator")
    assert "fullswarm keys revoke r1" in error.value.hint
    revoke(authority.folder, "r1")
    authority.issue("r1", "operator")
    assert [each.role for each in authority.folder.grants()] == ["operator"]


@pytest.mark.parametrize(("name", "role"), [("core", "operator"), ("r1", "hub"), ("truth", "robot")])
def test_the_names_of_processes_are_theirs_only(authority: Authority, name: str, role: Role) -> None:
    with pytest.raises(ConfigError, match="cannot have the role"):
        authority.issue(name, role)
    assert list_certificates(authority.folder, NOW_S) == ()


def test_only_a_hub_can_serve(authority: Authority) -> None:
    uses = {}
    for role in ROLES:
        made, _ = authority.issue(role if role in FIXED else f"the-{role}", role)
        parsed = x509.load_pem_x509_certificate(made.certificate.read_bytes())
        assert not parsed.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
        use = parsed.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        uses[role] = ExtendedKeyUsageOID.SERVER_AUTH in use
        assert ExtendedKeyUsageOID.CLIENT_AUTH in use
    assert [role for role, serves in uses.items() if serves] == ["hub"]


def test_a_hub_is_reached_at_its_addresses_and_at_further_ones(authority: Authority) -> None:
    authority.issue("hub", "hub", hosts=["10.0.0.1"])
    first = read_certificate(authority.folder.certificate_path("hub"))
    assert {"localhost", "127.0.0.1", "::1", "10.0.0.1"} <= set(first.hosts)
    assert not authority.issue("hub", "hub", hosts=["127.0.0.1"])[1]
    assert authority.issue("hub", "hub", hosts=["base.lab"])[1]
    second = read_certificate(authority.folder.certificate_path("hub"))
    assert set(second.hosts) == {*first.hosts, "base.lab"}
    assert (second.common_name, second.public_key) == (first.common_name, first.public_key)
    with pytest.raises(ConfigError, match="neither an address nor a host name"):
        authority.issue("hub", "hub", hosts=["x" * 70])


def test_a_hub_is_valid_for_robots_whose_clock_stands_where_they_were_switched_off(
    authority: Authority, wall: Wall
) -> None:
    wall.now_s += 100 * DAY_S
    made, _ = authority.issue("hub", "hub")
    assert read_certificate(made.certificate).begins_s == NOW_S - DAY_S
    robot, _ = authority.issue("r1", "robot")
    assert wall.now_s - DAY_S < read_certificate(robot.certificate).begins_s < wall.now_s


def test_nothing_outlives_the_authority(authority: Authority, wall: Wall) -> None:
    wall.now_s += 3640 * DAY_S
    made, _ = authority.issue("r1", "robot")
    assert read_certificate(made.certificate).expires_s == NOW_S + 3650 * DAY_S
    wall.now_s += 20 * DAY_S
    with pytest.raises(ConfigError, match="authority has expired"):
        authority.issue("r2", "robot")


@pytest.mark.parametrize("days", [0.0, -1.0, 1e9, float("nan"), float("inf")])
def test_lives_that_make_no_sense_are_refused(authority: Authority, days: float) -> None:
    with pytest.raises(ConfigError, match="cannot be valid for"):
        authority.issue("r1", "robot", days=days)


# ---------------------------------------------------------------- renewing
def test_a_renewed_certificate_has_the_same_name_key_and_length_of_life(authority: Authority, wall: Wall) -> None:
    made, _ = authority.issue("r1", "robot", days=3.0)
    before, key, grants = read_certificate(made.certificate), made.key.read_bytes(), authority.folder.grants()
    wall.now_s += 2.5 * DAY_S
    after = authority.renew("r1")
    assert (after.common_name, after.public_key, after.role) == (before.common_name, before.public_key, before.role)
    assert after == read_certificate(made.certificate)
    assert after.expires_s == wall.now_s + 3.0 * DAY_S
    assert made.key.read_bytes() == key
    assert authority.folder.grants() == grants
    assert authority.renew("r1", days=5.0).life_s == 5.0 * DAY_S


def test_what_is_past_two_thirds_of_its_life_is_renewed_and_nothing_else(authority: Authority, wall: Wall) -> None:
    for name, days in (("short", 3.0), ("long", 30.0), ("gone", 3.0)):
        authority.issue(name, "robot", days=days)
    revoke(authority.folder, "gone")
    wall.now_s += 1.9 * DAY_S
    assert authority.renew_due() == ()
    wall.now_s += 0.2 * DAY_S
    assert [each.name for each in authority.renew_due()] == ["short"]
    assert authority.renew_due() == ()


def test_a_request_is_answered_with_the_newest_certificate(authority: Authority, wall: Wall) -> None:
    made, _ = authority.issue("r1", "robot")
    present = read_certificate(made.certificate)
    request = make_request(made.key.read_bytes(), present.common_name)
    assert authority.answer("r1", request) == made.certificate.read_bytes()  # not due: the present one
    wall.now_s = present.due_s
    answer = authority.answer("r1", request)
    assert parse_certificate(answer).expires_s == wall.now_s + 30 * DAY_S
    assert answer == made.certificate.read_bytes()
    check_signed(answer, authority.folder.authority_path.read_bytes())


def test_a_request_for_another_name_or_with_another_key_is_refused(authority: Authority) -> None:
    mine, _ = authority.issue("r1", "robot")
    other, _ = authority.issue("r2", "robot")
    name = read_certificate(mine.certificate).common_name
    own = make_request(mine.key.read_bytes(), name)
    with pytest.raises(ConfigError, match="not issued to it"):
        authority.answer("r2", own)
    with pytest.raises(ConfigError, match="not issued to it"):
        authority.answer("r1", make_request(other.key.read_bytes(), name))
    with pytest.raises(ConfigError, match="not issued to it"):
        authority.answer("r1", make_request(mine.key.read_bytes(), "core.1"))
    revoke(authority.folder, "r1")
    with pytest.raises(ConfigError, match="is revoked"):
        authority.answer("r1", own)
    with pytest.raises(ConfigError, match="has no certificate"):
        authority.answer("r3", own)


@pytest.mark.parametrize("request_pem", [b"", b"x", b"-----BEGIN CERTIFICATE REQUEST-----\nAAAA\n"])
def test_what_is_no_request_is_refused(authority: Authority, request_pem: bytes) -> None:
    authority.issue("r1", "robot")
    with pytest.raises(ConfigError, match="not a signing request"):
        authority.answer("r1", request_pem)


def test_a_request_with_a_changed_byte_is_refused() -> None:
    request = make_request(make_key(), "r1.1")
    assert parse_request(request)[0] == "r1.1"
    changed = bytearray(ssl.PEM_cert_to_DER_cert(request.decode().replace(" REQUEST", "")))
    changed[-1] ^= 1
    pem = ssl.DER_cert_to_PEM_cert(bytes(changed)).replace("CERTIFICATE-", "CERTIFICATE REQUEST-")
    with pytest.raises(ConfigError, match="not a signing request"):
        parse_request(pem.encode())


# ---------------------------------------------------------------- revoking
def test_a_revoked_certificate_is_not_valid_again_when_its_name_gets_another(authority: Authority) -> None:
    made, _ = authority.issue("r1", "robot")
    stolen, key = read_certificate(made.certificate), made.key.read_bytes()
    assert [each.common_name for each in revoke(authority.folder, "r1")] == [stolen.common_name]
    assert revoke(authority.folder, "r1") == ()
    assert common_names(authority.folder) == set()
    with pytest.raises(ConfigError, match="is revoked"):
        authority.renew("r1")
    again, new = authority.issue("r1", "robot")
    replaced = read_certificate(again.certificate)
    assert new
    assert again.key.read_bytes() != key
    assert common_names(authority.folder) == {replaced.common_name}
    assert replaced.common_name != stolen.common_name


def test_a_generation_is_never_repeated_even_if_files_were_removed(authority: Authority, wall: Wall) -> None:
    made, _ = authority.issue("r1", "robot")
    stolen = read_certificate(made.certificate).common_name
    revoke(authority.folder, "r1")
    for path in (made.certificate, made.key):
        path.unlink()
    wall.now_s += 60.0
    authority.issue("r1", "robot")
    assert stolen not in common_names(authority.folder)


def test_revoking_needs_no_private_key_and_names_who_may_be_meant(authority: Authority) -> None:
    authority.issue("robot1", "robot")
    authority.folder.authority_key_path.unlink()
    assert revoke(authority.folder, "robot1")
    with pytest.raises(ConfigError, match="has no certificate") as error:
        revoke(authority.folder, "robot2")
    assert "robot1" in error.value.hint


def test_the_list_says_what_is_wrong(authority: Authority, wall: Wall) -> None:
    for name in ("good", "gone", "torn", "old"):
        authority.issue(name, "robot", days=1.0 if name == "old" else 30.0)
    revoke(authority.folder, "gone")
    torn = authority.folder.certificate_path("torn")
    torn.write_bytes(torn.read_bytes()[:100])
    wall.now_s += 2 * DAY_S
    found = {each.name: each.problem for each in list_certificates(authority.folder, wall.now_s)}
    assert found == {"good": "", "gone": "revoked", "torn": "this file is incomplete or damaged", "old": "expired"}
    early = {each.name: each.problem for each in list_certificates(authority.folder, NOW_S - 20 * DAY_S)}
    assert early["good"].startswith("not valid yet")


# ---------------------------------------------------------------- damage
def test_what_is_torn_is_issued_again_under_another_common_name(authority: Authority) -> None:
    made, _ = authority.issue("r1", "robot")
    before = read_certificate(made.certificate).common_name
    for path in (made.key, made.certificate):
        path.write_bytes(path.read_bytes()[:60])
        with pytest.raises(ConfigError, match="incomplete or damaged"):
            authority.folder.credentials("r1", "robot")
        assert authority.issue("r1", "robot")[1]
        authority.folder.credentials("r1", "robot")
    assert common_names(authority.folder) == {read_certificate(made.certificate).common_name}
    assert common_names(authority.folder) != {before}


def test_an_expired_certificate_is_renewed_by_issue(authority: Authority, wall: Wall) -> None:
    made, _ = authority.issue("r1", "robot")
    key = made.key.read_bytes()
    wall.now_s += 31 * DAY_S
    assert authority.issue("r1", "robot")[1]
    assert made.key.read_bytes() == key
    assert read_certificate(made.certificate).expires_s > wall.now_s


def test_an_authority_without_its_private_key_is_not_replaced(authority: Authority) -> None:
    authority.issue("r1", "robot")
    before = authority.folder.authority_path.read_bytes()
    authority.folder.authority_key_path.unlink()
    with pytest.raises(ConfigError, match="private key is missing"):
        Authority.make(authority.folder)
    with pytest.raises(ConfigError, match="not on this computer"):
        Authority.open(authority.folder)
    assert authority.folder.authority_path.read_bytes() == before


def test_a_certificate_of_another_authority_is_not_signed_by_ours(tmp_path: Path, authority: Authority) -> None:
    other = Authority.make(KeysFolder.of("lab", tmp_path / "other"), wall_s=Wall())
    made, _ = other.issue("r1", "robot")
    with pytest.raises(ConfigError, match="another authority"):
        check_signed(made.certificate.read_bytes(), authority.folder.authority_path.read_bytes())
    authority.folder.write(authority.folder.certificate_path("r1"), made.certificate.read_bytes())
    with pytest.raises(ConfigError, match="of another authority"):
        authority.renew("r1")


def test_a_passphrase_protects_the_private_key(tmp_path: Path) -> None:
    folder = KeysFolder.of("lab", tmp_path)
    Authority.make(folder, passphrase="correct horse")
    assert b"ENCRYPTED" in read_pem(folder.authority_key_path)
    Authority.open(folder, passphrase="correct horse").issue("r1", "robot")
    with pytest.raises(ConfigError, match="needs a passphrase"):
        Authority.open(folder)
    with pytest.raises(ConfigError, match="wrong passphrase"):
        Authority.open(folder, passphrase="wrong")


def test_a_copy_holds_what_another_computer_needs_and_no_more(tmp_path: Path, authority: Authority) -> None:
    authority.issue("anna", "operator")
    authority.issue("r1", "robot")
    copied = copy_to(authority.folder, "anna", tmp_path / "stick")
    copied.credentials("anna", "operator")
    files = {str(path.relative_to(tmp_path / "stick")) for path in (tmp_path / "stick").rglob("*") if path.is_file()}
    assert files == {"lab/authority.pem", "lab/anna/certificate.pem", "lab/anna/key.pem"}


# ---------------------------------------------------------------- the audit log of the keys
def test_issued_renewed_and_revoked_certificates_are_in_the_audit_log(authority: Authority) -> None:
    authority.issue("r1", "robot")
    authority.renew("r1")
    revoke(authority.folder, "r1")
    revoke(authority.folder, "r1")  # nothing changes
    log = authority.folder.path / AUDIT
    entries = list(Reader(log).read())
    assert [(each["act"], each["result"], each["what"]["name"]) for each in entries] == [
        ("key", "issued", "r1"), ("key", "issued", "r1"), ("key", "revoked", "r1"),
    ]  # fmt: skip
    assert verify(log).problems == []


def test_no_certificate_comes_about_that_the_audit_log_does_not_know(authority: Authority) -> None:
    (authority.folder.path / AUDIT).write_text("in its way")
    with pytest.raises(ConfigError, match="audit log cannot be written"):
        authority.issue("r1", "robot")
    assert common_names(authority.folder) == set()
    assert not authority.folder.certificate_path("r1").exists()


def test_revoking_works_although_the_audit_log_cannot_be_written(authority: Authority) -> None:
    authority.issue("r1", "robot")
    (authority.folder.path / AUDIT).rename(authority.folder.path / "moved")
    (authority.folder.path / AUDIT).write_text("in its way")
    with pytest.raises(ConfigError, match="audit log cannot be written"):
        revoke(authority.folder, "r1")
    assert common_names(authority.folder) == set()
