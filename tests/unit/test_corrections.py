"""Corrections for GNSS receivers without a port: frames, answers of casters, options, and what is never said."""

from __future__ import annotations

import base64
import math
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyrtcm import RTCMMessage

from fullswarm.bus import LocalBus
from fullswarm.clock import MonotonicClock, SimClock
from fullswarm.config import load_swarm
from fullswarm.errors import ConfigError, DriverError, FullswarmError, without_login
from fullswarm.keys import Keys
from fullswarm.localization.corrections import CorrectionFeed, Corrections, options_of, take_corrections
from fullswarm.localization.gnss import GnssSource
from fullswarm.localization.ntrip import Answer, Chunks, Login, Place, request
from fullswarm.localization.publisher import FixPublisher, Names
from fullswarm.localization.rtcm import MOST_WAITING, FrameFilter, Outbox
from fullswarm.localization.schemes import convention_of, open_source
from fullswarm.localization.sighting import Convention, Sighting
from fullswarm.localization.source import Limited, Receiver, Seen, Settings, SourceNode, Trouble
from fullswarm.messages import FixSourceReport
from fullswarm.runtime import Mailbox, Runtime
from tests.unit.test_fixes_gnss import ORIGIN, decoder, gga, pvt

PASSWORD = "s3cret"
HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: gnss/data\r\n"


def crc(data: bytes) -> int:
    """Return the remainder of the division by the polynomial of CRC-24Q, bit by bit."""
    left = int.from_bytes(data + bytes(3), "big")
    for bit in range(8 * len(data) + 23, 23, -1):
        if left >> bit & 1:
            left ^= 0x1864CFB << (bit - 24)
    return left


def frame(payload: bytes) -> bytes:
    head = bytes([0xD3, len(payload) >> 8, len(payload) & 0xFF]) + payload
    return head + crc(head).to_bytes(3, "big")


BASE = bytes(RTCMMessage(payload=b"\x3e\xd0\x00" + bytes(16)).serialize())  # 1005, the base's place
FRAMES = [BASE, frame(bytes(range(200))), frame(b"\x43\x50" + bytes([0xD3]) * 900)]


def all_frames(data: bytes, size: int = 50, work: float = math.inf) -> list[bytes]:
    each, found = FrameFilter(), list[bytes]()
    for at in range(0, len(data), size):
        each.add(data[at : at + size])
        while each.behind:
            found += each.take(work)[0]
    return found


# ---------------------------------------------------------------- frames
def test_the_checksum_of_the_test_is_that_of_the_library() -> None:
    assert frame(b"\x3e\xd0\x00" + bytes(16)) == BASE


@given(st.integers(1, 2000), st.binary(max_size=40), st.integers(1, 5000))
def test_whole_frames_pass_unchanged_and_in_order(size: int, between: bytes, work: int) -> None:
    between = between.replace(b"\xd3", b"")
    assert all_frames(between.join([b"", *FRAMES, b""]), size, work) == FRAMES


@given(st.data())
def test_a_damaged_frame_does_not_pass(data: st.DataObject) -> None:
    damaged = bytearray(FRAMES[1])
    at = data.draw(st.integers(0, 8 * len(damaged) - 1))
    damaged[at // 8] ^= 1 << at % 8
    passed = all_frames(bytes(damaged) + BASE + bytes(1100))
    assert bytes(damaged) not in passed
    assert passed[-1:] == [BASE]


@given(st.binary(max_size=3000), st.integers(1, 700))
def test_of_any_bytes_only_frames_pass(data: bytes, size: int) -> None:
    for each in all_frames(data, size):
        assert each[0] == 0xD3
        assert crc(each[:-3]) == int.from_bytes(each[-3:], "big")


def test_bytes_that_look_like_frames_everywhere_cost_a_bounded_amount_of_work() -> None:
    each = FrameFilter()
    each.add(b"\xd3\x03\xff" * 4000)
    frames, done = each.take(5000)
    assert (frames, each.behind) == ([], True)
    assert 5000 <= done <= 5000 + 1029
    assert each.take(0.0) == ([], 0)


def test_what_the_port_does_not_take_makes_room_for_newer_frames() -> None:
    box, sent = Outbox(), list[bytes]()
    for number in range(100):
        box.put(frame(number.to_bytes(2, "big") + bytes(300)), float(number))
    assert box.dropped_s == 99.0
    box.send(lambda data: sent.append(data))
    assert sum(map(len, sent)) <= MOST_WAITING
    assert [each[3:5] for each in sent] == [n.to_bytes(2, "big") for n in range(100 - len(sent), 100)]


def test_a_frame_that_was_begun_is_completed() -> None:
    box, sent = Outbox(), bytearray()

    def slow(data: bytes) -> bytes | None:
        sent.extend(data[:7])
        return data[7:] or None

    for _ in range(500):
        box.put(FRAMES[1], 0.0)
        box.send(slow)
    assert all_frames(bytes(sent)) == [FRAMES[1]] * (len(sent) // len(FRAMES[1]))


# ---------------------------------------------------------------- answers
@given(st.lists(st.binary(min_size=1, max_size=60), max_size=8), st.integers(1, 40))
def test_chunks_of_any_size_are_put_together(parts: list[bytes], size: int) -> None:
    data = b"".join(b"%X;name=value\r\n%s\r\n" % (len(part), part) for part in parts)
    chunks = Chunks()
    assert b"".join(chunks.feed(data[at : at + size]) for at in range(0, len(data), size)) == b"".join(parts)
    with pytest.raises(ConnectionResetError, match="ended"):
        chunks.feed(b"0\r\n\r\n")


@pytest.mark.parametrize("data", [b"hello\r\n", b"-5\r\n", b"5" * 2000, b"1\r\naXY\r\n", b"\r\n\r\n"])
def test_what_is_no_chunk_is_an_error(data: bytes) -> None:
    with pytest.raises(DriverError, match="damaged"):
        Chunks().feed(data)


def ending(answer: Answer, data: bytes, size: int) -> str:
    """Return how a caster's answer ends, in the words of the error."""
    try:
        for at in range(0, len(data), size):
            answer.feed(data[at : at + size])
        answer.end()
    except (DriverError, ConnectionResetError) as error:
        return str(error)
    raise AssertionError("no connection lasts for ever")


@given(st.binary(max_size=400), st.integers(1, 60))
def test_any_answer_is_read_or_refused(data: bytes, size: int) -> None:
    for head in (
        b"",
        b"HTTP/1.1 ",
        HEAD + b"Transfer-Encoding: chunked\r\n\r\n",
        b"SOURCETABLE 200 OK\r\n",
        b"ICY 200 OK\r\n",
    ):
        said = ending(Answer("BASE", Login("me", PASSWORD)), head + data, size)
        assert PASSWORD not in said


@pytest.mark.parametrize("size", [1, 7, 1000])
@pytest.mark.parametrize(
    "data",
    [
        HEAD + b"\r\n" + BASE,
        HEAD + b"Transfer-Encoding: chunked\r\n\r\n" + b"5\r\n" + BASE[:5] + b"\r\n%x\r\n" % len(BASE[5:]) + BASE[5:],
        b"ICY 200 OK\r\n" + BASE,
        b"ICY 200 OK\r\nServer: old\r\n\r\n" + BASE,
    ],
)
def test_what_follows_a_good_answer_are_corrections(data: bytes, size: int) -> None:
    answer = Answer("BASE", None)
    stream = b"".join(answer.feed(data[at : at + size]) for at in range(0, len(data), size))
    assert all_frames(stream) == [BASE]
    assert answer.streams


TABLE = b"STR;RTCM3_BERLIN;Berlin;\r\nSTR;BASE;x;\r\nSTR;OTHER;\r\n"


@pytest.mark.parametrize(
    ("data", "words", "refused"),
    [
        (b"HTTP/1.1 401 Unauthorized\r\n\r\n", r"refuses the login \(401\)", True),
        (b"ERROR - Bad Password\r\n", "refuses the login", True),
        (b"ERROR - Mount Point Taken or Invalid\r\n", "refuses mountpoint 'Bas'", True),
        (b"HTTP/1.1 404 Not Found\r\n\r\n", "no mountpoint 'Bas'", True),
        (b"HTTP/1.1 503 Oh\r\n\r\n", "answers 503 Service Unavailable", True),
        (b"HTTP/1.1 999 Oh\r\n\r\n", "answers 999", True),
        (b"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\n\r\n", "a web page", True),
        (b"SSH-2.0-OpenSSH_9.2\r\n", "not the answer of an NTRIP caster", False),
        (b"HTTP/1.1 200 OK\r\n" + b"X: y\r\n" * 2000, "has no end", False),
        (b"SOURCETABLE 200 OK\r\n" + TABLE + b"ENDSOURCETABLE\r\n", "no mountpoint 'Bas'.*did you mean 'BASE'", True),
        (HEAD.replace(b"data", b"sourcetable") + b"\r\n" + TABLE + b"ENDSOURCETABLE\r\n", "did you mean 'BASE'", True),
        (b"SOURCETABLE 200 OK\r\n" + b"STR;" + b"x" * (3 << 20), "no mountpoint 'Bas'", True),
    ],
)  # fmt: skip
def test_what_a_caster_refuses_is_said(data: bytes, words: str, refused: bool) -> None:
    answer = Answer("Bas", Login("me", PASSWORD))
    assert re.search(words, ending(answer, data, 4096))
    assert answer.refused is refused


def test_a_table_without_an_end_is_not_read_for_ever() -> None:
    answer, row = Answer("BASE", None), b"STR;" + b"x" * 60_000 + b"\n"
    answer.feed(b"SOURCETABLE 200 OK\r\n" + TABLE)
    fed = 0
    with pytest.raises(DriverError, match="BASE"):  # noqa: PT012  (how often it takes is what is measured)
        while fed < 10 << 20:
            answer.feed(row)
            fed += len(row)
    assert fed <= 2 << 20


def test_a_table_that_is_cut_off_still_names_its_mountpoints() -> None:
    answer = Answer("rtcm3_berlin", None)
    answer.feed(b"SOURCETABLE 200 OK\r\n" + TABLE)
    with pytest.raises(DriverError, match="did you mean 'RTCM3_BERLIN'"):
        answer.end()
    answer = Answer("BASE", None)
    answer.feed(b"SOURCETABLE 200 OK\r\n" + TABLE)
    with pytest.raises(DriverError, match="lists mountpoint 'BASE', but does not send it now"):
        answer.end()


def test_without_a_login_the_hint_says_how_to_give_one() -> None:
    with pytest.raises(DriverError, match="login=FILE"):
        Answer("BASE", None).feed(b"HTTP/1.1 401 Unauthorized\r\n\r\n")


def test_a_request() -> None:
    text = request("h:2101", "BASE", Login("me", PASSWORD), 2, b"$GPGGA,x*00\r\n").decode()
    words = base64.b64encode(f"me:{PASSWORD}".encode()).decode()
    assert text.startswith("GET /BASE HTTP/1.1\r\nHost: h:2101\r\n")
    assert "\r\nNtrip-Version: Ntrip/2.0\r\n" in text
    assert "\r\nNtrip-GGA: $GPGGA,x*00\r\n" in text
    assert f"\r\nAuthorization: Basic {words}\r\n" in text
    assert text.endswith("\r\n\r\n")
    old = request("h:2101", "BASE", None, 1, b"$GPGGA,x*00\r\n").decode()
    assert old.startswith("GET /BASE HTTP/1.0\r\n")
    assert not re.search("Ntrip-|Authorization|GGA", old)


# ---------------------------------------------------------------- the receiver's position
def checksum(sentence: str) -> str:
    total = 0
    for byte in sentence[1:].partition("*")[0].encode():
        total ^= byte
    return f"{total:02X}"


def test_the_position_is_a_sentence() -> None:
    sentence = Place(43_201.25, -48.5, 11.25, 453.21, 47.0, 5, 20, 0.8).gga().decode()
    fields = sentence.split(",")
    assert fields[:7] == ["$GPGGA", "120001.25", "4830.00000", "S", "01115.00000", "E", "5"]
    assert (int(fields[7]), *map(float, (fields[8], fields[9], fields[11]))) == (20, 0.8, 453.21, 47.0)
    assert sentence.endswith(f"*{checksum(sentence)}\r\n")


def test_the_receivers_position_is_known_from_its_first_measurement_even_if_it_is_too_uncertain() -> None:
    each = decoder()
    each.read(gga(quality=0))
    each.read(gga(quality=6))
    each.read(pvt(1000, 48.0, 11.0, 14, ok=0))
    assert each.place is None
    (seen,) = decoder().read(gga(quality=1))
    assert isinstance(seen, Trouble)
    for data in (gga(quality=1), pvt(1000, 48.0, 11.0, 5000, carrier=0)):
        each = decoder()
        each.read(data)
        assert each.place is not None
        assert (each.place.latitude_deg, each.place.longitude_deg) == pytest.approx((48.0, 11.0))
        assert each.place.day_s == pytest.approx(43_200.0, abs=10.0)


@given(st.data())
def test_any_position_that_is_kept_can_be_sent(data: st.DataObject) -> None:
    damaged = bytearray(pvt(1000, 48.0, 11.0, 14) + gga())
    for _ in range(data.draw(st.integers(1, 8))):
        damaged[data.draw(st.integers(6, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    # The checksums are made right, so that the damage arrives.
    body = damaged[2:98]
    a = b = 0
    for byte in body:
        a = (a + byte) & 255
        b = (b + a) & 255
    damaged[98:100] = bytes((a, b))
    each = decoder()
    each.read(bytes(damaged))
    if each.place is not None:
        assert re.fullmatch(rb"\$GPGGA(,[0-9.A-Z-]*){14}\*[0-9A-F]{2}\r\n", each.place.gga())


# ---------------------------------------------------------------- options of the URL
def corrections(options: str) -> Corrections | None:
    return take_corrections(options_of(f"gnss:///dev/ttyACM0?{options}"), "here")


def test_where_corrections_come_from() -> None:
    assert corrections("baud=38400") is None
    assert corrections("rtcm=tcp://192.168.1.9:5015") == Corrections("tcp", "192.168.1.9", 5015)
    assert corrections("rtcm=ntrip://caster.example/BASE") == Corrections("ntrip", "caster.example", 2101, "BASE")
    found = corrections("rtcm=ntrips://[::1]:443/BASE&login=/etc/fullswarm/ntrip&baud=9600")
    assert found == Corrections("ntrips", "[::1]", 443, "BASE", None, Path("/etc/fullswarm/ntrip"))
    assert found.address == "ntrips://[::1]:443/BASE"


@pytest.mark.parametrize("password", ["pass", "p/w", "p@ss", "p:w", "p#w", "p+w", "p?w=1", "://", "%26%25%23", "ä b"])
def test_a_password_may_have_any_character(password: str) -> None:
    found = corrections(f"rtcm=ntrip://me@mail.example:{password}@caster.example/BASE")
    plain = password.replace("%26", "&").replace("%25", "%").replace("%23", "#")
    assert found == Corrections("ntrip", "caster.example", 2101, "BASE", Login("me@mail.example", plain))
    assert plain not in repr(found)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("rtcm=caster.example/BASE", "no URL of corrections"),
        ("rtcm=http://caster.example/BASE", "no URL of corrections"),
        ("rtcm=ntrip://caster.example", "no mountpoint"),
        ("rtcm=ntrip://caster.example/BA%20SE", "no mountpoint"),
        ("rtcm=ntrip://cas%0d%0ater/BASE", "no host"),
        ("rtcm=ntrip://caster..example/BASE", "no host"),
        (f"rtcm=ntrip://{'x' * 64}.example/BASE", "no host"),
        ("rtcm=ntrips://caster.example/BASE", "no port"),
        ("rtcm=ntrip://caster.example:99999/BASE", "no port"),
        ("rtcm=tcp://caster.example", "no port"),
        ("rtcm=tcp://caster.example:1/BASE", "no mountpoint and no login"),
        ("rtcm=tcp://me:word@caster.example:1", "no mountpoint and no login"),
        ("rtcm=tcp://caster.example:1&login=/x", "takes no login"),
        ("rtcm=ntrip://me@caster.example/BASE", "without a password"),
        ("rtcm=ntrip://me:word@caster.example/BASE&login=/x", "two logins"),
        ("rtcm=ntrip://caster.example/BASE&login=x", "no absolute path"),
        ("login=/x", "login without rtcm"),
        ("rtcm=ntrip://me:a&word@caster.example/BASE", "write %26 for &"),
        ("rtcm=ntrip://me:a&b=word@caster.example/BASE", "write %26 for &"),
    ],
)
def test_options_that_will_not_do(options: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words) as error:
        corrections(options)
    assert "word" not in str(error.value).replace("password", "").replace("PASSWORD", "")


def test_a_login_in_a_file(tmp_path: Path) -> None:
    file = tmp_path / "ntrip"
    found = Corrections("ntrip", "h", 1, "BASE", None, file)
    with pytest.raises(DriverError, match="cannot be read: No such file"):
        found.find_login()
    file.write_text(f"me:{PASSWORD}:with colon\n")
    file.chmod(0o644)
    with pytest.raises(DriverError, match="chmod 600"):
        found.find_login()
    file.chmod(0o600)
    assert found.find_login() == Login("me", f"{PASSWORD}:with colon")
    file.write_text(PASSWORD)
    with pytest.raises(DriverError, match="USER:PASSWORD") as error:
        found.find_login()
    assert PASSWORD not in str(error.value)


def test_a_receiver_that_cannot_be_written_to_is_refused() -> None:
    for device in ("gnss+udp://127.0.0.1:0", "gnss+file:///tmp/bytes"):
        settings = Settings(f"{device}?rtcm=tcp://127.0.0.1:1", robot="r1", origin_deg=ORIGIN)
        with pytest.raises(ConfigError, match="cannot be sent"):
            GnssSource(settings, MonotonicClock())


# ---------------------------------------------------------------- passwords
WRONG = [
    "gnss:///dev/ttyACM0?rtcm=ntrip://me:{}@h",
    "gnss:///dev/ttyACM0?rtmc=ntrip://me:{}@h/BASE",
    "gnss:///dev/ttyACM0?rtcm=me:{}@h/BASE",
    "gnss:///dev/ttyACM0?baud=fast&rtcm=ntrip://me:{}@h/BASE",
    "gnss:///dev/ttyACM0?forward=far&rtcm=ntrip://me:{}@h/BASE",
    "gnss:///dev/ttyACM0?rtcm=ntrip://me:{}&more@h/BASE",
    "gnss:///dev/ttyACM0?rtcm=ntrip://me:{}&more=5@h/BASE",
    "gnss:///dev/ttyACM0?rtcm=ntrip://me:&{}@h/BASE",
    "gnss:///dev/ttyACM0?rtcm=ntrip://me:&{}&more@h/BASE",
    "gnss:///dev/ttyACM0&rtcm=ntrip://me:{}@h/BASE",
    "gnss://ttyACM0?rtcm=ntrip://me:{}@h/BASE",
    "gnss+udp://127.0.0.1:0?rtcm=ntrip://me:{}@h/BASE",
    "gnss+tcp://h?rtcm=ntrip://me:{}@h/BASE",
    "gnss+tcp://[h?rtcm=ntrip://me:{}@h/BASE",
    "gns:///dev/ttyACM0?rtcm=ntrip://me:{}@h/BASE",
    "natnet://?rtcm=ntrip://me:{}@h/BASE",
    "vrpn://h?rtcm=ntrip://me:{}@h/BASE",
    "me:{}@h/BASE",
    "gnss:///dev/ttyACM0?rtcm=ntrip://me:{}",
    "gnss:///dev/ttyACM0?rtcm=ntrip://me:{}/BASE",
    "gnss:///dev/ttyACM0&rtcm=ntrip://me:{}/BASE",
]


def open_with_axes(settings: Settings) -> None:
    """Do what the commands do with a source before it delivers."""
    convention_of(settings)
    open_source(settings, MonotonicClock())


@pytest.mark.parametrize("url", WRONG)
@pytest.mark.parametrize("password", [PASSWORD, f"{PASSWORD}/", f"#{PASSWORD}", f"?{PASSWORD}", f"://{PASSWORD}"])
def test_no_error_about_a_url_names_the_password(url: str, password: str) -> None:
    settings = Settings(url.format(password), robot="r1", origin_deg=ORIGIN)
    with pytest.raises(FullswarmError) as error:
        open_with_axes(settings)
    assert PASSWORD not in str(error.value)
    assert PASSWORD not in repr(error.value)


def test_no_error_of_a_fleet_file_names_the_password(tmp_path: Path) -> None:
    file = tmp_path / "lab.toml"
    url = f"gnss:///dev/ttyACM0?rtcm=ntrip://me:{PASSWORD}@h/BASE{'x' * 500}"
    file.write_text(f'[[robot]]\nid = "r1"\nfixes = "{url}"\n')
    with pytest.raises(ConfigError, match="500") as error:
        load_swarm(file)
    assert PASSWORD not in str(error.value)


@given(st.text("ab:/?&=#%@+.", max_size=12))
def test_whatever_stands_before_the_last_at_sign_is_hidden(middle: str) -> None:
    for url in (f"gnss:///dev/ttyACM0?baud=9600&rtcm=ntrip://me:X{middle}X@h/BASE", f"rtsp://me:X{middle}X@h/video"):
        if "://" not in middle:
            assert "X" not in without_login(url)
    assert without_login("natnet://192.168.1.5") == "natnet://192.168.1.5"
    assert without_login("a@b") == "a@b"


def test_the_hint_of_a_caster_that_repeats_the_password_does_not() -> None:
    words = base64.b64encode(f"me:{PASSWORD}".encode()).decode().rstrip("=")
    for name in (PASSWORD, words, f"x{PASSWORD}x"):
        answer = Answer("BASE", Login("me", PASSWORD))
        with pytest.raises(DriverError) as error:
            answer.feed(f"SOURCETABLE 200 OK\r\nSTR;{name};x\r\nSTR;GOOD;x\r\nENDSOURCETABLE\r\n".encode())
        assert name not in str(error.value)
        assert "GOOD" in str(error.value)


# ---------------------------------------------------------------- what is reported
def test_missing_corrections_are_reported_with_their_age_and_reason_in_few_different_words() -> None:
    clock = SimClock(1000.0)
    feed = CorrectionFeed(Corrections("ntrip", "h", 2101, "BASE"), Outbox(), lambda: None, clock)
    assert feed.trouble(1005.0) == ""
    feed.report("ntrip://h:2101/BASE: no answer")
    assert feed.trouble(1005.0) == "no corrections yet: ntrip://h:2101/BASE: no answer"
    feed._take(BASE, 1006.0)
    feed.report("ntrip://h:2101/BASE: no answer")
    assert feed.trouble(1015.9) == ""
    said = [feed.trouble(1006.0 + age_s) for age_s in range(100_000)]
    assert said[45] == "no corrections for 30 s: ntrip://h:2101/BASE: no answer"
    assert said[4000].startswith("no corrections for 1 h: ")
    assert len(set(said)) < 12
    feed.report("")  # a connection alone brings no corrections
    assert "no answer" in feed.trouble(1100.0)
    feed._take(BASE, 1100.0)
    assert feed.trouble(1101.0) == ""


def test_a_caster_is_asked_less_and_less_often() -> None:
    feed = CorrectionFeed(Corrections("ntrip", "h", 2101, "BASE"), Outbox(), lambda: None, SimClock())
    assert [feed._retry_s() for _ in range(8)] == [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0]
    feed._take(BASE, 1.0)
    assert feed._retry_s() == 1.0
    feed._flowing, feed._answer = False, Answer("BASE", None)
    assert ending(feed._answer, b"HTTP/1.1 401 Unauthorized\r\n\r\n", 100)
    assert [feed._retry_s() for _ in range(3)] == [30.0, 60.0, 60.0]


class Words:
    """A source that says what it is given."""

    sensor, address, hint = "gnss", "/dev/ttyACM0", "is it on?"

    def __init__(self) -> None:
        self.says: list[Seen] = []

    def start(self, receiver: Receiver) -> None:
        """Deliver nothing by itself."""

    def read(self, content: bytes) -> list[Seen]:
        del content
        return self.says

    def close(self) -> None:
        """Hold nothing."""


def test_missing_corrections_are_in_the_sources_report_and_its_fixes_go_on() -> None:
    runtime = Runtime(SimClock(100.0), Mailbox())
    bus, keys, source = LocalBus(runtime.mailbox), Keys("swarm"), Words()
    reports = list[FixSourceReport]()
    bus.subscribe(keys.fix_source(), FixSourceReport, reports.append)
    publisher = FixPublisher(bus, runtime, keys, Names(), sensor="gnss")
    node = SourceNode(source, Convention(), publisher, runtime, runtime.mailbox)
    seen = Sighting("r1", 1.0, 2.0, 0.0, 0.02, math.pi)

    def say(*what: Seen) -> str:
        source.says = list(what)
        node.arrive(runtime.now_s(), "", b"x")
        runtime.mailbox.drain()
        return node.problem

    assert say(Limited("no corrections for 30 s"), seen) == "no corrections for 30 s"
    assert publisher.sent == 1
    assert reports[-1].problem == "no corrections for 30 s"
    assert say(Trouble("the position is known to 2 m only")) == (
        "the position is known to 2 m only; no corrections for 30 s"
    )
    assert say(seen) == "no corrections for 30 s"  # a position ends what kept it away
    assert say(Limited(""), seen) == ""
    assert reports[-1].problem == ""
    node.close()
