"""Each capture system's protocol on a real port: format-true packets in, poses out; a system that ends is reported."""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import threading
import time
from collections.abc import Callable, Sequence

import pytest

from fullswarm.clock import MonotonicClock
from fullswarm.emulators.mocap.natnet import NatNetServer
from fullswarm.emulators.mocap.qualisys import QualisysServer
from fullswarm.emulators.mocap.server import Server, Shown
from fullswarm.emulators.mocap.vicon import ViconServer
from fullswarm.emulators.mocap.vrpn import VrpnServer
from fullswarm.localization.schemes import convention_of, open_source
from fullswarm.localization.sighting import Frame, Refused, Sighting
from fullswarm.localization.source import Content, Settings

NAMES = ["Rigid Body 1", "r2", "Lost ä"]
START_S = 60.0
"""Generous: a process of its own starts on a machine that may have other work."""


def turned(heading_rad: float, *, y_up: bool = False) -> tuple[float, float, float, float]:
    half = heading_rad / 2.0
    return (0.0, math.sin(half), 0.0, math.cos(half)) if y_up else (0.0, 0.0, math.sin(half), math.cos(half))


class Heard:
    """What a link delivers."""

    def __init__(self) -> None:
        self.frames: list[Frame] = []
        self.refused: list[Refused] = []
        self.reports: list[str] = []

    def arrive(self, arrival_s: float, sender: str, content: Content) -> None:
        if isinstance(content, Frame):
            self.frames.append(content)
        elif isinstance(content, Refused):
            self.refused.append(content)

    def report(self, trouble: str) -> None:
        self.reports.append(trouble)

    def sightings(self, settings: Settings, since: int = 0) -> dict[str, Sighting]:
        convention = convention_of(settings)
        return {
            body.name: convention.sighting(body, frame.time_s) for frame in self.frames[since:] for body in frame.bodies
        }


def wait_for(condition: Callable[[], bool], act: Callable[[], None] = lambda: None, timeout_s: float = START_S) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s
        act()
        threading.Event().wait(0.01)


Make = Callable[[Sequence[str]], Server]
CASES: list[tuple[str, Make, float, bool, str]] = [
    ("natnet", lambda names: NatNetServer(names, port=0, version=(2, 6)), 1.0, True, "?local=127.0.0.1"),
    ("natnet", lambda names: NatNetServer(names, port=0, version=(2, 11)), 1.0, True, ""),
    ("natnet", lambda names: NatNetServer(names, port=0, version=(3, 1)), 1.0, True, ""),
    ("natnet", lambda names: NatNetServer(names, port=0, version=(4, 0)), 1.0, False, ""),
    ("natnet", lambda names: NatNetServer(names, port=0, version=(4, 1)), 1.0, True, ""),
    ("natnet", lambda names: NatNetServer(names, port=0, version=(4, 2)), 1.0, True, ""),
    ("natnet", lambda names: NatNetServer(names, port=0, group="239.255.42.99", data_port=15_111), 1.0, True,
     "?local=127.0.0.1"),
    ("vrpn", lambda names: VrpnServer(names, port=0), 1.0, False, ""),
    ("qualisys", lambda names: QualisysServer(names, port=0), 1000.0, False, ""),
    ("vicon", lambda names: ViconServer(names, port=0), 1000.0, False, ""),
    ("libmotioncapture", lambda names: VrpnServer(names, port=0), 1.0, False, "?type=vrpn"),
]  # fmt: skip


@pytest.mark.parametrize(("scheme", "make", "per_m", "y_up", "options"), CASES)
def test_packets_in_poses_out(scheme: str, make: Make, per_m: float, y_up: bool, options: str) -> None:
    def at(x_m: float, y_m: float, height_m: float) -> tuple[float, float, float]:
        x, y, z = (x_m, height_m, -y_m) if y_up else (x_m, y_m, height_m)
        return per_m * x, per_m * y, per_m * z

    bodies = [
        Shown(NAMES[0], at(1.25, -2.5, 0.2), turned(0.6, y_up=y_up)),
        Shown(NAMES[1], at(-3.0, 0.75, 0.2), turned(-2.9, y_up=y_up)),
        Shown(NAMES[2], at(0.0, 0.0, 0.0), seen=False),
    ]
    server, heard = make(NAMES), Heard()
    server.start()
    settings = Settings(f"{scheme}://127.0.0.1:{server.port}{options}", axes="y-up" if y_up else "z-up")
    source = open_source(settings, MonotonicClock())
    try:
        source.start(heard)
        wait_for(lambda: len(heard.sightings(settings)) >= 2, lambda: server.frame(bodies))
        seen = heard.sightings(settings)
        one, two = seen[NAMES[0]], seen[NAMES[1]]
        assert (one.x_m, one.y_m, one.heading_rad) == pytest.approx((1.25, -2.5, 0.6), abs=1e-6)
        assert (two.x_m, two.y_m, two.heading_rad) == pytest.approx((-3.0, 0.75, -2.9), abs=1e-6)
        assert NAMES[2] not in seen or not seen[NAMES[2]].tracked
        assert heard.refused == []
        times = [frame.time_s for frame in heard.frames if frame.time_s is not None]
        assert times == sorted(times)
        # A body that is lost is never shown where it was.
        bodies[0] = Shown(NAMES[0], bodies[0].position, seen=False)
        for _ in range(3):
            server.frame(bodies)
        threading.Event().wait(0.3)
        since = len(heard.frames)
        wait_for(lambda: len(heard.frames) > since + 3, lambda: server.frame(bodies))
        later = heard.sightings(settings, since).get(NAMES[0])
        assert later is None or not later.tracked
    finally:
        source.close()
        server.close()


@pytest.mark.parametrize("size", [1, 7, 1_000])
def test_what_a_vicon_client_wants_may_arrive_joined_or_in_parts(size: int) -> None:
    """Recorded of libmotioncapture: objects without segments, a second packet, and then with segments."""
    said = bytes.fromhex(
        "01002b1a18000000a18601001000000003000000010000000200000005000000"
        "01002b1a09000000a28601000100000001"
        "01002b1a2c000000a18601001400000004000000010000000200000005000000090000002a000000080000000100000000000000"
    )
    server = ViconServer(NAMES, port=0)
    server.start()
    try:
        with socket.create_connection(("127.0.0.1", server.port)) as client:
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            client.settimeout(0.05)
            for start in range(0, len(said), size):
                client.sendall(said[start : start + size])
            got = bytearray()

            def read() -> None:
                server.frame([Shown(NAMES[1], (12_345.678, 0.0, 0.0))])
                with contextlib.suppress(TimeoutError):
                    got.extend(client.recv(65_536))

            wait_for(lambda: struct.pack("<d", 12_345.678) in got, read)
            assert NAMES[1].encode() in got, "the subjects, which it asked for in the first packet already"
    finally:
        server.close()


@pytest.mark.parametrize("make", [NatNetServer, VrpnServer, QualisysServer])
def test_a_system_that_ends_is_said_to_be_gone_and_one_that_comes_again_is_used(make: type[Server]) -> None:
    schemes = {NatNetServer: "natnet", VrpnServer: "vrpn", QualisysServer: "qualisys"}
    bodies = [Shown("r1", (1.0, 2.0, 3.0))]
    server = make(["r1"], "127.0.0.1", 0)  # type: ignore[call-arg]
    server.start()
    port, heard = server.port, Heard()
    url = f"{schemes[make]}://127.0.0.1:{port}"
    source = open_source(Settings(url, axes="z-up"), MonotonicClock())
    try:
        source.start(heard)
        wait_for(lambda: bool(heard.frames), lambda: server.frame(bodies))
        server.close()
        wait_for(lambda: heard.reports[-1].startswith(f"no connection to {url}: "))
        server = make(["r1"], "127.0.0.1", port)  # type: ignore[call-arg]
        server.start()
        before = len(heard.frames)
        wait_for(lambda: len(heard.frames) > before, lambda: server.frame(bodies))
        assert heard.reports[-1] == ""
    finally:
        source.close()
        server.close()


def test_a_pose_of_vrpn_that_never_changes_by_a_digit_is_no_measurement() -> None:
    server, heard = VrpnServer(["r1"], port=0), Heard()
    server.start()
    source = open_source(Settings(f"vrpn://127.0.0.1:{server.port}", axes="z-up"), MonotonicClock())
    try:
        source.start(heard)
        bodies = [Shown("r1", (1.0, 2.0, 3.0))]
        wait_for(lambda: len(heard.frames) > 30, lambda: server.frame(bodies))
        assert all(frame.bodies[0].tracked for frame in heard.frames)
        server.frozen = True
        before = len(heard.frames)
        wait_for(lambda: len(heard.frames) > before + 25, lambda: server.frame(bodies))
        assert not heard.frames[-1].bodies[0].tracked
    finally:
        source.close()
        server.close()


# ---------------------------------------------------------------- other people's clients read the players
@pytest.mark.parametrize("version", [(2, 6), (2, 11), (3, 0), (4, 0), (4, 1), (4, 2)])
def test_the_package_natnet_reads_what_our_motive_sends(version: tuple[int, int]) -> None:
    from natnet.data_descriptions import DataDescriptions
    from natnet.data_frame import DataFrame
    from natnet.packet_buffer import PacketBuffer
    from natnet.version import Version

    server = NatNetServer(NAMES, port=0, version=version)
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.settimeout(10.0)
    try:
        server.start()
        for request in (b"\x00\x00\x05\x00Ping\x00", b"\x04\x00\x00\x00"):
            client.sendto(request, ("127.0.0.1", server.port))
            answer = client.recv(65_536)
        models = DataDescriptions.read_from_buffer(PacketBuffer(answer[4:]), Version(*version))
        assert [each.name for each in models.rigid_bodies] == NAMES
        server.frame([Shown(NAMES[0], (1.0, 2.0, 3.0)), Shown(NAMES[2], (0.0, 0.0, 0.0), seen=False)])
        frame = DataFrame.read_from_buffer(PacketBuffer(client.recv(65_536)[4:]), Version(*version))
        assert [(each.pos, each.tracking_valid) for each in frame.rigid_bodies] == [
            ((1.0, 2.0, 3.0), True), ((0.0, 0.0, 0.0), False),
        ]  # fmt: skip
    finally:
        client.close()
        server.close()
