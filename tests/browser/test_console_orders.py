"""Seeing the swarm and giving orders: select, send, start, be refused, stop."""

from __future__ import annotations

import re

from playwright.sync_api import expect

from tests.browser.conftest import ROBOTS, Snap
from tests.browser.console import Console, Point, outer_threes
from tests.browser.swarm import OTHER, Demo, Observer, far

MOVED_M = 0.15
STOOD_M = 0.03
NEAR_M = 1.3
"""Three robots cannot stand on one point: the page gives them room around it."""
BOXES = [(4.6, 2.2), (2.4, 5.6)]
"""Of the demo's hall, each 1 m wide."""
PARKED_M = 0.3
BESIDE_BOX_M, BESIDE_ROBOT_M = 1.2, 0.8


def gap(start: Point, end: Point, point: Point) -> float:
    """Return how far `point` is from the way, m."""
    steps = ((start[0] + k / 20 * (end[0] - start[0]), start[1] + k / 20 * (end[1] - start[1])) for k in range(21))
    return min(far(step, point) for step in steps)


def room(places: dict[str, Point], robots: list[str], goal: Point) -> float:
    """Return how free the way of `robots` to a goal is; from 1.0 on nothing is in it."""
    starts = [places[robot] for robot in robots]
    if any(far(goal, start) < 2.0 for start in starts):
        return 0.0  # no way to speak of
    others = [place for robot, place in places.items() if robot not in robots]
    boxes = min(gap(start, goal, box) / BESIDE_BOX_M for start in starts for box in BOXES)
    return min(boxes, min(gap(start, goal, other) / BESIDE_ROBOT_M for start in starts for other in others))


def freest(places: dict[str, Point]) -> tuple[float, list[str], list[Point], Point]:
    """Return the freest way there is: how free, of which three, the corners of a lasso around them, and its goal."""
    floor = [(float(x), float(y)) for x in range(1, 10) for y in range(1, 10)]
    ways = [
        (room(places, three, goal), three, around, goal) for three, around in outer_threes(places) for goal in floor
    ]
    return max(ways, key=lambda way: way[0], default=(0.0, [], [], (0.0, 0.0)))


def park(observer: Observer) -> None:
    """Send all into a row at the wall: what ran before may have left them between the boxes."""
    goals = {robot: (1.0 + number, 9.0) for number, robot in enumerate(ROBOTS)}
    for robot, goal in goals.items():
        observer.operator.request("navigate_bc", (robot,), {"goal": list(goal)})
    observer.until(
        lambda: all(far(place, goals[robot]) < PARKED_M for robot, place in observer.places().items()), 90.0, "a row"
    )
    observer.operator.stop()
    observer.until(observer.is_calm, 10.0, "they stand")


def test_a_lasso_and_a_click_send_three_robots_and_no_other(calm: Console, observer: Observer, snap: Snap) -> None:
    # A way that is free: what is in one is the safety filter's business, not the page's.
    if freest(observer.fresh().places())[0] < 1.0:
        park(observer)
    before = observer.places()
    free, three, around, goal = freest(before)
    assert free >= 1.0
    calm.lasso(around)
    expect(calm.named("selection")).to_have_text("3 selected")
    assert sorted(calm.state["selection"]) == three
    calm.press("g")
    calm.click_floor(*goal)
    observer.until(
        lambda: all(far(place, goal) < NEAR_M for place in observer.places(three).values()), 40.0, "they arrive"
    )
    after = observer.places()
    assert all(far(before[robot], after[robot]) > 1.0 for robot in three), "they came from elsewhere"
    others = [robot for robot in ROBOTS if robot not in three]
    assert all(far(before[robot], after[robot]) < STOOD_M for robot in others), "the others stand where they stood"
    for robot in three:
        expect(calm.named(f"lease-{robot}")).to_have_text("you")
    snap(calm.page, "goal")


def test_a_refused_request_shows_its_reason(calm: Console, observer: Observer, snap: Snap) -> None:
    calm.select(["r2"])
    calm.start("formation_bc", targets="2, 8; 3, 8")
    expect(calm.named("refusal")).to_contain_text("2 targets for 1 robot: give one per robot")
    expect(calm.named("log")).to_contain_text("2 targets for 1 robot")
    snap(calm.page, "refusal")
    observer.rest(0.5)
    assert observer.all_stand_with("")


def test_a_selection_that_has_not_reported_starts_no_robot(calm: Console, observer: Observer) -> None:
    calm.page.evaluate("sessionStorage.setItem('selection', '[\"r77\"]')")  # of a group that is switched off
    calm.faultless()
    calm.page.reload()
    calm.until(lambda: len(calm.state["robots"]) == 8, 10.0, "the others are there")
    calm.start("flocking_bc")
    expect(calm.named("refusal")).to_contain_text("none of them has reported yet")
    observer.rest(1.0)
    assert observer.all_stand_with(""), "none named must not become all"


def test_robots_of_another_operator_are_refused_until_they_are_taken_over(
    calm: Console, demo: Demo, observer: Observer
) -> None:
    before = observer.fresh().places()["r3"]
    with demo.other_operator("leases", "hold", "r3"):
        expect(calm.named("lease-r3")).to_have_text(OTHER, timeout=20_000)
        calm.select(["r3"])
        calm.start("move_to_goal_bc", goal="5, 8.5")
        expect(calm.named("question")).to_contain_text(f"r3 is held by {OTHER}")
        observer.rest(0.5)
        assert far(before, observer.places()["r3"]) < STOOD_M
        calm.named("take-over").click()
        observer.until(lambda: far(before, observer.places()["r3"]) > MOVED_M, 10.0, "it obeys the new holder")
        expect(calm.named("lease-r3")).to_have_text("you")


def test_space_stops_all_and_shows_eight_receipts(calm: Console, observer: Observer) -> None:
    calm.start("flocking_bc")
    observer.until(lambda: not observer.stand() and observer.all_run("flocking_bc"), 10.0, "the flock moves")
    start = calm.named("start")
    start.focus()
    calm.page.keyboard.press("Space")  # on a button that would start it anew
    expect(calm.named("stop-receipts")).to_have_text("8 of 8 standing", timeout=5_000)
    observer.until(lambda: observer.all_stand_with(""), 1.0, "all stand, and none has a behaviour")
    observer.rest(1.0)
    assert observer.all_stand_with(""), "the focused button was not clicked by the same key"


def test_an_e_stop_shows_eight_receipts_and_clearing_is_an_act_of_its_own(
    calm: Console, observer: Observer, snap: Snap
) -> None:
    calm.start("flocking_bc")
    observer.until(lambda: not observer.stand(), 10.0, "the flock moves")
    calm.press("e")
    receipts = calm.named("estop-receipts").get_by_role("listitem")
    expect(receipts).to_have_count(8)
    for robot in ROBOTS:
        expect(receipts.filter(has_text=re.compile(rf"^{robot}\b"))).to_contain_text("standing after")
    observer.until(lambda: all(health.estop for health in observer.healths()), 10.0, "all have latched")
    snap(calm.page, "estop")
    calm.start("flocking_bc")
    expect(calm.named("refusal")).to_contain_text("e-stop")
    calm.named("estop-clear").click()
    hold = calm.named("estop-clear-hold")
    hold.click()  # a click is not enough
    observer.rest(1.0)
    assert all(health.estop for health in observer.healths())
    hold.hover()
    calm.page.mouse.down()
    observer.until(lambda: not any(health.estop for health in observer.healths()), 5.0, "the latch is released")
    calm.page.mouse.up()
    expect(hold).to_be_hidden()
    observer.rest(0.5)
    assert observer.stand(), "clearing starts nobody"
