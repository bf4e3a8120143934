"""Motion capture in, fixes out: what the datagrams may say and what is told of the others."""

from __future__ import annotations

import json
import math
import socket
import time
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.bus import LocalBus
from fullswarm.clock import MonotonicClock, SimClock
from fullswarm.errors import ConfigError
from fullswarm.keys import Keys
from fullswarm.localization.json_udp import FIELDS, Format, JsonSource
from fullswarm.localization.links import DatagramPort
from fullswarm.localization.publisher import FixPublisher, Names, parse_map, parse_objects
from fullswarm.localization.sighting import Convention, Refused, Sighting, unit_of
from fullswarm.localization.source import WAITING, Receiver, Settings, SourceNode
from fullswarm.messages import FixSourceReport, HealthReport, ObjectFix, PoseFix, RobotHealth
from fullswarm.runtime import Mailbox, Runtime

KEYS = Keys("swarm")


class Words:
    """A source of JSON datagrams without a port."""

    sensor, address, hint = "mocap", "udp 127.0.0.1:1", "is your program sending to this port?"

    def start(self, receiver: Receiver) -> None:
        """Deliver nothing by itself."""

    def read(self, content: bytes) -> list[Sighting | Refused]:
        return Format().read(content)

    def close(self) -> None:
        """Hold nothing."""


GOOD: dict[str, Any] = {"robot": "r1", "x": 1.5, "y": -2.0, "heading": 0.5}


def read(found: Any, **format_: Any) -> Sighting | Refused:
    (each,) = Format(Convention(**format_)).read(json.dumps(found).encode())
    return each


def sighting(found: Any, **format_: Any) -> Sighting:
    each = read(found, **format_)
    assert isinstance(each, Sighting), each
    return each


def about(axis: tuple[float, float, float], angle: float) -> list[float]:
    half = angle / 2.0
    return [math.sin(half) * part for part in axis] + [math.cos(half)]


def times(one: list[float], other: list[float]) -> list[float]:
    x, y, z, w = one
    a, b, c, d = other
    return [
        w * a + x * d + y * c - z * b, w * b - x * c + y * d + z * a,
        w * c + x * b - y * a + z * d, w * d - x * a - y * b - z * c,
    ]  # fmt: skip


def test_an_object_is_reported_as_one_and_not_as_a_robot() -> None:
    bench = Bench(Names(objects=parse_objects(["Person 1=0.3"])))
    found = list[ObjectFix]()
    bench.bus.subscribe(KEYS.object_fix(), ObjectFix, found.append)
    bench.send([{**GOOD, "robot": "Person 1"}, GOOD])
    fixes = bench.fixes
    assert [(each.object, each.x_m, each.y_m, each.radius_m) for each in found] == [("Person 1", 1.5, -2.0, 0.3)]
    assert [each.robot for each in fixes] == ["r1"]
    bench.node.close()


@pytest.mark.parametrize("word", ["person", "person=", "person=-1", "person=wide", "=0.3", "person=nan", "person=1e9"])
def test_an_object_needs_a_name_and_a_radius(word: str) -> None:
    with pytest.raises(ConfigError, match="NAME=RADIUS_M"):
        parse_objects([word])
    with pytest.raises(ConfigError, match="twice"):
        parse_objects(["a=1", "a=2"])


def test_the_plain_form() -> None:
    assert sighting(GOOD) == Sighting("r1", 1.5, -2.0, 0.5, 0.005, 0.02, None, 0, True)


def test_all_that_may_be_said() -> None:
    more = {"sigma_m": 0.1, "sigma_rad": 0.2, "time_s": 12.5, "contacts": 2, "tracked": True, "z": 0.3, "frame": 7}
    assert sighting({**GOOD, **more}) == Sighting("r1", 1.5, -2.0, 0.5, 0.1, 0.2, 12.5, 2, True)
    assert {*GOOD, *more, "name", "heading_deg", "quaternion"} == set(FIELDS)


def test_a_list_may_be_good_in_part() -> None:
    found = Format().read(json.dumps([GOOD, {**GOOD, "x": None}, {**GOOD, "robot": "r2"}]).encode())
    assert [each.name if isinstance(each, Sighting) else each.kind for each in found] == [
        "r1", "'x' is not a finite number", "r2",
    ]  # fmt: skip


@pytest.mark.parametrize(("unit", "length_m"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001)])
def test_units(unit: str, length_m: float) -> None:
    seen = sighting({**GOOD, "sigma_m": 0.1}, unit_m=unit_of(unit))
    assert (seen.x_m, seen.y_m, seen.position_sigma_m) == pytest.approx((1.5 * length_m, -2.0 * length_m, 0.1))


@given(st.floats(-3.1, 3.1), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_headings_are_the_same_in_all_forms(heading: float, tilt: float, roll: float) -> None:
    place = {"robot": "r1", "x": 1.0, "y": 2.0}
    up = times(times(about((0, 0, 1), heading), about((0, 1, 0), tilt)), about((1, 0, 0), roll))
    assert sighting({**place, "heading": heading}).heading_rad == pytest.approx(heading)
    assert sighting({**place, "heading_deg": math.degrees(heading)}).heading_rad == pytest.approx(heading)
    assert sighting({**place, "quaternion": up}).heading_rad == pytest.approx(heading, abs=1e-6)
    # The same body where y points up and the floor is x and -z: its y axis is our z, its z axis our -y.
    x, y, z, w = up
    floor = {"robot": "r1", "x": 1.0, "y": 0.1, "z": -2.0}
    turned = sighting({**floor, "quaternion": [x, z, -y, w]}, y_up=True)
    assert (turned.x_m, turned.y_m) == (1.0, 2.0)
    assert turned.heading_rad == pytest.approx(heading, abs=1e-6)
    assert sighting({**floor, "heading": heading}, y_up=True).heading_rad == pytest.approx(heading)


def test_without_a_heading_its_doubt_is_everything() -> None:
    seen = sighting({"robot": "r1", "x": 0, "y": 0})
    assert (seen.heading_rad, seen.heading_sigma_rad) == (0.0, math.pi)


@pytest.mark.parametrize(
    ("found", "kind"),
    [
        (5, "not an object with fields"),
        ({**GOOD, "headng": 1.0}, "unknown field 'headng'"),
        ({**GOOD, "name": "r1"}, "needs either 'robot' or 'name'"),
        ({"x": 1.0, "y": 1.0}, "needs either 'robot' or 'name'"),
        ({**GOOD, "robot": 5}, "the robot's name is not a text"),
        ({"robot": "r1", "x": 1.0}, "'y' is missing"),
        ({**GOOD, "x": "1.0"}, "'x' is not a finite number"),
        ({**GOOD, "x": True}, "'x' is not a finite number"),
        ({**GOOD, "x": 10**400}, "'x' is not a finite number"),
        ({**GOOD, "x": 1e6}, "no place on a floor"),
        ({**GOOD, "heading_deg": 3.0}, "more than one heading"),
        ({**GOOD, "sigma_m": 0.0}, "'sigma_m' is not above zero"),
        ({**GOOD, "sigma_rad": -1}, "'sigma_rad' is not above zero"),
        ({**GOOD, "contacts": 1.5}, "'contacts' is not a small whole number"),
        ({**GOOD, "contacts": -1}, "'contacts' is not a small whole number"),
        ({**GOOD, "tracked": 1}, "'tracked' is not true or false"),
        ({"robot": "r1", "x": 1, "y": 1, "quaternion": [0, 0, 1]}, "a quaternion is [x, y, z, w]"),
        ({"robot": "r1", "x": 1, "y": 1, "quaternion": [0, 0, 0, 0]}, "a quaternion has length 1"),
        (
            {"robot": "r1", "x": 1, "y": 1, "quaternion": about((0, 1, 0), math.pi / 2)},
            "the body's x axis points up or down",
        ),
    ],
)
def test_what_is_wrong_is_said(found: Any, kind: str) -> None:
    refused = read(found)
    assert isinstance(refused, Refused)
    assert refused.kind == kind


def test_a_wrong_field_gets_a_hint() -> None:
    assert str(read({**GOOD, "headng": 1.0})) == "unknown field 'headng': did you mean 'heading'?"


@given(st.binary(max_size=200))
def test_any_bytes_are_sightings_or_refused(data: bytes) -> None:
    assert all(isinstance(each, Sighting | Refused) for each in Format().read(data))


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.sampled_from(FIELDS), inner, max_size=8),
    max_leaves=20,
)


@given(st.dictionaries(st.sampled_from(FIELDS), values), st.booleans())
def test_any_json_is_a_finite_sighting_or_refused(found: dict[str, Any], y_up: bool) -> None:
    for each in Format(Convention(y_up=y_up)).read(json.dumps(found).encode()):
        if isinstance(each, Sighting):
            assert math.isfinite(each.x_m + each.y_m + each.heading_rad + each.position_sigma_m + (each.time_s or 0.0))


# ---------------------------------------------------------------- the node
class Bench:
    def __init__(self, names: Names) -> None:
        self.runtime = Runtime(SimClock(100.0), Mailbox())
        self.bus = LocalBus(self.runtime.mailbox)
        self.fixes: list[PoseFix] = []
        self.bus.subscribe(KEYS.pose_fix(), PoseFix, self.fixes.append)
        self.reports: list[FixSourceReport] = []
        self.bus.subscribe(KEYS.fix_source(), FixSourceReport, self.reports.append)
        self.publisher = FixPublisher(self.bus, self.runtime, KEYS, names, sensor="mocap", process="fixes-1")
        self.node = SourceNode(Words(), Convention(), self.publisher, self.runtime, self.runtime.mailbox)

    def send(self, found: Any, sender: str = "10.0.0.7") -> None:
        data = found if isinstance(found, bytes) else json.dumps(found).encode()
        self.node.arrive(self.runtime.now_s() - 0.001, sender, data)
        self.runtime.mailbox.drain()


def test_a_sighting_becomes_a_fix_of_the_robot_it_is_mapped_to() -> None:
    bench = Bench(Names(robots=parse_map(["Rigid Body 1=r7"])))
    bench.send([{"name": "Rigid Body 1", "x": 1, "y": 2, "heading": 3, "contacts": 1}, GOOD])
    assert bench.fixes == [
        PoseFix(
            robot="r7", x_m=1.0, y_m=2.0, heading_rad=3.0, position_sigma_m=0.005, heading_sigma_rad=0.02,
            source="fixes-1", stamp_s=99.999, contacts=1, sensor="mocap",
        ),
        PoseFix(
            robot="r1", x_m=1.5, y_m=-2.0, heading_rad=0.5, position_sigma_m=0.005, heading_sigma_rad=0.02,
            source="fixes-1", stamp_s=99.999, sensor="mocap",
        ),
    ]  # fmt: skip


def test_a_sender_with_a_clock_is_a_source_of_its_own() -> None:
    bench = Bench(Names())
    bench.send({**GOOD, "time_s": 7.25})
    assert (bench.fixes[0].source, bench.fixes[0].stamp_s) == ("fixes-1/10.0.0.7", 7.25)


def test_a_body_that_the_cameras_have_lost_is_no_fix_and_no_mistake() -> None:
    bench = Bench(Names())
    bench.send({"robot": "r1", "tracked": False})
    assert (bench.fixes, bench.publisher.bad.total()) == ([], 0)


def test_each_kind_of_mistake_is_told_once_and_counted(capsys: pytest.CaptureFixture[str]) -> None:
    bench = Bench(Names())
    for number in range(5):
        bench.send({**GOOD, "x": f"{number}"})
        bench.send(b"\xff\x00")
        bench.send({**GOOD, "robot": "Rigid Body 1"})
    told = capsys.readouterr().out
    assert told.count("'x' is not a finite number: '0'") == 1
    assert told.count("not JSON") == 1
    assert told.count("--map NAME=ROBOT") == 1
    assert told.count("a datagram was refused") == 3
    assert set(bench.publisher.bad.values()) == {5}
    bench.node.close()
    assert "refused=15" in capsys.readouterr().out


def test_a_report_says_every_second_what_is_seen_and_what_is_not() -> None:
    bench = Bench(Names(robots=parse_map(["Rigid Body 1=r7"])))
    bench.publisher.expect("r7", "Rigid Body 1")
    bench.publisher.expect("r8", "tag 8")
    bench.send([{"name": "Rigid Body 1", "x": 1, "y": 2}])
    bench.runtime.run(1.5)
    bench.publisher.problem("the camera has moved")
    bench.runtime.mailbox.drain()
    assert [report.problem for report in bench.reports] == ["", "the camera has moved"]
    last = bench.reports[-1]
    assert (last.source, last.sensor, last.robots, last.markers) == (
        "fixes-1", "mocap", ("r7", "r8"), ("Rigid Body 1", "tag 8"),
    )  # fmt: skip
    assert list(last.unseen_s) == pytest.approx([1.5, -1.0], abs=0.02)


def test_it_says_once_that_a_robot_is_not_here(capsys: pytest.CaptureFixture[str]) -> None:
    bench = Bench(Names())
    health = RobotHealth(robot="r1", driver="", make="", model="", firmware="", lifecycle="READY")
    bench.bus.publish(KEYS.health("r1"), HealthReport(host="r1", process="p", version="0", robots=(health,)))
    bench.runtime.run(6.0)
    for _ in range(3):
        bench.send([GOOD, {**GOOD, "robot": "r1x"}])
    told = capsys.readouterr().out
    assert told.count("fixes for a robot that is not here") == 1
    assert "did you mean 'r1'?" in told


def test_a_source_that_is_silent_is_reported_and_well_again_with_the_next_datagram() -> None:
    bench = Bench(Names())
    bench.send(GOOD)
    bench.runtime.run(1.5)
    assert bench.reports[-1].problem == ""
    bench.runtime.run(1.5)
    problem = "nothing arrives from udp 127.0.0.1:1: is your program sending to this port?"
    assert bench.reports[-1].problem == problem
    bench.send(GOOD)
    bench.runtime.run(1.1)
    assert bench.reports[-1].problem == ""
    bench.node.report("no connection")
    bench.runtime.mailbox.drain()
    assert bench.reports[-1].problem == "no connection"


def test_a_port_hands_on_what_comes() -> None:
    mailbox = Mailbox()
    runtime = Runtime(MonotonicClock(), mailbox)
    source = JsonSource(Settings("json://127.0.0.1:0"), Format(), runtime.clock)
    publisher = FixPublisher(LocalBus(mailbox), runtime, KEYS, Names(), sensor="mocap")
    node = SourceNode(source, Convention(), publisher, runtime, mailbox)
    try:
        node.start()
        host, number = source.address.removeprefix("udp ").split(":")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(json.dumps(GOOD).encode(), (host, int(number)))
            deadline_s = time.monotonic() + 5.0
            while publisher.sent == 0:
                assert time.monotonic() < deadline_s
                mailbox.deliver_one(0.1)
        with pytest.raises(ConfigError, match="cannot listen there"):
            JsonSource(Settings(f"json://{host}:{number}"), Format(), runtime.clock)
    finally:
        node.close()


def test_of_what_is_too_much_the_oldest_is_forgotten() -> None:
    bench = Bench(Names())
    for number in range(WAITING + 5):
        bench.node.arrive(100.0, "a", json.dumps({**GOOD, "x": number / 100.0}).encode())
    bench.runtime.mailbox.drain()
    assert (len(bench.fixes), bench.fixes[0].x_m) == (WAITING, 0.05)


@pytest.mark.parametrize(
    ("listen", "words"),
    [
        ("9870", "expected HOST:PORT"),
        ("127.0.0.1:x", "expected HOST:PORT"),
        ("127.0.0.1:70000", "expected HOST:PORT"),
        ("0.0.0.0:0", "open to the network"),
        ("192.0.2.1:0", "open to the network"),
    ],
)
def test_addresses_that_will_not_do(listen: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        DatagramPort(listen, False, "--listen")


def test_an_address_of_another_machine_is_said_to_be_one() -> None:
    with pytest.raises(ConfigError, match="cannot listen there"):
        DatagramPort("192.0.2.1:0", True, "--listen")


@pytest.mark.parametrize("words", [["r1"], ["=r1"], ["a="], ["a=r 1"], ["a=r1", "a=r2"], ["a=r1", "b=r1"]])
def test_maps_that_will_not_do(words: list[str]) -> None:
    with pytest.raises(ConfigError, match=r"NAME=ROBOT|mapped already"):
        parse_map(words)


def test_a_unit_that_nobody_knows() -> None:
    with pytest.raises(ConfigError, match="'ft' is not a unit"):
        unit_of("ft")
