"""Six sizes, light and dark, each state: nothing is off the screen, covered or cut, and nothing lies on the map."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

import pytest
from playwright.sync_api import Browser, ViewportSize, expect

from tests.browser.axe import NPM, violations
from tests.browser.conftest import Snap
from tests.browser.console import Console
from tests.browser.played import change, play
from tests.browser.states import SIZES, STATES, clear, complaints, latch, release, show

Play = Callable[[int, bool], Console]
FINGERS = [size for size in SIZES if size not in ((1440, 900), (720, 450))]
"""Of tablets and phones; the others are screens of computers."""
STATED = dict(zip(SIZES, ("stick", "form", "missions", "form", "clearing", "question"), strict=True))
"""The state in which CI lets axe look at each size; the exhaustive run does so in all."""


def viewport(size: tuple[int, int]) -> ViewportSize:
    return {"width": size[0], "height": size[1]}


@pytest.fixture(scope="module")
def played(browser: Browser) -> Iterator[Play]:
    """Return pages by their number of robots and whether they are touched; each is opened once."""
    pages: dict[tuple[int, bool], Console] = {}

    def page(robots: int, touched: bool) -> Console:
        key = (robots, touched)
        if key not in pages:
            pages[key] = play(browser, viewport(SIZES[0]), robots, color_scheme="light", has_touch=touched)
        return pages[key]

    yield page
    for console in pages.values():
        console.page.context.close()


def look(console: Console, size: tuple[int, int], scheme: Any, axe: list[str], snap: Snap | None) -> list[str]:
    """Go through all states at a size; return what is wrong, one line each."""
    console.page.emulate_media(color_scheme=scheme)
    console.page.set_viewport_size(viewport(size))
    found = []
    for name, state in STATES.items():
        with state(console):
            coarse: bool = console.page.evaluate("matchMedia('(pointer: coarse)').matches")
            wrong = complaints(console, coarse=coarse, name=name)
            if NPM is not None and name in axe:
                wrong += violations(console.page)
            if snap is not None:
                snap(console.page, f"{name}-{size[0]}x{size[1]}-{scheme}")
            found += [f"{name}: {each}" for each in wrong]
    console.page.evaluate("window.shifts.splice(0)")  # by the new size
    console.faultless()
    return found


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_every_state_has_its_place(played: Play, size: tuple[int, int]) -> None:
    scheme = "dark" if SIZES.index(size) % 2 else "light"
    assert look(played(8, size in FINGERS), size, scheme, [STATED[size]], None) == []


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("robots", [8, 32])
@pytest.mark.parametrize("touched", [False, True], ids=["mouse", "touch"])
def test_every_state_in_every_size_light_and_dark(
    played: Play, size: tuple[int, int], scheme: str, robots: int, touched: bool, snap: Snap
) -> None:
    assert look(played(robots, touched), size, scheme, list(STATES), snap) == []


@pytest.mark.parametrize("size", [(390, 844), (844, 390), (1024, 700)], ids=str)
def test_what_folds_away_can_be_opened(played: Play, size: tuple[int, int]) -> None:
    console = played(8, True)
    page = console.page
    page.set_viewport_size(viewport(size))
    console.named("bar-fold").tap()
    for each in ("theme", "signals", "help"):
        expect(page.locator(f"#{each}")).to_be_visible()
    page.locator("#help").tap()
    expect(page.locator("#help-panel")).to_be_visible()
    top = page.locator("#help-panel").bounding_box()
    stop = console.named("estop").bounding_box()
    assert top is not None
    assert stop is not None
    assert top["y"] >= stop["y"] + stop["height"], "the help does not cover the e-stop"
    page.locator("#help-close").tap()
    expect(page.locator("#help")).to_be_hidden()
    if size[0] < 600 or size[1] < 640:
        expect(page.locator("#layer-trails")).to_be_hidden()
        console.named("tool-more").tap()
        for each in ("goal-behaviour", "formation-shape", "layer-coverage"):
            box = console.named(each).bounding_box()
            assert box is not None
            assert box["x"] + box["width"] <= size[0]
        page.keyboard.press("Escape")
    expect(page.locator("#layer-trails")).to_be_visible(visible=size[0] >= 600 and size[1] >= 640)


def test_the_map_is_fitted_again_until_it_is_moved(played: Play) -> None:
    console = played(8, False)
    page = console.page
    for size in ((1440, 900), (390, 844), (720, 450)):
        page.set_viewport_size(viewport(size))
        page.wait_for_timeout(150)
        box = page.locator("#map").bounding_box()
        assert box is not None
        west, south = console.at(0.0, 0.0)
        east, north = console.at(10.0, 10.0)
        assert box["x"] <= west < east <= box["x"] + box["width"]
        assert box["y"] <= north < south <= box["y"] + box["height"]
        share = max((east - west) / box["width"], (south - north) / box["height"])
        assert share > 0.8, "the arena fills the map"
    page.locator("#zoom-in").click()
    width = console.at(10.0, 0.0)[0] - console.at(0.0, 0.0)[0]
    page.set_viewport_size(viewport((1440, 900)))
    page.wait_for_timeout(150)
    assert console.at(10.0, 0.0)[0] - console.at(0.0, 0.0)[0] == pytest.approx(width), "the person's own view is kept"
    page.locator("#zoom-fit").click()


NOTICES = """() => {
  const all = fake.ids();
  fake.say({ t: "stop", standing: all.slice(0, 6), moving: all.slice(6), silent: [], done: false });
  fake.say({ t: "lost", robots: ["r1", "r2"], by: "ben@workshop" });
  const entry = { at: 1, clock: "12:00:00", kind: "request", text: "x ".repeat(99), robots: [], mine: true };
  fake.say({ t: "log", entry });
  const words = "a cliff sensor sees no floor ".repeat(4);
  Object.assign(fake.swarm, { trouble: { r2: ["cliff", words] }, silent: ["r5"] });
  fake.tick();
}"""
ANCHORS = [
    "#map",
    "#tool-goal",
    "#time-live",
    "#stop",
    "#estop",
    "#start, #behaviour-search",
    "#select-none",
    "#tabs button:last-child",
]
PLACES = """(anchors) => anchors.map((each) => {
  const { x, y, width, height } = document.querySelector(each).getBoundingClientRect();
  return [each, x, y, width, height];
})"""


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_nothing_moves_under_a_pointer(played: Play, size: tuple[int, int]) -> None:
    console = played(8, False)
    console.page.set_viewport_size(viewport(size))
    show(console, "fleet")
    console.page.mouse.move(5, 5)
    console.page.wait_for_timeout(700)  # what a key or a click moves does not count for half a second after it
    console.page.evaluate("window.shifts.splice(0)")
    before = console.page.evaluate(PLACES, ANCHORS)
    console.page.evaluate(NOTICES)
    expect(console.named("stop-receipts")).to_contain_text("6 of 8 standing")
    expect(console.named("lost")).to_be_visible()
    console.page.wait_for_timeout(300)
    assert console.page.evaluate(PLACES, ANCHORS) == before
    lost = console.named("lost").bounding_box()
    console.page.evaluate("fake.say({ t: 'stop', standing: fake.ids(), moving: [], silent: [], done: true })")
    console.page.evaluate("document.getElementById('stop-panel').hidden = true")
    assert console.named("lost").bounding_box() == lost, "what is about to be clicked stays when another one goes"
    console.faultless()
    console.page.locator("#lost-close").click()
    change(console, trouble={}, silent=[])


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_an_e_stop_leaves_the_map_where_it_is(played: Play, size: tuple[int, int]) -> None:
    console = played(8, False)
    console.page.set_viewport_size(viewport(size))
    show(console, "fleet")
    console.page.wait_for_timeout(100)
    before = console.page.locator("#map").bounding_box()
    latch(console)
    assert console.page.locator("#map").bounding_box() == before
    console.named("estop-clear").click()
    assert console.page.locator("#map").bounding_box() == before
    console.page.wait_for_timeout(600)  # what the click moves does not count
    console.page.evaluate("window.shifts.splice(0)")
    clear(console)
    expect(console.named("estop-clear-hold")).to_be_hidden()
    console.page.wait_for_timeout(200)
    console.faultless()
    release(console)


def test_the_fleet_is_told_in_words_and_not_too_often(played: Play) -> None:
    console = played(8, False)
    console.page.set_viewport_size(viewport((1440, 900)))
    words = console.named("fleet-words")
    expect(words).to_have_text("8 robots, 8 moving, none needs attention")
    told_aloud = console.named("fleet-told")
    expect(told_aloud).to_have_text("8 robots, 8 moving, none needs attention")
    assert told_aloud.get_attribute("role") == "status"
    console.page.evaluate("""() => {
      window.told = [];
      const watch = new MutationObserver(() => window.told.push(performance.now()));
      watch.observe(document.getElementById("fleet-told"), { childList: true, characterData: true, subtree: true });
    }""")
    change(console, trouble={"r3": ["cliff", "no floor"]})
    expect(words).to_have_text("8 robots, 8 moving, 1 needs attention: r3, cliff")
    for number in range(12):
        change(console, moving=bool(number % 2))
        expect(words).to_contain_text("8 moving" if number % 2 else "none moving", timeout=500)
        console.page.wait_for_timeout(100)
    change(console, trouble={}, moving=True)
    expect(words).to_have_text("8 robots, 8 moving, none needs attention")
    expect(told_aloud).to_have_text("8 robots, 8 moving, none needs attention")
    told: list[float] = console.page.evaluate("window.told")
    assert len(told) <= 3
    assert all(later - sooner > 900.0 for sooner, later in pairwise(told))


def test_links_skip_to_the_map_and_the_fleet(played: Play) -> None:
    console = played(8, False)
    console.page.set_viewport_size(viewport((390, 844)))
    show(console, "log")
    console.page.evaluate("document.activeElement.blur()")
    url = console.page.url
    for tabs, target in ((1, "map"), (2, "fleet-region")):
        console.page.evaluate("document.activeElement.blur(); document.body.tabIndex = -1; document.body.focus()")
        for _ in range(tabs):
            console.page.keyboard.press("Tab")
        link = console.page.locator(":focus")
        box = link.bounding_box()
        assert box is not None
        assert box["x"] >= 0
        assert box["y"] >= 0
        assert box["height"] >= 44
        console.page.keyboard.press("Enter")
        assert console.page.evaluate("document.activeElement.id") == target
    assert console.page.url == url
    console.page.evaluate("document.body.removeAttribute('tabindex')")


def test_everything_is_reached_by_tab_and_shows_it(played: Play) -> None:
    """Each focus has an outline, the way goes down and to the right, and comes round."""
    console = played(8, False)
    page = console.page
    page.set_viewport_size(viewport((1440, 900)))
    page.evaluate("document.body.tabIndex = -1; document.body.focus()")
    met: list[str] = []
    for _ in range(160):
        page.keyboard.press("Tab")
        name, outlined = page.evaluate("""() => {
          const e = document.activeElement;
          const { outlineStyle, outlineWidth } = getComputedStyle(e);
          const outlined = outlineStyle !== "none" && parseFloat(outlineWidth) >= 2;
          return [e.id || e.dataset.testid || e.textContent.trim(), outlined];
        }""")
        if name in met[:1] or page.evaluate("document.activeElement === document.body"):
            break
        assert outlined, name
        met.append(name)
    for each in ("stop", "estop", "fleet-region", "tool-goal", "map", "time-at", "behaviour-search", "log"):
        assert each in met
    order = [
        met.index(each) for each in ("stop", "estop", "fleet-region", "tool-goal", "map", "time-at", "behaviour-search")
    ]
    assert order == sorted(order)
    page.evaluate("document.body.removeAttribute('tabindex')")
    page.evaluate("window.shifts.splice(0)")
