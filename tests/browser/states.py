"""The states of the page that are looked at in all sizes, and how it gets into each of them, with a played console."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from playwright.sync_api import expect

from tests.browser.console import Console
from tests.browser.played import change

SIZES = ((1440, 900), (1024, 700), (768, 1024), (390, 844), (844, 390), (720, 450))
"""The last one is a laptop's screen at 200 %."""
GEOMETRY = Path(__file__).with_name("geometry.js").read_text()
LEAST_ROWS = 4
"""Of the fleet, seen whole where it is shown and none is in trouble."""
State = Callable[[Console], AbstractContextManager[None]]


def complaints(console: Console, *, coarse: bool, name: str = "") -> list[str]:
    """Return what is wrong with where things are, one line each."""
    size = console.page.viewport_size
    assert size is not None
    low = size["height"] < 640
    rows = {"fleet": LEAST_ROWS - low, "trouble": LEAST_ROWS - 1 - low}.get(name, 0)
    found: list[str] = console.page.evaluate(f"({GEOMETRY})({{ coarse: {str(coarse).lower()}, rows: {rows} }})")
    return found + hidden_labels(console)


BUTTONS = """() => {
  const map = document.querySelector("#map").getBoundingClientRect();
  const buttons = [...document.querySelectorAll(".zoom button, .camera-toggle")];
  const boxes = buttons.map((each) => each.getBoundingClientRect());
  return boxes.filter(({ width }) => width).map(({ left, top, right, bottom }) => [left - map.left, top - map.top,
    right - map.left, bottom - map.top]);
}"""


def hidden_labels(console: Console) -> list[str]:
    """Return which labels on the map lie under its buttons: none, a second after a button has come."""

    def under() -> list[str]:
        boxes = console.page.evaluate(BUTTONS)
        return [
            f"the label {label['key']} lies under a button"
            for label in console.state["labels"]
            for left, top, right, bottom in boxes
            if label["left"] < right and label["left"] + label["width"] > left
            and label["top"] < bottom and label["top"] + label["height"] > top
        ]  # fmt: skip

    for _ in range(20):
        if not (found := under()):
            break
        console.page.wait_for_timeout(50)
    return found


def show(console: Console, panel: str) -> None:
    """Show a panel, where there are tabs."""
    tab = console.page.locator(f'#tabs [data-tab="{panel}"]')
    if tab.is_visible():
        tab.click()


@contextmanager
def fleet(console: Console) -> Iterator[None]:
    show(console, "fleet")
    yield


@contextmanager
def trouble(console: Console) -> Iterator[None]:
    """One robot needs attention, for a reason that takes some words."""
    show(console, "fleet")
    change(console, trouble={"r3": ["cliff", "a cliff sensor sees no floor at the front left"]})
    yield
    change(console, trouble={})


@contextmanager
def estop(console: Console) -> Iterator[None]:
    """All have latched, and it is asked whether all people are clear of them."""
    show(console, "fleet")
    latch(console)
    yield
    release(console)


@contextmanager
def receipts(console: Console) -> Iterator[None]:
    latch(console)
    fold = console.page.locator("#estop-fold")
    if fold.get_attribute("aria-expanded") == "false":
        fold.click()
    yield
    release(console)


@contextmanager
def clearing(console: Console) -> Iterator[None]:
    latch(console)
    console.named("estop-clear").click()
    expect(console.named("estop-clear-hold")).to_be_visible()
    yield
    release(console)


def latch(console: Console) -> None:
    console.page.evaluate("""() => {
      const ids = fake.ids();
      Object.assign(fake.swarm, { estop: ids });
      const stood = { standing: true, rolled_m: 0.02, engaged: true };
      const receipts = ids.map((robot, k) => ({ robot, after_s: 0.1 + k / 50, ...stood }));
      fake.say({ t: "estop", id: "e1", engaged: true, done: true, receipts, waiting: [], silent: [] });
      fake.tick();
    }""")
    expect(console.page.locator("#estop-title")).to_contain_text("confirmed standing")


def clear(console: Console) -> None:
    """Clear the e-stop as another operator does."""
    console.page.evaluate("""() => {
      Object.assign(fake.swarm, { estop: [] });
      fake.say({ t: "estop", id: "e2", engaged: false, done: true, receipts: [], waiting: [], silent: [] });
      fake.tick();
    }""")


def release(console: Console) -> None:
    clear(console)
    console.page.evaluate("fake.skip(6000)")
    expect(console.page.locator("#estop-panel")).to_be_hidden()


@contextmanager
def form(console: Console) -> Iterator[None]:
    """The form of a behaviour with many parameters."""
    show(console, "behaviours")
    console.named("behaviour-flocking_bc").click()
    expect(console.named("start")).to_be_visible()
    yield
    console.named("form-back").click()


@contextmanager
def question(console: Console) -> Iterator[None]:
    """Another operator holds the robots."""
    show(console, "fleet")
    leases = [{"robot": robot, "operator": "ben@workshop", "taken_from": "", "mine": False} for robot in ("r2", "r3")]
    change(console, leases=leases)
    console.select(["r2"])
    console.page.evaluate("document.querySelector('#map').focus()")
    console.page.keyboard.press("Shift+ArrowUp")  # driving asks whether to take over
    expect(console.named("question")).to_be_visible()
    yield
    console.page.locator("#question-no").click()
    console.press("Escape")
    change(console, leases=[])


@contextmanager
def missions(console: Console) -> Iterator[None]:
    steps = [
        {
            "name": name, "behaviour": "flocking_bc", "phase": phase, "robots": ["r1", "r2"], "elapsed_s": 12.0,
            "waits_for": waits, "confirm": confirm, "reason": "", "places": places,
        }
        for name, phase, waits, confirm, places in (
            ("roam", "done", [], "", [{"parameter": "goal", "kind": "point", "points": [[2, 8]]}]),
            ("ask", "running", [], "Is the hall clear?", []),
            ("meet", "waiting", ["after: west/ask"], "", [{"parameter": "goal", "kind": "point", "points": [[7, 4]]}]),
        )
    ]  # fmt: skip
    tour = {"mission": "m1", "name": "tour", "phase": "running", "operator": "berta", "reason": "", "silent": False,
            "tracks": [{"name": "west", "steps": steps}, {"name": "east", "steps": steps[2:]}]}  # fmt: skip
    change(console, missions=[tour])
    show(console, "missions")
    toggle = console.named("missions-toggle")
    if toggle.is_visible() and toggle.get_attribute("aria-pressed") == "false":
        toggle.click()
    expect(console.named("mission-tour")).to_be_visible()
    yield
    change(console, missions=[])
    if toggle.is_visible():
        toggle.click()


@contextmanager
def mission_form(console: Console) -> Iterator[None]:
    """A mission of points that is being made."""
    show(console, "fleet")
    console.select(["r2", "r3"])
    show(console, "missions")
    toggle = console.named("missions-toggle")
    if toggle.is_visible() and toggle.get_attribute("aria-pressed") == "false":
        toggle.click()
    console.named("mission-new").click()
    for _ in range(7):
        console.page.evaluate("document.querySelector('#map').focus()")
        console.page.keyboard.press("ArrowRight")
        console.page.keyboard.press("ArrowUp")
        console.page.keyboard.press("Enter")
    expect(console.page.locator("#mission-points li")).to_have_count(7)
    yield
    console.named("mission-cancel").click()
    console.press("Escape")
    if toggle.is_visible():
        toggle.click()


@contextmanager
def ranges(console: Console) -> Iterator[None]:
    """What the range sensors of two selected robots measure."""
    show(console, "fleet")
    change(console, ranged=["r1", "r2", "r3"])
    console.select(["r1", "r2"])
    console.page.evaluate("""() => {
      const rays = Uint16Array.from({ length: 90 }, (_, k) => 900 + 300 * Math.sin(k / 5));
      const mm = btoa(String.fromCharCode(...new Uint8Array(rays.buffer)));
      const plain = { first_rad: -Math.PI, step_rad: Math.PI / 45, cone_rad: 0, max_m: 4, age_s: 0.05, mm };
      const say = () => ["r1", "r2"].forEach((robot) => {
        const { x, y } = window.fullswarm.state.robots[robot];
        fake.say({ t: "scans", robot, scans: [{ ...plain, at: [x, y, 0] }] });
      });
      say();
      window.scanning = setInterval(say, 200); // a scan is shown for a second
    }""")
    console.until(lambda: set(console.state["ranges"]) == {"r1", "r2"}, 5.0, "the scans are drawn")
    yield
    console.page.evaluate("clearInterval(window.scanning)")
    console.press("Escape")
    change(console, ranged=[])


@contextmanager
def cameras(console: Console) -> Iterator[None]:
    """The cameras, one with a problem, in place of a panel."""
    problem = "the camera has moved: no fixes until it hangs still and its floor tags are visible"
    known = [{"name": "ceiling", "problem": ""}, {"name": "door", "problem": problem}]
    console.page.evaluate("(cameras) => fake.say({ t: 'cameras', cameras })", known)
    more = console.named("tool-more")
    if more.is_visible():
        more.click()
    console.named("camera-toggle").click()
    console.named("camera-under").select_option("ceiling")
    expect(console.named("camera-floor-words")).to_contain_text("Not drawn")
    yield
    console.named("camera-under").select_option("")
    console.page.locator("#camera-close").click()
    console.page.evaluate("fake.say({ t: 'cameras', cameras: [] })")


@contextmanager
def bookmarks(console: Console) -> Iterator[None]:
    show(console, "fleet")
    console.named("time-more").click()
    expect(console.named("mark-add")).to_be_visible()
    yield
    console.named("time-close").click()


def open_experiments(console: Console) -> None:
    """Open the panel, with a list."""
    fold = console.named("bar-fold")
    if fold.is_visible():
        fold.click()
    console.named("experiments-toggle").click()
    list_experiments(console)
    expect(console.named("experiment-paper")).to_be_visible()


def list_experiments(console: Console, **fields: object) -> None:
    """Have the console send a list that has all there can be: states, a fault, long names; `fields` are of "filter"."""
    cells = [
        {
            "behaviour": f"{name} cohesion_per_s=0.35 separation_m=0.8", "scenario": "concave", "robots": robots,
            "words": f"{name} concave kinematic paper", "trials": 6, "failed": robots // 32, "collisions": 24 * robots,
            "expected": name == "flocking", "arrived": 0.98,
        }
        for name in ("flocking", "flocking_bc") for robots in (4, 8, 16, 32)
    ]  # fmt: skip
    results = {
        "trials": 192, "finished": 77, "failed": 2, "collisions": 2880, "unexpected": 1440, "left_s": 130, "older": 3,
        "unreadable": 1, "cells": cells, "more_cells": 20,
        "failures": ["flocking_bc concave N=32 kinematic paper seed 3: it took longer than 600 s (2 times)"],
    }  # fmt: skip
    plain = {
        "kind": "package", "description": "Move to goal with and without barrier certificates", "fault": "",
        "trials": 640, "small_trials": 192, "seeds": "0-19", "small_seeds": "0-5", "can_start": True, "state": "new",
        "by": "", "stopping": False, "words": "", "bad": False, "report": "", "results": None,
    }  # fmt: skip
    wrong = "experiments/corridors_of_the_new_hall.toml:12: groups[0].scenarios: there is no scenario 'corridr'"
    states: dict[str, dict[str, object]] = {
        "corridors": {"state": "faulty", "fault": wrong, "can_start": False},
        "paper": {"state": "running", "by": "anna@lab", "results": results},
        "safety": {"state": "ended", "report": "/report/x/", "results": results},
        "filter": {"state": "stopped", "report": "/report/y/", "results": results, **fields},
        "paper_filter": {},
    }
    entries = [plain | {"id": f"package:{name}", "name": name} | fields for name, fields in states.items()]
    frame = {"t": "experiment_list", "folder": "experiments", "problem": "", "entries": entries}
    console.page.evaluate("(frame) => fake.say(frame)", frame)


@contextmanager
def experiments(console: Console) -> Iterator[None]:
    """The list of experiments."""
    open_experiments(console)
    yield
    console.named("experiments-close").click()


@contextmanager
def experiment(console: Console) -> Iterator[None]:
    """An experiment that runs."""
    open_experiments(console)
    console.named("experiment-paper").click()
    expect(console.named("experiment-stop")).to_be_visible()
    yield
    console.named("experiment-back").click()
    console.named("experiments-close").click()


@contextmanager
def experiment_stopped(console: Console) -> Iterator[None]:
    """An experiment that can be continued, and whose report can be opened."""
    open_experiments(console)
    console.named("experiment-filter").click()
    expect(console.named("experiment-report")).to_be_visible()
    yield
    console.named("experiment-back").click()
    console.named("experiments-close").click()


@contextmanager
def stick(console: Console) -> Iterator[None]:
    show(console, "drive")
    toggle = console.named("drive-toggle")
    if toggle.is_visible():
        toggle.click()
    expect(console.named("stick")).to_be_visible()
    yield
    if toggle.is_visible():
        toggle.click()


@contextmanager
def charts(console: Console) -> Iterator[None]:
    show(console, "charts")
    yield


@contextmanager
def chart_form(console: Console) -> Iterator[None]:
    """It is chosen what a chart shows."""
    show(console, "charts")
    console.named("chart-add").click()
    expect(console.named("chart-submit")).to_be_visible()
    yield
    console.named("chart-cancel").click()


@contextmanager
def lines(console: Console) -> Iterator[None]:
    """A chart has a line for each of eight robots, of more their least, median and largest; its cursor names them."""
    show(console, "charts")
    console.named("chart-add").click()
    console.named("chart-of").select_option("speed")
    console.named("chart-submit").click()
    console.named("chart-plot-3").focus()
    console.page.keyboard.press("Home")
    few = len(console.page.evaluate("fake.ids()")) <= 8
    expect(console.named("chart-tip-3")).to_contain_text("r8" if few else "median of")
    yield
    console.named("chart-title-3").click()
    console.named("chart-remove").click()


@contextmanager
def details(console: Console) -> Iterator[None]:
    """The details of one robot, in place of the table."""
    show(console, "fleet")
    console.named("details-r2").click()
    console.page.evaluate("fake.detail('r2')")
    expect(console.named("detail-chart-battery")).to_be_visible()
    yield
    console.named("detail-close").click()


@contextmanager
def log(console: Console) -> Iterator[None]:
    show(console, "log")
    yield


STATES: dict[str, State] = {
    "fleet": fleet, "trouble": trouble, "estop": estop, "receipts": receipts, "clearing": clearing, "form": form,
    "question": question, "missions": missions, "mission_form": mission_form, "ranges": ranges, "cameras": cameras,
    "bookmarks": bookmarks, "stick": stick, "charts": charts, "lines": lines, "chart form": chart_form,
    "details": details, "log": log, "experiments": experiments, "experiment": experiment,
    "experiment_stopped": experiment_stopped,
}  # fmt: skip
