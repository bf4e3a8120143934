"""A study session as a participant and an experimenter meet it: every dialog, stops in each of them, the export."""

from __future__ import annotations

import csv
import json
import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, ViewportSize, expect
from playwright.sync_api import TimeoutError as PlaywrightTimeout

from tests.browser.axe import NPM, violations
from tests.browser.conftest import Snap
from tests.browser.console import Console

FLEET = """
[world]
engine = "kinematic"
bounds_m = [0.0, 0.0, 20.0, 20.0]
[[robot]]
id = "r1"
pose = [2.0, 2.0, 0.0]
[[robot]]
id = "r2"
pose = [2.0, 5.0, 0.0]
[[robot]]
id = "r3"
pose = [5.0, 2.0, 0.0]
"""
STUDY = """
name = "short"
participants = ["K7"]
fleet = "hall.toml"
duration_s = 36.0
briefing = "You operate three robots."
consent = "I take part of my own will."
task = "Bring r1 to the far corner."

[[conditions]]
name = "secret-charts-shown"

[[conditions]]
name = "secret-charts-hidden"
hide = ["charts"]

[[probes]]
name = "moving"
question = "How many robots move?"
at_s = [12.0]
freeze = true
truth = "moving"
timeout_s = 300.0

[[probes]]
name = "hurry"
question = "Is a robot in the north?"
at_s = [15.0]
choices = ["yes", "no"]
correct = "yes"
"""
SMALL: list[ViewportSize] = [{"width": 390, "height": 844}, {"width": 844, "height": 390}]
WIDE: ViewportSize = {"width": 1440, "height": 900}


class Session:
    """`fullswarm study run`, and what it prints."""

    def __init__(self, folder: Path) -> None:
        command = ["study", "run", str(folder / "study.toml"), "--participant", "K7", "--out", str(folder / "data")]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "fullswarm", *command],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            env={**os.environ, "FULLSWARM_CONSOLE_TOKEN": "x" * 24},
        )  # fmt: skip
        self.said = ""
        self._lines: queue.Queue[str] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.put(line)

    def tells(self, pattern: str, timeout_s: float = 90.0) -> str:
        deadline_s = time.monotonic() + timeout_s
        while (found := re.search(pattern, self.said)) is None:
            try:
                self.said += self._lines.get(timeout=max(0.0, deadline_s - time.monotonic()))
            except queue.Empty:
                raise AssertionError(f"it never said {pattern!r}, but:\n{self.said}") from None
        return found[0]

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        self.process.wait(30.0)
        self._reader.join(10.0)
        if self.process.stdout is not None:
            self.process.stdout.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "hall.toml").write_text(FLEET)
    (tmp_path / "study.toml").write_text(STUDY)
    return tmp_path


@pytest.fixture
def session(folder: Path) -> Iterator[Session]:
    started = Session(folder)
    yield started
    started.close()


def stops_are_in_reach(page: Page) -> None:
    """Nothing lies over the stop and the e-stop: what is hit at their centres is the button itself."""
    for name in ("stop", "estop"):
        hit = page.evaluate(
            """(id) => {
              const box = document.getElementById(id).getBoundingClientRect();
              const hit = document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2);
              return hit?.closest("button")?.id;
            }""",
            name,
        )
        assert hit == name
        expect(page.locator(f"#{name}")).to_be_enabled()


def looks_right(console: Console, snap: Snap, name: str, sizes: tuple[ViewportSize, ...] = (*SMALL, WIDE)) -> None:
    """Axe finds nothing, stops are in reach, no condition is named; on small screens nothing lies outside."""
    page = console.page
    for size in sizes:
        page.set_viewport_size(size)
        stops_are_in_reach(page)
        assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]
        if NPM is not None:
            assert violations(page) == []
        snap(page, f"study-{name}-{size['width']}")
    assert "secret" not in page.content()


def rate(page: Page) -> None:
    """Fill in the questionnaire with the keyboard alone."""
    for number, name in enumerate(("mental", "physical", "temporal", "performance", "effort", "frustration")):
        slider = page.get_by_test_id(f"tlx-{name}")
        slider.focus()
        slider.press("Home")
        for _ in range(2 * number):
            slider.press("ArrowRight")
        slider.press("Enter")
    for number in range(15):
        radio = page.locator(f'input[name="pair-{number}"]').first
        radio.focus()
        radio.press("Enter")


def test_a_session_from_consent_to_export(browser: Browser, folder: Path, session: Session, snap: Snap) -> None:
    address = session.tells(r"http://\S+#token=\S+")
    console = Console(browser.new_context(viewport=WIDE).new_page(), address)
    page = console.page
    expect(page.get_by_test_id("study-page")).to_contain_text("You operate three robots.")
    console.until(lambda: len(console.state["robots"]) == 3, 60.0, "all robots report")
    looks_right(console, snap, "briefing")
    page.get_by_test_id("study-start").click()
    expect(page.get_by_test_id("study-outcome")).to_contain_text("Tick the box")
    page.get_by_test_id("study-consent").focus()
    page.keyboard.press("Enter")
    until_started(console)
    expect(page.get_by_test_id("study-strip")).to_contain_text("Bring r1 to the far corner.")
    began_s = time.monotonic()
    console.select(["r1"])
    console.press("g")
    console.click_floor(17.0, 17.0)
    page.mouse.wheel(0, 100)
    snap(page, "study-running")
    question = page.get_by_test_id("study-question")
    expect(question).to_contain_text("How many robots move?", timeout=40_000)
    expect(page.get_by_test_id("map")).to_be_hidden()
    looks_right(console, snap, "freeze")
    still = console.places()["r1"]
    page.wait_for_timeout(1000)
    there = console.places()["r1"]
    assert abs(there[0] - still[0]) + abs(there[1] - still[1]) < 0.01, "the world stands still"
    page.get_by_test_id("study-answer").fill("1")
    page.keyboard.press("Space")  # the stop, also in a field for numbers
    expect(page.get_by_test_id("stop-receipts")).to_contain_text("3 of 3 standing")
    snap(page, "study-freeze-stop")
    page.keyboard.press("Enter")
    expect(page.get_by_test_id("map")).to_be_visible()
    expect(page.get_by_test_id("study-question")).to_contain_text("Is a robot in the north?", timeout=40_000)
    looks_right(console, snap, "probe", (SMALL[0],))  # the trial's time goes on
    page.get_by_label("no", exact=True).focus()
    page.keyboard.press("Enter")
    page.get_by_test_id("study-send").click()
    page.set_viewport_size(WIDE)
    expect(page.get_by_test_id("tlx-send")).to_be_visible(timeout=60_000)
    assert time.monotonic() - began_s > 36.0
    looks_right(console, snap, "tlx")
    page.get_by_test_id("tlx-effort").click()
    snap(page, "study-tlx-touched")
    page.get_by_test_id("tlx-send").click()
    expect(page.get_by_test_id("study-outcome")).to_contain_text("Rate Mental demand first.")
    rate(page)
    console.press("e")
    expect(page.locator("#estop-panel")).to_be_visible()
    snap(page, "study-tlx-estop")
    page.get_by_test_id("tlx-send").click()
    expect(page.get_by_test_id("study-done")).to_contain_text("Thank you")
    session.tells("trial complete")
    assert session.tells("condition [AB] is next")
    assert session.process.wait(30.0) == 0
    page.context.close()
    check_what_was_stored(folder)


def until_started(console: Console) -> None:
    """Press the button until the core and all robots report; before, the page says what is missing."""
    button = console.named("study-start")

    def press() -> bool:
        with suppress(PlaywrightTimeout):  # the trial may begin, and the button go, between the look and the click
            if button.is_visible():
                button.click(timeout=2000)  # which waits for it to be enabled, and no longer than that if it goes
        # Its attribute: the first question may cover the page while the click above still waits for the button.
        return console.named("study-strip").get_attribute("hidden") is None

    console.until(press, 60.0, "the trial begins")


def check_what_was_stored(folder: Path) -> None:
    trial = next((folder / "data" / "trials" / "K7").iterdir())
    kinds = [json.loads(line)["kind"] for line in (trial / "events.jsonl").read_text().splitlines()]
    assert kinds[0] == "begin"
    assert {"select", "request", "view", "tool", "stop", "probe", "answer", "end", "tlx"} <= set(kinds)
    done = subprocess.run(
        [sys.executable, "-m", "fullswarm", "study", "export", str(folder / "data"), "-o", str(folder / "out.csv")],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "the study is blinded" in done.stderr
    with (folder / "out.csv").open() as file:
        rows = list(csv.DictReader(file))
    value = {(row["measure"], row["of"]): row["value"] for row in rows}
    assert {row["condition_name"] for row in rows} == {""}
    assert float(value["tlx_rating", "frustration"]) == 50.0
    assert float(value["tlx_raw", ""]) == 25.0
    assert float(value["probe_correct", "moving@12"]) == 1.0
    assert float(value["probe_correct", "hurry@15"]) == 0.0
    assert float(value["inputs", "request"]) == 1.0
    assert float(value["robot_interaction_time_total", "r1"]) > 0.0
