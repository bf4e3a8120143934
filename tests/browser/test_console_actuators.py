"""Lamps and other actuators of robots on the page, as a behaviour asks for them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from tests.browser.conftest import SIZE, Snap
from tests.browser.console import Console
from tests.system.test_reload import FLEET, UnderDevelopment

TIMEOUT_MS = 20_000
LAW = """
import numpy as np

def velocity(view, params):
    view.actuate(view.id == "r1", "lamp", "{lamp}")
    view.actuate(view.id == "r2", "gripper", "closed")
    return np.zeros_like(view.position)
"""
ROOM = FLEET.replace("[-100, -10, 100, 10]", "[-4, -4, 4, 4]")
RED, GREEN = (229, 32, 43), (24, 177, 60)
COLOURS = """([x, y]) => {
  const map = document.getElementById("map");
  const [left, top] = [map.getBoundingClientRect().x, map.getBoundingClientRect().y];
  const ratio = map.width / map.clientWidth;
  const [u, v] = [Math.round((x - left) * ratio) - 12, Math.round((y - top) * ratio) - 12];
  const part = new OffscreenCanvas(25, 25).getContext("2d", { willReadFrequently: true });
  part.drawImage(map, u, v, 25, 25, 0, 0, 25, 25);
  const { data } = part.getImageData(0, 0, 25, 25);
  return Array.from({ length: 625 }, (_, k) => [data[4 * k], data[4 * k + 1], data[4 * k + 2]].join());
}"""


@pytest.fixture
def lab(browser: Browser, tmp_path: Path) -> Iterator[UnderDevelopment]:
    assert browser.is_connected()  # started before the robots, which its start would hold up
    made = UnderDevelopment(tmp_path / "my-lab", "--console", fleet=ROOM)
    try:
        yield made
    finally:
        made.close()


def test_the_page_shows_what_robots_do_with_lamp_and_gripper(
    lab: UnderDevelopment, browser: Browser, snap: Snap
) -> None:
    lab.until(lambda: "#token=" in lab.log.read_text() and lab.ready(), "the page is served")
    address = re.search(r"http://\S+#token=\S+", lab.log.read_text())
    assert address is not None
    lab.law.write_text(LAW.format(lamp="red"))
    lab.until(lambda: "glide.py" in lab.log.read_text(), "the law is loaded")
    context = browser.new_context(viewport=SIZE, color_scheme="light")
    console = Console(context.new_page(), address[0])
    row, other = console.named("robot-row-r1"), console.named("robot-row-r2")
    expect(row).to_contain_text("no behaviour", timeout=TIMEOUT_MS)
    expect(row).not_to_contain_text("lamp")
    lab.until(lab.ready, "the robots are ready")
    console.start("glide")
    expect(row).to_contain_text("Glide · lamp red", timeout=TIMEOUT_MS)
    expect(other).to_contain_text("Glide · gripper closed")

    def drawn(robot: str, colour: tuple[int, int, int]) -> bool:
        at = console.at(*console.places()[robot])
        return ",".join(map(str, colour)) in console.page.evaluate(COLOURS, list(at))

    console.until(lambda: drawn("r1", RED), 5.0, "the lamp on the map")
    assert not drawn("r2", RED)
    console.select(["r1", "r2"])
    console.page.wait_for_timeout(300)
    snap(console.page, "actuators")
    lab.law.write_text(LAW.format(lamp="green"))
    expect(row).to_contain_text("Glide · lamp green", timeout=TIMEOUT_MS)
    console.until(lambda: drawn("r1", GREEN) and not drawn("r1", RED), 5.0, "the lamp has changed")
    console.page.emulate_media(color_scheme="dark")
    console.page.wait_for_timeout(300)
    snap(console.page, "actuators-dark")
    lab.law.write_text(LAW.format(lamp="off"))
    expect(row).to_contain_text("Glide · lamp off", timeout=TIMEOUT_MS)
    console.until(lambda: not drawn("r1", GREEN), 5.0, "the lamp is off")
    console.faultless()
    context.close()
