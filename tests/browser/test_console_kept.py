"""Places on the map and saved requests: kept by the core, shared by all pages, used in forms."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Browser, expect

from fullswarm.keys import Keys
from fullswarm.messages import BehaviourRequest
from tests.browser.conftest import SIZE, Snap
from tests.browser.console import Console
from tests.browser.swarm import Demo, Observer
from tests.browser.test_console_fleet import stored

NEED_MS = 8_000
NEAR_M = 0.5


@pytest.fixture
def asked(observer: Observer) -> Iterator[dict[str, BehaviourRequest]]:
    """All requests on the bus, by id, as another program receives them."""
    found: dict[str, BehaviourRequest] = {}

    def receive(request: BehaviourRequest) -> None:
        found[request.id] = request

    subscription = observer.bus.subscribe(Keys("swarm").behaviour_request, BehaviourRequest, receive)
    yield found
    subscription.close()


def places(console: Console, *, shown: bool) -> None:
    """Open or close the list of places, which is in that of behaviours."""
    if console.named("form-back").is_visible():
        console.named("form-back").click()
    if console.named("place-list").is_visible() != shown:
        console.named("places-open").click()


def keep(console: Console, name: str, kind: str, points: str) -> None:
    """Fill in the form of a new place."""
    console.named("place-name").fill(name)
    console.named("place-kind").select_option(kind)
    console.page.locator("#place-points input").fill(points)
    console.named("place-keep").click()


def test_a_place_is_kept_for_all_drawn_and_driven_to(calm: Console, observer: Observer, snap: Snap) -> None:
    places(calm, shown=True)
    calm.named("place-name").fill("dock")
    calm.page.locator("#place-points").get_by_role("button", name="Pick on the map").click()
    calm.page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")  # refitted
    calm.click_floor(5.0, 8.5)
    calm.named("place-keep").click()
    expect(calm.named("place-dock")).to_be_visible(timeout=NEED_MS)
    place: Any = stored(observer, "place/dock")
    assert place["kind"] == "point"
    assert math.dist(place["points"][0], (5.0, 8.5)) < 0.1
    keep(calm, "dock 2", "point", "1, 1")
    expect(calm.named("place-problem")).to_contain_text("letters, digits")
    keep(calm, "hall", "area", "1, 1")
    expect(calm.named("place-problem")).to_contain_text("opposite corners")
    keep(calm, "hall", "area", "1, 1; 3, 3")
    expect(calm.named("place-hall")).to_contain_text("2.0 × 2.0 m", timeout=NEED_MS)
    expect(calm.named("place-go-dock")).to_be_disabled()
    calm.select(["r4"])
    calm.named("place-go-dock").click()
    observer.until(lambda: math.dist(observer.places()["r4"], (5.0, 8.5)) < NEAR_M, 60.0, "it is there")
    snap(calm.page, "places")
    for name in ("dock", "hall"):
        calm.named(f"place-delete-{name}").click()
        expect(calm.named(f"place-{name}")).to_have_count(0, timeout=NEED_MS)
        assert stored(observer, f"place/{name}") is None
    places(calm, shown=False)  # the page is that of the other tests, too


def test_a_request_is_saved_with_a_place_and_made_again_from_another_page(
    calm: Console, demo: Demo, browser: Browser, observer: Observer, asked: dict[str, BehaviourRequest], snap: Snap
) -> None:
    places(calm, shown=True)
    keep(calm, "hall", "area", "1, 1; 3, 2")
    expect(calm.named("place-hall")).to_be_visible(timeout=NEED_MS)
    places(calm, shown=False)
    calm.select(["r1", "r2"])
    calm.named("behaviour-area_sweep_bc").click()
    calm.page.get_by_label("Place: area").select_option(label="hall: two opposite corners")
    calm.page.locator('[name="lane_m"]').first.fill("0.5")
    calm.named("save-open").click()
    calm.named("save-name").fill("morning")
    calm.named("save-robots").check()
    snap(calm.page, "save")
    calm.named("save").click()
    expect(calm.named("save-name")).to_be_hidden(timeout=NEED_MS)
    assert not asked, "to save is not to start"
    saved: Any = stored(observer, "saved/morning")
    assert saved["behaviour"] == "area_sweep_bc"
    assert saved["robots"] == ["r1", "r2"]
    assert saved["parameters"]["area"] == [[1, 1], [3, 2]]

    context = browser.new_context(viewport=SIZE)
    other = Console(context.new_page(), demo.address)
    other.named("saved-morning").click()
    assert other.state["selection"] == ["r1", "r2"]
    expect(other.page.locator('[name="lane_m"]').first).to_have_value("0.5")
    other.named("start").click()
    observer.until(lambda: len(asked) == 1, 10.0, "it is requested")
    (request,) = asked.values()
    assert request.behaviour == "area_sweep_bc"
    assert set(request.robots) == {"r1", "r2"}
    assert request.parameters["lane_m"] == 0.5
    assert request.parameters["area"] == [[1, 1], [3, 2]]
    other.named("save-open").click()
    other.named("saved-delete").click()
    expect(calm.named("saved-morning")).to_have_count(0, timeout=NEED_MS)
    assert stored(observer, "saved/morning") is None
    other.press("Space")
    other.give_back()  # else its session holds them for ten seconds more
    other.faultless()
    context.close()
    calm.named("form-back").click()
    places(calm, shown=True)
    calm.named("place-delete-hall").click()
    expect(calm.named("place-hall")).to_have_count(0, timeout=NEED_MS)
    places(calm, shown=False)
