"""A mission of points that is made on the page: what it sends, against the clicks, and what the robots then do."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Browser, Locator, expect

from fullswarm.keys import Keys
from fullswarm.operator.missions import MissionClient
from tests.browser.axe import NPM, violations
from tests.browser.conftest import SIZE, Snap
from tests.browser.console import Console
from tests.browser.played import change, play, sent
from tests.browser.swarm import Observer, far
from tests.browser.test_console_orders import park

NEAR_M = 0.2
FIRST, SECOND = (1.0, 8.1), (1.6, 7.5)
"""Where nothing is, near the place of r1 in the row."""


@pytest.fixture(scope="module")
def page(browser: Browser) -> Iterator[Console]:
    console = play(browser, SIZE, 4, color_scheme="light")
    yield console
    console.page.context.close()


@pytest.fixture
def played(page: Console) -> Iterator[Console]:
    page.named("missions-toggle").click()
    page.select(["r2", "r3"])
    page.named("mission-new").click()
    yield page
    page.faultless()
    if page.named("mission-form").is_visible():
        page.named("mission-cancel").click()
    page.press("Escape")
    change(page, leases=[], missions=[])
    page.named("missions-toggle").click()


def points(played: Console) -> Locator:
    return played.page.locator("#mission-points li")


def plan(played: Console) -> dict[str, Any]:
    found: dict[str, Any] = sent(played, "startmission")[-1]["plan"]
    return found


def reply(played: Console, *, ok: bool, reason: str = "") -> None:
    """Answer for the core."""
    told = {
        "t": "mission",
        "op": "start",
        "mission": "route-1",
        "request_id": "",
        "ok": ok,
        "reason": reason,
        "code": "",
    }
    played.page.evaluate("(told) => fake.say(told)", told)


def test_the_mission_is_what_was_clicked_and_stays_until_the_core_has_accepted_it(played: Console, snap: Snap) -> None:
    for x_m, y_m in ((2.0, 3.0), (7.0, 6.0), (5.0, 8.0), (3.0, 5.5)):
        played.click_floor(x_m, y_m)
    played.click_floor(-0.5, 5.0)
    expect(played.named("mission-problem")).to_contain_text("outside the arena")
    expect(points(played)).to_have_count(4)
    points(played).nth(1).get_by_role("button", name="Remove point 2").click()
    expect(points(played).nth(1)).to_contain_text("5.0")
    if NPM is not None:
        assert violations(played.page) == []
    snap(played.page, "mission-form")
    played.named("mission-start").click()
    played.until(lambda: bool(sent(played, "startmission")), 5.0, "it is sent")
    steps = plan(played)["tracks"][0]["steps"]
    goals = [step["parameters"]["goal"] for step in steps]
    for found, clicked in zip(goals, ((2.0, 3.0), (5.0, 8.0), (3.0, 5.5)), strict=True):
        assert found == pytest.approx(clicked, abs=0.05)
    assert [step["name"] for step in steps] == ["point 1", "point 2", "point 3"]
    assert all(step["robots"] == ["r2", "r3"] and step["done"] == {"arrived": "all"} for step in steps)
    reply(played, ok=False, reason="the goal is outside the arena")
    expect(played.named("mission-problem")).to_have_text("the goal is outside the arena")
    expect(points(played)).to_have_count(3)
    reply(played, ok=True)
    expect(played.named("mission-form")).to_be_hidden()


def test_places_are_added_and_names_are_looked_at(played: Console) -> None:
    world = "(places) => fake.say({ ...fake.world(), t: 'world', places })"
    played.page.evaluate(world, {"dock": {"kind": "point", "points": [[1.5, 2.5]]}})
    played.named("mission-place").select_option("dock")
    expect(points(played)).to_have_text(["11.50, 2.50×"])
    before = len(sent(played, "startmission"))
    played.named("mission-name").fill("not a name")
    played.named("mission-start").click()
    expect(played.named("mission-problem")).to_contain_text("letters, digits")
    assert len(sent(played, "startmission")) == before
    played.page.evaluate(world, {})
    expect(played.named("mission-place")).to_be_hidden()


def test_the_picking_of_another_form_is_left_alone(played: Console) -> None:
    played.click_floor(6.0, 6.0)
    points(played).get_by_role("button", name="Remove point 1").click()
    played.named("places-open").click()
    played.page.get_by_role("button", name="Pick on the map: points").click()
    expect(played.named("mission-pick")).to_have_attribute("aria-pressed", "false")
    played.named("mission-cancel").click()
    played.click_floor(3.0, 4.0)
    expect(played.page.locator("#place-points input")).not_to_have_value("")
    expect(points(played)).to_have_count(0)
    played.named("places-open").click()


def test_robots_that_another_operator_holds_are_asked_for(played: Console) -> None:
    lease = {"robot": "r3", "operator": "ben@workshop", "taken_from": "", "mine": False}
    change(played, leases=[lease])
    played.click_floor(6.0, 6.0)
    before = len(sent(played, "startmission"))
    played.named("mission-start").click()
    expect(played.named("question")).to_contain_text("ben@workshop")
    assert len(sent(played, "startmission")) == before
    played.named("take-over").click()
    played.until(lambda: len(sent(played, "startmission")) > before, 5.0, "it is sent")
    assert sent(played, "startmission")[-1]["take"] is True


def test_without_robots_or_points_nothing_can_be_started(played: Console) -> None:
    expect(played.named("mission-start")).to_be_disabled()
    played.click_floor(6.0, 6.0)
    expect(played.named("mission-start")).to_be_enabled()
    played.page.locator("#select-none").click()
    expect(played.named("mission-start")).to_be_disabled()
    expect(played.named("mission-robots")).to_contain_text("Select the robots")
    played.page.locator("#map").focus()
    played.page.keyboard.press("Escape")
    expect(played.named("mission-pick")).to_have_attribute("aria-pressed", "false")
    expect(points(played)).to_have_count(1)


def test_a_robot_goes_from_point_to_point_and_the_past_shows_the_mission(calm: Console, observer: Observer) -> None:
    client = MissionClient(observer.bus, Keys("swarm"), observer.runtime, "observer", name="berta")
    park(observer)  # a robot also has arrived where another one, or a box, stands in its way
    calm.select(["r1"])
    calm.named("missions-toggle").click()
    calm.named("mission-new").click()
    name = calm.named("mission-name").input_value()
    for point in (FIRST, SECOND):
        calm.click_floor(*point)
    calm.named("mission-start").click()
    expect(calm.named("mission-form")).to_be_hidden()
    observer.until(lambda: phases(client, name) == ("running", "waiting"), 10.0, "the first step runs")
    went: list[float] = []

    def reached() -> bool:
        went.append(far(observer.places(["r1"])["r1"], FIRST))
        return phases(client, name) == ("done", "done")

    calm.until(lambda: calm.state["routes"] and calm.state["routes"][0]["phase"] == "running", 10.0, "it is drawn")
    began_s = calm.state["time"]["at_s"]
    observer.until(reached, 60.0, "both points are reached")
    assert min(went) < NEAR_M
    assert far(observer.places(["r1"])["r1"], SECOND) < NEAR_M
    calm.page.evaluate("(at_s) => window.fullswarm.look(at_s)", began_s)
    calm.until(lambda: calm.state["time"]["ready"] and not calm.state["time"]["live"], 15.0, "the past is shown")
    calm.until(
        lambda: [each["phase"] for each in calm.state["routes"]] == ["running", "waiting"], 10.0, "as it was then"
    )
    expect(calm.named("mission-new")).to_have_attribute("inert", "")
    calm.press("l")
    calm.until(lambda: calm.state["time"]["live"], 10.0, "it is live again")
    calm.until(lambda: calm.state["routes"] == [], 10.0, "it is over")
    calm.named("missions-toggle").click()
    client.close()


def phases(client: MissionClient, name: str) -> tuple[str, ...]:
    found = [each for each in client.missions.values() if each.name == name]
    return tuple(step.phase for each in found[-1:] for track in each.tracks for step in track.steps)
