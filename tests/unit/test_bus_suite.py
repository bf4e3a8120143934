"""One suite for both buses: in one process, live within one session, live between two sessions through a hub."""

from __future__ import annotations

import functools
import math
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from fullswarm import config
from fullswarm.bus import LocalBus
from fullswarm.bus.arrivals import Arrivals
from fullswarm.bus.base import Carried, NamedBus, SenderBus
from fullswarm.bus.codec import encode
from fullswarm.bus.endpoint import DEFAULT_HUB, check_endpoint
from fullswarm.bus.hub import Hub
from fullswarm.bus.zenoh_bus import (
    CACHED_KEYS,
    FETCHED_AT_ONCE,
    ZenohBus,
    client_config,
    is_urgent,
    untyped,
)
from fullswarm.clock import MonotonicClock, SimClock
from fullswarm.errors import ConfigError, Unreachable
from fullswarm.keys import Keys
from fullswarm.messages import Command, Heartbeat, Reception, RobotStates, SeenObstacles, StopRequest
from fullswarm.runtime import FETCH_S, Mailbox

DEADLINE_S = 5.0
KEYS = Keys("test")


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def beat(sequence: int, node: str = "core") -> Heartbeat:
    return Heartbeat(node=node, process="p", sequence=sequence)


@dataclass
class Pair:
    """Who publishes, who subscribes (maybe the same bus), and the subscriber's mailbox."""

    publisher: SenderBus
    subscriber: SenderBus
    mailbox: Mailbox

    def until(self, condition: Callable[[], bool]) -> None:
        """Deliver messages until `condition`; fail after the deadline."""
        end_s = time.monotonic() + DEADLINE_S
        while not condition():
            self.mailbox.deliver_one(0.01)
            assert time.monotonic() < end_s, "nothing more came"

    def settle(self) -> None:
        """Return when the publisher's side knows every subscription made so far (they are declared in order)."""
        seen: list[Heartbeat] = []
        probe = self.subscriber.subscribe("settle", Heartbeat, seen.append)

        def arrived() -> bool:
            self.publisher.publish("settle", beat(0))
            return bool(seen)

        self.until(arrived)
        probe.close()


@pytest.fixture(scope="module")
def hub() -> Iterator[str]:
    with Hub(free_endpoint()) as opened:
        yield opened.endpoint


@pytest.fixture(params=["local", "own", "remote", "shows"])
def pair(request: pytest.FixtureRequest, hub: str) -> Iterator[Pair]:
    mailbox = Mailbox()
    if request.param == "local":
        local = LocalBus(mailbox)
        yield Pair(local, local, mailbox)
        local.close()
        return
    subscriber = ZenohBus(mailbox, hub=hub, only_shows=request.param == "shows")
    publisher = subscriber if request.param == "own" else ZenohBus(Mailbox(), hub=hub)
    for bus in (publisher, subscriber):
        bus.wait_connected(DEADLINE_S)
    yield Pair(publisher, subscriber, mailbox)
    publisher.close()
    subscriber.close()


@pytest.fixture
def remote(hub: str) -> Iterator[tuple[ZenohBus, ZenohBus, Pair]]:
    """A publisher, a subscriber, and both as a pair."""
    mailbox = Mailbox()
    publisher, subscriber = ZenohBus(Mailbox(), hub=hub), ZenohBus(mailbox, hub=hub)
    publisher.wait_connected(DEADLINE_S)
    subscriber.wait_connected(DEADLINE_S)
    yield publisher, subscriber, Pair(publisher, subscriber, mailbox)
    publisher.close()
    subscriber.close()


# ---------------------------------------------------------------- both buses
def test_messages_arrive_whole_and_in_order(pair: Pair) -> None:
    seen: list[Heartbeat] = []
    pair.subscriber.subscribe(KEYS.heartbeat("core"), Heartbeat, seen.append)
    pair.settle()
    sent = [beat(number) for number in range(200)]
    for message in sent:
        pair.publisher.publish(KEYS.heartbeat("core"), message)
    pair.until(lambda: len(seen) == len(sent))
    assert seen == sent


@pytest.mark.parametrize("latest", [False, True])
def test_the_sender_arrives_beside_the_message(pair: Pair, latest: bool) -> None:
    seen: list[tuple[int, str]] = []
    pair.subscriber.subscribe_with_sender(
        KEYS.heartbeat(), Heartbeat, lambda got: seen.append((got.message.sequence, got.sender)), latest=latest
    )
    pair.settle()
    named = NamedBus(pair.publisher, "r1")
    for number, (bus, sender) in enumerate(((named, ""), (pair.publisher, ""), (named, "core"), (pair.publisher, "é"))):
        bus.publish(KEYS.heartbeat(f"n{number}"), beat(number), sender=sender)
    pair.until(lambda: len(seen) == 4)
    assert seen[:3] == [(0, "r1"), (1, ""), (2, "core")]


def test_all_that_is_on_the_wire_can_be_had_unread(remote: tuple[ZenohBus, ZenohBus, Pair]) -> None:
    publisher, subscriber, pair = remote
    tap = subscriber.tap(["test/heartbeat/*", "test/stop"])
    pair.settle()
    tap.take()
    clock = MonotonicClock()
    began_s = clock.now_s()
    publisher.publish(KEYS.heartbeat("n1"), beat(1), sender="r1")
    publisher.publish(KEYS.leases, beat(0))
    publisher.publish(KEYS.stop, StopRequest(id="s", source="me"))
    publisher.publish(KEYS.heartbeat("n2"), beat(2))
    seen: list[Carried] = []

    def taken() -> bool:
        seen.extend(tap.take())
        return len(seen) == 3

    pair.until(taken)
    assert [(each.number, each.key, each.sender, each.data) for each in seen] == [
        (0, "test/heartbeat/n1", "r1", encode(beat(1))),
        (1, "test/stop", "", encode(StopRequest(id="s", source="me"))),
        (0, "test/heartbeat/n2", "", encode(beat(2))),
    ]
    arrivals_s = [each.arrival_s for each in seen]
    assert arrivals_s == sorted(arrivals_s)
    assert began_s <= arrivals_s[0] <= arrivals_s[-1] <= clock.now_s()
    assert tap.dropped == 0
    arrived: list[Heartbeat] = []
    subscriber.subscribe(KEYS.heartbeat("n1"), Heartbeat, arrived.append)
    pair.settle()
    tap.take()
    publisher.publish(KEYS.heartbeat("n1"), beat(3))
    pair.until(lambda: len(arrived) == 1)
    tap.close()
    publisher.publish(KEYS.heartbeat("n1"), beat(4))
    pair.until(lambda: len(arrived) == 2)
    assert [each.data for each in tap.take()] == [encode(beat(3))]  # what came before its end is not lost
    assert tap.take() == []
    tap.close()


def test_of_what_nobody_takes_the_newest_is_kept(remote: tuple[ZenohBus, ZenohBus, Pair]) -> None:
    publisher, subscriber, pair = remote
    tap = subscriber.tap(["test/heartbeat/*"], room=3)
    arrived: list[Heartbeat] = []
    subscriber.subscribe(KEYS.heartbeat("n1"), Heartbeat, arrived.append)
    pair.settle()
    tap.take()
    for number in range(5):
        publisher.publish(KEYS.heartbeat("n1"), beat(number))
    pair.until(lambda: len(arrived) == 5)
    assert [each.data for each in tap.take()] == [encode(beat(number)) for number in (2, 3, 4)]
    assert tap.dropped == 1  # at least


@given(
    ahead_s=st.floats(-1e9, 1e9), ways_s=st.lists(st.floats(0.0, 0.02), min_size=2, max_size=60),
    every_s=st.floats(0.001, 0.05), look_s=st.floats(0.05, 0.5),
)  # fmt: skip
def test_when_messages_arrived_follows_from_the_stamps_of_another_clock(
    ahead_s: float, ways_s: list[float], every_s: float, look_s: float
) -> None:
    """Each within the time since the last look, in order, and once one came just before a look, to its way's spread."""
    arrivals, sent_s = Arrivals(), [number * every_s for number in range(len(ways_s))]
    came_s = list(np.maximum.accumulate([at_s + way_s for at_s, way_s in zip(sent_s, ways_s, strict=True)]))
    looks_s, taken = [look_s * number for number in range(1, 2 + int(came_s[-1] / look_s) + 1)], 0
    late_s = math.inf
    for before_s, now_s in zip([-math.inf, *looks_s], looks_s, strict=False):
        rows = [row for row, at_s in enumerate(came_s) if before_s < at_s <= now_s]
        found_s = arrivals.at([sent_s[row] + ahead_s for row in rows], now_s)
        late_s = min(late_s, now_s - sent_s[rows[-1]]) if rows else late_s
        assert all(before_s <= at_s <= now_s for at_s in found_s)
        assert found_s == sorted(found_s)
        for row, at_s in zip(rows, found_s, strict=True):
            assert abs(at_s - came_s[row]) <= max(late_s, 0.02) + 1e-3 * now_s + 1e-6
        taken += len(rows)
    assert taken == len(ways_s)


def test_a_clock_that_is_set_anew_costs_one_look() -> None:
    arrivals = Arrivals()
    for step_s in (0.0, -3600.0, 86_400.0):
        began_s = arrivals._looked_s if step_s else 0.0
        for number in range(1, 9):
            now_s = began_s + 0.25 * number
            stamps_s = [now_s + step_s - each_s for each_s in (0.2, 0.1, 0.005)]
            assert arrivals.at(stamps_s, now_s) == pytest.approx([now_s - 0.195, now_s - 0.095, now_s], abs=2e-3)


def test_a_message_without_a_stamp_counts_as_of_now() -> None:
    assert Arrivals().at([math.nan, 5.0, math.nan], 7.0) == [7.0, 7.0, 7.0]
    assert Arrivals().at([], 7.0) == []


def test_the_sender_is_the_chunk_of_the_key_after_the_swarms(remote: tuple[ZenohBus, ZenohBus, Pair], hub: str) -> None:
    publisher, subscriber, pair = remote
    seen: list[str] = []
    subscriber.subscribe_with_sender(KEYS.heartbeat(), Heartbeat, lambda got: seen.append(got.sender))
    pair.settle()
    session = zenoh.open(client_config(hub, multicast=False))
    try:
        listener = session.declare_subscriber("test/**")
        session.put("test/r7/heartbeat/core", encode(beat(1)), attachment=b"core")
        pair.until(lambda: len(seen) == 1)
        publisher.publish(KEYS.heartbeat("core"), beat(2), sender="r8")
        publisher.publish(KEYS.heartbeat("core"), beat(3), sender="a/b")  # not one chunk
        pair.until(lambda: len(seen) == 3)
        keys = [str(listener.recv().key_expr) for _ in range(3)]
    finally:
        untyped(session.close)
    assert seen == ["r7", "r8", ""]
    assert sorted(keys) == [f"test/{name}/heartbeat/core" for name in ("r7", "r8", "unnamed")]


def test_a_process_of_an_older_version_is_named(
    remote: tuple[ZenohBus, ZenohBus, Pair], hub: str, capsys: pytest.CaptureFixture[str]
) -> None:
    _, subscriber, pair = remote
    seen: list[Heartbeat] = []
    subscriber.subscribe(KEYS.heartbeat(), Heartbeat, seen.append)
    pair.settle()
    session = zenoh.open(client_config(hub, multicast=False))
    try:
        session.put("test/heartbeat/core", encode(beat(1)))
        pair.until(lambda: subscriber.dropped == 1)
    finally:
        untyped(session.close)
    assert not seen
    assert "older version of fullswarm: update it" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("host", "robots", "sender", "arrives"),
    [
        ("r1", ("r1",), "r1", True),
        ("r1", ("r1",), "", True),  # a program without a name
        ("r1", ("r1",), "r2", False),
        ("r1", ("r1", "r2"), "r1", False),
        ("r1", ("r1",), "core", False),
    ],
)
def test_what_robots_report_comes_from_themselves(
    remote: tuple[ZenohBus, ZenohBus, Pair], host: str, robots: tuple[str, ...], sender: str, arrives: bool
) -> None:
    publisher, subscriber, pair = remote
    seen: list[Reception] = []
    subscriber.subscribe(KEYS.reception(), Reception, seen.append)
    pair.settle()
    zeros = (0.0,) * len(robots)
    message = Reception(host=host, robots=robots, x_m=zeros, y_m=zeros)
    publisher.publish(KEYS.reception(host), message, sender=sender)
    pair.until(lambda: bool(seen) or subscriber.dropped == 1)
    assert (seen == [message]) is arrives


def test_wildcards_select(pair: Pair) -> None:
    one: list[str] = []
    deep: list[str] = []
    pair.subscriber.subscribe(KEYS.heartbeat(), Heartbeat, lambda message: one.append(message.node))
    pair.subscriber.subscribe("test/**", Heartbeat, lambda message: deep.append(message.node))
    pair.settle()
    for node in ("a", "b"):
        pair.publisher.publish(KEYS.heartbeat(node), beat(0, node))
    pair.publisher.publish("test/heartbeat/x/deep", beat(0, "x"))
    pair.publisher.publish(KEYS.heartbeat("end"), beat(0, "end"))
    pair.until(lambda: "end" in one and "end" in deep)
    assert one == ["a", "b", "end"]
    assert deep == ["a", "b", "x", "end"]


def test_swarms_do_not_hear_each_other(pair: Pair) -> None:
    seen: list[int] = []
    pair.subscriber.subscribe(KEYS.heartbeat(), Heartbeat, lambda message: seen.append(message.sequence))
    pair.settle()
    pair.publisher.publish(Keys("other").heartbeat("core"), beat(1))
    pair.publisher.publish(KEYS.heartbeat("core"), beat(2))
    pair.until(lambda: 2 in seen)
    assert seen == [2]


def test_another_type_is_not_delivered(pair: Pair) -> None:
    seen: list[Heartbeat] = []
    pair.subscriber.subscribe("test/mixed", Heartbeat, seen.append)
    pair.settle()
    pair.publisher.publish("test/mixed", StopRequest(id="s"))
    pair.publisher.publish("test/mixed", beat(1))
    pair.until(lambda: bool(seen))
    assert seen == [beat(1)]
    if isinstance(pair.subscriber, ZenohBus):
        assert pair.subscriber.dropped == 1


def test_every_subscriber_gets_its_copy(pair: Pair) -> None:
    first: list[Heartbeat] = []
    second: list[Heartbeat] = []
    pair.subscriber.subscribe("test/x", Heartbeat, first.append)
    pair.subscriber.subscribe("test/*", Heartbeat, second.append, latest=True)
    pair.settle()
    pair.publisher.publish("test/x", beat(1))
    pair.until(lambda: bool(first and second))
    assert first == second == [beat(1)]


def test_a_closed_subscription_is_silent(pair: Pair) -> None:
    closed: list[Heartbeat] = []
    kept: list[Heartbeat] = []
    subscription = pair.subscriber.subscribe("test/x", Heartbeat, closed.append)
    pair.subscriber.subscribe("test/x", Heartbeat, kept.append)
    pair.settle()
    subscription.close()
    subscription.close()
    pair.publisher.publish("test/x", beat(1))
    pair.until(lambda: bool(kept))
    assert closed == []


def test_publishing_from_a_handler_does_not_recurse(pair: Pair) -> None:
    order: list[str] = []

    def on_first(_message: Heartbeat) -> None:
        order.append("first begins")
        pair.subscriber.publish("test/second", beat(2))
        order.append("first ends")

    pair.subscriber.subscribe("test/first", Heartbeat, on_first)
    pair.subscriber.subscribe("test/second", Heartbeat, lambda _message: order.append("second"))
    pair.settle()
    pair.publisher.publish("test/first", beat(1))
    pair.until(lambda: "second" in order)
    assert order == ["first begins", "first ends", "second"]


def test_close_ends_everything_and_may_be_repeated(pair: Pair) -> None:
    seen: list[Heartbeat] = []
    pair.subscriber.subscribe("test/x", Heartbeat, seen.append)
    pair.settle()
    assert pair.subscriber.connected()
    pair.subscriber.close()
    pair.subscriber.close()
    assert not pair.subscriber.connected()
    pair.publisher.publish("test/x", beat(1))
    pair.subscriber.publish("test/x", beat(1))
    pair.subscriber.subscribe("test/x", Heartbeat, seen.append).close()
    while pair.mailbox.deliver_one(0.05):  # what settling left behind
        assert seen == []
    assert seen == []


# ---------------------------------------------------------------- the live bus alone
@pytest.mark.parametrize("own", [False, True])
def test_latest_keeps_the_newest_of_each_key(remote: tuple[ZenohBus, ZenohBus, Pair], own: bool) -> None:
    publisher, subscriber, pair = remote
    seen: list[tuple[str, int]] = []
    subscriber.subscribe(
        KEYS.heartbeat(), Heartbeat, lambda message: seen.append((message.node, message.sequence)), latest=True
    )
    inbox = subscriber._inboxes[0]
    pair.settle()
    sender = subscriber if own else publisher
    for number in range(50):  # nobody delivers meanwhile: the node is busy
        sender.publish(KEYS.heartbeat("a"), beat(number, "a"))
        sender.publish(KEYS.heartbeat("b"), beat(number, "b"))
    sender.publish(KEYS.heartbeat("end"), beat(0, "end"))
    wait(lambda: any(key.endswith("/heartbeat/end") for key in inbox._waiting))
    pair.mailbox.drain()
    assert seen == [("a", 49), ("b", 49), ("end", 0)]
    sender.publish(KEYS.heartbeat("a"), beat(50, "a"))
    pair.until(lambda: seen[-1] == ("a", 50))


@pytest.fixture
def shown(hub: str) -> Iterator[tuple[ZenohBus, ZenohBus, Pair]]:
    """A publisher, a subscriber that only shows, and both as a pair."""
    mailbox = Mailbox()
    publisher, subscriber = ZenohBus(Mailbox(), hub=hub), ZenohBus(mailbox, hub=hub, only_shows=True)
    for bus in (publisher, subscriber):
        bus.wait_connected(DEADLINE_S)
    yield publisher, subscriber, Pair(publisher, subscriber, mailbox)
    publisher.close()
    subscriber.close()


def seen_obstacles(number: int) -> SeenObstacles:
    return SeenObstacles(host="r1", rows=((float(number), 2.0, 0.5, 0.5, 0.0, 0.0),), stamp_s=1.0)


def test_who_only_shows_fetches_the_newest_and_hears_heartbeats_at_once(
    shown: tuple[ZenohBus, ZenohBus, Pair],
) -> None:
    publisher, subscriber, pair = shown
    seen: list[float] = []
    beats: list[int] = []
    listening = subscriber.subscribe(
        KEYS.obstacles(), SeenObstacles, lambda message: seen.append(message.rows[0][0]), latest=True
    )
    subscriber.subscribe(KEYS.heartbeat(), Heartbeat, lambda message: beats.append(message.sequence), latest=True)
    pair.settle()
    last = 2 * FETCHED_AT_ONCE
    for number in range(last + 1):
        publisher.publish(KEYS.obstacles("r1"), seen_obstacles(number))
    publisher.publish(KEYS.heartbeat("a"), beat(7, "a"))
    inbox = next(each for each in subscriber._inboxes if each.kind is Heartbeat)
    wait(lambda: bool(inbox._waiting))  # it came behind the others, and did not wait for a fetch
    assert seen == []
    assert pair.mailbox.fetch()  # more than one fetch takes
    pair.until(lambda: bool(seen) and seen[-1] == last)
    assert 2 <= len(seen) <= 4
    assert beats == [7]
    assert pair.mailbox.fetch_s == FETCH_S
    listening.close()
    assert pair.mailbox.fetch_s == math.inf
    publisher.publish(KEYS.obstacles("r1"), seen_obstacles(0))
    pair.settle()
    assert seen[-1] == last


def test_every_node_fetches_states_and_hears_all_else_at_once(remote: tuple[ZenohBus, ZenohBus, Pair]) -> None:
    publisher, subscriber, pair = remote
    seen: list[tuple[str, int]] = []
    beats: list[int] = []

    def tell(host: str, number: int) -> None:
        row = (1.0,)
        publisher.publish(
            KEYS.state("swarm", host),
            RobotStates(
                host=host, robots=(host,), x_m=row, y_m=row, heading_rad=row, speed_m_s=row, turn_rad_s=row,
                radius_m=row, sequence=number, stamp_s=0.0,
            ),
        )  # fmt: skip

    listening = subscriber.subscribe(
        KEYS.state(), RobotStates, lambda message: seen.append((message.host, message.sequence)), latest=True
    )
    subscriber.subscribe(KEYS.heartbeat(), Heartbeat, lambda message: beats.append(message.sequence), latest=True)
    pair.settle()
    for number in range(FETCHED_AT_ONCE // 4):
        tell("r1", number)
        tell("r2", number)
    last = FETCHED_AT_ONCE // 4 - 1
    publisher.publish(KEYS.heartbeat("a"), beat(7, "a"))
    inbox = next(each for each in subscriber._inboxes if each.kind is Heartbeat)
    wait(lambda: bool(inbox._waiting))
    assert seen == [], "nothing was woken by a state"
    assert pair.mailbox.fetch_s == FETCH_S
    assert not pair.mailbox.fetch()
    assert len(seen) == len(dict(seen)), "the newest of each robot"

    def arrived() -> bool:
        """Repeat the last states: the heartbeat can overtake them, and a hub without processor time drops some."""
        tell("r1", last)
        tell("r2", last)
        return dict(seen) == {"r1": last, "r2": last}

    pair.until(arrived)
    tell("r1", last + 1)
    pair.until(lambda: ("r1", last + 1) in seen)
    assert beats == [7]
    listening.close()
    assert pair.mailbox.fetch_s == math.inf


def test_what_is_fetched_is_checked_like_all_else(
    hub: str, shown: tuple[ZenohBus, ZenohBus, Pair], capsys: pytest.CaptureFixture[str]
) -> None:
    _, subscriber, pair = shown
    seen: list[SeenObstacles] = []
    subscriber.subscribe(KEYS.obstacles(), SeenObstacles, seen.append, latest=True)
    pair.settle()
    raw = zenoh.open(client_config(hub, multicast=False))
    good = encode(seen_obstacles(3))
    for key, payload in (("r2", b""), ("r3", b"\xff\xfe"), ("r4", encode(beat(1))), ("r1", good)):
        raw.put(f"test/{key}/obstacles/{key}", payload)
    pair.until(lambda: bool(seen))
    untyped(raw.close)
    assert seen == [seen_obstacles(3)]
    assert subscriber.dropped == 3
    assert capsys.readouterr().out.count("message dropped") == 3


def wait(condition: Callable[[], bool]) -> None:
    end_s = time.monotonic() + DEADLINE_S
    while not condition():
        time.sleep(0.002)
        assert time.monotonic() < end_s, "the condition never came"


def test_bytes_that_are_no_message_are_counted_and_logged_once(
    hub: str, remote: tuple[ZenohBus, ZenohBus, Pair], capsys: pytest.CaptureFixture[str]
) -> None:
    _, subscriber, pair = remote
    seen: list[Heartbeat] = []
    subscriber.subscribe("test/raw", Heartbeat, seen.append)
    pair.settle()
    other_version = encode(beat(1)).replace(b"Heartbeat/1", b"Heartbeat/2")
    raw = zenoh.open(client_config(hub, multicast=False))
    for payload in (b"", b"\xff\xfe", other_version, encode(StopRequest(id="s")), encode(beat(7))):
        raw.put("test/r9/raw", payload)
    pair.until(lambda: bool(seen))
    untyped(raw.close)
    assert seen == [beat(7)]
    assert subscriber.dropped == 4
    assert capsys.readouterr().out.count("message dropped") == 1


def test_a_number_that_cannot_be_is_dropped_and_named_once_per_sender_and_second(
    remote: tuple[ZenohBus, ZenohBus, Pair], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    publisher, subscriber, pair = remote
    clock = SimClock()
    monkeypatch.setattr(subscriber, "_clock", clock)
    clock.advance_to(100.0)
    seen: list[SeenObstacles] = []
    subscriber.subscribe(KEYS.obstacles(), SeenObstacles, seen.append)
    pair.settle()

    def tell(host: str, half_m: float) -> None:
        rows = ((1.0, 2.0, half_m, 0.5, 0.0, 0.0),)
        publisher.publish(KEYS.obstacles(host), SeenObstacles(host=host, rows=rows, stamp_s=1.0))

    for count in (1, 2):
        for half_m in (math.nan, 1e308, -1.0):
            tell("r1", half_m)
            tell("r2", half_m)
        pair.until(functools.partial(lambda dropped: subscriber.dropped == dropped, 6 * count))
        clock.advance_to(102.0)
    tell("r1", 0.5)
    pair.until(lambda: bool(seen))
    assert len(seen) == 1
    lines = [line for line in capsys.readouterr().out.splitlines() if "message dropped" in line]
    assert len(lines) == 4
    assert sum("obstacles/r1" in line for line in lines) == 2
    assert all("$.rows[" in line for line in lines)


def test_the_bus_lives_without_a_hub() -> None:
    mailbox = Mailbox()
    bus = ZenohBus(mailbox, hub=free_endpoint())
    seen: list[Heartbeat] = []
    bus.subscribe("test/x", Heartbeat, seen.append)
    bus.publish("test/x", beat(1))
    mailbox.drain()
    assert seen == [beat(1)]
    assert bus.unsent == 1
    assert not bus.connected()
    with pytest.raises(Unreachable, match="no hub answers") as caught:
        bus.wait_connected(0.05)
    assert "fullswarm up" in caught.value.hint
    assert caught.value.where.startswith("tcp/127.0.0.1:")
    bus.close()
    with pytest.raises(Unreachable, match="closed"):
        bus.wait_connected(0.05)


def test_many_keys_do_not_grow_the_bus(remote: tuple[ZenohBus, ZenohBus, Pair]) -> None:
    publisher, _, pair = remote
    seen: list[int] = []
    total = CACHED_KEYS + 200
    pair.subscriber.subscribe("test/reply/*", Heartbeat, lambda message: seen.append(message.sequence))
    pair.settle()
    for number in range(total):
        publisher.publish(f"test/reply/{number}", beat(number))
    pair.until(lambda: len(seen) == total)
    assert len(publisher._publishers) <= CACHED_KEYS
    assert len(publisher._routes) <= CACHED_KEYS


def test_a_bad_key_or_expression_does_no_harm(remote: tuple[ZenohBus, ZenohBus, Pair]) -> None:
    publisher, subscriber, _ = remote
    publisher.publish("test//x#", beat(1))
    assert publisher.unsent == 1
    with pytest.raises(ConfigError, match="not a key expression"):
        subscriber.subscribe("test//x", Heartbeat, print)
    with pytest.raises(ConfigError, match="not the address of a hub"):
        ZenohBus(Mailbox(), hub="127.0.0.1:7447")


def test_commands_and_stops_are_urgent() -> None:
    urgent = [KEYS.command("r"), KEYS.control_requests("r", "b"), KEYS.centralised_request("b"), KEYS.stop,
              KEYS.centralised_commands("b"), KEYS.estop, KEYS.estop_receipt("r"), KEYS.heartbeat("n"),
              KEYS.behaviour_request]  # fmt: skip
    others = [KEYS.state("1_2", "h"), KEYS.health("command"), KEYS.ack("command"), KEYS.summary("stop"),
              KEYS.behaviour_status, KEYS.measurement("command", "command")]  # fmt: skip
    assert all(is_urgent(key) for key in urgent)
    assert not any(is_urgent(key) for key in others)


def test_a_command_goes_through(remote: tuple[ZenohBus, ZenohBus, Pair]) -> None:
    publisher, _, pair = remote
    seen: list[Command] = []
    pair.subscriber.subscribe(KEYS.command("r1"), Command, seen.append)
    pair.settle()
    order = Command(robot="r1", request_id="q", linear_m_s=0.1, angular_rad_s=0.0, ttl_s=0.3, sequence=1, stamp_s=0.0)
    publisher.publish(KEYS.command("r1"), order)
    pair.until(lambda: seen == [order])


# ---------------------------------------------------------------- the hub
def test_a_port_in_use_is_explained(hub: str) -> None:
    with pytest.raises(ConfigError, match="another program listens") as caught:
        Hub(hub).open()
    assert caught.value.where == hub
    assert caught.value.hint


def test_the_hub_opens_once_closes_twice_and_tells_its_clients() -> None:
    hub = Hub(free_endpoint())
    hub.open()
    hub.open()
    bus = ZenohBus(Mailbox(), hub=hub.endpoint)
    bus.wait_connected(DEADLINE_S)
    hub.close()
    hub.close()
    wait(lambda: not bus.connected())
    hub.open()
    bus.wait_connected(DEADLINE_S)
    bus.close()
    hub.close()


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "localhost", "[::1]", "[::ffff:127.0.0.1]"])
def test_loopback_is_open_to_all(host: str) -> None:
    check_endpoint(f"tcp/{host}:7447", insecure_network=False)


@pytest.mark.parametrize("host", ["0.0.0.0", "[::]", "192.168.1.5", "robot7.local", "[::ffff:10.0.0.1]", "127.1"])
def test_the_network_needs_a_deliberate_word(host: str) -> None:
    endpoint = f"tcp/{host}:7447"
    with pytest.raises(ConfigError, match="any computer on that network could drive the robots") as caught:
        Hub(endpoint)
    assert "--insecure-network" in caught.value.hint
    Hub(endpoint, insecure_network=True)


@pytest.mark.parametrize(
    "text", ["", "127.0.0.1:7447", "tcp/127.0.0.1", "tcp/127.0.0.1:0", "tcp/127.0.0.1:70000", "tcp/a b:1",
             "udp/127.0.0.1:7447", "tcp/127.0.0.1:7447,tcp/0.0.0.0:7447", "tcp/127.0.0.1:7447\n"]
)  # fmt: skip
def test_what_is_not_an_address_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="not the address of a hub"):
        check_endpoint(text, insecure_network=True)


def test_one_default_hub() -> None:
    assert DEFAULT_HUB == config.DEFAULT_HUB


def test_the_package_does_not_load_zenoh() -> None:
    script = "import sys, fullswarm.bus; sys.exit('zenoh' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0
