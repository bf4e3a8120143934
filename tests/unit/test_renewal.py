"""Certificates renew themselves over the bus, in time, and only for the process and key that they were issued to."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from fullswarm.bus.certificates import CertificateRenewer, RenewalService
from fullswarm.bus.local import LocalBus
from fullswarm.bus.renewal import renewal_node
from fullswarm.clock import SimClock
from fullswarm.identity import Credentials
from fullswarm.identity.authority import Authority, copy_to, revoke
from fullswarm.identity.certificates import DAY_S, Certificate, make_request, read_certificate
from fullswarm.identity.folder import KeysFolder
from fullswarm.keys import Keys
from fullswarm.messages import CertificateReply, CertificateRequest, Message
from fullswarm.runtime import Runtime

KEYS = Keys("lab")
BEGIN_S = 1_800_000_000.0


@dataclass
class Lab:
    """A base station with an authority, and robots with folders of their own, on one simulated clock."""

    folder: Path
    runtime: Runtime = field(default_factory=lambda: Runtime(SimClock()))
    messages: list[Message] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.bus = LocalBus(self.runtime.mailbox)
        self.authority = Authority.make(KeysFolder.of("lab", self.folder / "base"), wall_s=self.wall_s)
        self.bus.subscribe(KEYS.renewal_request(), CertificateRequest, self.messages.append)
        self.bus.subscribe(KEYS.renewal_reply(), CertificateReply, self.messages.append)
        self.nodes: list[CertificateRenewer | RenewalService] = []

    def wall_s(self) -> float:
        return BEGIN_S + self.runtime.now_s()

    def serve(self) -> RenewalService:
        self.nodes.append(service := RenewalService(self.bus, self.runtime, KEYS, self.authority, self.wall_s))
        return service

    def robot(self, name: str = "r1", days: float = 1.0) -> Credentials:
        self.authority.issue(name, "robot", days=days)
        return copy_to(self.authority.folder, name, self.folder / name).credentials(name, "robot")

    def renewer(self, files: Credentials, wall_offset_s: float = 0.0) -> CertificateRenewer:
        made = CertificateRenewer(self.bus, self.runtime, KEYS, files, lambda: self.wall_s() + wall_offset_s)
        self.nodes.append(made)
        return made

    def run(self, days: float) -> None:
        self.runtime.run(days * DAY_S)

    def replies(self) -> list[CertificateReply]:
        return [each for each in self.messages if isinstance(each, CertificateReply)]

    def requests(self) -> list[CertificateRequest]:
        return [each for each in self.messages if isinstance(each, CertificateRequest)]


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    made = Lab(tmp_path)
    yield made
    for node in made.nodes:
        node.close()


def state(files: Credentials) -> Certificate:
    return read_certificate(files.certificate)


def test_many_lives_pass_without_a_person_and_nothing_expires(lab: Lab) -> None:
    files, core = lab.robot(), lab.authority.issue("core", "core", days=1.0)[0]
    lab.serve()
    lab.renewer(files)
    name, key = state(files).common_name, files.key.read_bytes()
    for _ in range(16):
        lab.run(0.25)
        for each in (files, core):
            assert state(each).expires_s - lab.wall_s() > 0.3 * DAY_S
    assert (state(files).common_name, files.key.read_bytes()) == (name, key)
    assert len(lab.requests()) < 12


def test_a_certificate_of_minutes_is_renewed_too(lab: Lab) -> None:
    files = lab.robot(days=3 / 1440)
    lab.serve()
    lab.renewer(files)
    for _ in range(8):
        lab.run(1 / 1440)
        assert state(files).expires_s > lab.wall_s()


def test_a_robot_whose_clock_stands_years_back_is_renewed_when_it_starts(lab: Lab) -> None:
    files = lab.robot()
    lab.run(0.7)
    lab.serve()
    lab.renewer(files, wall_offset_s=-1000 * DAY_S)
    before = state(files)
    lab.run(0.001)
    assert state(files).expires_s > before.expires_s


def test_what_is_not_due_stays(lab: Lab) -> None:
    files = lab.robot()
    lab.serve()
    lab.renewer(files)
    before = files.certificate.stat()
    lab.run(0.6)
    assert files.certificate.stat().st_mtime_ns == before.st_mtime_ns
    assert len(lab.requests()) == 1


def test_a_base_that_was_away_is_asked_until_it_answers(lab: Lab) -> None:
    files = lab.robot()
    lab.renewer(files)
    lab.run(0.7)
    before = state(files)
    lab.serve()
    lab.run(0.02)
    assert state(files).expires_s > before.expires_s


def test_a_revoked_robot_gets_nothing(lab: Lab) -> None:
    files = lab.robot()
    lab.serve()
    revoke(lab.authority.folder, "r1")
    lab.renewer(files)
    with capture_logs() as logs:
        lab.run(0.9)
    assert state(files).expires_s == BEGIN_S + DAY_S
    assert all("revoked" in each.refused and not each.certificate for each in lab.replies())
    assert len([each for each in logs if "was not renewed" in each["event"] and "reason" in each]) >= 1


def test_what_expires_without_an_answer_is_said_before_it_happens(lab: Lab) -> None:
    lab.renewer(lab.robot())
    with capture_logs() as logs:
        lab.run(0.6)
        assert not logs
        lab.run(0.1)
    assert any("fullswarm keys renew r1" in each.get("hint", "") for each in logs)


def test_another_robot_cannot_ask_in_its_name(lab: Lab) -> None:
    mine, other = lab.robot("r1"), lab.robot("r2")
    lab.serve()
    request = make_request(other.key.read_bytes(), state(mine).common_name).decode()
    lab.bus.publish(KEYS.renewal_request("r1"), CertificateRequest(name="r1", request=request))
    lab.run(0.001)
    (reply,) = lab.replies()
    assert not reply.certificate
    assert "not issued to it" in reply.refused


@pytest.mark.parametrize("forged", ["other robot's", "other authority's", "older", "garbage", "another name"])
def test_only_its_own_newer_certificate_replaces_the_present_one(lab: Lab, tmp_path: Path, forged: str) -> None:
    files, other = lab.robot("r1"), lab.robot("r2")
    older = files.certificate.read_text()
    lab.runtime.clock.advance_to(0.7 * DAY_S)  # type: ignore[attr-defined]
    lab.authority.renew("r1")
    newer = lab.authority.folder.certificate_path("r1").read_text()
    files.certificate.write_text(newer)
    stranger = Authority.make(KeysFolder.of("lab", tmp_path / "stranger"), wall_s=lab.wall_s)
    stranger.issue("r1", "robot", days=60.0)
    text = {
        "other robot's": other.certificate.read_text(),
        "other authority's": stranger.folder.certificate_path("r1").read_text(),
        "older": older,
        "garbage": "-----BEGIN CERTIFICATE-----\n",
        "another name": newer,
    }[forged]
    lab.renewer(files)
    name = "r2" if forged == "another name" else "r1"
    lab.bus.publish(KEYS.renewal_reply("r1"), CertificateReply(name=name, certificate=text))
    lab.run(0.001)
    assert files.certificate.read_text() == newer


def test_a_storm_of_requests_is_answered_twice_a_second(lab: Lab) -> None:
    files = lab.robot()
    lab.serve()
    request = make_request(files.key.read_bytes(), state(files).common_name).decode()
    for number in range(500):
        lab.bus.publish(KEYS.renewal_request("r1"), CertificateRequest(name="r1", request=request))
        lab.bus.publish(KEYS.renewal_request(f"x{number}"), CertificateRequest(name=f"x{number}", request=request))
    lab.runtime.run(1.0)
    assert len([each for each in lab.replies() if each.name == "r1"]) == 1
    assert all(not each.certificate for each in lab.replies() if each.name != "r1")


def test_the_core_of_the_base_station_renews_and_others_there_need_not_ask(lab: Lab, tmp_path: Path) -> None:
    core, _ = lab.authority.issue("core", "core")
    console, _ = lab.authority.issue("console", "console")
    elsewhere = lab.robot()

    def kind(files: Credentials) -> type | None:
        node = renewal_node(lab.bus, lab.runtime, KEYS, files)
        if node is not None:
            lab.nodes.append(node)
        return None if node is None else type(node)

    assert [kind(each) for each in (core, console, elsewhere)] == [RenewalService, None, CertificateRenewer]
    locked = KeysFolder.of("lab", tmp_path / "locked")
    secret, _ = Authority.make(locked, passphrase="secret").issue("core", "core")
    with capture_logs() as logs:
        assert kind(secret) is None
    assert "needs a passphrase" in logs[0]["reason"]


def test_a_folder_that_cannot_be_written_is_reported_once_and_tried_again(lab: Lab) -> None:
    lab.authority.issue("core", "core", days=1.0)
    grants = lab.authority.folder.grants_path
    text = grants.read_bytes()
    grants.write_bytes(b"torn")
    lab.serve()
    with capture_logs() as logs:
        lab.run(0.7)
    assert len([each for each in logs if each["event"] == "certificates cannot be renewed"]) == 1
    grants.write_bytes(text)
    lab.run(0.02)
    assert read_certificate(lab.authority.folder.certificate_path("core")).issued_s > BEGIN_S
