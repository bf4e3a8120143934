"""For all eyes, hands and screens: no unlabelled control, nothing that jumps, dark, narrow."""

from __future__ import annotations

from typing import Literal

import pytest
from playwright.sync_api import Browser, Page, ViewportSize, expect

from tests.browser.axe import NPM, violations
from tests.browser.conftest import SIZE, Snap
from tests.browser.console import Console
from tests.browser.swarm import Demo, Observer

TABLET: ViewportSize = {"width": 1024, "height": 768}
PHONE: ViewportSize = {"width": 390, "height": 844}
LEAST_MAP_PX = 200
LEAST_PX = 44
"""What a finger hits."""
Scheme = Literal["light", "dark"]


@pytest.mark.skipif(NPM is None, reason="no npm here to fetch axe-core: apt install nodejs npm")
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing(calm: Console, observer: Observer, scheme: Scheme, snap: Snap) -> None:
    page = calm.page
    page.emulate_media(color_scheme=scheme)
    try:
        calm.until(lambda: is_dark(page) == (scheme == "dark"), 5.0, f"the page is {scheme}")
        calm.select(["r1", "r2"])
        calm.start("flocking_bc")
        observer.until(lambda: not observer.stand(["r1", "r2"]), 10.0, "two drive")
        assert violations(page) == []
        snap(page, f"form-{scheme}")
        calm.named("form-back").click()
        assert violations(page) == []
        snap(page, scheme)
        calm.named("details-r1").click()
        expect(calm.named("detail-facts")).to_contain_text("Flocking")
        assert violations(page) == []
        snap(page, f"detail-{scheme}")
        calm.named("detail-close").click()
        calm.press("?")
        assert violations(page) == []
        calm.press("Escape")
        calm.press("e")
        expect(calm.named("estop-receipts").get_by_role("listitem")).to_have_count(8)
        calm.named("estop-clear").click()
        assert violations(page) == []
        calm.page.keyboard.press("Escape")
    finally:
        page.emulate_media(color_scheme="light")


def is_dark(page: Page) -> bool:
    """Whether the page's ground is dark, and its button offers light."""
    lightness, label = page.evaluate(
        "[getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number).reduce((a, b) => a + b),"
        " document.getElementById('theme').textContent]"
    )
    return bool(lightness < 3 * 128 and label == "Light")


def test_a_tablet_shows_it_all_with_room_for_fingers(browser: Browser, demo: Demo, snap: Snap) -> None:
    context = browser.new_context(viewport=TABLET, has_touch=True, color_scheme="light")
    console = Console(context.new_page(), demo.address)
    expect(console.named("robot-row-r8")).to_be_attached(timeout=15_000)
    console.until(lambda: len(console.state["robots"]) == 8, 10.0, "all robots are on the map")
    snap(console.page, "tablet")
    for testid in ("stop", "estop", "tool-goal", "tool-formation", "map"):
        box = console.named(testid).bounding_box()
        assert box is not None
        assert box["width"] >= LEAST_PX, testid
        assert box["height"] >= LEAST_PX, testid
        assert box["x"] >= 0, testid
        assert box["x"] + box["width"] <= TABLET["width"], testid
        assert box["y"] + box["height"] <= TABLET["height"], testid
    assert console.page.evaluate("document.documentElement.scrollWidth") <= TABLET["width"]
    console.faultless()
    context.close()


@pytest.mark.parametrize(
    ("width", "height", "scheme"),
    [(1440, 900, "light"), (390, 844, "dark"), (844, 390, "light"), (720, 450, "dark")],
)
def test_the_estop_panel_covers_no_part_of_the_map(
    calm: Console, observer: Observer, snap: Snap, width: int, height: int, scheme: Scheme
) -> None:
    """Also while it asks whether everybody is clear of the robots; 720x450 is a laptop's screen at 200 %."""
    page = calm.page
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": width, "height": height})
    try:
        calm.named("estop").click()
        expect(page.locator("#estop-title")).to_have_text("E-STOP: 8 of 8 confirmed standing", timeout=5_000)
        snap(page, f"estop-{width}x{height}-{scheme}")
        calm.named("estop-clear").click()
        boxes = {each: page.locator(f"#{each}").bounding_box() for each in ("map", "estop-panel", "estop-clear-hold")}
        map_box, panel, hold = boxes["map"], boxes["estop-panel"], boxes["estop-clear-hold"]
        assert map_box is not None
        assert panel is not None
        assert hold is not None
        assert map_box["height"] >= LEAST_MAP_PX
        beside = panel["x"] >= map_box["x"] + map_box["width"] or panel["x"] + panel["width"] <= map_box["x"]
        assert beside or panel["y"] >= map_box["y"] + map_box["height"]
        for x_px, y_px in (calm.at(*place) for place in calm.places().values()):
            assert map_box["x"] <= x_px <= map_box["x"] + map_box["width"]
            assert map_box["y"] <= y_px <= map_box["y"] + map_box["height"]
        for box in (hold, calm.named("estop").bounding_box(), calm.named("stop").bounding_box()):
            assert box is not None
            assert box["y"] >= 0
            assert box["y"] + box["height"] <= height
            assert box["x"] >= 0
            assert box["x"] + box["width"] <= width
        snap(page, f"clear-{width}x{height}-{scheme}")
        observer.operator.estop(False)
        expect(page.locator("#estop-panel")).to_be_hidden(timeout=15_000)
    finally:
        page.set_viewport_size(SIZE)
        page.emulate_media(color_scheme="light")


def test_a_phone_can_stop_them(browser: Browser, demo: Demo, snap: Snap) -> None:
    context = browser.new_context(viewport=PHONE, has_touch=True, color_scheme="dark")
    console = Console(context.new_page(), demo.address)
    expect(console.named("link-state")).to_have_text("live", timeout=15_000)
    assert console.page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    console.named("stop").tap()
    expect(console.named("stop-receipts")).to_have_text("8 of 8 standing", timeout=5_000)
    snap(console.page, "phone")
    console.faultless()
    context.close()


def test_nothing_jumps_while_the_page_fills(browser: Browser, demo: Demo) -> None:
    context = browser.new_context(viewport=SIZE)
    console = Console(context.new_page(), demo.address)
    console.until(lambda: len(console.state["robots"]) == 8, 15.0, "all robots are on the map")
    expect(console.named("behaviour-flocking_bc")).to_be_visible()
    console.page.wait_for_timeout(1000)  # what comes late must not move anything either
    console.faultless()
    context.close()
