"""The fleet in words and in order: attention, endings, refusals, details of a robot, undo, own groups."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, expect

from fullswarm.keys import Keys
from fullswarm.messages import BehaviourRequest, ParamReply
from fullswarm.operator.params import ParamClient
from tests.browser.conftest import ROBOTS, SIZE, Snap
from tests.browser.console import Console
from tests.browser.swarm import Demo, Observer, far

KEYS = Keys("swarm")
ORDER = "[...document.querySelectorAll('.row')].map((row) => [row.id, row.getBoundingClientRect().top])"
NEED_MS = 8_000


@pytest.fixture
def requests(observer: Observer) -> Iterator[list[BehaviourRequest]]:
    """All requests on the bus, as another program receives them: each once."""
    found: dict[str, BehaviourRequest] = {}
    listed: list[BehaviourRequest] = []

    def receive(request: BehaviourRequest) -> None:
        if found.setdefault(request.id, request) is request:
            listed.append(request)

    subscription = observer.bus.subscribe(KEYS.behaviour_request, BehaviourRequest, receive)
    yield listed
    subscription.close()


def test_rows_stay_where_they_are_and_the_strip_names_who_needs_attention(
    calm: Console, observer: Observer, snap: Snap
) -> None:
    expect(calm.named("attention-count")).to_have_text("None needs attention", timeout=NEED_MS)
    before = calm.page.evaluate(ORDER)
    assert [row.removeprefix("robot-row-") for row, _ in before] == list(ROBOTS)
    observer.operator.estop(True, ("r6",))
    expect(calm.named("attention-r6")).to_have_text("r6 e-stop", timeout=NEED_MS)
    expect(calm.named("attention-count")).to_have_text("1 needs attention")
    assert calm.page.evaluate(ORDER) == before, "no row has moved"
    snap(calm.page, "attention")
    calm.named("attention-r6").click()
    assert calm.state["selection"] == ["r6"]
    expect(calm.named("attention-words")).to_contain_text("clear the e-stop")
    calm.named("attention-only").click()
    expect(calm.page.locator(".row")).to_have_count(1)
    calm.named("attention-only").click()
    expect(calm.page.locator(".row")).to_have_count(8)
    observer.operator.estop(False)
    observer.until(lambda: not any(health.estop for health in observer.healths()), 10.0, "it is released")
    calm.page.mouse.move(700, 500)
    calm.page.evaluate("document.activeElement?.blur()")
    expect(calm.named("attention-count")).to_have_text("None needs attention", timeout=NEED_MS)
    expect(calm.named("attention-r6")).to_have_count(0)


def test_what_ends_as_intended_is_no_alarm(calm: Console, observer: Observer) -> None:
    calm.select(["r2"])
    calm.page.evaluate("document.activeElement?.blur()")
    calm.page.keyboard.down("Shift")
    calm.page.keyboard.down("ArrowLeft")
    expect(calm.named("driving")).to_have_text("driving r2")
    observer.until(lambda: observer.healths(["r2"])[0].behaviour == "drive_bc", 10.0, "it is driven")
    calm.page.keyboard.up("ArrowLeft")
    calm.page.keyboard.up("Shift")
    observer.until(lambda: observer.healths(["r2"])[0].stop_code == "expired", 10.0, "the stick's intent has expired")
    row = calm.named("robot-row-r2")
    expect(row).to_contain_text("stick released", timeout=NEED_MS)
    expect(calm.named("attention-count")).to_have_text("None needs attention")
    expect(row).not_to_have_class(re.compile("attention"))
    expect(calm.named("driving")).to_contain_text("none active")
    calm.start("flocking_bc")
    observer.until(lambda: observer.healths(["r2"])[0].behaviour == "flocking_bc", 10.0, "it flocks")
    expect(calm.named("driving")).to_contain_text("1 active")
    calm.press("Space")
    observer.until(observer.is_calm, 10.0, "all are stopped")
    expect(row).to_contain_text("stopped by an operator", timeout=NEED_MS)
    expect(calm.named("attention-count")).to_have_text("None needs attention")
    calm.clear_the_map()


def test_a_refusal_says_what_to_click_is_counted_and_goes_with_its_cause(calm: Console, observer: Observer) -> None:
    observer.operator.estop(True, ("r1",))
    observer.until(lambda: observer.healths(["r1"])[0].estop, 10.0, "it is latched")
    calm.select(["r1"])
    calm.start("flocking_bc")
    refusal = calm.named("refusal")
    expect(refusal).to_contain_text("clear it with the button")
    expect(refusal).to_contain_text("Flocking")
    assert "`" not in refusal.inner_text()
    line = calm.named("log").locator(".entry-refused").filter(has_text="Flocking refused")
    expect(line).to_have_count(1)
    calm.named("start").click()
    expect(line.locator(".entry-count")).to_have_text("× 2")
    expect(line).to_have_count(1)
    expect(refusal).to_contain_text("clear it with the button")
    observer.operator.estop(False)
    expect(refusal).to_have_text("", timeout=NEED_MS)
    calm.named("start").click()
    observer.until(lambda: observer.healths(["r1"])[0].behaviour == "flocking_bc", 10.0, "it obeys again")
    expect(calm.named("progress")).to_have_text("Flocking: 1 of 1 run it")


def test_the_details_of_a_robot_are_those_on_the_bus_and_in_the_address(
    calm: Console, observer: Observer, snap: Snap
) -> None:
    calm.select(["r4"])
    calm.start("move_to_goal_bc", goal="5, 8.5")
    observer.until(lambda: not observer.stand(["r4"]), 10.0, "it drives")
    calm.named("details-r4").click()
    expect(calm.named("detail-title")).to_be_focused()
    facts = calm.named("detail")
    health = observer.fresh().healths(["r4"])[0]
    for words in (health.driver, f"{health.make}, {health.model}", "Move to goal", "5, 8.5 m", "you"):
        expect(facts).to_contain_text(words)
    assert health.model == "kinematic disc"
    expect(calm.named("detail-requests").locator("li").first).to_contain_text("Move to goal")
    expect(calm.named("detail-speed-words")).to_have_text(re.compile(r"^\d\.\d\d m/s, commanded \d\.\d\d m/s"))
    assert "robot=r4" in calm.page.url
    snap(calm.page, "detail")

    def at() -> tuple[float, float]:
        found = re.search(r"(-?[\d.]+) m, (-?[\d.]+) m, heading", facts.inner_text())
        return (float(found[1]), float(found[2])) if found else (99.0, 99.0)

    calm.until(lambda: far(at(), observer.fresh().places()["r4"]) < 0.5, 10.0, "the pane's pose is the robot's")
    calm.faultless()
    calm.page.reload()
    expect(calm.named("detail-title")).to_have_text("r4")
    expect(facts).to_contain_text(health.driver)
    calm.named("detail-next").click()
    expect(calm.named("detail-title")).to_have_text("r5")
    calm.named("detail-close").click()
    expect(calm.named("detail")).to_be_hidden()
    assert "robot=" not in calm.page.url
    calm.until(lambda: len(calm.state["robots"]) == 8, 10.0, "all robots are on the map")
    observer.operator.stop()
    observer.until(observer.is_calm, 10.0, "all stand")
    calm.clear_the_map()
    calm.page.mouse.dblclick(*calm.at(*calm.places()["r7"]))
    expect(calm.named("detail-title")).to_have_text("r7")
    calm.page.keyboard.press("Escape")
    expect(calm.named("detail")).to_be_hidden()
    assert calm.state["selection"] == ["r7"], "Escape has closed the pane alone"
    calm.page.locator("#map").focus()
    calm.page.keyboard.press("Enter")
    expect(calm.named("detail-title")).to_have_text("r7")
    calm.named("detail-close").click()


def test_undo_says_what_it_does_and_asks_again_for_what_ran_before(
    calm: Console, observer: Observer, requests: list[BehaviourRequest]
) -> None:
    calm.select(["r1", "r2"])
    calm.start("move_to_goal_bc", goal="5, 8.5", arrive_radius_m="1.5")
    observer.until(lambda: running(observer, "r1", "r2") == {"move_to_goal_bc"}, 10.0, "two drive to a goal")
    calm.select(["r1", "r2", "r3"])
    calm.start("flocking_bc")
    observer.until(lambda: running(observer, "r1", "r2", "r3") == {"flocking_bc"}, 10.0, "three flock")
    undo = calm.named("undo")
    expect(undo).to_have_text("Undo Flocking: ask again for Move to goal for r1, r2; stop r3")
    first = next(each for each in requests if each.behaviour == "move_to_goal_bc")
    del requests[:]
    undo.click()
    observer.until(
        lambda: running(observer, "r1", "r2") == {"move_to_goal_bc"} and running(observer, "r3") == {""}, 10.0, "undone"
    )
    again = next(each for each in requests if each.behaviour == "move_to_goal_bc")
    assert again.id != first.id
    assert (again.robots, again.parameters, again.operator) == (first.robots, first.parameters, first.operator)
    assert not again.take
    expect(undo).to_be_hidden()
    calm.start("flocking_bc")
    observer.until(lambda: running(observer, "r3") == {"flocking_bc"}, 10.0, "they flock again")
    expect(undo).to_contain_text("Undo Flocking")
    calm.press("Space")
    expect(undo).to_be_hidden()
    calm.clear_the_map()


def running(observer: Observer, *robots: str) -> set[str]:
    return {health.behaviour for health in observer.healths(robots)}


def test_a_group_of_the_selection_is_there_for_all_consoles_and_other_programs(
    calm: Console, demo: Demo, browser: Browser, observer: Observer
) -> None:
    calm.select(["r5", "r6"])
    calm.named("group-new").click()
    calm.named("group-name").fill("a pair")
    calm.page.keyboard.press("Enter")
    expect(calm.named("group-problem")).to_contain_text("letters, digits")
    calm.named("group-name").fill("pair")
    calm.page.keyboard.press("Enter")
    expect(calm.named("group-pair")).to_be_visible()
    assert stored(observer, "group/pair") == {"robots": ["r5", "r6"]}
    context = browser.new_context(viewport=SIZE)
    other = Console(context.new_page(), demo.address)
    other.named("group-pair").click()
    expect(other.named("selection")).to_have_text("2 selected")
    other.page.locator("#group-delete").click()
    expect(other.named("group-pair")).to_have_count(0)
    expect(calm.named("group-pair")).to_have_count(0)
    assert stored(observer, "group/pair") is None
    other.faultless()
    context.close()


def stored(observer: Observer, key: str) -> object:
    """Return what the core keeps, as another program asks for it."""
    replies: list[ParamReply] = []
    ParamClient(observer.bus, KEYS, observer.runtime, "observer").ask("get", key, replies.append)
    observer.until(lambda: bool(replies), 5.0, "the core answers")
    return replies[0].entries[0].value if replies[0].entries else None
