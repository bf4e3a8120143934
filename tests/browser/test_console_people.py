"""Two operators with a page each: who is here, hand-over, filter of the log; and the guide of a first visit."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Browser, Locator, expect

from tests.browser.axe import NPM, violations
from tests.browser.conftest import SIZE, Snap
from tests.browser.console import Console
from tests.browser.played import change, play, sent
from tests.browser.states import SIZES, complaints, show
from tests.browser.swarm import Demo, Observer

PEOPLE = [
    {"name": name, "role": role, "pages": pages, "clock": "12:03", "holds": holds, "holding": len(holds), "drives": []}
    for name, role, pages, holds in (
        ("anna", "operator", 2, ["r1", "r2"]),
        ("console guest of the department@workshop 3f2a", "driver", 1, []),
        ("wall", "observer", 1, []),
        ("berta@lab", "", 0, ["r5"]),
    )
]
LEASES = [{"robot": robot, "operator": "anna", "taken_from": "", "mine": True} for robot in ("r1", "r2")]
OFFER = {
    "id": "o1", "from": "console guest@workshop 3f2a", "to": "anna", "robots": ["r3", "r4", "r7"], "runs": "Flocking",
    "left_s": 27.0, "mine": False,
}  # fmt: skip
COMPUTERS = ((1440, 900), (720, 450))
"""Sizes that are used with a mouse; the others are those of tablets and phones."""
SAY = """(lines) => lines.forEach(([by, kind, severity, robots], k) => fake.say({ t: "log", entry: {
  at: k, clock: "12:00:00", kind, severity, by, robots, text: `${kind} ${k}`, mine: by === "anna", request_id: "",
  number: k + 1, count: 1 } }))"""
LINES = [
    ["anna", "request", "info", ["r1"]],
    ["anna", "stop", "warning", []],
    ["ben", "request", "info", ["r4", "r5"]],
    ["ben", "refused", "warning", ["r3"]],
    ["", "fault", "error", ["r1"]],
    ["", "link", "info", []],
]


@pytest.fixture
def second(browser: Browser, demo: Demo) -> Iterator[Console]:
    """The page of another operator."""
    context = browser.new_context(viewport=SIZE, color_scheme="light")
    console = Console(context.new_page(), demo.address)
    yield console
    console.faultless()
    context.close()


def lines(console: Console) -> Locator:
    return console.page.locator("#log .entry")


def test_robots_are_handed_over_and_go_on(calm: Console, second: Console, observer: Observer, snap: Snap) -> None:
    second.until(lambda: bool(second.state["operator"]), 15.0, "it is greeted")
    other = second.state["operator"]
    expect(calm.named("people")).to_have_text("2 here")
    calm.select(["r1", "r2"])
    calm.start("flocking_bc")
    expect(calm.named("lease-r1")).to_have_text("you")
    calm.named("people").click()
    calm.named(f"offer-to-{other}").click()
    expect(second.named("offer-words")).to_contain_text("r1, r2, running Flocking")
    expect(calm.named("offer")).to_be_visible()
    expect(calm.named("lease-r1")).to_have_text("you")
    snap(second.page, "offer")
    second.named("offer-yes").click()
    for robot in ("r1", "r2"):
        expect(second.named(f"lease-{robot}")).to_have_text("you")
        expect(calm.named(f"lease-{robot}")).to_have_text(other)
    assert all(each.behaviour == "flocking_bc" for each in observer.fresh().healths(["r1", "r2"])), "they go on"
    assert {"r1", "r2"} == {robot for robot, by in observer.view.snapshot().holders.items() if by == other}
    expect(calm.named(f"person-{other}")).to_contain_text("holds r1, r2")
    calm.named("people-close").click()
    # Neither sends them on without a take-over, and a filter finds who did what.
    calm.page.keyboard.press("g")
    calm.click_floor(5.0, 5.0)
    expect(calm.named("question")).to_be_visible()
    calm.page.locator("#question-no").click()
    calm.press("Escape")
    calm.named("log-filter").click()
    calm.named("log-by").select_option(other)
    expect(lines(calm).last).to_contain_text("handed over by")
    expect(calm.named("log-hidden-words")).to_contain_text("hidden by the filter")
    assert "log_by=" in calm.page.url
    calm.press(",")
    calm.until(lambda: not calm.state["time"]["live"] and calm.state["time"]["ready"], 15.0, "the past is shown")
    expect(calm.named("log-hidden-words")).to_contain_text("hidden by the filter")
    assert calm.state["log"] > 0
    assert all(other in each for each in lines(calm).all_inner_texts()), "the log of the past is filtered, too"
    calm.press("l")
    calm.named("log-clear").click()
    calm.named("log-filter").click()
    expect(calm.named("log-hidden")).to_be_hidden()
    second.give_back()


def test_a_first_visit_is_guided_by_what_is_done_and_a_second_one_is_not(
    browser: Browser, demo: Demo, calm: Console, snap: Snap
) -> None:
    context = browser.new_context(viewport=SIZE, color_scheme="light")
    console = Console(context.new_page(), demo.address, first_visit=True)
    words = console.named("guide-words")
    expect(words).to_contain_text("1 of 6. Select a robot")
    expect(console.page.locator("[data-guided]")).to_have_count(1)
    snap(console.page, "guide")
    console.named("robot-row-r1").get_by_role("checkbox").check()
    expect(words).to_contain_text("✓ 2 of 6. Ask for a behaviour")
    console.start("flocking_bc")
    expect(words).to_contain_text("✓ 3 of 6. Press Stop")
    console.press("Space")
    expect(words).to_contain_text("✓ 4 of 6. E-stop")
    assert console.page.locator("[data-guided]").get_attribute("id") == "estop"
    console.clear_the_map()
    for step in ("5 of 6. Robots that need attention", "6 of 6. Open the help"):
        console.named("guide-next").click()
        expect(words).to_contain_text(step)
    console.page.locator("#help").click()
    expect(console.named("guide")).to_be_hidden()
    console.page.reload()
    expect(console.named("robot-row-r1")).to_be_visible()
    expect(console.named("guide")).to_be_hidden()
    console.press("?")
    console.named("guide-again").click()
    expect(words).to_contain_text("of 6.")
    console.press("Escape")
    expect(console.named("guide")).to_be_hidden()
    assert console.page.locator("[data-guided]").count() == 0
    console.give_back()
    console.faultless()
    context.close()


@pytest.mark.parametrize("touched", [False, True], ids=["mouse", "touch"])
def test_guide_operators_offer_and_filter_have_their_place_at_all_sizes(
    browser: Browser, touched: bool, snap: Snap
) -> None:
    console = play(browser, SIZE, first_visit=True, color_scheme="light", has_touch=touched)
    change(console, people=PEOPLE, leases=LEASES)
    page = console.page
    found: list[str] = []

    def look(name: str, size: tuple[int, int]) -> None:
        coarse: bool = page.evaluate("matchMedia('(pointer: coarse)').matches")
        wrong = complaints(console, coarse=coarse)
        if NPM is not None and SIZES.index(size) == ("guide", "people", "offer", "filter").index(name):
            wrong += violations(page)
        snap(page, f"{name}-{size[0]}x{size[1]}")
        found.extend(f"{name} at {size}: {each}" for each in wrong)

    for number, size in enumerate(SIZES):
        if (size in COMPUTERS) is touched:
            continue
        page.emulate_media(color_scheme="dark" if number % 2 else "light")
        page.set_viewport_size({"width": size[0], "height": size[1]})
        expect(console.named("guide")).to_be_visible()
        look("guide", size)
        change(console, offers=[OFFER])
        expect(console.named("offer-yes")).to_be_visible()
        look("offer", size)
        change(console, offers=[])
        if not console.named("people").is_visible():
            console.named("bar-fold").click()
        console.named("people").click()
        look("people", size)
        console.named("people-close").click()
        show(console, "log")
        console.named("log-filter").click()
        console.named("log-level").select_option("warning")
        look("filter", size)
        console.named("log-clear").click()
        console.named("log-filter").click()
        show(console, "fleet")
    assert found == []
    assert not console.errors
    page.context.close()


def test_the_log_is_filtered_and_the_address_keeps_it(browser: Browser) -> None:
    console = play(browser, SIZE)
    page = console.page
    page.evaluate(SAY, LINES)
    console.named("log-filter").click()

    def shown(**fields: str) -> list[int]:
        for name, value in fields.items():
            console.named(f"log-{name}").select_option(value)
        return [int(each.get_attribute("data-number") or 0) for each in lines(console).all()]

    assert shown(by="ben") == [3, 4]
    assert shown(by="me") == [1, 2]
    expect(console.named("log-hidden-words")).to_have_text("4 of 6 hidden by the filter")
    assert shown(by="", level="warning") == [2, 4, 5]
    assert shown(level="error") == [5]
    assert shown(level="", robots="r1") == [1, 2, 5], "a stop of all concerns r1, too"
    assert shown(robots="@east") == [2, 3]
    console.select(["r3"])
    assert shown(robots="selected") == [2, 4]
    console.named("log-search").fill("refused")
    assert shown() == [4]
    page.reload()
    console.until(lambda: len(console.state["robots"]) == 8, 15.0, "it is back")
    page.evaluate(SAY, LINES)
    assert shown() == [4], "as before the reload"
    console.named("log-clear").click()
    assert shown() == [1, 2, 3, 4, 5, 6]
    assert "log_" not in page.url
    page.context.close()


def test_an_answer_is_one_press_and_nothing_is_accepted_in_the_past(browser: Browser) -> None:
    console = play(browser, SIZE)
    change(console, people=PEOPLE, leases=LEASES, offers=[OFFER])
    console.named("offer-yes").click()
    fields: dict[str, Any] = sent(console, "handover")[-1]
    assert (fields["op"], fields["id"]) == ("accept", "o1")
    console.press(",")
    expect(console.named("past-banner")).to_be_visible()
    assert console.named("offer-yes").get_attribute("inert") is not None
    console.named("offer-no").click()
    assert sent(console, "handover")[-1]["op"] == "decline"
    console.press("l")
    change(console, offers=[])
    console.select(["r2", "r3"])
    console.named("people").click()
    offer = console.named("offer-to-console guest of the department@workshop 3f2a")
    expect(offer).to_have_text("Offer r2")
    expect(console.named("offer-to-wall")).to_have_count(0)
    offer.press("Enter")
    assert sent(console, "handover")[-1]["robots"] == ["r2"]
    console.faultless()
    console.page.context.close()
