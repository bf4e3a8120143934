"""The shared table converges: whatever is written where, lost, doubled or cut off, once the network carries again."""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.agent.messaging.table import ENTRY_BYTES, MOST_KEYS, ReplicatedTable
from fullswarm.errors import ConfigError
from fullswarm.messages import LARGEST_STAMP, TableEntry, TableUpdate

KEYS = ("best", "best/2", "most", "a", "b", "c")
MERGES = {"best": min, "most": max}


@dataclass
class Cloud:
    """Replicas that broadcast to each other in rounds; each link may be cut, and loses messages by chance."""

    count: int
    loss: float
    seed: int
    replicas: list[ReplicatedTable] = field(init=False)
    side: list[int] = field(init=False)

    def __post_init__(self) -> None:
        self.replicas = [ReplicatedTable(f"r{row}", MERGES) for row in range(self.count)]
        self.side = [0] * self.count
        self.chance = random.Random(self.seed)

    def round(self, line: bool = False) -> None:
        """Each replica broadcasts once, with its digest; on a line only the next ones receive it."""
        for sender, replica in enumerate(self.replicas):
            entries, digest = replica.take(), replica.digest
            for receiver, other in enumerate(self.replicas):
                linked = not line or abs(sender - receiver) == 1
                if receiver == sender or not linked or self.side[sender] != self.side[receiver]:
                    continue
                if self.chance.random() >= self.loss:
                    other.receive(entries)
                    other.compare(digest)
                if self.chance.random() < 0.1:  # once more, late
                    other.receive(entries)

    @property
    def agree(self) -> bool:
        return len({tuple(each.items()) for each in self.replicas}) == 1


writes = st.tuples(st.just("put"), st.integers(0, 4), st.sampled_from(KEYS), st.integers(-3, 3))
cuts = st.tuples(st.just("cut"), st.lists(st.integers(0, 2), min_size=5, max_size=5))
rounds = st.tuples(st.just("round"))


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.one_of(writes, writes, cuts, rounds), max_size=40), st.sampled_from([0.0, 0.3, 0.7]), st.integers(0, 9)
)
def test_all_replicas_agree_once_partitions_have_healed(
    operations: list[tuple[Any, ...]],
    loss: float,
    seed: int,
) -> None:
    cloud = Cloud(5, loss, seed)
    written: dict[str, list[float]] = {}
    for name, *rest in operations:
        if name == "put":
            row, key, value = rest
            cloud.replicas[row].put(key, value)
            written.setdefault(key, []).append(float(value))
        elif name == "cut":
            cloud.side = rest[0]
        else:
            cloud.round()
    cloud.side = [0] * 5
    for _ in range(100):
        if cloud.agree and len({each.digest for each in cloud.replicas}) == 1:
            break
        cloud.round(line=True)  # several hops
    assert cloud.agree
    found = dict(cloud.replicas[0].items())
    assert found.keys() == written.keys()
    for key, values in written.items():
        if key.startswith("best"):
            assert found[key] == min(values)
        elif key == "most":
            assert found[key] == max(values)
        else:
            assert found[key] in values


def test_the_last_writer_wins_also_after_the_partition_in_which_it_wrote() -> None:
    cloud = Cloud(4, 0.0, 1)
    cloud.replicas[0].put("a", 1.0)
    for _ in range(3):
        cloud.round()
    cloud.side = [0, 0, 1, 1]
    cloud.replicas[1].put("a", 2.0)
    cloud.replicas[3].put("a", 3.0)
    cloud.replicas[3].put("a", 4.0)  # the later one by the Lamport clock
    for _ in range(5):
        cloud.round()
    assert [each.get("a") for each in cloud.replicas] == [2.0, 2.0, 4.0, 4.0]
    cloud.side = [0] * 4
    for _ in range(5):
        cloud.round()
    assert [each.get("a") for each in cloud.replicas] == [4.0] * 4
    assert cloud.replicas[0].writer_of("a") == "r3"


entries = st.builds(
    TableEntry, st.sampled_from(("best", "a")), st.sampled_from([0.0, -0.0, 1.0, 2.0]), st.integers(0, 3),
    st.sampled_from(("r0", "r1")),
)  # fmt: skip


@given(st.lists(entries, max_size=8), st.randoms(use_true_random=False))
def test_the_order_and_the_repetition_of_entries_do_not_matter(found: list[TableEntry], chance: random.Random) -> None:
    one, other = ReplicatedTable("x", MERGES), ReplicatedTable("x", MERGES)
    one.receive(found)
    shuffled = found + found[:3]
    chance.shuffle(shuffled)
    for each in shuffled:
        other.receive([each])
    assert one.items() == other.items()
    assert one.digest == other.digest


def test_nothing_is_sent_when_nothing_is_new() -> None:
    cloud = Cloud(3, 0.0, 1)
    cloud.replicas[0].put("a", "red")
    cloud.replicas[1].put("place", [1.0, 2.0])
    for _ in range(5):
        cloud.round()
    assert not any(each.unsent for each in cloud.replicas)
    cloud.replicas[0].put("a", "red")
    assert not cloud.replicas[0].unsent
    assert cloud.replicas[2].items() == [("a", "red"), ("place", (1.0, 2.0))]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 100))
def test_too_many_keys_of_two_sides_leave_the_same_ones_on_all(seed: int) -> None:
    cloud = Cloud(2, 0.3, seed)
    cloud.side = [0, 1]
    chance = random.Random(seed)
    names = [f"k{number:03d}" for number in chance.sample(range(1000), 2 * MOST_KEYS)]
    for number, name in enumerate(names):
        cloud.replicas[number % 2].put(name, number)
    cloud.side = [0, 0]
    for _ in range(150):
        cloud.round()
    assert cloud.agree
    assert [key for key, _ in cloud.replicas[0].items()] == sorted(names)[:MOST_KEYS]
    assert cloud.replicas[0].evicted + cloud.replicas[1].evicted >= 2 * MOST_KEYS - MOST_KEYS
    with pytest.raises(ConfigError, match="the table is full"):
        cloud.replicas[0].put("another", 1.0)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), [1.0] * 9, None, {"a": 1.0}, "x" * ENTRY_BYTES, [[1.0]]])
def test_a_value_that_no_message_can_carry_is_refused(value: object) -> None:
    table = ReplicatedTable("r1")
    with pytest.raises(ConfigError, match="the table cannot hold"):
        table.put("a", value)  # type: ignore[arg-type]  # on purpose
    assert not table.items()


def test_a_message_of_a_table_is_of_256_bytes_at_most_and_no_key_waits_for_ever() -> None:
    table = ReplicatedTable("robot-7")
    for number in range(MOST_KEYS):
        table.put(f"task/{number}", [1.5 * number, 2.0, float(number)])
    seen: set[str] = set()
    for turn in range(40):
        table.put("task/0", [float(turn), 0.0, 0.0])  # again and again
        found = table.take()
        assert found
        seen |= {each.key for each in found}
        update = TableUpdate(robot="", team=0, law="", entries=found, digest=table.digest)
        empty = TableUpdate(robot="", team=0, law="")
        size = len(msgspec.msgpack.encode(update)) - len(msgspec.msgpack.encode(empty))
        assert size <= 256
    assert len(seen) == MOST_KEYS


def test_a_merge_that_fails_is_reported_and_the_newer_entry_stays() -> None:
    table = ReplicatedTable("r1", MERGES)
    table.put("best", 1.0)
    table.receive([TableEntry("best", "a text", 7, "r2")])
    assert "TypeError" in table.failure
    assert table.get("best") == "a text"


def test_a_stamp_at_the_end_of_the_range_does_no_harm() -> None:
    table = ReplicatedTable("r1")
    table.receive([TableEntry("a", 1.0, LARGEST_STAMP, "r2")])
    table.put("b", 1.0)
    assert all(each.stamp <= LARGEST_STAMP for each in table.take())
