from __future__ import annotations

from collections.abc import Iterator

import pytest

from fullswarm.core.leases import CHECK_S, EXPIRE_S
from fullswarm.messages import BehaviourRequest, EStop, Lease, LeaseRequest, Leases, StopRequest
from fullswarm.store import Store
from tests.unit.core_swarm import KEYS, Swarm

ANNA, BOB = "anna@lab", "bob@lab"


class Table(Swarm):
    """A swarm with two operators who hold robots."""

    def hold(self, operator: str, *robots: str, take: bool = False) -> None:
        self.bus.publish(KEYS.lease_request, LeaseRequest(operator=operator, robots=robots, hold=True, take=take))
        self.run(0.01)

    def release(self, operator: str, *robots: str) -> None:
        self.bus.publish(KEYS.lease_request, LeaseRequest(operator=operator, robots=robots, hold=False))
        self.run(0.01)

    def order(
        self, ident: str, operator: str, *robots: str, behaviour: str = "flocking", take: bool = False, source: str = ""
    ) -> bool:
        """Ask; tell whether it was not refused."""
        request = BehaviourRequest(
            id=ident, behaviour=behaviour, robots=robots, operator=operator, take=take, source=source
        )
        self.bus.publish(KEYS.behaviour_request, request)
        self.run(0.01)
        return self.status(ident).phase != "refused"

    @property
    def said(self) -> list[Leases]:
        return [message for message in self.sent(Leases) if isinstance(message, Leases)]

    @property
    def leases(self) -> dict[str, Lease]:
        return {lease.robot: lease for lease in self.said[-1].leases}

    @property
    def holders(self) -> dict[str, str]:
        return {robot: lease.operator for robot, lease in self.leases.items()}


@pytest.fixture
def swarm() -> Iterator[Table]:
    made = Table()
    yield made
    made.close()


def test_without_leases_everybody_drives_everything(swarm: Table) -> None:
    assert swarm.order("a", ANNA, "r0")
    assert swarm.order("b", BOB)
    swarm.run(2.5)
    assert len(swarm.said) >= 3, "each second, so that who comes later knows too"
    assert {each.leases for each in swarm.said} == {()}


def test_a_free_robot_is_granted_and_said_at_once(swarm: Table) -> None:
    swarm.run(0.3)
    before = swarm.said[-1].sequence
    swarm.hold(ANNA, "r0", "r1", "stranger")
    assert swarm.holders == {"r0": ANNA, "r1": ANNA}
    assert (swarm.said[-1].sequence, swarm.said[-1].core) == (before + 1, "core-1")
    swarm.hold(BOB, "r1", "r2")
    assert swarm.holders == {"r0": ANNA, "r1": ANNA, "r2": BOB}


def test_others_are_refused_by_name_and_told_how_to_take_over(swarm: Table) -> None:
    swarm.hold(ANNA, "r0")
    swarm.hold(BOB, "r1", "r2")
    assert not swarm.order("a", "carl@lab", "r0", "r1", "r2")
    assert swarm.status("a").reason.startswith("r0 is held by anna@lab, r1 and r2 are held by bob@lab (")
    assert "--take" in swarm.status("a").reason
    assert swarm.order("b", ANNA, "r0")
    assert swarm.behaviours() == ["flocking", "", ""]


def test_a_request_of_the_whole_swarm_is_refused_for_one_robot(swarm: Table) -> None:
    swarm.hold(BOB, "r1")
    assert not swarm.order("a", ANNA)
    assert swarm.status("a").reason.startswith("r1 is held by bob@lab (")
    assert swarm.behaviours() == ["", "", ""]


def test_many_robots_of_one_holder_are_counted() -> None:
    swarm = Table(count=12)
    swarm.hold(BOB, *(f"r{k}" for k in range(12)))
    swarm.order("a", ANNA)
    assert swarm.status("a").reason.startswith("r0, r1, r2, r3, r4 and 7 more are held by bob@lab (")
    swarm.close()


def test_taking_over_with_a_request_gives_the_lease(swarm: Table) -> None:
    swarm.hold(BOB, "r0")
    assert swarm.order("a", ANNA, "r0", "r1", take=True)
    assert swarm.holders == {"r0": ANNA}, "what nobody held stays free"
    assert swarm.leases["r0"].taken_from == BOB
    assert not swarm.order("b", BOB, "r0")
    swarm.run(EXPIRE_S + CHECK_S)
    assert swarm.holders == {}, "it was not renewed"


def test_what_is_handed_over_is_taken_from_the_giver_only(swarm: Table) -> None:
    swarm.hold(ANNA, "r0")
    swarm.hold("carl@lab", "r1")
    request = LeaseRequest(operator=BOB, robots=("r0", "r1", "r2"), hold=True, take=True, given_by=ANNA)
    swarm.bus.publish(KEYS.lease_request, request)
    swarm.run(0.01)
    assert swarm.holders == {"r0": BOB, "r1": "carl@lab", "r2": BOB}
    assert swarm.leases["r0"].taken_from == ANNA


def test_a_take_over_that_is_wrong_otherwise_takes_nothing(swarm: Table) -> None:
    swarm.hold(BOB, "r0")
    request = BehaviourRequest(
        id="a", behaviour="rendezvous", robots=("r0",), operator=ANNA, take=True, parameters={"gain": 99}
    )
    swarm.bus.publish(KEYS.behaviour_request, request)
    swarm.run(0.01)
    assert swarm.status("a").phase == "refused"
    assert swarm.holders == {"r0": BOB}


def test_a_lease_is_taken_only_on_purpose(swarm: Table) -> None:
    swarm.hold(BOB, "r0")
    swarm.hold(ANNA, "r0")
    assert swarm.holders == {"r0": BOB}
    swarm.hold(ANNA, "r0", take=True)
    assert (swarm.leases["r0"].operator, swarm.leases["r0"].taken_from) == (ANNA, BOB)
    swarm.hold(ANNA, "r0")
    assert swarm.leases["r0"].taken_from == BOB, "renewing does not make history forgotten"


def test_it_lapses_three_seconds_after_the_last_renewal(swarm: Table) -> None:
    swarm.hold(ANNA, "r0")
    swarm.run(EXPIRE_S - 0.2)
    swarm.hold(ANNA, "r0")
    said = len(swarm.said)
    swarm.run(0.05)
    assert len(swarm.said) == said, "a renewal changes nothing that had to be said"
    swarm.run(EXPIRE_S - 0.2)
    assert swarm.holders == {"r0": ANNA}
    assert swarm.leases["r0"].age_s == pytest.approx(2 * EXPIRE_S - 0.4, abs=1.1)
    swarm.run(0.2 + CHECK_S)
    assert swarm.holders == {}


def test_the_holders_own_requests_renew(swarm: Table) -> None:
    swarm.hold(ANNA, "r0")
    for number in range(8):
        swarm.run(0.5)
        assert swarm.order(f"d{number}", ANNA, "r0", behaviour="drive")
    assert swarm.holders == {"r0": ANNA}


def test_releasing_gives_back_ones_own_only(swarm: Table) -> None:
    swarm.hold(ANNA, "r0", "r1")
    swarm.hold(BOB, "r2")
    swarm.release(ANNA, "r0", "r2")
    assert swarm.holders == {"r1": ANNA, "r2": BOB}
    assert swarm.order("a", BOB, "r0")


def test_sticks_are_refused_like_everything_else(swarm: Table) -> None:
    swarm.hold(BOB, "r0")
    assert not swarm.order("a", ANNA, "r0", behaviour="drive")


def test_who_gives_no_name_is_known_by_his_process(swarm: Table) -> None:
    swarm.hold("cli@here:1", "r0")
    assert swarm.order("a", "", "r0", source="cli@here:1")
    assert not swarm.order("b", "", "r0", source="cli@here:2")
    assert not swarm.order("c", "", "r0")
    swarm.hold("", "r1")
    swarm.hold("x" * 1000, "r1")
    assert swarm.holders == {"r0": "cli@here:1"}


@pytest.mark.parametrize("how", ["stop", "estop", "behaviour"])
def test_a_stop_needs_no_lease(swarm: Table, how: str) -> None:
    swarm.hold(ANNA, "r0")
    swarm.order("a", ANNA, "r0")
    swarm.run(0.1)
    assert swarm.behaviours()[0] == "flocking"
    if how == "stop":
        swarm.bus.publish(KEYS.stop, StopRequest(id="s", robots=("r0",), source="bob"))
    elif how == "estop":
        swarm.bus.publish(KEYS.estop, EStop(id="s", engaged=True, robots=("r0",), source="bob"))
    else:
        swarm.order("s", BOB, "r0", behaviour="stop")
    swarm.run(0.2)
    assert swarm.behaviours()[0] in ("", "stop")
    assert swarm.status("s").phase != "refused"
    assert swarm.holders == {"r0": ANNA}


def test_a_new_core_knows_the_leases_at_their_next_renewal(swarm: Table) -> None:
    swarm.hold(ANNA, "r0")
    swarm.core.close()
    swarm.start_core(Store())
    swarm.run(0.01)
    assert (swarm.holders, swarm.said[-1].core) == ({}, "core-2")
    swarm.hold(ANNA, "r0")
    assert swarm.holders == {"r0": ANNA}


def test_a_group_is_held_as_its_robots() -> None:
    store = Store()
    store.set("group/scouts", {"robots": ["r0", "r2", "gone"]}, "test")
    swarm = Table(store=store)
    swarm.hold(ANNA, "@scouts", "@nobody")
    assert swarm.holders == {"r0": ANNA, "r2": ANNA}
    assert not swarm.order("a", BOB, "@scouts")
    swarm.release(ANNA, "@scouts")
    assert swarm.holders == {}
    swarm.close()
