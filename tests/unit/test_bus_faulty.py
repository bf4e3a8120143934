"""The bad network: its text, its model on a simulated clock, and a swarm that has to live with it."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import count, pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.bus.base import Bus
from fullswarm.bus.local import LocalBus
from fullswarm.bus.network_faults import (
    DETOUR_S,
    EXAMPLE,
    FaultyBus,
    Network,
    Partition,
    check_names,
    faulty,
    parse_network,
)
from fullswarm.clock import SimClock
from fullswarm.errors import ConfigError
from fullswarm.messages import Heartbeat
from fullswarm.runtime import Mailbox, Runtime

PERIOD_S = 0.01


# ---------------------------------------------------------------- the text
def test_the_example() -> None:
    cut = Partition((frozenset({"r1", "r2"}), frozenset({"*"})))
    assert parse_network(EXAMPLE) == Network(0.2, 0.1, 0.05, partitions=(cut,))


@pytest.mark.parametrize(
    "text", ["delay=100ms±50", "delay=100ms+-50", "delay=0.1s±50ms", " delay = 100ms ± 50 ", "jitter=50ms,delay=100ms"]
)
def test_ways_to_write_a_delay(text: str) -> None:
    assert parse_network(text) == Network(delay_s=0.1, jitter_s=0.05)


def test_all_conditions_and_two_partitions() -> None:
    found = parse_network("duplicate=5%,reorder=.1,loss=0.5,partition=r1|core@5s-10s,partition=a|b|*@800ms")
    first = Partition((frozenset({"r1"}), frozenset({"core"})), 5.0, 10.0)
    second = Partition((frozenset({"a"}), frozenset({"b"}), frozenset({"*"})), 0.8, math.inf)
    assert found == Network(0.5, duplicate=0.05, reorder=0.1, partitions=(first, second))
    assert found.names == {"r1", "core", "a", "b"}


@pytest.mark.parametrize(
    ("text", "where", "what"),
    [
        ("loss=20", "'loss=20' at character 1", "not a share"),
        ("loss=101%", "'loss=101%' at character 1", "not a share"),
        ("loss=-1%", "'loss=-1%' at character 1", "not a share"),
        ("loss=20%, lag=3s", "'lag=3s' at character 11", "not a condition of a network"),
        ("loss=20%,dely=3s", "'dely=3s' at character 10", "did you mean 'delay'?"),
        ("delay=100", "'delay=100' at character 1", "no unit"),
        ("delay=soon", "'delay=soon' at character 1", "not a time"),
        ("delay=61s", "'delay=61s' at character 1", "too long"),
        ("delay=50ms±100", "'delay=50ms±100'", "the jitter is longer"),
        ("loss=1%,loss=2%", "'loss=2%' at character 9", "given twice"),
        ("delay=9ms±1,jitter=1ms", "'jitter=1ms' at character 13", "given twice"),
        ("loss", "'loss' at character 1", "a value is missing"),
        ("", "''", "no condition"),
        ("loss=1%,", "'loss=1%,'", "no condition between the commas"),
        ("partition=r1", "'partition=r1' at character 1", "two sides"),
        ("partition=r1+|*", "'partition=r1+|*' at character 1", "empty"),
        ("partition=r1|r1", "'partition=r1|r1' at character 1", "named twice"),
        ("partition=r 1|*", "'partition=r 1|*' at character 1", "cannot name"),
        ("partition=r1|*@5", "'partition=r1|*@5' at character 1", "not a time"),
        ("partition=r1|*@5s-4s", "'partition=r1|*@5s-4s' at character 1", "ends before it begins"),
    ],
)
def test_errors_say_where_and_what(text: str, where: str, what: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_network(text, "--network")
    assert str(caught.value).startswith(f"--network: {where}: ")
    assert what in str(caught.value)
    assert caught.value.exit_code == 2


@given(st.text(alphabet="losdelayprtin=%,.±+-|*@0159ms ", max_size=40))
def test_any_text_parses_or_is_refused_with_reason(text: str) -> None:
    try:
        network = parse_network(text)
    except ConfigError as error:
        where = error.where
    else:
        assert 0.0 <= network.jitter_s <= network.delay_s
        where = "--network"
    assert where.startswith("--network")


@given(
    st.integers(0, 100), st.integers(0, 2000), st.integers(0, 2000), st.integers(0, 100), st.integers(0, 100)
)  # fmt: skip
def test_what_is_written_is_what_is_meant(loss: int, delay: int, jitter: int, duplicate: int, reorder: int) -> None:
    jitter = min(jitter, delay)
    found = parse_network(f"reorder={reorder}%,loss={loss}%,delay={delay}ms±{jitter},duplicate={duplicate}%")
    expected = (loss / 100, delay * 0.001, jitter * 0.001, duplicate / 100, reorder / 100)
    got = (found.loss, found.delay_s, found.jitter_s, found.duplicate, found.reorder)
    assert got == pytest.approx(expected)


def test_a_partition_that_names_a_stranger() -> None:
    with pytest.raises(ConfigError, match=r"names 'rovr1'.*not a process of this swarm.*did you mean 'rover1'"):
        check_names(parse_network("partition=rovr1|core"), ("rover1", "core"))


@pytest.mark.parametrize(
    ("spec", "one", "other", "parted"),
    [
        ("partition=r1+r2|*", "r1", "core", True),
        ("partition=r1+r2|*", "core", "r2", True),
        ("partition=r1+r2|*", "r1", "r2", False),
        ("partition=r1+r2|*", "r3", "core", False),
        ("partition=r1|core", "r1", "r2", False),  # r2 is on no side
        ("partition=r1|r2|*", "r1", "r2", True),
        ("partition=r1|r2|*", "r3", "", False),  # a message that does not say whose it is comes from the rest
        ("partition=r1|*", "r1", "", True),
    ],
)
def test_sides(spec: str, one: str, other: str, parted: bool) -> None:
    (partition,) = parse_network(spec).partitions
    assert partition.parts(one, other, 0.0) is partition.parts(other, one, 0.0) is parted


# ---------------------------------------------------------------- the model
class Post:
    """Numbered messages from one process to another, sent every 10 ms on a simulated clock."""

    def __init__(self, spec: str, seed: int = 0, name: str = "r1", since_s: float = 0.0) -> None:
        self.runtime = Runtime(SimClock(), Mailbox())
        self.local = LocalBus(self.runtime.mailbox)
        self.bus = faulty(self.local, self.runtime, spec, seed, name, since_s)
        self.got: list[tuple[int, float]] = []
        self.sent_s: list[float] = []

    def listen(self, handler: Callable[[Heartbeat], None] | None = None) -> None:
        self.bus.subscribe("s/heartbeat/*", Heartbeat, handler or self._hear)

    def _hear(self, beat: Heartbeat) -> None:
        self.got.append((beat.sequence, self.runtime.now_s()))

    def send(self, messages: int, node: str = "core") -> None:
        numbers = count()

        def tick() -> None:
            number = next(numbers)
            if number < messages:
                self.sent_s.append(self.runtime.now_s())
                beat = Heartbeat(node=node, process="p", sequence=number)
                self.local.publish(f"s/heartbeat/{node}", beat, sender=node)

        timer = self.runtime.every(PERIOD_S, tick)
        self.runtime.run(messages * PERIOD_S + 1.0)
        timer.cancel()

    @property
    def numbers(self) -> list[int]:
        return [number for number, _ in self.got]

    def delays_s(self) -> list[float]:
        return [arrived_s - self.sent_s[number] for number, arrived_s in self.got]


def carried(spec: str, messages: int = 400, seed: int = 0) -> Post:
    post = Post(spec, seed)
    post.listen()
    post.send(messages)
    return post


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 100), st.integers(0, 1000))
def test_the_share_that_is_lost(percent: int, seed: int) -> None:
    post = carried(f"loss={percent}%", 1000, seed)
    share = percent / 100
    # Five standard deviations: one in a million would fail by chance, and the seed makes it repeat.
    assert abs(1.0 - len(post.got) / 1000 - share) <= 5.0 * math.sqrt(share * (1 - share) / 1000)
    assert post.numbers == sorted(set(post.numbers))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 300), st.integers(0, 300), st.integers(0, 1000))
def test_delays_keep_bounds_and_order(delay_ms: int, jitter_ms: int, seed: int) -> None:
    jitter_ms = min(delay_ms, jitter_ms)
    post = carried(f"delay={delay_ms}ms±{jitter_ms}", 200, seed)
    assert post.numbers == list(range(200))
    assert min(post.delays_s()) >= (delay_ms - jitter_ms) / 1000 - 1e-9
    assert max(post.delays_s()) <= (delay_ms + jitter_ms) / 1000 + 1e-9


def test_a_lone_message_meets_the_whole_range_of_delays() -> None:
    delays_s = [carried("delay=100ms±50", 1, seed).delays_s()[0] for seed in range(300)]
    assert min(delays_s) < 0.055
    assert max(delays_s) > 0.145
    assert sum(delays_s) / 300 == pytest.approx(0.1, abs=0.01)


def test_reordered_messages_arrive_all_the_same() -> None:
    post = carried("reorder=20%,delay=20ms")
    assert sorted(post.numbers) == list(range(400))
    overtaken = sum(later < earlier for earlier, later in pairwise(post.numbers))
    assert 20 < overtaken < 120
    assert max(post.delays_s()) <= 0.02 + DETOUR_S + 1e-9


def test_doubled_messages() -> None:
    post = carried("duplicate=25%")
    assert set(post.numbers) == set(range(400))
    assert 60 <= len(post.numbers) - 400 <= 140


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32))
def test_a_seed_repeats_and_another_does_not(seed: int) -> None:
    spec = "loss=30%,delay=50ms±50,duplicate=10%,reorder=10%"
    first = carried(spec, 100, seed).got
    assert carried(spec, 100, seed).got == first
    assert carried(spec, 100, seed + 1).got != first


def test_each_receiver_loses_others() -> None:
    posts = [Post("loss=50%", 1, name) for name in ("r1", "r2")]
    for post in posts:
        post.listen()
        post.send(200)
    assert posts[0].numbers != posts[1].numbers


def test_the_traffic_of_one_sender_does_not_change_the_fate_of_anothers() -> None:
    alone, busy = Post("loss=50%"), Post("loss=50%")
    busy.listen()
    busy.send(50, node="world")
    busy.got.clear()
    busy.sent_s.clear()
    alone.listen()
    alone.send(100)
    busy.send(100)
    assert busy.numbers == alone.numbers


def test_a_partition_from_a_time_to_a_time() -> None:
    post = Post("partition=r1|*@1s-2s", since_s=0.5)
    post.listen()
    post.send(400)
    expected = [number for number in range(400) if 1.5 <= post.sent_s[number] < 2.5]
    assert sorted(set(range(400)) - set(post.numbers)) == expected
    assert isinstance(post.bus, FaultyBus)
    assert post.bus.counts.cut == len(expected) >= 100
    assert post.bus.counts.sent == 400


def test_what_a_process_tells_itself_is_left_alone() -> None:
    post = Post("loss=100%,delay=1s", name="core")
    post.listen()
    post.send(20)
    assert post.numbers == list(range(20))
    assert post.delays_s() == [0.0] * 20


def test_nodes_of_one_process_share_the_fate_of_a_message() -> None:
    post = Post("loss=50%")
    others: list[int] = []
    post.listen()
    post.listen(lambda beat: others.append(beat.sequence))
    post.send(200)
    assert post.numbers == others
    assert 60 < len(others) < 140


def test_the_end_of_a_subscription_and_of_the_bus() -> None:
    post = Post("delay=50ms")
    first: list[int] = []

    def hear(beat: Heartbeat) -> None:
        first.append(beat.sequence)

    subscription = post.bus.subscribe("s/heartbeat/*", Heartbeat, hear)
    post.listen()
    post.runtime.after(0.201, subscription.close)
    post.runtime.after(0.401, post.bus.close)
    post.send(100)
    subscription.close()
    assert first == list(range(15))  # sent at 10 to 150 ms
    assert post.numbers == list(range(35))
    assert not post.bus.connected()


def test_the_same_handler_may_listen_twice() -> None:
    post = Post("delay=5ms")
    one = post.bus.subscribe("s/heartbeat/*", Heartbeat, post._hear)
    post.bus.subscribe("s/heartbeat/*", Heartbeat, post._hear)
    post.send(1)
    assert post.numbers == [0, 0]
    one.close()
    one.close()
    post.got.clear()
    post.send(1)
    assert post.numbers == [0]


def test_a_refused_expression_leaves_nothing_behind() -> None:
    class Picky(LocalBus):
        def subscribe_with_sender(self, *_: object, **__: object) -> object:  # type: ignore[override]  # refuses everything
            raise ConfigError("no")

    runtime = Runtime(SimClock(), Mailbox())
    bus: Bus = faulty(Picky(runtime.mailbox), runtime, "loss=1%", 0, "r1")  # type: ignore[arg-type]  # as above
    for _ in range(2):
        with pytest.raises(ConfigError):
            bus.subscribe("?", Heartbeat, print)
