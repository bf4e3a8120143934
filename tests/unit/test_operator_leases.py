from __future__ import annotations

from collections.abc import Iterator

import pytest

from fullswarm.messages import Lease, LeaseRequest, Leases, Message
from fullswarm.operator.leases import RENEW_S, SETTLE_S, LeaseHolder
from fullswarm.store import Store
from tests.unit.core_swarm import KEYS, Swarm

ANNA, BOB = "anna@lab", "bob@lab"


class Desk:
    """One operator's holder on a swarm with a real core, and its callbacks."""

    def __init__(self, swarm: Swarm, name: str) -> None:
        self.lost: list[tuple[tuple[str, ...], str]] = []
        self.refused: list[tuple[tuple[str, ...], str]] = []
        self.changes: list[dict[str, str]] = []
        self.holder = LeaseHolder(
            swarm.bus,
            KEYS,
            swarm.runtime,
            name,
            on_change=lambda leases: self.changes.append({robot: each.operator for robot, each in leases.items()}),
            on_lost=lambda robots, operator: self.lost.append((robots, operator)),
            on_refused=lambda robots, operator: self.refused.append((robots, operator)),
        )


@pytest.fixture
def swarm() -> Iterator[Swarm]:
    store = Store()
    store.set("group/pair", {"robots": ["r0", "r1"]}, "test")
    made = Swarm(store=store)
    yield made
    made.close()


@pytest.fixture
def anna(swarm: Swarm) -> Desk:
    return Desk(swarm, ANNA)


@pytest.fixture
def bob(swarm: Swarm) -> Desk:
    return Desk(swarm, BOB)


def say(swarm: Swarm, sequence: int, core: str = "core-1", **holders: str) -> None:
    """Speak as the core."""
    leases = tuple(Lease(robot=robot, operator=operator, age_s=0.0) for robot, operator in holders.items())
    swarm.bus.publish(KEYS.leases, Leases(leases=leases, core=core, sequence=sequence))
    swarm.run(0.001)


def test_it_holds_for_as_long_as_it_lives(swarm: Swarm, anna: Desk) -> None:
    anna.holder.hold(["r0", "r1"])
    swarm.run(10.0)
    assert anna.holder.held() == ("r0", "r1")
    assert anna.changes == [{"r0": ANNA, "r1": ANNA}], "said once, although the core says it each second"
    anna.holder.release(["r0"])
    swarm.run(0.1)
    assert anna.holder.held() == ("r1",)
    swarm.run(5.0)
    assert anna.holder.held() == ("r1",)
    anna.holder.close()
    swarm.run(0.1)
    assert [lease for message in swarm.sent(Leases)[-1:] for lease in getattr(message, "leases", ())] == []


def test_a_take_over_is_reported_to_both_once(swarm: Swarm, anna: Desk, bob: Desk) -> None:
    anna.holder.hold(["r0", "r1"])
    swarm.run(2.0)
    bob.holder.hold(["r0"], take=True)
    swarm.run(5.0)
    assert anna.lost == [(("r0",), BOB)]
    assert (anna.holder.held(), bob.holder.held()) == (("r1",), ("r0",))
    assert anna.holder.held_by_others(["r0", "r1"]) == {"r0": BOB}
    assert (anna.refused, bob.lost, bob.refused) == ([], [], [])


def test_a_lost_robot_does_not_come_back_without_a_request(swarm: Swarm, anna: Desk, bob: Desk) -> None:
    anna.holder.hold(["r0"])
    swarm.run(1.0)
    bob.holder.hold(["r0"], take=True)
    swarm.run(2.0)
    bob.holder.release()
    swarm.run(5.0)
    assert anna.holder.held() == ()
    anna.holder.hold(["r0"])
    swarm.run(0.1)
    assert anna.holder.held() == ("r0",)
    bob.holder.hold(["r0"], take=True)
    swarm.run(2.0)
    assert anna.lost == [(("r0",), BOB)] * 2, "once per loss"


def test_a_word_that_was_under_way_does_not_end_a_take_over(swarm: Swarm, bob: Desk) -> None:
    """The core has not received it yet when it reports once more that anna holds the robot."""
    swarm.core.close()
    say(swarm, 1, r0=ANNA)
    bob.holder.hold(["r0"], take=True)
    say(swarm, 2, r0=ANNA)
    say(swarm, 3, r0=BOB)
    assert (bob.holder.wanted(), bob.refused, bob.lost) == (("r0",), [], [])
    swarm.run(RENEW_S)
    renewal = swarm.sent(LeaseRequest)[-1]
    assert (renewal.operator, renewal.robots, renewal.take) == (BOB, ("r0",), False)  # type: ignore[attr-defined]  # a LeaseRequest


def test_a_lost_take_over_is_sent_again(swarm: Swarm, anna: Desk, bob: Desk) -> None:
    anna.holder.hold(["r0"])
    swarm.run(1.0)
    swarm.bus.drop = lambda _key, message: isinstance(message, LeaseRequest) and message.take
    bob.holder.hold(["r0"], take=True)
    swarm.bus.drop = lambda _key, _message: False
    swarm.run(RENEW_S + 0.1)
    assert bob.holder.held() == ("r0",)
    assert anna.lost == [(("r0",), BOB)]


def test_a_refusal_is_reported_once_and_nothing_is_waited_for(swarm: Swarm, anna: Desk, bob: Desk) -> None:
    anna.holder.hold(["r0"])
    swarm.run(0.5)
    bob.holder.hold(["r0", "r2"])
    swarm.run(SETTLE_S + 1.1)
    assert bob.refused == [(("r0",), ANNA)]
    assert (bob.holder.held(), bob.lost) == (("r2",), [])
    anna.holder.release()
    swarm.run(5.0)
    assert bob.holder.held() == ("r2",)


def test_a_new_core_gives_back_what_was_held(swarm: Swarm, anna: Desk, bob: Desk) -> None:
    anna.holder.hold(["r0"])
    swarm.run(1.5)
    swarm.core.close()
    swarm.start_core(Store())
    swarm.run(RENEW_S + 0.1)
    assert anna.holder.held() == ("r0",)
    assert (anna.lost, anna.refused) == ([], [])
    say(swarm, 999, core="core-1", r0=BOB)  # of the core that is gone
    assert anna.holder.held() == ("r0",)
    assert anna.lost == []


def test_a_new_core_may_have_given_the_robot_to_another(swarm: Swarm, anna: Desk, bob: Desk) -> None:
    anna.holder.hold(["r0"])
    swarm.run(1.5)
    swarm.core.close()
    swarm.start_core(Store())
    bob.holder.hold(["r0"])
    swarm.run(5.0)
    assert anna.lost == [(("r0",), BOB)]
    assert bob.holder.held() == ("r0",)


def test_words_twice_and_late_change_nothing(swarm: Swarm, anna: Desk) -> None:
    swarm.core.close()
    anna.holder.hold(["r0"])
    say(swarm, 5, r0=ANNA)
    say(swarm, 4, r0=BOB)
    say(swarm, 5, r0=BOB)
    assert anna.holder.held() == ("r0",)
    say(swarm, 6, r0=BOB)
    say(swarm, 6, r0=BOB)
    say(swarm, 7, r0=BOB)
    assert anna.lost == [(("r0",), BOB)]


def test_a_group_is_held_robot_by_robot(swarm: Swarm, anna: Desk, bob: Desk) -> None:
    anna.holder.hold(["@pair"])
    swarm.run(4.0)
    assert anna.holder.held() == ("r0", "r1")
    bob.holder.hold(["r0"], take=True)
    swarm.run(2.0)
    bob.holder.release()
    swarm.run(4.0)
    assert anna.lost == [(("r0",), BOB)]
    assert anna.holder.held() == ("r1",), "a robot lost does not come back with its group"
    anna.holder.release(["@pair"])
    swarm.run(2.0)
    assert (anna.holder.held(), anna.holder.wanted()) == ((), ())


def test_it_survives_a_bus_that_loses_every_other_word(swarm: Swarm, anna: Desk) -> None:
    counts = {LeaseRequest: 0, Leases: 0}

    def drop(_key: str, message: Message) -> bool:
        kind = type(message)
        if kind not in counts:
            return False
        counts[kind] += 1
        return counts[kind] % 2 == 0

    swarm.bus.drop = drop
    anna.holder.hold(["r0"])
    swarm.run(3.0)
    for _ in range(20):
        swarm.run(0.5)
        assert anna.holder.held() == ("r0",)
    assert anna.lost == []
