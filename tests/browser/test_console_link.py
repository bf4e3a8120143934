"""What dies and comes back: the core, the page itself, the console."""

from __future__ import annotations

import signal

from playwright.sync_api import expect

from tests.browser.conftest import Snap
from tests.browser.console import Console
from tests.browser.swarm import START_S, Demo, Observer

TOLD_MS = 1500.0


def test_a_killed_core_is_shown_within_one_and_a_half_seconds(
    calm: Console, demo: Demo, observer: Observer, snap: Snap
) -> None:
    core = demo.child("core")
    expect(calm.named("link-state")).to_have_text("live")
    demo.hold_restarts(True)
    try:
        calm.says("link-state", "core is silent")
        killed_ms = calm.now_ms()  # before the kill, so the figure is rather too long
        core.send_signal(signal.SIGKILL)
        told_after_ms = calm.said_ms() - killed_ms
        snap(calm.page, "core-silent")
    finally:
        demo.hold_restarts(False)
    assert told_after_ms < TOLD_MS
    expect(calm.named("link-state")).to_have_text("live", timeout=1000 * START_S)
    calm.start("flocking_bc")
    observer.until(lambda: observer.all_run("flocking_bc") and not observer.stand(), 15.0, "the new core is obeyed")


def test_a_reload_in_mid_run_loses_nothing(calm: Console, observer: Observer) -> None:
    calm.select(["r4", "r5"])
    calm.start("flocking_bc")
    expect(calm.named("lease-r4")).to_have_text("you")
    pair = ("r4", "r5")
    observer.until(
        lambda: not observer.stand(pair) and all(each.behaviour == "flocking_bc" for each in observer.healths(pair)),
        10.0,
        "both drive",
    )
    calm.until(lambda: calm.state["trails"]["r4"] > 5, 10.0, "a trail is drawn")
    before, log, operator = calm.state, calm.named("log").inner_text(), calm.page.locator("#operator").inner_text()
    charted = len(calm.charts()[0]["times"])
    request_ids = {health.request_id for health in observer.healths(pair)}
    calm.faultless()

    calm.page.reload()
    expect(calm.named("link-state")).to_have_text("live")
    calm.until(lambda: len(calm.state["robots"]) == 8, 5.0, "all robots are back")
    after = calm.state
    assert after["operator"] == before["operator"]
    assert calm.page.locator("#operator").inner_text() == operator
    assert log[-1500:] in calm.named("log").inner_text(), "its newest lines: the console keeps fewer than a page"
    calm.until(lambda: len(calm.charts()[0]["times"]) >= charted > 0, 5.0, "the charts are back")
    assert all(after["trails"][robot] >= 0.8 * length for robot, length in before["trails"].items()), "thinned at most"
    assert after["goals"].keys() >= before["goals"].keys()
    for robot in pair:
        expect(calm.named(f"lease-{robot}")).to_have_text("you")
    observer.fresh()
    assert {health.request_id for health in observer.healths(pair)} == request_ids, "no robot noticed"
    assert not observer.stand(pair)
    expect(calm.named("lost")).to_be_hidden()


def test_a_console_that_dies_is_started_again_and_the_page_finds_it(calm: Console, demo: Demo) -> None:
    operator = calm.state["operator"]
    demo.hold_restarts(True)
    try:
        demo.child("console").send_signal(signal.SIGKILL)
        expect(calm.named("link-state")).to_contain_text("no data for")
    finally:
        demo.hold_restarts(False)
    expect(calm.named("link-state")).to_have_text("live", timeout=1000 * START_S)
    assert calm.state["operator"] == operator, "the same operator, in another process of the console"
    for words in ("WebSocket connection", "icon.svg"):  # the browser itself complains of a server that is not there
        calm.forgive(words)
