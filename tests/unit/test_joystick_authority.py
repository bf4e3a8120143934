"""Who may drive, and what ends it: other operators, a lost core, stops and e-stops, a second pad."""

from __future__ import annotations

import pytest

from fullswarm.messages import EStop, StopRequest
from fullswarm.operator.joystick.state import BUTTONS
from tests.unit.joystick_bench import LB, ME, Bench, fresh, sticks

bench = pytest.fixture(fresh)


def test_robots_of_another_operator_are_not_driven_but_named_and_felt(bench: Bench) -> None:
    bench.holders = {"r3": "ben@lab"}
    bench.run(1.0)
    bench.press(LB)
    bench.push(leftx=1.0)
    assert bench.requests == []
    assert "r3 held by ben@lab" in bench.note()
    assert bench.pads.rumbles == [bench.pad]
    assert bench.lease_requests == []


def test_the_dead_man_and_back_take_robots_over(bench: Bench) -> None:
    bench.holders = {"r3": "ben@lab"}
    bench.run(1.0)
    bench.tap("back")
    assert bench.holders == {"r3": "ben@lab"}
    bench.press(LB)
    bench.press("back")
    bench.run(0.1)
    assert set(bench.holders.values()) == {ME}
    bench.push(leftx=1.0)
    assert bench.newest().behaviour == "move_right_bc"


def test_a_take_over_that_the_core_does_not_grant_ends_in_a_refusal(bench: Bench) -> None:
    bench.holders = {"r3": "ben@lab"}
    bench.run(1.0)
    bench.press(LB)
    bench.grant = False
    bench.press("back")
    bench.push(leftx=1.0)
    bench.run(1.0)
    assert bench.requests == []
    bench.run(1.5)
    assert "r3 held by ben@lab" in bench.note()
    bench.grant = True
    bench.run(1.0)
    assert bench.requests == []


def test_robots_that_another_operator_takes_are_released_and_it_is_named(bench: Bench) -> None:
    bench.press(LB)
    bench.push(leftx=1.0)
    bench.run(0.5)
    bench.holders["r2"] = "ben@lab"
    bench.tell_leases()
    bench.run(0.3)
    assert not any(sticks(bench.newest()))
    assert "r2 held by ben@lab" in bench.note()
    assert set(bench.holders) == {"r2"}
    count = len(bench.requests)
    bench.run(0.5)
    assert len(bench.requests) == count


def test_the_leases_are_given_back_only_after_the_zeros(bench: Bench) -> None:
    bench.press(LB)
    bench.push(leftx=1.0)
    bench.release(LB)
    assert set(bench.holders.values()) == {ME}
    bench.run(0.2)
    assert bench.holders == {}


def test_a_refusal_of_the_core_ends_the_stream_with_its_reason(bench: Bench) -> None:
    bench.refuse = "no behaviour is called move_right_bc"
    bench.press(LB)
    bench.push(leftx=1.0)
    bench.run(1.0)
    assert bench.note() == "no behaviour is called move_right_bc"
    assert len(bench.requests) <= 4
    assert bench.pads.rumbles == [bench.pad]


@pytest.mark.parametrize("lost", ["hub", "core"])
def test_a_stick_held_in_vain_does_not_queue(bench: Bench, lost: str) -> None:
    if lost == "hub":
        bench.bus.hub = False
    else:
        bench.core = False
        bench.run(1.5)
    bench.press(LB)
    bench.push(leftx=1.0)
    bench.run(1.0)
    assert bench.requests == []
    assert lost in bench.note()
    bench.bus.hub = bench.core = True
    bench.run(1.5)
    assert bench.requests == []
    bench.release(LB)
    bench.press(LB)
    bench.run(0.05)
    assert bench.newest().behaviour == "move_right_bc"


def test_a_core_lost_while_driving_ends_the_drive_until_the_dead_man_is_pressed_again(bench: Bench) -> None:
    bench.press(LB)
    bench.push(leftx=1.0)
    bench.core = False
    bench.run(1.5)
    assert not any(sticks(bench.newest()))
    count = len(bench.requests)
    bench.core = True
    bench.run(1.0)
    assert len(bench.requests) == count


def test_stop_stops_the_selected_robots_and_the_dead_man_must_be_pressed_again(bench: Bench) -> None:
    bench.tap("dpright")
    bench.press(LB)
    bench.push(leftx=1.0)
    bench.tap("a")
    bench.run(0.6)
    assert {stop.robots for _, stop in bench.stops} == {("r1",)}
    assert not any(sticks(bench.newest()))
    bench.press("back")
    bench.run(0.3)
    assert not any(sticks(bench.newest()))


@pytest.mark.parametrize(
    ("order", "stands"),
    [
        (StopRequest(id="s", source="ben"), True),
        (StopRequest(id="s", source="ben", robots=("r2",)), True),
        (StopRequest(id="s", source="ben", robots=("r9",)), False),
        (EStop(id="e", engaged=True, source="ben", robots=("r2",)), True),
        (EStop(id="e", engaged=False, source="ben"), True),
    ],
)
def test_robots_that_another_operator_stops_or_clears_are_released(
    bench: Bench, order: StopRequest | EStop, stands: bool
) -> None:
    bench.press(LB)
    bench.push(leftx=1.0)
    bench.bus.publish(bench.keys.stop if isinstance(order, StopRequest) else bench.keys.estop, order)
    bench.run(0.5)
    count = len(bench.requests)
    bench.run(0.5)
    assert (len(bench.requests) == count) is stands
    assert any(sticks(bench.newest())) is not stands
    assert ("by ben" in bench.note()) is stands
    bench.release(LB)
    bench.press(LB)
    bench.run(0.1)
    assert any(sticks(bench.newest()))


def test_each_press_of_the_e_stop_is_a_new_one(bench: Bench) -> None:
    bench.tap("b")
    bench.run(1.0)
    bench.bus.publish(bench.keys.estop, EStop(id="clear", engaged=False, source="ben"))
    bench.run(0.1)
    bench.tap("b")
    bench.run(0.5)
    pressed = [order.id for order in bench.estops if order.engaged]
    assert len(set(pressed)) == 2
    assert pressed.index(pressed[-1]) > len(pressed) // 2
    assert len(set(pressed[pressed.index(pressed[-1]) :])) == 1


def test_the_pad_that_was_chosen_by_number_stays_it_when_another_is_unplugged() -> None:
    bench = Bench(pad="2")
    first, second = bench.pad, bench.pads.plug()
    bench.run(0.2)
    bench.pad = second
    bench.press(LB)
    bench.push(leftx=1.0)
    del bench.pads.pads[first]
    bench.run(0.2)
    assert any(sticks(bench.newest()))
    bench.release(LB)
    bench.run(0.3)
    assert not any(sticks(bench.newest()))
    count = len(bench.requests)
    other = bench.pads.plug()
    bench.run(0.2)
    bench.press(LB, pad=other)
    bench.run(0.3)
    assert len(bench.requests) == count


def test_e_stop_needs_neither_dead_man_nor_lease_nor_core_and_is_for_all(bench: Bench) -> None:
    bench.holders = {"r1": "ben@lab"}
    bench.core = False
    bench.run(2.0)
    bench.tap("dpright")
    bench.tap("b")
    assert bench.estops[0].engaged
    assert bench.estops[0].robots == ()
    assert "0 of 4 confirmed" in bench.note()
    assert all(each.engaged for each in bench.estops)


def test_e_stop_works_on_a_pad_that_may_not_drive() -> None:
    bench = Bench(pad="2")
    bench.press(LB)
    bench.push(leftx=1.0)
    assert bench.requests == []
    bench.tap("b")
    assert bench.estops


def test_no_button_clears_an_e_stop(bench: Bench) -> None:
    for button in BUTTONS:
        bench.tap(button)
    bench.press(LB)
    for button in BUTTONS:
        bench.tap(button)
    assert bench.estops
    assert all(each.engaged for each in bench.estops)


def test_the_pad_whose_dead_man_is_pressed_first_drives(bench: Bench) -> None:
    other = bench.pads.plug()
    bench.run(0.1)
    bench.pads.set(other, leftx=-1.0)
    bench.press(LB, pad=other)
    bench.run(0.05)
    assert bench.newest().behaviour == "move_left_bc"
    bench.press(LB)
    bench.push(leftx=1.0)
    assert {each.behaviour for _, each in bench.requests} == {"move_left_bc"}
    bench.release(LB, pad=other)
    bench.run(0.3)
    assert not any(sticks(bench.newest()))
    bench.release(LB)
    bench.press(LB)
    bench.run(0.05)
    assert bench.newest().behaviour == "move_right_bc"


def test_only_the_pad_that_is_named_drives() -> None:
    bench = Bench(pad=f"{2:032x}")
    bench.press(LB)
    bench.push(leftx=1.0)
    assert bench.requests == []
    bench.pad = bench.pads.plug()
    bench.run(0.1)
    bench.press(LB)
    bench.push(leftx=1.0)
    assert bench.newest().behaviour == "move_right_bc"
