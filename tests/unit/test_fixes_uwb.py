"""Distances to radio anchors: a tag's shell and JSON in, range fixes out."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.bus import LocalBus
from fullswarm.clock import MonotonicClock, SimClock
from fullswarm.errors import ConfigError
from fullswarm.keys import Keys
from fullswarm.localization.publisher import FixPublisher, Names
from fullswarm.localization.sighting import Convention, Ranging, Refused
from fullswarm.localization.source import Anchors, Receiver, Settings, SourceNode
from fullswarm.localization.uwb import Lines, UwbSource
from fullswarm.messages import RangeFix
from fullswarm.runtime import Mailbox, Runtime

LEC = b"DIST,2,AN0,1151,3.40,2.40,1.65,2.31,AN1,0cb8,3.40,1.20,1.65,0.50,POS,2.57,1.98,1.68,100\r\n"
LES = b" 1151[3.40,2.40,1.65]=2.31 0CB8[3.40,1.20,1.65]=0.50 le_us=2576 est[2.57,1.98,1.68,100]\r\n"
BOTH = [Ranging("r1", "1151", 2.31), Ranging("r1", "0CB8", 0.5)]


@pytest.mark.parametrize("line", [LEC, LES])
def test_the_shell_of_a_tag(line: bytes) -> None:
    assert Lines("r1").read(b"dwm> lec\r\n" + line) == BOTH
    lines = Lines("r1")
    assert [each for at in range(len(line)) for each in lines.read(line[at : at + 1])] == BOTH
    (refused,) = Lines("").read(LEC)
    assert isinstance(refused, Refused)
    assert "--robot" in str(refused)


def test_json_lines_and_datagrams() -> None:
    one = {"robot": "r2", "anchor": "A", "distance": 3.5, "sigma_m": 0.2, "time_s": 7.0}
    assert Lines("").read(json.dumps(one).encode()) == [Ranging("r2", "A", 3.5, 0.2, 7.0)]
    two = [one, {"anchor": "B", "distance": 1}]
    assert Lines("r1").read(json.dumps(two).encode() + b"\n") == [
        Ranging("r2", "A", 3.5, 0.2, 7.0), Ranging("r1", "B", 1.0),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("found", "kind"),
    [
        ({"anchor": "A"}, "'distance' is not a finite number"),
        ({"anchor": "A", "distance": -1}, "a distance that is none"),
        ({"anchor": "A", "distance": 0}, "a distance that is none"),
        ({"anchor": "A", "distance": 1e9}, "a distance that is none"),
        ({"anchor": "A", "distance": 1, "sigma": 1}, "unknown field 'sigma'"),
        ({"anchor": 5, "distance": 1}, "needs 'robot' and 'anchor'"),
        ({"anchor": "A", "distance": 1, "sigma_m": -1}, "'sigma_m' is no standard deviation"),
        (5, "not an object with fields"),
    ],
)
def test_what_is_wrong_is_said(found: Any, kind: str) -> None:
    (refused,) = Lines("r1").read(json.dumps([found]).encode() + b"\n")
    assert isinstance(refused, Refused)
    assert refused.kind == kind


@given(st.lists(st.binary(max_size=60) | st.sampled_from([LEC, LES, b"DIST,3,AN0", b"\r\n", b'{"robot":'])))
def test_any_bytes_are_distances_or_refused(chunks: list[bytes]) -> None:
    lines = Lines("r1")
    assert all(isinstance(each, Ranging | Refused) for chunk in chunks for each in lines.read(chunk))


class Tag:
    """A source without a port."""

    sensor, address, hint = "uwb", "tag", ""

    def __init__(self) -> None:
        self._lines = Lines("r1")

    def start(self, receiver: Receiver) -> None:
        """Deliver nothing by itself."""

    def read(self, content: bytes) -> Any:
        return self._lines.read(content)

    def close(self) -> None:
        """Hold nothing."""


def test_a_distance_to_an_anchor_of_known_place_is_a_range_fix(capsys: pytest.CaptureFixture[str]) -> None:
    runtime = Runtime(SimClock(100.0), Mailbox())
    bus, found = LocalBus(runtime.mailbox), list[RangeFix]()
    bus.subscribe(Keys("swarm").range_fix(), RangeFix, found.append)
    publisher = FixPublisher(bus, runtime, Keys("swarm"), Names(), sensor="uwb", process="uwb-1")
    anchors = Anchors({"1151": (3.4, 2.4, 1.65)}, radio_height_m=0.25, sigma_m=0.1)
    node = SourceNode(Tag(), Convention(), publisher, runtime, runtime.mailbox, anchors=anchors)
    node.arrive(99.0, "tag", LEC)
    runtime.mailbox.drain()
    assert found == [
        RangeFix(
            robot="r1", anchor="1151", x_m=3.4, y_m=2.4, up_m=1.4, distance_m=2.31, sigma_m=0.1, source="uwb-1",
            stamp_s=99.0, sensor="uwb",
        )
    ]  # fmt: skip
    assert "'0CB8': add its place to [anchors]" in capsys.readouterr().out
    node.close()


def test_anchors_must_have_places() -> None:
    with pytest.raises(ConfigError, match="no places of anchors"):
        UwbSource(Settings("uwb:///dev/ttyACM0", robot="r1"), MonotonicClock())
