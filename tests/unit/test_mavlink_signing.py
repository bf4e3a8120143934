"""Signing: keys, timestamps over restarts, whom to believe; compared with pymavlink's own."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.clock import wall_time_s
from fullswarm.drivers.base import Lifecycle, Limits
from fullswarm.drivers.mavlink.autopilot import ArduPilot
from fullswarm.drivers.mavlink.codec import Encoder, FrameSigner, StationEncoder, StreamParser, decoded_ids, dialect
from fullswarm.drivers.mavlink.driver import MavlinkDriver
from fullswarm.drivers.mavlink.session import Session
from fullswarm.drivers.mavlink.settings import Options, read_settings
from fullswarm.drivers.mavlink.signing import (
    EPOCH_S,
    OTHER_KEY,
    STALE,
    TICKS_S,
    UNSIGNED,
    Signing,
    Timestamps,
    read_key,
    state_path,
)
from fullswarm.errors import ConfigError, DriverError

KEY, OTHER = bytes(range(32)), bytes(32)
NOW_S = EPOCH_S + 1e8


class Wall:
    """A wall clock that the test sets."""

    def __init__(self) -> None:
        self.now_s = NOW_S

    def __call__(self) -> float:
        return self.now_s


def signing(key: bytes = KEY, path: Path | None = None, wall: Wall | None = None, link: int = 0) -> Signing:
    return Signing(key, Timestamps(path, wall or Wall()), link)


def beat(signer: FrameSigner | None) -> bytes:
    return Encoder(1, 1, signer).pack(dialect().MAVLink_heartbeat_message(10, 3, 129, 15, 4, 3))


def heard(data: bytes, ours: Signing) -> list[Any]:
    return StreamParser(believe=ours.accept).feed(data)


# ---------------------------------------------------------------- whom to believe
def test_both_ends_agree_with_pymavlink() -> None:
    sender = signing(link=5).signer()
    peer = dialect().MAVLink(None)
    peer.signing.secret_key = KEY
    for _ in range(3):
        assert peer.decode(bytearray(beat(sender))).get_signed()
    theirs = dialect().MAVLink(None, srcSystem=1, srcComponent=1)
    theirs.signing.secret_key, theirs.signing.sign_outgoing = KEY, True
    theirs.signing.timestamp = int(1e8 * TICKS_S)
    ours = signing()
    for _ in range(3):
        frame = dialect().MAVLink_heartbeat_message(10, 3, 129, 15, 4, 3).pack(theirs)
        assert [m.get_type() for m in heard(frame, ours)] == ["HEARTBEAT"]
    assert ours.doubt(1) == ""


@pytest.mark.parametrize(("signer", "doubt"), [(None, UNSIGNED), (signing(OTHER).signer(), OTHER_KEY)])
def test_others_are_not_believed(signer: FrameSigner | None, doubt: str) -> None:
    ours = signing()
    assert heard(beat(signer), ours) == []
    assert ours.doubt(1) == doubt
    assert ours.doubt(2) == ""
    good = beat(signing().signer())
    assert len(heard(good, ours)) == 1
    assert ours.doubt(1) == ""


def test_version_1_cannot_be_signed() -> None:
    mav = dialect().MAVLink(None, srcSystem=1, srcComponent=1)
    frame = dialect().MAVLink_heartbeat_message(10, 3, 129, 15, 4, 3).pack(mav, force_mavlink1=True)
    assert heard(frame, signing()) == []
    assert len(StreamParser().feed(frame)) == 1


def test_a_replay_is_not_believed_and_a_forgery_does_no_harm() -> None:
    ours, theirs = signing(), signing().signer()
    first, second = beat(theirs), beat(theirs)
    assert len(heard(first, ours)) == 1
    assert heard(first, ours) == []
    assert ours.doubt(1) == STALE
    forged = bytearray(second)
    forged[-8:-6] = b"\xff\xff"  # far in the future, with a signature that does not fit
    assert heard(bytes(forged), ours) == []
    assert len(heard(second, ours)) == 1


@given(st.integers(0, 24), st.integers(0, 7))
def test_no_flipped_bit_is_believed(index: int, bit: int) -> None:
    frame = bytearray(beat(signing().signer()))
    frame[-1 - index % len(frame)] ^= 1 << bit
    assert heard(bytes(frame), signing()) == []


@pytest.mark.parametrize(("late_s", "believed"), [(30.0, True), (300.0, False)])
def test_a_new_sender_may_be_a_minute_behind(late_s: float, believed: bool) -> None:
    wall = Wall()
    wall.now_s -= late_s
    assert bool(heard(beat(signing(wall=wall).signer()), signing())) is believed


def test_we_keep_up_with_a_vehicle_whose_clock_is_ahead() -> None:
    wall = Wall()
    wall.now_s += 3600.0
    vehicle, ours = signing(wall=wall), signing()
    assert len(heard(beat(vehicle.signer()), ours)) == 1
    assert len(heard(beat(ours.signer()), vehicle)) == 1  # an hour late it would be silence


def test_finding_the_peer_does_not_use_up_its_timestamp() -> None:
    ours, frame = signing(), beat(signing().signer())
    assert len(StreamParser(believe=ours.authentic).feed(frame)) == 1
    assert len(heard(frame, ours)) == 1


# ---------------------------------------------------------------- timestamps
def test_a_guardian_signs_on_a_link_of_its_own_so_that_frames_made_before_are_no_replay() -> None:
    ours, vehicle = signing(), signing()
    station = StationEncoder(255, 190, 1, ours.signer())
    guardian = StationEncoder(255, 190, 1, ours.signer(guardian=True))
    beforehand = [guardian.arm(False), guardian.arm(False)]
    assert vehicle.accept(station.heartbeat(), 255, 190)  # newer than what waits with the guardian
    assert [vehicle.accept(each, 255, 190) for each in beforehand] == [True, True]
    assert not vehicle.accept(beforehand[0], 255, 190)
    assert beforehand[0][-13] == 128


def test_timestamps_only_grow_over_restarts_crashes_and_a_clock_set_back(tmp_path: Path) -> None:
    wall, path, seen = Wall(), tmp_path / "deep" / "state", []
    for step_s, crash in ((0.0, False), (1.0, True), (-500.0, True), (0.0, False), (400.0, False), (200.0, True)):
        wall.now_s += step_s
        stamps = Timestamps(path, wall)
        for _ in range(50):
            wall.now_s += 0.5
            seen.append(stamps.next())
        if not crash:
            stamps.save(0.0)
    assert all(a < b for a, b in itertools.pairwise(seen))
    assert seen[0] == pytest.approx((NOW_S - EPOCH_S) * TICKS_S, rel=1e-6)


def test_a_clean_end_leaves_no_gap(tmp_path: Path) -> None:
    ours = signing(path=tmp_path / "state")
    stamp = ours.signer().timestamp()
    ours.close()
    assert int((tmp_path / "state").read_text()) == stamp
    assert [each.name for each in tmp_path.iterdir()] == ["state"]


def test_a_spoilt_state_is_told_and_a_full_disk_stops_nobody(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("yesterday")
    with pytest.raises(DriverError, match="delete it"):
        Timestamps(tmp_path / "state")
    (tmp_path / "file").write_text("")
    with pytest.raises(DriverError, match="signing timestamps"):
        Timestamps(tmp_path / "file" / "state")
    wall = Wall()
    stamps = Timestamps(tmp_path / "folder" / "state", wall)
    (tmp_path / "folder" / "state").unlink()
    (tmp_path / "folder").rmdir()
    (tmp_path / "folder").write_text("no folder any more")
    wall.now_s += 60.0
    assert stamps.next() > 0


def test_a_port_that_is_not_there_does_not_push_the_signing_clock_ahead(tmp_path: Path) -> None:
    key, state = tmp_path / "key", tmp_path / "state"
    key.write_bytes(KEY)
    key.chmod(0o600)
    driver = MavlinkDriver(f"mavlink+serial:///dev/no-such-rover?sign_key={key}&sign_state={state}")
    for _ in range(3):
        with pytest.raises(DriverError, match="plug the robot in"):
            driver.open()
    assert int(state.read_text()) / TICKS_S + EPOCH_S - wall_time_s() < 1.0


# ---------------------------------------------------------------- keys
def test_a_key_is_raw_or_hexadecimal(tmp_path: Path) -> None:
    path = tmp_path / "key"
    for text in (KEY, KEY.hex().encode(), KEY.hex().upper().encode() + b"\n"):
        path.write_bytes(text)
        path.chmod(0o600)
        assert read_key(path) == KEY
    assert str(state_path(KEY, 1)) != str(state_path(KEY, 2)) != str(state_path(OTHER, 2))
    assert KEY.hex()[:8] not in str(state_path(KEY, 1))


@pytest.mark.parametrize(("text", "mode"), [(b"secret", 0o600), (KEY + b"\n", 0o600), (KEY, 0o640), (KEY, 0o604)])
def test_what_is_no_key_is_refused(tmp_path: Path, text: bytes, mode: int) -> None:
    path = tmp_path / "key"
    path.write_bytes(text)
    path.chmod(mode)
    with pytest.raises(ConfigError, match="key"):
        read_key(path)
    with pytest.raises(ConfigError, match="No such file"):
        read_key(tmp_path / "none")


def test_the_key_never_stands_in_the_url() -> None:
    for name in ("key", "sign"):
        with pytest.raises(ConfigError, match="does not belong into a URL"):
            read_settings("mavlink+tcp://h:1", "h", {name: KEY.hex()})
    with pytest.raises(ConfigError, match="without a key"):
        read_settings("mavlink+tcp://h:1", "h", {"sign_state": "x"})
    assert read_settings("mavlink+tcp://h:1", "h", {}).signing() is None


# ---------------------------------------------------------------- the session
def talk(session: Session, parser: StreamParser, signer: FrameSigner | None, begin_s: float) -> None:
    """Let a vehicle say its heartbeat four times a second, for four seconds."""
    encoder = Encoder(1, 1, signer)
    for step in range(round(begin_s * 4), round(begin_s * 4) + 16):
        frame = encoder.pack(dialect().MAVLink_heartbeat_message(10, 3, 65, 0, 4, 3))
        for message in parser.feed(frame):
            session.receive(message, step / 4)
        for sent in session.tick(step / 4):
            assert sent[2] & 1  # everything is signed


@pytest.mark.parametrize(("signer", "doubt"), [(None, UNSIGNED), (signing(OTHER).signer(), OTHER_KEY)])
def test_the_fault_says_why_a_vehicle_is_not_believed(signer: FrameSigner | None, doubt: str) -> None:
    ours = signing()
    session = Session(Options(1, Limits(1.0, 2.0, 1.0, 2.0), "bench"), 0.0, ours)
    talk(session, StreamParser(decoded_ids(), ours.accept), signer, 0.0)
    assert session.state is Lifecycle.FAULT
    assert doubt in session.fault
    talk(session, StreamParser(decoded_ids(), ours.accept), signing().signer(), 4.0)
    assert session.autopilot.key == ArduPilot.key
    assert doubt not in session.fault
