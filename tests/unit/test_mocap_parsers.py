"""Parsers of capture systems against bytes that are damaged or not theirs: refused or read, never an exception."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.emulators.mocap.natnet import NatNetServer
from fullswarm.emulators.mocap.server import Shown
from fullswarm.errors import ConfigError
from fullswarm.localization.libmotioncapture import parse_line
from fullswarm.localization.natnet import FRAME, MODELS, SERVER_INFO, Session, Version, packet, parse_models
from fullswarm.localization.qualisys import parse_names, quaternion_of
from fullswarm.localization.schemes import convention_of, open_source
from fullswarm.localization.sighting import Body, Convention, Frame, Refused
from fullswarm.localization.source import Settings
from fullswarm.localization.vrpn import Broken
from fullswarm.localization.vrpn import Session as VrpnSession

SHOWN = [Shown("r1", (1.0, 2.0, 3.0)), Shown("r2", (4.0, 5.0, 6.0))]
VERSIONS = [(2, 6), (2, 11), (3, 1), (4, 0), (4, 1), (4, 2)]


def packets(version: Version) -> list[bytes]:
    """Return what a server of this version sends: itself, its bodies, a frame."""
    server = NatNetServer([each.name for each in SHOWN], port=0, version=version)
    try:
        return [
            packet(SERVER_INFO, server._info()),
            packet(MODELS, server._models()),
            packet(FRAME, server._frame(SHOWN, 1.5)),
        ]
    finally:
        server.close()


PACKETS = {version: packets(version) for version in VERSIONS}


@given(st.sampled_from(VERSIONS), st.data())
def test_damaged_natnet_is_a_frame_or_refused(version: Version, data: st.DataObject) -> None:
    session = Session()
    session.receive(PACKETS[version][0])
    session.receive(PACKETS[version][1])
    damaged = bytearray(data.draw(st.sampled_from(PACKETS[version])))
    for _ in range(data.draw(st.integers(0, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(damaged)))
    assert isinstance(session.receive(bytes(damaged[:cut])), Frame | Refused | None)
    assert isinstance(session.receive(bytes(damaged)), Frame | Refused | None)


@given(st.binary(max_size=400), st.sampled_from(VERSIONS), st.sampled_from([SERVER_INFO, MODELS, FRAME]))
def test_any_bytes_are_no_exception_for_natnet(data: bytes, version: Version, kind: int) -> None:
    session = Session()
    session.receive(PACKETS[version][0])
    session.receive(data)
    session.receive(packet(kind, data))


def test_counts_that_no_packet_can_hold_do_not_take_time() -> None:
    with pytest.raises(Refused, match="impossible count"):
        parse_models(b"\xff\xff\xff\x7f" + bytes(16), (3, 0))


def test_a_frame_before_its_names_has_no_bodies_and_names_are_asked_for() -> None:
    session = Session()
    info, models, frame = PACKETS[(3, 1)]
    assert session.receive(frame) is None
    session.receive(info)
    assert session.receive(frame) == Frame((), 1.5000001)
    session.turn(10.0)
    assert [each[:2] for each in session.outbox] == [b"\x0a\x00", b"\x04\x00"]
    session.receive(models)
    found = session.receive(frame)
    assert isinstance(found, Frame)
    assert [(body.name, body.x, body.tracked) for body in found.bodies] == [("r1", 1.0, True), ("r2", 4.0, True)]


def test_versions_that_do_not_say_whether_a_body_is_seen_are_refused() -> None:
    found = Session().receive(packets((2, 5))[0])
    assert isinstance(found, Refused)
    assert "2.5: update Motive" in str(found)


@given(st.lists(st.binary(max_size=120), max_size=8))
def test_any_bytes_are_frames_refused_or_broken_for_vrpn(chunks: list[bytes]) -> None:
    session = VrpnSession()
    session.receive(b"vrpn: ver. 07.38  0\0\0\0\0\0")
    try:
        for chunk in chunks:
            assert all(isinstance(each, Frame | Refused) for each in session.receive(chunk))
    except Broken:
        pass


def test_a_server_that_is_none_of_vrpn_is_said_to_be_none() -> None:
    with pytest.raises(Broken, match="no VRPN server"):
        VrpnSession().receive(b"HTTP/1.1 400 Bad Request\r\n\r\n")


@given(st.binary(max_size=200))
def test_any_line_of_libmotioncapture_is_a_frame_or_refused(line: bytes) -> None:
    assert isinstance(parse_line(line), Frame | Refused)


@given(st.floats(-3.1, 3.1), st.floats(-1.4, 1.4), st.floats(-3.1, 3.1))
def test_quaternions_of_matrices(yaw: float, pitch: float, roll: float) -> None:
    cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (math.cos, math.sin))
    columns = (
        cy * cp, sy * cp, -sp,
        cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr,
        cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr,
    )  # fmt: skip
    x, y, z, w = quaternion_of(columns)
    assert math.hypot(x, y, z, w) == pytest.approx(1.0, abs=1e-6)
    assert (1.0 - 2.0 * (y * y + z * z), 2.0 * (w * z + x * y)) == pytest.approx(columns[:2], abs=1e-6)


def test_names_of_qualisys() -> None:
    body = "<Body><Name>%s</Name><Enabled>%s</Enabled></Body>"
    text = f"<Q><The_6D><Bodies>2</Bodies>{body % ('a &amp; b', 'true')}{body % ('off', 'false')}</The_6D></Q>"
    assert parse_names(text.encode()) == ["a & b"]
    with pytest.raises(ValueError, match="definitions"):
        parse_names(b'<!DOCTYPE x [<!ENTITY a "b">]><x>&a;</x>')


def test_a_place_that_is_no_number_is_refused() -> None:
    for x, y in ((math.nan, 0.0), (0.0, math.nan), (math.inf, 0.0)):
        with pytest.raises(Refused, match="no place on a floor"):
            Convention().sighting(Body("r1", x, y, 0.0), None)


def test_a_large_residual_makes_a_pose_less_certain() -> None:
    seen = Convention(unit_m=0.001).sighting(Body("r1", 0.0, 0.0, 0.0, error=30.0), None)
    assert seen.position_sigma_m == pytest.approx(0.03)
    assert Convention().sighting(Body("r1", 0, 0, 0, error=math.nan), None).position_sigma_m == 0.005


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (Settings("natnet://10.0.0.1"), "state which axis"),
        (Settings("vrpn://10.0.0.1"), "state which axis"),
        (Settings("natnet://10.0.0.1", axes="up"), "'up' are no axes"),
        (Settings("vicon://"), "names no host"),
        (Settings("natnett://10.0.0.1"), "did you mean 'natnet'"),
        (Settings("10.0.0.1"), "is no source"),
        (Settings("natnet://10.0.0.1:99999", axes="y-up"), "not a URL"),
        (Settings("natnet://10.0.0.1?lokal=x", axes="y-up"), "unknown option 'lokal'"),
        (Settings("libmotioncapture://10.0.0.1?type=vicom"), "no type of libmotioncapture"),
        (Settings("vicon://10.0.0.1", unit="ft"), "'ft' is not a unit"),
    ],
)
def test_settings_that_will_not_do(settings: Settings, words: str) -> None:
    from fullswarm.clock import MonotonicClock

    with pytest.raises(ConfigError, match=words):
        convention_of(settings), open_source(settings, MonotonicClock())


# ---------------------------------------------------------------- recordings
def test_a_recording_is_played_as_it_was(tmp_path: Path) -> None:
    from fullswarm.emulators.mocap.player import protocol_of, read_recording
    from fullswarm.localization.source import Recorder

    path = tmp_path / "a.jsonl"
    recorder = Recorder(path, "natnet://10.0.0.1", Convention(y_up=True))
    recorder.write(
        5.0, Frame((Body("r1", 1.0, 2.0, 3.0, (0.0, 0.0, 0.0, 1.0)), Body("r2", 0, 0, 0, tracked=False)), 1.0)
    )
    recorder.write(5.5, Frame((Body("r1", 1.5, 2.0, 3.0),), 1.5))
    recorder.close()
    recording = read_recording(path)
    assert protocol_of(recording, None) == "natnet"
    assert (recording.names, [line.at_s for line in recording.lines]) == (["r1", "r2"], [0.0, 0.5])
    assert recording.lines[0].bodies == (Shown("r1", (1.0, 2.0, 3.0)), Shown("r2", (0.0, 0.0, 0.0), seen=False))
    with pytest.raises(ConfigError, match="the file exists"):
        Recorder(path, "natnet://10.0.0.1", Convention())
    with pytest.raises(ConfigError, match="poses, not bytes"):
        protocol_of(recording, "raw")


@pytest.mark.parametrize("text", ["", "{}", "no", '{"fullswarm_fixes": 2, "source": "x", "unit_m": 1}', "[]"])
def test_files_that_are_no_recordings(tmp_path: Path, text: str) -> None:
    from fullswarm.emulators.mocap.player import read_recording

    path = tmp_path / "a.jsonl"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"not a recording|is empty"):
        read_recording(path)
