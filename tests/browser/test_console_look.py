"""For all eyes, hands and screens: no unlabelled control, nothing that jumps, dark, narrow."""

from __future__ import annotations

from typing import Literal

import pytest
from playwright.sync_api import Browser, Page, ViewportSize, expect

from tests.browser.axe import NPM, violations
from tests.browser.conftest import SIZE, Snap
from tests.browser.console import Console
from tests.browser.swarm import Demo, Observer

pytestmark = pytest.mark.system

TABLET: ViewportSize = {"width": 1024, "height": 768}
PHONE: ViewportSize = {"width": 390, "height": 844}
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
