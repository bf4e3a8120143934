"""Missions on the map: their places are where the steps send robots, in order; list and map point at each other."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Browser, expect

from tests.browser.axe import NPM, violations
from tests.browser.conftest import SIZE, Snap
from tests.browser.console import Console
from tests.browser.played import change, play

Place = dict[str, Any]


def point(x_m: float, y_m: float) -> list[Place]:
    return [{"parameter": "somewhere", "kind": "point", "points": [[x_m, y_m]]}]


def several(kind: str, *points: tuple[float, float]) -> list[Place]:
    return [{"parameter": "places", "kind": kind, "points": [list(each) for each in points]}]


def step(name: str, phase: str, places: list[Place], *robots: str) -> dict[str, Any]:
    return {
        "name": name, "behaviour": "of_an_outside_package", "phase": phase, "robots": list(robots), "elapsed_s": 3.0,
        "waits_for": [], "confirm": "", "reason": "", "places": places,
    }  # fmt: skip


def mission(phase: str = "running") -> dict[str, Any]:
    west = [
        step("out", "done", point(2.0, 8.0), "r1", "r2"),
        step("gather", "running", several("formation", (4.0, 7.0), (6.0, 7.0)), "r1", "r2"),
        step("look", "waiting", []),
        step("home", "waiting", point(2.0, 2.0)),
        step("back", "waiting", point(2.0, 8.0)),
    ]
    east = [step("sweep", "waiting", several("area", (6.0, 1.0), (9.0, 4.0)))]
    return {
        "mission": "m1", "name": "tour", "phase": phase, "operator": "berta", "reason": "", "silent": False,
        "tracks": [{"name": "west", "steps": west}, {"name": "east", "steps": east}],
    }  # fmt: skip


@pytest.fixture(scope="module")
def console(browser: Browser) -> Iterator[Console]:
    console = play(browser, SIZE, 4, color_scheme="light")
    change(console, missions=[mission()])
    console.until(lambda: len(routes(console)) == 4, 10.0, "the mission is drawn")
    yield console
    console.faultless()
    console.page.context.close()


def routes(console: Console) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = console.state["routes"]
    return found


def pointed(console: Console) -> list[tuple[str, list[int]]]:
    return [(each["track"], each["numbers"]) for each in routes(console) if each["pointed"]]


def test_each_place_has_the_numbers_of_its_steps_and_what_comes_of_them(console: Console, snap: Snap) -> None:
    found = {(each["track"], *each["numbers"]): (each["at"], each["phase"]) for each in routes(console)}
    assert found == {
        ("west", 1, 5): ([2.0, 8.0], "waiting"),  # there, and back to it
        ("west", 2): ([5.0, 7.0], "running"),
        ("west", 4): ([2.0, 2.0], "waiting"),
        ("east", 1): ([7.5, 2.5], "waiting"),
    }
    for each in routes(console):
        left, top = console.page.evaluate("(() => { const b = document.querySelector('#map').getBoundingClientRect();"
                                          " return [b.left, b.top]; })()")  # fmt: skip
        assert console.at(*each["at"]) == pytest.approx((left + each["x"], top + each["y"]), abs=0.5)
    labels = {each["words"] for each in console.state["labels"]}
    assert "west: 2 gather" in labels
    snap(console.page, "routes")


def test_the_step_that_is_pointed_at_in_the_list_stands_out_on_the_map(console: Console) -> None:
    console.named("step-home").hover()
    console.until(lambda: pointed(console) == [("west", [4])], 5.0, "the mouse on a step shows its place")
    console.named("step-look").hover()  # a step without a place
    console.until(lambda: pointed(console) == [], 5.0, "no place")
    console.named("mission-show").focus()
    for _ in range(3):
        console.page.keyboard.press("Tab")  # Pause, Abort, the first step that has a place
    expect(console.named("step-out")).to_be_focused()
    console.until(lambda: pointed(console) == [("west", [1, 5])], 5.0, "the focus shows its place, too")
    console.page.keyboard.press("Tab")
    console.until(lambda: pointed(console) == [("west", [2])], 5.0, "the next one")


def test_a_place_that_is_pointed_at_on_the_map_marks_its_step_in_the_list(console: Console) -> None:
    console.page.mouse.move(*console.at(2.0, 2.0))
    expect(console.named("step-home")).to_have_attribute("data-pointed", "true")
    expect(console.named("step-out")).to_have_attribute("data-pointed", "false")
    console.page.mouse.move(*console.at(9.5, 9.5))
    expect(console.named("step-home")).to_have_attribute("data-pointed", "false")


def test_a_mission_is_shown_whole_and_can_be_hidden(console: Console) -> None:
    for _ in range(12):
        console.press("+")
    console.named("mission-show").click()
    box = console.named("map").bounding_box()
    assert box is not None
    for x_m, y_m in ((2.0, 8.0), (2.0, 2.0), (9.0, 1.0), (6.0, 7.0)):
        x, y = console.at(x_m, y_m)
        assert box["x"] < x < box["x"] + box["width"]
        assert box["y"] < y < box["y"] + box["height"]
    console.named("layer-routes").click()
    console.until(lambda: routes(console) == [], 5.0, "the layer is off")
    console.named("mission-show").click()
    console.until(lambda: len(routes(console)) == 4, 5.0, "asking for it shows it again")
    expect(console.named("layer-routes")).to_have_attribute("aria-pressed", "true")


def test_a_mission_that_has_ended_is_drawn_only_if_it_was_asked_for(console: Console) -> None:
    ended = mission("aborted") | {"mission": "m2"}
    change(console, missions=[ended])
    console.until(lambda: routes(console) == [], 5.0, "it has ended")
    console.named("mission-show").click()
    console.until(lambda: len(routes(console)) == 4, 5.0, "it is asked for")
    change(console, missions=[mission()])


def test_few_pixels_a_metre_leave_the_marks_that_matter(console: Console) -> None:
    for _ in range(14):
        console.press("-")
    console.until(lambda: len(routes(console)) in (1, 2, 3), 5.0, "places near each other are one mark")
    words = {each["words"] for each in console.state["labels"] if each["key"].startswith("mission")}
    assert all("gather" in each for each in words)
    console.press("f")


def test_reader_and_keyboard_find_their_way(console: Console) -> None:
    if NPM is not None:
        assert violations(console.page) == []
