"""What a first-time operator does, task by task: with how few acts, and what the robots then really do.

An act is a click, a key, a drag, a hold, or a text typed into a field. The figures are the measure of the page itself:
a task that suddenly takes more acts has become harder.
"""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from playwright.sync_api import Locator, expect

from tests.browser.conftest import ROBOTS, Snap
from tests.browser.console import Console
from tests.browser.swarm import OTHER, Demo, Observer, far
from tests.browser.test_console_missions import THREE
from tests.browser.test_console_missions import start as start_mission

MOVED_M, STOOD_M = 0.15, 0.03


@dataclass
class Hand:
    """Acts on the page as a person does, and counts."""

    console: Console
    acts: list[str] = field(default_factory=list)

    def click(self, what: Locator | str) -> None:
        place = self.console.named(what) if isinstance(what, str) else what
        place.click()
        self.acts.append("click")

    def floor(self, x_m: float, y_m: float) -> None:
        self.console.click_floor(x_m, y_m)
        self.acts.append("click")

    def key(self, key: str) -> None:
        self.console.press(key)
        self.acts.append(key)

    def fill(self, place: Locator, text: str) -> None:
        place.fill(text)
        self.acts.append("type")

    def tick(self, *robots: str) -> None:
        for robot in robots:
            self.click(self.console.named(f"robot-row-{robot}").get_by_role("checkbox"))

    def drag(self, begin: tuple[float, float], end: tuple[float, float]) -> None:
        with self.held(begin):
            self.console.page.mouse.move(*end, steps=6)

    @contextmanager
    def held(self, place: tuple[float, float]) -> Iterator[None]:
        """Press at a place of the page and let go afterwards."""
        mouse = self.console.page.mouse
        mouse.move(*place)
        mouse.down()
        try:
            yield
        finally:
            mouse.up()
            self.acts.append("hold")


@pytest.fixture
def hand(calm: Console) -> Hand:
    """Acts on a page as it is when it is opened: no form is."""
    if calm.named("behaviour-form").is_visible():
        calm.named("form-back").click()
    return Hand(calm)


def middle(place: Locator) -> tuple[float, float]:
    """Return the middle of an element on the page."""
    box = place.bounding_box()
    assert box is not None
    return box["x"] + box["width"] / 2.0, box["y"] + box["height"] / 2.0


def test_one_robot_is_sent_to_a_place(hand: Hand, observer: Observer, snap: Snap) -> None:
    before = observer.fresh().places()
    x_m, y_m = before["r2"]
    hand.tick("r2")
    hand.key("g")
    hand.floor(min(9.0, x_m + 1.5) if x_m < 5.0 else x_m - 1.5, y_m)
    observer.until(lambda: far(before["r2"], observer.places()["r2"]) > MOVED_M, 15.0, "it goes")
    snap(hand.console.page, "task-go")
    assert all(far(before[each], observer.places()[each]) < STOOD_M for each in ROBOTS if each != "r2")
    assert len(hand.acts) == 3


def test_all_robots_form_a_ring(hand: Hand, observer: Observer, snap: Snap) -> None:
    hand.key("Control+a")
    hand.key("o")
    hand.drag(hand.console.at(5.0, 7.5), hand.console.at(6.7, 7.5))
    observer.until(lambda: not observer.stand(), 15.0, "they set off")
    snap(hand.console.page, "task-form")
    assert len(hand.acts) == 3
    goals = hand.console.state["goals"]
    assert len(goals) == len(ROBOTS)


def test_two_groups_are_made_and_one_of_them_is_started(hand: Hand, observer: Observer, snap: Snap) -> None:
    console = hand.console
    for name, robots in (("left", ("r1", "r2")), ("right", ("r3", "r4"))):
        console.press("Escape")
        hand.tick(*robots)
        hand.click("group-new")
        hand.fill(console.named("group-name"), name)
        hand.click("group-save")
        expect(console.named(f"group-{name}")).to_be_visible()
    hand.click("group-left")
    assert sorted(console.state["selection"]) == ["r1", "r2"]
    hand.click("behaviour-flocking_bc")
    hand.click("start")
    observer.until(
        lambda: {each.robot for each in observer.healths() if each.behaviour == "flocking_bc"} == {"r1", "r2"},
        15.0, "the left ones run it, and no other",
    )  # fmt: skip
    snap(console.page, "task-groups")
    assert len(hand.acts) == 2 * 5 + 3
    for name in ("left", "right"):
        console.named(f"group-{name}").click()
        console.named("group-delete").click()
        expect(console.named(f"group-{name}")).to_have_count(0)


def test_all_are_stopped(hand: Hand, observer: Observer) -> None:
    observer.operator.request("flocking_bc", ())
    observer.until(lambda: not observer.stand(), 15.0, "they drive")
    hand.key("Space")
    observer.until(lambda: observer.all_stand_with(""), 5.0, "all stand")
    assert len(hand.acts) == 1


def test_an_e_stop_is_pressed_and_cleared(hand: Hand, observer: Observer) -> None:
    console = hand.console
    hand.key("e")
    observer.until(lambda: all(each.estop for each in observer.healths()), 10.0, "all have latched")
    hand.click("estop-clear")
    with hand.held(middle(console.named("estop-clear-hold"))):
        observer.until(lambda: not any(each.estop for each in observer.healths()), 10.0, "it is released")
    assert len(hand.acts) == 3


def test_a_robot_is_taken_over(hand: Hand, demo: Demo, observer: Observer) -> None:
    before = observer.fresh().places()["r3"]
    with demo.other_operator("leases", "hold", "r3"):
        expect(hand.console.named("lease-r3")).to_have_text(OTHER, timeout=20_000)
        hand.tick("r3")
        hand.key("g")
        hand.floor(5.0, 8.5)
        hand.click("take-over")
        observer.until(lambda: far(before, observer.places()["r3"]) > MOVED_M, 15.0, "it obeys")
    assert len(hand.acts) == 4


def test_a_robot_is_driven_by_the_stick_on_the_screen(hand: Hand, observer: Observer, snap: Snap) -> None:
    console = hand.console
    hand.tick("r5")
    hand.click("drive-toggle")
    x, y = middle(console.named("stick"))
    with hand.held((x, y)):
        console.page.mouse.move(x + 40.0, y, steps=4)
        observer.until(lambda: abs(observer.rows(["r5"])[0].turn_rad_s) > 0.1, 10.0, "it turns")
        snap(console.page, "task-stick")
        assert observer.stand(each for each in ROBOTS if each != "r5")
    observer.until(lambda: abs(observer.rows(["r5"])[0].turn_rad_s) < 0.02, 2.0, "it stands when the stick is let go")
    assert len(hand.acts) == 3
    console.named("drive-toggle").click()


def test_the_faulty_robot_and_its_cause_are_found(hand: Hand, demo: Demo, observer: Observer, snap: Snap) -> None:
    console = hand.console
    demo.hold_restarts(True)
    agent = demo.child("agent", "r6")
    agent.send_signal(signal.SIGSTOP)
    try:
        chip = console.named("attention-r6")
        expect(chip).to_be_visible(timeout=15_000)
        hand.click(chip)
        expect(console.named("attention-words")).to_contain_text("Check its power and network")
        hand.click("details-r6")
        expect(console.page.locator("#detail-state")).to_contain_text("SILENT")
        snap(console.page, "task-faulty")
    finally:
        agent.send_signal(signal.SIGCONT)
        demo.hold_restarts(False)
    assert len(hand.acts) == 2
    console.named("detail-close").click()
    observer.until(
        lambda: (
            len(observer.healths()) == len(ROBOTS)
            and not any(each.silent for each in observer.rows())
            and all(each.lifecycle in ("READY", "ACTIVE") for each in observer.healths())
        ),
        90.0, "it is back",
    )  # fmt: skip


def test_a_mission_is_confirmed_and_aborted(hand: Hand, observer: Observer) -> None:
    client = start_mission(observer)
    card = hand.console.named("mission-tour").first
    expect(card).to_be_visible()
    hand.click(card.get_by_role("button", name="Confirm: Is the hall clear?", exact=True))
    observer.until(lambda: all(each.behaviour == "flocking_bc" for each in observer.healths(THREE)), 15.0, "they run")
    hand.click(card.get_by_role("button", name="Abort…", exact=True))
    hand.click(card.get_by_role("button", name="Abort", exact=True))
    observer.until(lambda: all(each.behaviour == "" for each in observer.healths(THREE)), 15.0, "they stop")
    assert len(hand.acts) == 3
    hand.console.named("missions-toggle").click()
    client.close()


def test_the_last_minute_is_looked_at_again(hand: Hand, snap: Snap) -> None:
    console = hand.console
    for _ in range(5):
        hand.key(",")
    console.until(
        lambda: not console.state["time"]["live"] and console.state["time"]["ready"], 15.0, "the past is shown"
    )
    at_s = console.state["time"]["at_s"]
    hand.key("p")
    console.until(lambda: console.state["time"]["at_s"] > at_s + 1.0, 15.0, "it plays")
    snap(console.page, "task-past")
    expect(console.named("past-banner")).to_be_visible()
    hand.key("l")
    console.until(lambda: console.state["time"]["live"], 10.0, "it is live again")
    assert len(hand.acts) == 7


def test_an_experiment_is_started_watched_and_its_report_opened(
    hand: Hand, demo: Demo, folder: Path, snap: Snap
) -> None:
    page = hand.console.page
    hand.click("experiments-toggle")
    hand.click("experiment-meet")
    hand.click("experiment-start")
    now = hand.console.named("experiment-now")
    expect(now).to_contain_text("Running, started by")
    other = page.context.new_page()
    other.goto(demo.address)
    other.get_by_test_id("experiments-toggle").click()
    expect(other.get_by_test_id("experiment-state-meet")).to_contain_text(re.compile("running|ended"))
    other.close()
    expect(now).to_contain_text("It has ended: 2 of 2 trials", timeout=150_000)
    snap(page, "task-experiment")
    errors: list[str] = []
    with page.context.expect_page() as opened:
        page.context.once("page", lambda tab: tab.on("console", lambda said: errors.append(said.text)))
        hand.click("experiment-report")
    report = opened.value
    results = [json.loads(each.read_bytes()) for each in (folder / "experiments/meet/trials").glob("*/result.json")]
    seconds = sum(each["outcome"]["simulated_s"] for each in results)
    tiles = report.locator(".tiles li")
    expect(tiles.filter(has_text="trials done").locator("b")).to_have_text(str(len(results)))
    expect(tiles.filter(has_text="simulated").locator("b")).to_have_text(f"{seconds:.0f} s")
    assert report.evaluate("self.origin") == "null", "it is apart from the console's page"
    assert errors == []
    report.close()
    assert len(hand.acts) == 4
    hand.console.named("experiments-close").click()
