"""A plan under the map: its colours are where its sidecar puts them, whatever the zoom; and a measured distance."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image
from playwright.sync_api import Browser, expect

from tests.browser.conftest import SIZE, Snap
from tests.browser.console import Console
from tests.browser.swarm import Demo

CELL_M, LEFT_M, LOW_M, SIDE = 0.05, 1.0, 2.0, 60
COLOURS = {(0, 0): "red", (1, 0): "lime", (0, 1): "blue", (1, 1): "yellow"}
"""By column and row of the quarter, from the lower left."""
HUES = {"red": (1, 0, 0), "lime": (0, 1, 0), "blue": (0, 0, 1), "yellow": (1, 1, 0)}


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of map_server, 3 m wide, in four colours."""
    folder = tmp_path_factory.mktemp("plan")
    picture, half = Image.new("RGB", (SIDE, SIDE)), SIDE // 2
    for (column, row), colour in COLOURS.items():
        left, top = column * half, (1 - row) * half
        picture.paste(colour, (left, top, left + half, top + half))
    picture.save(folder / "plan.png")
    sidecar = folder / "plan.yaml"
    sidecar.write_text(f"image: plan.png\nresolution: {CELL_M}\norigin: [{LEFT_M}, {LOW_M}, 0.0]\n")
    return sidecar


@pytest.fixture
def planned(browser: Browser, demo: Demo, plan: Path) -> Iterator[Console]:
    """A page of a second console of the same swarm, with the plan."""
    command = [
        "console",
        "--read-only",
        "--json",
        "--listen",
        "127.0.0.1:0",
        "--hub",
        demo.hub,
        "--underlay",
        str(plan),
    ]
    with subprocess.Popen(
        [sys.executable, "-m", "fullswarm", *command], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        assert process.stdout is not None
        context = browser.new_context(viewport=SIZE, color_scheme="light")
        try:
            console = Console(context.new_page(), json.loads(process.stdout.readline())["url"])
            expect(console.named("link-state")).to_have_text("live")
            yield console
            console.faultless()
        finally:
            context.close()
            process.terminate()


def seen(console: Console, x_m: float, y_m: float) -> tuple[float, ...]:
    """Return how much each primary colour stands out where a point of the floor is on the screen, 0 to 1."""
    x, y = console.at(x_m, y_m)
    picture = Image.open(io.BytesIO(console.page.screenshot())).convert("RGB")
    pixel = picture.getpixel((round(x), round(y)))
    assert isinstance(pixel, tuple)
    low, high = min(pixel), max(pixel)
    return tuple(float(each - low > 0.5 * (high - low)) if high - low > 60 else -1.0 for each in pixel)


def test_a_plan_lies_where_its_sidecar_puts_it_and_can_be_hidden(planned: Console, snap: Snap) -> None:
    planned.page.keyboard.press("c")  # no coverage over it
    planned.page.keyboard.press("t")
    half_m = SIDE * CELL_M / 2.0
    middles = {
        colour: (LEFT_M + (column + 0.5) * half_m + 0.11, LOW_M + (row + 0.5) * half_m + 0.13)
        for (column, row), colour in COLOURS.items()
    }

    def drawn() -> bool:
        hits = [seen(planned, *middles[colour]) == HUES[colour] for colour in middles]
        return sum(hits) >= 3  # a robot may stand on one of them

    for zoom in ("f", "+", "-"):
        planned.page.keyboard.press(zoom)
        planned.until(drawn, 15.0, f"the plan is under the map after {zoom}")
    snap(planned.page, "underlay")
    planned.named("layer-underlay").click()
    planned.until(
        lambda: not any(seen(planned, *middles[colour]) == HUES[colour] for colour in middles), 10.0, "it is hidden"
    )


def test_a_distance_is_measured(planned: Console, snap: Snap) -> None:
    planned.press("m")
    expect(planned.named("tool-measure")).to_have_attribute("aria-pressed", "true")
    planned.click_floor(1.0, 1.0)
    planned.click_floor(4.0, 5.0)
    snap(planned.page, "measured")
    assert float(planned.state["ruler"].split()[0]) == pytest.approx(5.0, abs=0.05)
    planned.press("Escape")
    assert planned.state["ruler"] is None
