"""What a new user sees who opens the address of `make demo`, and that the first order takes the robots over.

This file comes first: the show that these tests look at ends with them.
"""

from __future__ import annotations

from playwright.sync_api import expect

from tests.browser.conftest import ROBOTS, Snap
from tests.browser.console import Console
from tests.browser.swarm import Demo, Observer, far

MOVED_M = 0.15


def test_the_page_shows_eight_moving_robots(console: Console, observer: Observer, snap: Snap) -> None:
    first: dict[str, tuple[float, float]] = {}
    moved: set[str] = set()

    def all_moved() -> bool:
        for robot, place in console.places().items():
            if far(place, first.setdefault(robot, place)) > MOVED_M:
                moved.add(robot)
        return moved == set(ROBOTS)

    console.until(all_moved, 60.0, "all move on the map")
    snap(console.page, "light")
    observer.until(lambda: len(observer.rows()) == 8, 5.0, "the bus tells of all robots")
    shown, true = console.places(), observer.fresh().places()
    assert all(far(shown[robot], true[robot]) < 0.5 for robot in ROBOTS), "what the page shows is where they are"
    for robot in ROBOTS:
        expect(console.named(f"robot-row-{robot}")).to_contain_text("Move to goal")


def test_the_first_order_ends_the_show(console: Console, demo: Demo) -> None:
    console.select(["r1"])
    console.start("move_to_goal_bc", goal="3, 3")
    demo.tells("you have control", 10.0)
