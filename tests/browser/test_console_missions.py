"""A mission on the page: what is shown of it, and its buttons, against what the robots then do."""

from __future__ import annotations

from playwright.sync_api import Browser, Locator, ViewportSize, expect

from fullswarm.config.mission_file import parse_mission
from fullswarm.keys import Keys
from fullswarm.operator.missions import MissionClient
from tests.browser.axe import NPM, violations
from tests.browser.conftest import Snap
from tests.browser.console import Console
from tests.browser.swarm import Demo, Observer

MISSION = """
name = "tour"
[tracks.west]
robots = ["r1", "r2"]
[[tracks.west.steps]]
name = "ask"
done = { confirm = "Is the hall clear?" }
[[tracks.west.steps]]
name = "roam"
behaviour = "flocking_bc"
done = { time_s = 600 }
[tracks.east]
robots = ["r3"]
[[tracks.east.steps]]
name = "follow"
behaviour = "flocking_bc"
after = ["west/ask"]
done = { time_s = 600 }
"""
THREE = ("r1", "r2", "r3")
SMALL: list[ViewportSize] = [
    {"width": 390, "height": 844},
    {"width": 844, "height": 390},
    {"width": 1024, "height": 768},
]


def start(observer: Observer) -> MissionClient:
    client = MissionClient(observer.bus, Keys("swarm"), observer.runtime, "observer", name="berta")
    pending = client.ask("start", plan=parse_mission(MISSION, "tour.toml", "tour").plan)
    observer.until(lambda: pending.reply is not None, 10.0, "the core answers")
    assert pending.reply is not None
    assert pending.reply.ok, pending.reply
    return client


def button(console: Console, name: str) -> Locator:
    return console.named("mission-tour").first.get_by_role("button", name=name, exact=True)


def test_a_mission_is_confirmed_paused_resumed_and_aborted(
    calm: Console, observer: Observer, browser: Browser, demo: Demo, snap: Snap
) -> None:
    client = start(observer)
    card, phase = calm.named("mission-tour").first, calm.named("mission-phase").first
    expect(phase).to_have_text("running for berta")
    expect(card.get_by_test_id("step-follow")).to_contain_text("after: west/ask")
    assert observer.stand(THREE)
    if NPM is not None:
        assert violations(calm.page) == []
    snap(calm.page, "mission")
    check_small_screens(browser, demo, snap)
    button(calm, "Confirm: Is the hall clear?").click()
    observer.until(lambda: all(h.behaviour == "flocking_bc" for h in observer.healths(THREE)), 10.0, "they run")
    expect(card.get_by_test_id("step-ask")).to_contain_text("done")
    button(calm, "Pause").click()
    observer.until(lambda: all(h.behaviour == "" for h in observer.healths(THREE)), 10.0, "they stop")
    expect(phase).to_have_text("paused")
    button(calm, "Resume").click()
    observer.until(lambda: all(h.behaviour == "flocking_bc" for h in observer.healths(THREE)), 10.0, "they run again")
    calm.press(" ")  # the stop
    expect(phase).to_have_text("paused")
    expect(calm.named("mission-reason").first).to_contain_text("stopped by")
    button(calm, "Abort…").click()
    button(calm, "No").click()
    expect(phase).to_have_text("paused")
    button(calm, "Abort…").click()
    button(calm, "Abort").click()
    expect(phase).to_have_text("aborted")
    calm.named("missions-toggle").click()
    expect(calm.named("charts")).to_be_visible()
    client.close()


def check_small_screens(browser: Browser, demo: Demo, snap: Snap) -> None:
    """The panel is a tab there: nothing beyond the screen, and the question can be answered."""
    for size in SMALL:
        context = browser.new_context(viewport=size, color_scheme="dark")
        console = Console(context.new_page(), demo.address)
        console.page.get_by_role("button", name="Missions").click()
        expect(button(console, "Confirm: Is the hall clear?")).to_be_visible()
        if NPM is not None:
            assert violations(console.page) == []
        assert console.page.evaluate("document.documentElement.scrollWidth") <= size["width"]
        snap(console.page, f"mission-{size['width']}")
        context.close()


def test_the_panel_is_shown_in_place_of_the_charts(calm: Console) -> None:
    toggle = calm.named("missions-toggle")
    toggle.click()
    expect(calm.named("missions-panel")).to_be_visible()
    toggle.click()
    expect(calm.named("charts")).to_be_visible()
