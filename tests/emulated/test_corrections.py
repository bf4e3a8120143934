"""Corrections on real ports: from an emulated caster to the receiver's own port, and its position to the caster."""

from __future__ import annotations

import contextlib
import datetime as dt
import ipaddress
import os
import socket
import ssl
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from fullswarm.clock import MonotonicClock
from fullswarm.emulators.mocap.raw import RawServer
from fullswarm.emulators.ntrip.caster import Caster, Kind
from fullswarm.localization import corrections
from fullswarm.localization.links import ByteStream
from fullswarm.localization.rtcm import Outbox
from fullswarm.localization.schemes import open_source
from fullswarm.localization.sighting import Sighting
from fullswarm.localization.source import Content, Limited, Seen, Settings
from tests.emulated.test_mocap_protocols import START_S, wait_for
from tests.unit.test_corrections import FRAMES
from tests.unit.test_fixes_gnss import ORIGIN, gga

LOGIN, PASSWORD = "me@mail.example:s3cret/word", "s3cret"
GARBAGE = [b"\xd3\xff\xff" * 50, b"HTTP/1.1 200 OK\r\n", bytes(range(256)), FRAMES[1][:-1] + b"\x00", b"\xd3\x00"]


class Receiver(RawServer):
    """A receiver behind a TCP port, which keeps what is sent to it."""

    def __init__(self) -> None:
        super().__init__((), "127.0.0.1", 0)
        self.received = bytearray()

    def hear(self, client: socket.socket, data: bytes) -> None:
        self.received += data


class Robot:
    """A source with its receiver, read as its node reads it."""

    def __init__(self, options: str, device: str = "") -> None:
        self.receiver = Receiver()
        self.receiver.start()
        url = f"{device or f'gnss+tcp://127.0.0.1:{self.receiver.port}'}?{options}"
        self.source = open_source(Settings(url, robot="r1", origin_deg=ORIGIN), MonotonicClock())
        self.seen: list[Seen] = []
        self.reports: list[str] = []
        self.source.start(self)

    def arrive(self, arrival_s: float, sender: str, content: Content) -> None:
        assert isinstance(content, bytes)
        self.seen += self.source.read(content)

    def report(self, trouble: str) -> None:
        self.reports.append(trouble)

    def measure(self, quality: int = 4) -> None:
        """Have the receiver send a position."""
        self.receiver.send_bytes(gga(north_m=12.0, quality=quality))

    @property
    def received(self) -> bytes:
        return bytes(self.receiver.received)

    @property
    def limits(self) -> list[str]:
        return [each.text for each in self.seen if isinstance(each, Limited)]

    @property
    def positions(self) -> int:
        return sum(isinstance(each, Sighting) for each in self.seen)

    def limited_to(self, words: str) -> None:
        """Wait until the source says why there are no corrections."""
        wait_for(lambda: any(words in text for text in self.limits), self.measure)

    def close(self) -> None:
        self.source.close()
        self.receiver.close()


@contextlib.contextmanager
def at_work(caster: Caster, options: str = "", scheme: str = "ntrip", login: str = LOGIN) -> Iterator[Robot]:
    caster.start()
    who = f"{login}@" if login else ""
    robot = Robot(f"rtcm={scheme}://{who}127.0.0.1:{caster.port}/BASE{options}")
    try:
        yield robot
    finally:
        began_s = time.monotonic()
        robot.close()
        caster.close()
        assert time.monotonic() - began_s < 1.0
        assert PASSWORD not in " ".join(robot.limits + robot.reports)


def flows(caster: Caster, robot: Robot) -> None:
    """Check that frames, and nothing else, get from the caster to the receiver."""
    wait_for(lambda: caster.listeners == 1 and len(robot.receiver.clients) == 1)
    before = len(robot.received)
    between = b"".join(piece for pair in zip(GARBAGE, [*FRAMES, b"", b""], strict=True) for piece in pair)
    caster.send_rtcm(between + bytes(1100), piece=100)
    wait_for(lambda: robot.received[before:] == b"".join(FRAMES))


@pytest.mark.parametrize("kind", [Kind.V2, Kind.V2_PLAIN, Kind.V2_TABLE, Kind.V1, Kind.V1_ONLY])
def test_frames_arrive_at_the_receiver_and_its_position_at_the_caster(kind: Kind) -> None:
    caster = Caster(["BASE", "OTHER"], kind, login=LOGIN)
    with at_work(caster) as robot:
        flows(caster, robot)
        assert caster.positions == []  # it has none yet
        robot.measure(quality=0)
        robot.measure(quality=1)  # too uncertain for a fix, good enough for a network of stations
        wait_for(lambda: len(caster.positions) == 1)
        fields = caster.positions[0].split(",")
        assert fields[0] == "$GPGGA"
        assert float(fields[2]) == pytest.approx(4800.0 + 60.0 * 12.0 / 111_194.0, abs=1e-4)
        assert (fields[3], float(fields[4]), fields[5], fields[6]) == ("N", 1100.0, "E", "1")
        robot.measure()
        wait_for(lambda: robot.positions == 1)
        assert robot.limits == []
        old = kind is Kind.V1_ONLY
        assert caster.requests[-1].startswith(f"GET /BASE HTTP/1.{0 if old else 1}\r\n")


def test_the_position_is_sent_again_and_with_the_next_request(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(corrections, "GGA_S", 0.3)
    caster = Caster(["BASE"])
    with at_work(caster, login="") as robot:
        wait_for(lambda: caster.listeners == 1)
        wait_for(lambda: len(caster.positions) > 3, robot.measure)
        assert "Ntrip-GGA" not in caster.requests[0]
        caster.hang_up()
        wait_for(lambda: len(caster.requests) == 2)
        assert "\r\nNtrip-GGA: $GPGGA,120000.00,4800.0" in caster.requests[1]


def test_frames_from_before_a_receiver_was_reached_are_not_sent() -> None:
    receiver, box = Receiver(), Outbox()
    receiver.start()
    box.put(FRAMES[1], 0.0)
    with contextlib.closing(ByteStream("127.0.0.1", receiver.port, box)) as stream:
        box.put(FRAMES[0], 0.0)
        stream.turn(0.0)
        wait_for(lambda: len(receiver.received) >= len(FRAMES[0]))
        assert bytes(receiver.received) == FRAMES[0]
    receiver.close()


def test_a_serial_receiver_gets_the_same_bytes() -> None:
    master, slave = os.openpty()
    tty.setraw(master)
    caster = Caster(["BASE"])
    caster.start()
    robot = Robot(f"baud=38400&rtcm=ntrip://127.0.0.1:{caster.port}/BASE", f"gnss://{os.ttyname(slave)}")
    got = bytearray()

    def read() -> None:
        caster.send_rtcm(FRAMES[0])
        if len(got) < 3 * len(FRAMES[0]):
            got.extend(os.read(master, 1000))

    try:
        wait_for(lambda: caster.listeners == 1 and not robot.reports.count("no") and "" in robot.reports)
        wait_for(lambda: len(got) >= 3 * len(FRAMES[0]), read)
        assert bytes(got[: 3 * len(FRAMES[0])]) == 3 * FRAMES[0]
        os.write(master, gga(north_m=12.0))
        wait_for(lambda: robot.positions == 1 and len(caster.positions) == 1)
    finally:
        robot.close()
        caster.close()
        os.close(master)
        os.close(slave)


@pytest.mark.parametrize(
    ("kind", "mounts", "login", "words"),
    [
        (Kind.V2, ["BASE"], "me:other", "the caster refuses the login (401)"),
        (Kind.V1, ["BASE"], "me:other", "the caster refuses the login (are user"),
        (Kind.V2, ["BASE"], "", "the caster refuses access without a login (401)"),
        (Kind.V2, ["base1", "OTHER"], LOGIN, "no mountpoint 'BASE' (did you mean 'base1'?)"),
        (Kind.V2_TABLE, ["base1", "OTHER"], LOGIN, "no mountpoint 'BASE' (did you mean 'base1'?)"),
        (Kind.V1, ["base1", "OTHER"], LOGIN, "no mountpoint 'BASE' (did you mean 'base1'?)"),
        (Kind.V1_ONLY, ["XYZ", "OTHER"], LOGIN, "no mountpoint 'BASE' (known: OTHER, XYZ)"),
    ],
)  # fmt: skip
def test_what_a_caster_refuses_is_said_and_positions_go_on(
    kind: Kind, mounts: list[str], login: str, words: str
) -> None:
    with at_work(Caster(mounts, kind, login=LOGIN), login=login) as robot:
        robot.limited_to(words)
        before = robot.positions
        wait_for(lambda: robot.positions > before + 3, robot.measure)
        assert robot.received == b""
        assert robot.reports == [""]  # the receiver itself is well


def test_a_login_in_a_file_is_read_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(corrections, "REFUSED_RETRY_S", 0.1)
    file = tmp_path / "ntrip"
    caster = Caster(["BASE"], login=LOGIN)
    with at_work(caster, f"&login={file}", login="") as robot:
        robot.limited_to("the login cannot be read: No such file")
        file.touch(0o600)
        file.write_text(LOGIN)
        flows(caster, robot)


def test_a_lost_connection_is_opened_again() -> None:
    caster = Caster(["BASE"])
    with at_work(caster, login="") as robot:
        for _ in range(3):
            flows(caster, robot)
            caster.hang_up()
            wait_for(lambda: caster.listeners == 0)
        assert robot.limits == []  # a short gap is no trouble


def test_a_caster_that_falls_silent_is_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(corrections, "SILENT_S", 0.5)
    caster = Caster(["BASE"])
    with at_work(caster, login="") as robot:
        wait_for(lambda: len(caster.requests) > 1)
        robot.limited_to("nothing arrives for 0.5 s")
        flows(caster, robot)


@pytest.mark.parametrize("noise", [b"$GNGGA,noise\r\n", b"\xd3\x03\xff" * 3000])
def test_what_sends_no_rtcm_is_left_and_named(noise: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(corrections, "NO_FRAMES_S", 1.5)
    monkeypatch.setattr(corrections, "SILENT_S", 1.0)
    caster = Caster(["BASE"])

    def send() -> None:
        caster.send_rtcm(noise)
        robot.measure()

    with at_work(caster, login="") as robot:
        wait_for(lambda: any("what arrives is not RTCM 3" in text for text in robot.limits), send)
        wait_for(lambda: len(caster.requests) > 1)
        assert robot.received == b""


def test_a_caster_that_does_not_answer_is_asked_in_both_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(corrections, "SILENT_S", 0.3)
    caster = Caster(["BASE"], Kind.DEAF)
    with at_work(caster, login="") as robot:
        robot.limited_to("nothing arrives for 0.3 s")
        wait_for(lambda: len(caster.requests) > 1)
        assert [text.split("\r\n")[0] for text in caster.requests[:2]] == ["GET /BASE HTTP/1.1", "GET /BASE HTTP/1.0"]


def test_a_flood_is_bounded_and_harms_no_positions() -> None:
    caster = Caster(["BASE"])
    with at_work(caster, login="") as robot:
        wait_for(lambda: caster.listeners == 1 and len(robot.receiver.clients) == 1)
        over = threading.Event()

        def flood() -> None:
            while not over.is_set() and caster.listeners:
                caster.send_rtcm(100 * FRAMES[1] + b"\xd3\x03\xff" * 10)

        thread = threading.Thread(target=flood)
        began_s = time.monotonic()
        thread.start()
        wait_for(lambda: robot.positions >= 100 and time.monotonic() - began_s > 2.0, robot.measure)
        received, lasted_s = robot.received, time.monotonic() - began_s
        over.set()
        thread.join()
        assert 0 < len(received) < 65_536 * (lasted_s + 1.5)
        assert received.count(FRAMES[1]) == len(received) // len(FRAMES[1])


def test_a_base_of_ones_own_needs_no_caster() -> None:
    base = RawServer((), "127.0.0.1", 0)
    base.start()
    robot = Robot(f"rtcm=tcp://127.0.0.1:{base.port}")
    try:
        wait_for(lambda: len(base.clients) == 1 and len(robot.receiver.clients) == 1)
        base.send_bytes(b"$GNGGA,noise\r\n" + FRAMES[0] + b"\xb5\x62noise" + FRAMES[2])
        wait_for(lambda: robot.received == FRAMES[0] + FRAMES[2])
    finally:
        robot.close()
        base.close()


# ---------------------------------------------------------------- TLS
def certificate(folder: Path) -> tuple[Path, Path]:
    """Return the files of a certificate for 127.0.0.1, signed by itself, and of its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "caster")])
    now = dt.datetime.now(dt.UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - dt.timedelta(days=1))
        .not_valid_after(now + dt.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]), False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), True)
        .sign(key, hashes.SHA256())
    )
    files = folder / "caster.pem", folder / "caster.key"
    files[0].write_bytes(made.public_bytes(serialization.Encoding.PEM))
    plain = serialization.NoEncryption()
    form = serialization.PrivateFormat.PKCS8
    files[1].write_bytes(key.private_bytes(serialization.Encoding.PEM, form, plain))
    return files


def test_over_tls_the_casters_certificate_must_be_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chain, key = certificate(tmp_path)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(chain, key)
    caster = Caster(["BASE"], login=LOGIN, tls=context)
    with at_work(caster, scheme="ntrips") as robot:
        robot.limited_to("certificate")
        assert caster.requests == []  # and so no login was sent
        monkeypatch.setenv("SSL_CERT_FILE", str(chain))
        flows(caster, robot)


# ---------------------------------------------------------------- passwords
@pytest.mark.parametrize(
    ("kind", "wanted", "mount", "words"),
    [
        (Kind.V2, "me:else", "OTHER", "the caster refuses the login (401)"),
        (Kind.V1, "me:else", "OTHER", "the caster refuses the login"),
        (Kind.V2, "me:else", "BASE", "no mountpoint 'BASE' (known: OTHER)"),
        (Kind.V2, f"me:{PASSWORD}", "OTHER", "corrections arrive"),
    ],
)
def test_the_command_writes_the_password_nowhere(
    kind: Kind, wanted: str, mount: str, words: str, tmp_path: Path
) -> None:
    receiver, caster = Receiver(), Caster([PASSWORD, "OTHER"], kind, login=wanted)
    receiver.start()
    caster.start()
    url = f"gnss+tcp://127.0.0.1:{receiver.port}?rtcm=ntrip://me:{PASSWORD}@127.0.0.1:{caster.port}/{mount}"
    out = tmp_path / "walk.jsonl"
    command = [sys.executable, "-m", "fullswarm", "fixes", "record", "--source", url, "--out", str(out), "--debug"]
    recording = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        asked = 2 if words.startswith("no mountpoint") else 1
        wait_for(lambda: len(caster.requests) >= asked, lambda: receiver.send_bytes(gga()))
        ends_s = time.monotonic() + 0.5

        def send() -> None:
            receiver.send_bytes(gga())
            caster.send_rtcm(FRAMES[0])

        wait_for(lambda: time.monotonic() > ends_s, send)
        recording.terminate()
        said, _ = recording.communicate(timeout=START_S)
    finally:
        recording.kill()
        receiver.close()
        caster.close()
    assert words in said
    assert PASSWORD not in said
    assert PASSWORD not in out.read_text()
