"""Looking back on the page, live and in a recording: against the bus, and the file as the public reader gives it."""

from __future__ import annotations

import io
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader
from PIL import Image, ImageSequence
from playwright.sync_api import Browser, ViewportSize, expect

from tests.browser.axe import NPM, violations
from tests.browser.conftest import SIZE, Snap
from tests.browser.console import Console
from tests.browser.swarm import Observer, far
from tests.unit.test_record_playback import places, record

SECONDS = 30.0
AROUND_S = 0.3
SIZES: list[ViewportSize] = [
    {"width": 1024, "height": 700},
    {"width": 768, "height": 1024},
    {"width": 390, "height": 844},
    {"width": 844, "height": 390},
]


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "run.mcap"
    record(path, SECONDS)
    return path


@pytest.fixture(scope="module")
def address(file: Path) -> Iterator[str]:
    """Serve the recording as its user does; return the page's address."""
    command = ["console", "--recording", str(file), "--json", "--listen", "127.0.0.1:0"]
    with subprocess.Popen(
        [sys.executable, "-m", "fullswarm", *command], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        assert process.stdout is not None
        try:
            yield json.loads(process.stdout.readline())["url"]
        finally:
            process.terminate()


@pytest.fixture(scope="module")
def page(browser: Browser, address: str) -> Iterator[Console]:
    context = browser.new_context(viewport=SIZE, color_scheme="light", accept_downloads=True, reduced_motion="reduce")
    console = Console(context.new_page(), address)
    console.until(lambda: console.state["time"]["to_s"] > SECONDS - 1.0, 20.0, "the recording is read")
    yield console
    context.close()


@pytest.fixture
def recording(page: Console) -> Iterator[Console]:
    yield page
    page.faultless()
    if page.named("time-panel").is_visible():
        page.named("time-close").click()


def look(console: Console, at_s: float) -> None:
    console.page.evaluate("(at_s) => window.fullswarm.look(at_s)", at_s)
    console.until(lambda: console.state["time"]["ready"], 10.0, f"the page shows {at_s} s")
    console.page.wait_for_timeout(150)  # a few frames are drawn


def test_a_recording_shows_robots_log_and_charts_of_the_moment(recording: Console, file: Path) -> None:
    for at_s in (3.0, 27.0, 14.0, 8.5):  # forth and back
        look(recording, at_s)
        shown = recording.places()
        for robot, place in places(file, at_s).items():
            assert shown[robot] == pytest.approx(place, abs=0.05)
        log = recording.named("log").inner_text()
        assert ("Flocking, unfiltered for" in log) == (at_s >= 5.0)
        assert ("stops the whole swarm" in log) == (at_s >= 12.0)
    expect(recording.named("link-state")).to_have_text("recording")
    expect(recording.named("stop")).to_be_disabled()
    expect(recording.named("time-words")).to_have_text("0:08 / 0:30")


def test_a_recording_plays_at_a_speed_and_stands_still(recording: Console) -> None:
    look(recording, 2.0)
    recording.named("time-speed").select_option("4")
    recording.named("time-play").click()
    recording.until(lambda: recording.state["time"]["at_s"] > 10.3, 15.0, "it plays into the next segment")
    recording.named("time-play").click()
    stood_s = recording.state["time"]["at_s"]
    assert recording.places()["r1"][0] == pytest.approx(0.1 * stood_s, abs=0.05)
    recording.named("time-forward").click()
    recording.until(lambda: recording.state["time"]["at_s"] == pytest.approx(stood_s + 1.0), 5.0, "one second on")
    look(recording, 8.0)
    recording.press("k")
    recording.until(lambda: recording.state["time"]["at_s"] == pytest.approx(12.0, abs=0.2), 5.0, "the next event")
    expect(recording.named("time-spoken")).to_have_text(re.compile(r"\d\d:\d\d:\d\d stop: .* stops the whole swarm"))
    recording.named("time-at").focus()
    recording.page.keyboard.press("Home")
    recording.until(lambda: recording.state["time"]["at_s"] == pytest.approx(0.0, abs=0.2), 5.0, "the beginning")


def test_chosen_charts_of_a_recording_end_at_the_moment(recording: Console, file: Path) -> None:
    recording.named("chart-add").click()
    recording.named("chart-of").select_option("x")
    recording.named("chart-submit").click()
    for at_s in (27.0, 6.0, 14.0):
        look(recording, at_s)
        _wait_for_end(recording, at_s)
        chart = recording.charts()[3]
        here = places(file, chart["times"][-1])
        assert chart["lines"] == sorted(here)
        assert [line[-1] for line in chart["values"]] == pytest.approx(
            [here[each][0] for each in sorted(here)], abs=0.05
        )
        assert chart["times"][0] < 1.5, "it begins with the recording"
    recording.named("chart-title-3").click()
    recording.named("chart-remove").click()


def _wait_for_end(console: Console, at_s: float) -> None:
    """Wait until the chart that was added ends at a moment."""

    def ends() -> bool:
        times = console.charts()[3]["times"]
        return bool(times) and abs(times[-1] - at_s) <= 0.5

    console.until(ends, 10.0, f"the chart ends at {at_s} s")


def test_bookmarks_are_kept_beside_the_recording(recording: Console, file: Path) -> None:
    look(recording, 12.0)
    recording.named("time-more").click()
    recording.named("mark-name").fill("the stop")
    recording.named("mark-add").click()
    mark = recording.named("mark-the stop")
    expect(mark).to_be_visible()
    kept = file.with_name("run.bookmarks.json")
    assert kept.stat().st_mode & 0o777 == 0o600
    (stored,) = json.loads(kept.read_text())["bookmarks"]
    with file.open("rb") as stream:
        first_ns = min(message.log_time for _, _, message in make_reader(stream).iter_messages())
    assert stored["time_s"] == pytest.approx(1e-9 * first_ns + 12.0, abs=0.1)
    look(recording, 1.0)
    mark.click()
    recording.until(lambda: recording.state["time"]["at_s"] == pytest.approx(12.0, abs=0.1), 5.0, "the page jumps")
    recording.page.get_by_role("button", name="Delete bookmark the stop").click()
    expect(mark).to_have_count(0)
    assert json.loads(kept.read_text())["bookmarks"] == []


@pytest.mark.parametrize("kind", ["mcap", "gif"])
def test_a_clip_is_made_and_downloaded(recording: Console, kind: str, tmp_path: Path) -> None:
    recording.named("time-more").click()
    for at_s, button in ((10.0, "clip-from"), (13.0, "clip-to")):
        look(recording, at_s)
        recording.named(button).click()
    recording.named("clip-kind").select_option(kind)
    recording.named("clip-make").click()
    link = recording.named("clip-link")
    expect(link).to_be_visible(timeout=60_000)
    with recording.page.expect_download() as download:
        link.click()
    data = Path(download.value.path()).read_bytes()
    assert re.fullmatch(rf"run-\d{{6}}\.{kind}", download.value.suggested_filename)
    if kind == "gif":
        with Image.open(io.BytesIO(data)) as picture:
            assert picture.format == "GIF"
            assert sum(1 for _ in ImageSequence.Iterator(picture)) == 31
        return
    (tmp_path / "clip.mcap").write_bytes(data)
    x = [
        json.loads(message.data)["x_m"][0]
        for _, channel, message in make_reader(io.BytesIO(data)).iter_messages()
        if channel.topic.startswith("/state/")
    ]
    assert (x[0], x[-1]) == pytest.approx((1.0, 1.3), abs=0.03)


def test_it_fits_small_screens(recording: Console, snap: Snap) -> None:
    look(recording, 12.0)
    recording.named("time-more").click()
    recording.page.emulate_media(color_scheme="dark")
    for size in SIZES:
        recording.page.set_viewport_size(size)
        recording.named("time-panel").scroll_into_view_if_needed()
        recording.page.wait_for_timeout(200)
        if NPM is not None:
            assert violations(recording.page) == []
        assert recording.page.evaluate("document.documentElement.scrollWidth") <= size["width"]
        for each in ("time-play", "time-at", "time-more", "mark-name", "clip-make"):
            expect(recording.named(each)).to_be_visible()
        snap(recording.page, f"timeline-{size['width']}")
    recording.page.set_viewport_size(SIZE)
    recording.page.wait_for_timeout(200)
    recording.page.evaluate("window.shifts.splice(0)")  # by the new sizes


def test_an_operator_looks_back_and_can_still_stop_the_swarm(calm: Console, observer: Observer, snap: Snap) -> None:
    calm.start("flocking_bc")
    observer.until(lambda: observer.all_run("flocking_bc"), 10.0, "they drive")
    heard: list[tuple[float, dict[str, tuple[float, float]]]] = []  # on the bus, by the clock of this machine
    moments: list[float] = []
    for count in range(1, 61):
        observer.rest(0.05)
        heard.append((observer.runtime.now_s(), observer.places()))
        if count % 20 == 10:
            moments.append(calm.state["time"]["at_s"])
    for at_s in reversed(moments):
        look(calm, at_s)
        for robot, place in calm.places().items():
            # A state may have come late on the way to either of the two, by less than AROUND_S.
            there = [places[robot] for heard_s, places in heard if abs(heard_s - at_s) < AROUND_S]
            assert min(far(place, each) for each in there) < 0.12, (robot, at_s)
    expect(calm.named("past-banner")).to_contain_text(re.compile(r"Not live looking at \d\d:\d\d:\d\d, [\d.]+ s ago"))
    assert calm.page.evaluate("document.getElementById('start').inert")
    if NPM is not None:
        assert violations(calm.page) == []
    snap(calm.page, "timeline-past")
    calm.press(" ")
    observer.until(observer.stand, 20.0, "they stop, though the page shows the past")
    assert not calm.state["time"]["live"]
    calm.named("time-live").click()
    expect(calm.named("past-banner")).to_be_hidden()
    expect(calm.named("log")).to_contain_text("stops the whole swarm")
    calm.named("time-more").click()
    expect(calm.named("clip-words")).to_contain_text("nothing is recorded on this machine")
    expect(calm.named("clip-make")).to_be_disabled()
    calm.named("time-close").click()
