"""Charts that a person chooses: kept in the address, with the values of the fleet, and reasons where there are none."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, expect

from tests.browser.axe import NPM, violations
from tests.browser.conftest import SIZE, Snap
from tests.browser.console import Console
from tests.browser.played import ADDRESS, play, sent
from tests.browser.swarm import Observer

FOUR = "?chart=battery@west&chart=speed:r1,r2&chart=work.total_m&chart=x"


@pytest.fixture(scope="module")
def kept(browser: Browser) -> Iterator[Console]:
    """A played console with 12 robots, of which r1 to r3 are the group west."""
    console = play(browser, SIZE, 12, color_scheme="light")
    yield console
    console.page.context.close()


@pytest.fixture
def played(kept: Console) -> Iterator[Console]:
    yield kept
    kept.faultless()


def titles(console: Console) -> list[str]:
    return [each["title"] for each in console.charts()]


def opened(console: Console, query: str) -> None:
    """Open the page with a query in its address, and wait until its charts have data or reasons."""
    console.page.goto(f"{ADDRESS}{query}")
    console.until(lambda: all(each["times"] or each["why"] for each in console.charts()), 10.0, "the charts are there")


def choose(console: Console, of: str, who: str = "") -> None:
    console.named("chart-of").select_option(of)
    if who:
        console.named("chart-who").select_option(label=who)
    console.named("chart-submit").click()


# -------------------------------------------------------------------- a console that is played
def test_a_chart_of_a_group_is_added_and_found_again(played: Console) -> None:
    opened(played, "")
    assert titles(played) == ["Work", "Coverage", "Collisions"]
    assert "chart" not in played.page.url
    played.named("chart-add").click()
    expect(played.named("chart-of")).to_be_focused()
    expect(played.named("chart-doc")).to_contain_text("What Battery is. Unit: %")
    choose(played, "battery", "west")
    expect(played.named("chart-title-3")).to_be_focused()
    assert titles(played)[3] == "Battery · west"
    assert "chart=battery@west" in played.page.url
    played.until(lambda: played.charts()[3]["lines"] == ["r1", "r2", "r3"], 5.0, "a line for each robot")
    assert [line[-1] for line in played.charts()[3]["values"]] == pytest.approx([20.0, 30.0, 40.0]), "%"
    expect(played.named("chart-value-3")).to_have_text("20 to 40 %")
    expect(played.named("chart-table-3").locator("tr")).to_have_text(["r120 %", "r230 %", "r340 %"])
    before = played.charts()
    played.page.reload()
    played.until(lambda: bool(played.charts()[3]["times"]), 10.0, "the same charts again")
    assert titles(played) == [each["title"] for each in before]
    assert played.charts()[3]["lines"] == before[3]["lines"]
    asked = sent(played, "charts")[-1]["charts"]
    assert asked[3] == {"of": "battery", "robots": ["r1", "r2", "r3"]}
    assert [each["of"] for each in asked[:3]] == ["work.total_m", "coverage.fraction", "collisions.events"]


def test_a_chart_is_changed_and_removed(played: Console) -> None:
    opened(played, FOUR)
    played.named("chart-title-1").click()
    expect(played.named("chart-of")).to_have_value("speed")
    choose(played, "network.delay_max_s")
    assert titles(played) == ["Battery · west", "Network, delay max", "Work", "Position x · all robots"]
    expect(played.named("chart-value-1")).to_have_text("0.012 s")
    for _ in range(4):
        played.named("chart-title-0").click()
        played.named("chart-remove").click()
    assert played.charts() == []
    played.page.reload()
    played.until(lambda: bool(sent(played, "charts")), 5.0, "it asks for none")
    assert played.charts() == []
    assert sent(played, "charts")[-1]["charts"] == []
    played.named("chart-add").click()
    played.page.keyboard.press("Escape")
    expect(played.named("chart-add")).to_be_focused()


def test_unknown_names_are_refused_in_their_places(played: Console) -> None:
    opened(played, "?chart=batery&chart=battery@north&chart=%3Cb%3E&chart=speed:%3Ci%3E&chart=round_trip&chart=battery")
    expect(played.named("chart-why-0")).to_have_text("there is no 'batery', did you mean 'battery'?")
    expect(played.named("chart-why-1")).to_have_text("there is no group 'north' now")
    expect(played.named("chart-why-2")).to_have_text("'<b>' is not the name of a field or a metric: choose another one")
    expect(played.named("chart-why-3")).to_have_text("'<i>' is not the name of a robot")
    expect(played.named("chart-why-4")).to_have_text("no robot reports round trip")
    expect(played.named("chart-why-5")).to_be_hidden()
    expect(played.named("chart-value-5")).to_have_text("median 50 %")
    played.named("chart-add").click()
    expect(played.named("chart-note")).to_contain_text("6 charts at most")
    expect(played.named("chart-form")).to_be_hidden()


def test_the_cursor_tells_the_values_by_mouse_and_keys(played: Console) -> None:
    opened(played, FOUR)
    plot, tip = played.named("chart-plot-1"), played.named("chart-tip-1")
    expect(tip).to_be_hidden()
    plot.hover()
    expect(tip).to_contain_text("r1 0.")
    expect(tip).to_contain_text("m/s")
    played.page.mouse.move(5, 5)
    expect(tip).to_be_hidden()
    plot.focus()
    played.page.keyboard.press("Home")
    expect(tip).to_contain_text("-10 min")
    told = plot.get_attribute("aria-valuetext")
    assert told is not None
    assert told.startswith("-10 min: r1 0.")
    played.page.keyboard.press("ArrowRight")
    expect(tip).to_contain_text(re.compile(r"-58\d s"))
    played.page.keyboard.press("Space")
    assert sent(played, "stop"), "Space is the stop here as well"
    if NPM is not None:
        assert violations(played.page) == []


def test_the_details_of_a_robot_chart_its_speed_and_battery(played: Console) -> None:
    opened(played, "?chart=work.total_m&robot=r5")
    for field in ("speed", "battery"):
        played.page.evaluate("fake.detail('r5')")
        played.named(f"detail-chart-{field}").click()
    assert titles(played) == ["Work", "Speed · r5", "Battery · r5"]
    played.named("detail-chart-speed").click()
    assert len(played.charts()) == 3, "it is there already"
    expect(played.named("chart-note")).to_have_text("Charted: Speed · r5")
    assert "robot=r5" in played.page.url


# -------------------------------------------------------------------- a live swarm
def test_charts_have_the_values_of_the_fleet(calm: Console, observer: Observer, snap: Snap) -> None:
    """Against the bus, as another program receives it: positions of robots that stand, and the work of all."""
    calm.select(["r1", "r2"])
    for of, who in (("x", "Selected: r1, r2"), ("battery", "All robots"), ("speed", "All robots")):
        calm.named("chart-add").click()
        choose(calm, of, who)
    calm.until(lambda: all(each["times"] for each in calm.charts()[3:]), 10.0, "they come")
    x = calm.charts()[3]
    observer.fresh()
    assert x["lines"] == ["r1", "r2"]
    assert [line[-1] for line in x["values"]] == pytest.approx(
        [observer.places()[each][0] for each in ("r1", "r2")], abs=0.01
    )
    level = {row.robot: row.health.battery for row in observer.rows() if row.health is not None}
    battery = calm.charts()[4]
    if max(level.values()) < 0.0:
        expect(calm.named("chart-why-4")).to_have_text("no robot reports battery")
    else:
        assert [line[-1] for line in battery["values"]] == pytest.approx(
            [100 * level[each] for each in battery["lines"]], abs=1
        )
    assert calm.charts()[5]["lines"] == [row.robot for row in observer.rows()]
    (work,) = (each.values["total_m"] for each in observer.view.snapshot().summaries if each.metric == "work")
    assert calm.charts()[0]["values"][0][-1] == pytest.approx(work, abs=0.3)
    snap(calm.page, "charts-chosen")
    at_s = calm.charts()[3]["times"][-1]
    calm.page.evaluate("(at_s) => window.fullswarm.look(at_s)", at_s - 2.0)
    expect(calm.named("chart-plot-3")).to_be_visible()
    calm.until(lambda: calm.state["time"]["ready"], 10.0, "the past is shown")
    calm.press("l")
    calm.until(lambda: calm.charts()[3]["times"][-1] > at_s + 1.0, 10.0, "what is live goes on")
    gaps = [later - sooner for sooner, later in zip(x["times"], x["times"][1:], strict=False)]
    assert all(math.isclose(gap, 0.5, abs_tol=0.3) for gap in gaps[-10:])
    for _ in range(3):
        calm.named("chart-title-3").click()
        calm.named("chart-remove").click()
    assert titles(calm) == ["Work", "Coverage", "Collisions"]
