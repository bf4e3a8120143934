"""One swarm, one browser and one page for all tests: an operator's session lasts longer than one order."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, ViewportSize, expect, sync_playwright

from fullswarm.operator.robot_state import row_state
from tests.browser.console import Console
from tests.browser.swarm import Demo, Observer

CHROMIUM = shutil.which("chromium")
ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
SIZE: ViewportSize = {"width": 1440, "height": 900}
ROBOTS = tuple(f"r{number}" for number in range(1, 9))
OPTIONS = ("--seconds", "3600", "--set", "world.engine=kinematic")
"""The show must not end while it is looked at; kinematic bodies leave the processor to the browser."""

EXPERIMENT = """
name = "meet"
description = "Two robots go to one place, with and without the safety filter"
seeds = "0-9"

[limits.create]
speed_limit_m_s = 0.5
turn_limit_rad_s = 4.25

[small]
seeds = "0"
engines = ["kinematic"]

[[groups]]
name = "meet"
behaviours = [{ name = "move_to_goal", collisions_expected = true }, { name = "move_to_goal_bc" }]
scenarios = ["empty"]
robots = [2]
engines = ["kinematic"]
limits = ["create"]
time_limit_s = 4.0
"""

expect.set_options(timeout=15_000)  # ms; the five seconds of Playwright are few where other work shares the machine

Snap = Callable[[Page, str], None]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with what needs no swarm, which takes more than a processor; skip what needs a browser if there is none."""
    items.sort(key=lambda item: "demo" in getattr(item, "fixturenames", ()) and "tests/browser/" in item.nodeid)
    if CHROMIUM is not None:
        return
    for item in items:
        if "console" in getattr(item, "fixturenames", ()) or "browser" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.skip(reason="no Chromium here: apt install chromium"))


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield started
        started.close()


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the demo's shell, with an experiment that takes seconds."""
    folder = tmp_path_factory.mktemp("shell")
    (folder / "experiments").mkdir()
    (folder / "experiments" / "meet.toml").write_text(EXPERIMENT)
    return folder


@pytest.fixture(scope="session")
def demo(browser: Browser, folder: Path) -> Iterator[Demo]:
    """Return the swarm; the browser is there before it, so that the page sees its robots set off."""
    started = Demo(*OPTIONS, folder=folder)
    yield started
    started.close()


@pytest.fixture(scope="session")
def observer(demo: Demo) -> Iterator[Observer]:
    started = Observer(demo.hub)
    yield started
    started.close()


@pytest.fixture(scope="session")
def opened(browser: Browser, demo: Demo) -> Iterator[Console]:
    """The operator's page."""
    context = browser.new_context(viewport=SIZE, color_scheme="light")
    yield Console(context.new_page(), demo.address)
    context.close()


@pytest.fixture
def console(opened: Console) -> Iterator[Console]:
    """The operator's page, which must be without fault after each test, too."""
    yield opened
    opened.faultless()


@pytest.fixture
def calm(console: Console, observer: Observer) -> Console:
    """The page, nothing selected and held, all robots standing without a behaviour."""
    observer.fresh()
    if any(health.estop for health in observer.healths()):
        observer.operator.estop(False)
    observer.operator.stop()
    observer.rest(0.5)
    observer.until(observer.is_calm, 20.0, "all eight stand, free")
    if any(row_state(row).attention for row in observer.rows()):
        # What stopped them on a busy machine is shown until they are asked for something.
        observer.operator.request("flocking_bc", ())
        observer.until(lambda: observer.all_run("flocking_bc"), 20.0, "all run")
        observer.operator.stop()
        observer.until(observer.is_calm, 20.0, "all eight stand again")
    console.press("Escape")
    console.give_back()
    console.clear_the_map()
    return console


@pytest.fixture(scope="session")
def snap(tmp_path_factory: pytest.TempPathFactory) -> Snap:
    """Keep a picture of the page in the folder that FULLSWARM_SCREENSHOTS names."""
    wished = os.environ.get("FULLSWARM_SCREENSHOTS")
    folder = Path(wished) if wished else tmp_path_factory.mktemp("screenshots")
    folder.mkdir(parents=True, exist_ok=True)

    def take(page: Page, name: str) -> None:
        page.screenshot(path=folder / f"{name}.png")

    return take
