"""Range scans on the map, with a played console: which robots are asked for, what is drawn where, and until when."""

from __future__ import annotations

import base64
import io
import math
import struct
from collections.abc import Iterator

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, FloatRect, expect

from tests.browser.axe import violations
from tests.browser.conftest import SIZE
from tests.browser.console import Console
from tests.browser.played import change, play, sent
from tests.browser.states import SIZES, complaints

WALL_M, RAYS = 1.5, 90


@pytest.fixture(scope="module")
def opened(browser: Browser) -> Iterator[Console]:
    console = play(browser, SIZE, 8, color_scheme="light")
    change(console, moving=False, ranged=[f"r{k}" for k in range(1, 7)])
    yield console
    console.page.context.close()


@pytest.fixture
def console(opened: Console) -> Console:
    opened.select([])
    opened.until(lambda: asked(opened) in ([], None), 5.0, "no robot is asked")
    return opened


def asked(console: Console) -> list[str] | None:
    frames = sent(console, "scans")
    return frames[-1]["robots"] if frames else None


def scan(console: Console, robot: str, mm: list[int], **fields: object) -> None:
    """Have the console send what a robot's sensor measures all around it, in 90 rays from its back."""
    where = console.state["robots"][robot]
    plain = {
        "at": [where["x"], where["y"], 0.0], "first_rad": -math.pi, "step_rad": 2.0 * math.pi / RAYS, "cone_rad": 0,
        "max_m": 4.0, "age_s": 0.05, "mm": base64.b64encode(struct.pack(f"<{len(mm)}H", *mm)).decode(),
    }  # fmt: skip
    console.page.evaluate("(frame) => fake.say(frame)", {"t": "scans", "robot": robot, "scans": [{**plain, **fields}]})


def test_the_page_asks_for_selected_robots_with_sensors_and_no_more_than_four(console: Console) -> None:
    expect(console.named("layer-ranges")).to_be_visible()
    console.select(["r2"])
    console.until(lambda: asked(console) == ["r2"], 5.0, "r2 is asked")
    console.select([f"r{k}" for k in range(2, 9)])
    console.until(lambda: asked(console) == ["r2", "r3", "r4", "r5"], 5.0, "four are asked")
    console.select(["r8"])  # it has no sensor
    console.until(lambda: asked(console) == [], 5.0, "none is asked")
    console.select(["r1"])
    console.until(lambda: asked(console) == ["r1"], 5.0, "r1 is asked")
    console.page.keyboard.press("r")
    expect(console.named("layer-ranges")).to_have_attribute("aria-pressed", "false")
    console.until(lambda: asked(console) == [], 5.0, "none is asked when the layer is off")
    console.named("layer-ranges").focus()
    console.page.keyboard.press("Enter")
    console.until(lambda: asked(console) == ["r1"], 5.0, "r1 is asked again")


def test_a_hit_is_drawn_where_it_is_and_a_scan_vanishes_within_a_second(console: Console) -> None:
    console.select(["r1"])
    console.until(lambda: asked(console) == ["r1"], 5.0, "r1 is asked")
    robot = console.state["robots"]["r1"]
    place = (robot["x"] + WALL_M, robot["y"] + 0.002)
    before = colour(console, *place)
    hits = [round(1000 * WALL_M)] * (RAYS - 2) + [65534, 65535]
    scan(console, "r1", hits)
    console.until(lambda: console.state["ranges"] == {"r1": RAYS - 2}, 5.0, "the scan is drawn")
    drawn = colour(console, *place)
    assert sum(abs(a - b) for a, b in zip(before, drawn, strict=True)) > 100
    console.until(lambda: console.state["ranges"] == {}, 3.0, "it has vanished")
    console.until(lambda: colour(console, *place) == before, 2.0, "the map is as before")
    scan(console, "r2", hits)  # of a robot that is not selected
    assert console.state["ranges"] == {}


def colour(console: Console, x_m: float, y_m: float) -> tuple[int, ...]:
    """Return the colour of the page at a place of the world."""
    x, y = console.page.evaluate("([x, y]) => window.fullswarm.toScreen(x, y)", [x_m, y_m])
    clip = FloatRect(x=round(x) - 1, y=round(y) - 1, width=3, height=3)
    picture = Image.open(io.BytesIO(console.page.screenshot(clip=clip))).convert("RGB")
    pixels = np.asarray(picture).reshape(-1, 3)
    return tuple(int(each) for each in pixels[pixels[:, 2].argmin()])


def test_malformed_scans_break_nothing(console: Console) -> None:
    console.select(["r1"])
    console.until(lambda: asked(console) == ["r1"], 5.0, "r1 is asked")
    scan(console, "r1", [])
    scan(console, "r1", [1000] * 3, cone_rad=0.4, step_rad=0)
    console.until(lambda: console.state["ranges"] == {"r1": 3}, 5.0, "three cones are drawn")
    console.faultless()


@pytest.mark.parametrize("size", SIZES)
def test_it_fits_all_sizes(console: Console, size: tuple[int, int]) -> None:
    console.select(["r1", "r2"])
    console.page.set_viewport_size({"width": size[0], "height": size[1]})
    try:
        console.until(lambda: asked(console) == ["r1", "r2"], 5.0, "two are asked")
        for robot in ("r1", "r2"):
            scan(console, robot, [1200] * RAYS)
        assert complaints(console, coarse=False) == []
        assert violations(console.page) == []
    finally:
        console.page.set_viewport_size(SIZE)
