"""The e-stop of a robot that is about to drive, pressed and released: real agent, real orders, a simulated clock."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fullswarm.bringup import preflight
from fullswarm.bringup.checks import Check
from fullswarm.messages import EStop, Lease, Leases, Message
from fullswarm.operator.session import Session
from fullswarm.operator.view import FleetView
from tests.unit.agent_bench import Bench


class Yard:
    """A robot of a bench, somebody who is about to drive it, and all e-stop orders that anybody gives."""

    def __init__(self) -> None:
        self.bench = bench = Bench([(2.0, 2.0, 0.0)])
        self.line = Session(bench.bus, bench.keys, bench.runtime, "tcp/hub", "ann")
        self.view = FleetView(bench.bus, bench.keys, bench.runtime, ("r1",))
        self.orders: list[EStop] = []
        bench.bus.subscribe(bench.keys.estop, EStop, self.orders.append)
        bench.run(1.0)

    def check(self, answer: bool | None = True) -> Check:
        return preflight.estop_check(self.line, self.view, "r1", lambda _: answer)

    @property
    def latched(self) -> bool:
        return bool(self.bench.agent.controller.estop[0])

    @property
    def ours(self) -> list[EStop]:
        return [each for each in self.orders if each.source == self.line.source]

    def drive_to(self, x_m: float, y_m: float) -> None:
        parameters = {"goal": [x_m, y_m], "gain": 1.0, "arrive_radius_m": 0.1}
        self.bench.enable("move_to_goal", parameters, request_id=f"to {x_m} {y_m}")
        self.bench.run(1.0)

    def press_as_bob(self) -> None:
        order = EStop(id="x", engaged=True, robots=("r1",), source="bob")
        self.bench.bus.publish(self.bench.keys.estop, order)

    def when(self, *, engaged: bool, act: Callable[[], None]) -> None:
        """Do something as soon as our order comes by."""
        done = False

        def see(order: EStop) -> None:
            nonlocal done
            if order.source == self.line.source and order.engaged == engaged and not done:
                done = True
                act()

        self.bench.bus.subscribe(self.bench.keys.estop, EStop, see)

    def lose(self, lost: Callable[[str, Message], bool], monkeypatch: pytest.MonkeyPatch) -> None:
        """Have messages vanish on their way."""
        whole = self.bench.bus.publish

        def publish(key: str, message: Message) -> None:
            if not lost(key, message):
                whole(key, message)

        monkeypatch.setattr(self.bench.bus, "publish", publish)


@pytest.fixture
def yard() -> Yard:
    return Yard()


def test_it_is_pressed_and_released_and_nothing_moves(yard: Yard) -> None:
    before = yard.bench.simulated.pose.copy()
    check = yard.check()
    assert check.status == "ok", check
    assert "seen standing after" in check.what
    assert [each.engaged for each in yard.ours][:1] == [True]
    assert {each.robots for each in yard.ours} == {("r1",)}
    assert not yard.latched
    np.testing.assert_array_equal(yard.bench.simulated.pose, before)
    yard.drive_to(9.0, 2.0)
    assert yard.bench.commanded.any(), "it obeys as before"


@pytest.mark.parametrize(
    ("answer", "status", "part"), [(False, "ok", "not wanted"), (None, "warning", "no terminal to ask")]
)
def test_nobody_is_surprised(yard: Yard, answer: bool | None, status: str, part: str) -> None:
    check = yard.check(answer)
    assert (check.status, part in check.what) == (status, True)
    assert yard.orders == []


def test_one_that_was_latched_before_stays_latched(yard: Yard) -> None:
    yard.bench.estop(engaged=True, order="red button")
    yard.bench.run(1.0)
    check = yard.check()
    assert (check.status, "latched already" in check.what) == ("warning", True)
    assert yard.ours == []
    yard.bench.run(2.0)
    assert yard.latched


def test_one_that_drives_is_left_alone(yard: Yard) -> None:
    yard.drive_to(19.0, 2.0)
    check = yard.check()
    assert (check.status, check.what) == ("warning", "not pressed: it moves")
    yard.bench.stop("halt")
    yard.bench.run(2.0)
    yard.drive_to(*yard.bench.simulated.pose[0, :2].tolist())
    check = yard.check()
    assert (check.status, "it runs move_to_goal" in check.what) == ("warning", True)
    assert yard.ours == []


def test_one_that_somebody_else_holds_is_left_alone(yard: Yard) -> None:
    message = Leases(leases=(Lease(robot="r1", operator="bob", age_s=1.0),))
    yard.bench.runtime.every(0.5, lambda: yard.bench.bus.publish(yard.bench.keys.leases, message))
    yard.bench.run(1.0)
    assert yard.check().what == "not pressed: bob holds it"
    assert yard.ours == []


def test_who_is_asked_may_take_his_time(yard: Yard) -> None:
    def agree(_: str) -> bool:
        yard.drive_to(19.0, 2.0)
        return True

    check = preflight.estop_check(yard.line, yard.view, "r1", agree)
    assert (check.status, check.what) == ("warning", "not pressed: it moves")
    assert yard.ours == []


def test_somebody_elses_press_is_not_undone(yard: Yard) -> None:
    yard.when(engaged=True, act=yard.press_as_bob)
    check = yard.check()
    assert (check.status, check.what) == ("warning", "bob pressed it meanwhile: it stays latched")
    assert all(each.engaged for each in yard.ours)
    yard.bench.run(3.0)
    assert yard.latched


def test_a_press_that_crosses_our_release_holds(yard: Yard) -> None:
    yard.when(engaged=False, act=yard.press_as_bob)
    check = yard.check()
    assert (check.status, "stays latched" in check.what) == ("warning", True)
    yard.bench.run(3.0)
    assert yard.latched


def test_a_press_that_our_release_has_undone_is_given_again(yard: Yard) -> None:
    """The robot heard bob just before our release, and we hear of him only after it."""
    bench = yard.bench

    def deliver() -> None:
        assert not yard.latched, "our release was carried out after his press"
        bench.agent.inbox.estops._orders["x", True] = {}  # known there: a copy of it is not carried out again
        yard.press_as_bob()

    def later() -> None:
        bench.runtime.after(0.2, deliver)

    yard.when(engaged=False, act=later)
    check = yard.check()
    assert (check.status, "stays latched" in check.what) == ("warning", True)
    assert yard.latched
    assert yard.ours[-1].engaged


def test_an_order_that_does_not_get_through_is_a_failure(yard: Yard, monkeypatch: pytest.MonkeyPatch) -> None:
    yard.lose(lambda _, message: isinstance(message, EStop) and message.engaged, monkeypatch)
    check = yard.check()
    assert (check.status, "not confirmed within" in check.what) == ("failure", True)
    assert "do not drive" in check.mend


def test_a_release_that_does_not_get_through_says_what_to_do(yard: Yard, monkeypatch: pytest.MonkeyPatch) -> None:
    yard.lose(lambda _, message: isinstance(message, EStop) and not message.engaged, monkeypatch)
    check = yard.check()
    assert (check.status, check.mend) == ("failure", "fullswarm estop --clear r1")
    assert yard.latched


def test_an_error_between_press_and_release_releases(yard: Yard, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, count = yard.line.run, 0

    def run(duration_s: float | None = None) -> None:
        nonlocal count
        count += 1
        whole(duration_s)
        if count == 3:  # twice it looks, then it presses
            assert yard.latched
            raise KeyboardInterrupt

    monkeypatch.setattr(yard.line, "run", run, raising=False)
    with pytest.raises(KeyboardInterrupt):
        yard.check()
    assert not yard.latched
