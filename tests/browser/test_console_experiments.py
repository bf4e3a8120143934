"""The panel of experiments with a played console: by keyboard, after a reload, what is sent, and what observers see."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, expect

from tests.browser.console import Console
from tests.browser.played import play, sent
from tests.browser.states import list_experiments, open_experiments


@pytest.fixture
def console(browser: Browser) -> Iterator[Console]:
    console = play(browser, {"width": 1440, "height": 900}, color_scheme="light")
    yield console
    console.page.evaluate("window.shifts.splice(0)")
    console.faultless()
    console.page.context.close()


def test_an_experiment_is_chosen_and_started_by_keyboard_alone(console: Console) -> None:
    page = console.page
    console.named("experiments-toggle").focus()
    page.keyboard.press("Enter")
    list_experiments(console)
    expect(page.locator("#experiments")).to_be_focused()
    for _ in range(5):  # Close, then the list
        page.keyboard.press("Tab")
    expect(console.named("experiment-filter")).to_be_focused()
    page.keyboard.press("Enter")
    expect(console.named("experiment-back")).to_be_focused()
    console.named("experiment-part").select_option("full")
    console.named("experiment-seeds").focus()
    page.keyboard.type("3-4")
    list_experiments(console)  # what is typed stays
    expect(console.named("experiment-seeds")).to_have_value("3-4")
    page.keyboard.press("Enter")
    starts = [each for each in sent(console, "experiment") if each["op"] == "start"]
    assert [(each["id"], each["small"], each["seeds"]) for each in starts] == [("package:filter", False, "3-4")]
    console.named("experiment-seeds").fill("all of them")
    page.keyboard.press("Enter")
    assert len([each for each in sent(console, "experiment") if each["op"] == "start"]) == 1, (
        "the field says what it takes"
    )
    page.keyboard.press("Escape")
    expect(console.named("experiment-filter")).to_be_focused()
    page.keyboard.press("Escape")
    expect(page.locator("#experiments")).to_be_hidden()
    expect(console.named("experiments-toggle")).to_be_focused()
    assert sent(console, "experiment")[-1]["op"] == "unwatch"


def test_stops_work_while_the_panel_is_open(console: Console) -> None:
    open_experiments(console)
    console.named("experiment-paper").click()
    console.named("experiment-stop").focus()
    console.page.keyboard.press("Space")
    assert len(sent(console, "stop")) == 1
    assert [each["op"] for each in sent(console, "experiment")] == ["watch"], "Space is the robots' stop"
    console.page.keyboard.press("Enter")
    assert sent(console, "experiment")[-1]["op"] == "stop"
    console.named("estop").click()
    assert len(sent(console, "estop")) == 1


def test_a_reload_shows_what_was_open(console: Console) -> None:
    open_experiments(console)
    console.named("experiment-filter").click()
    console.page.reload()
    expect(console.page.locator("#experiments")).to_be_visible()
    list_experiments(console)
    expect(console.page.locator("#experiments-title")).to_have_text("filter")
    list_experiments(console, id="package:other")
    expect(console.named("experiment-paper")).to_be_visible()  # its file is gone: the list


def test_an_observer_watches_and_starts_nothing(console: Console) -> None:
    console.page.evaluate("""() => fake.say({ t: "hello", swarm: "lab", operator: "olga", read_only: true })""")
    open_experiments(console)
    console.named("experiment-paper").click()
    expect(console.named("experiment-now")).to_contain_text("77 of 192 trials")
    expect(console.named("experiment-stop")).to_be_hidden()
    console.named("experiment-back").click()
    console.named("experiment-filter").click()
    expect(console.named("experiment-report")).to_have_attribute("href", "/report/y/")
    expect(console.named("experiment-start")).to_be_hidden()


def test_what_is_wrong_is_said(console: Console) -> None:
    open_experiments(console)
    console.named("experiment-corridors").click()
    expect(console.named("experiment-fault")).to_contain_text("there is no scenario 'corridr'")
    expect(console.named("experiment-start")).to_be_hidden()
    console.page.evaluate("""() => fake.say({
      t: "experiment_list", folder: "x", problem: "experiments are not installed", entries: null })""")
    expect(console.named("experiment-problem")).to_have_text("experiments are not installed")
