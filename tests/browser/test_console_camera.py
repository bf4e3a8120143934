"""Cameras on the page: a button when there is one, its pictures while the panel is open, and what is wrong with it."""

from __future__ import annotations

import base64

from playwright.sync_api import expect

from fullswarm.keys import Keys
from fullswarm.messages import CameraPicture
from tests.browser.conftest import Snap
from tests.browser.console import Console
from tests.browser.swarm import Observer

PIXEL = base64.b64decode(
    "/9j/4AAQSkZJRgABAQEAYABgAAD/2wBDAAMCAgICAgMCAgIDAwMDBAYEBAQEBAgGBgUGCQgKCgkICQkKDA8MCgsOCwkJDRENDg8QEBEQCgwSExIQEw8Q"
    "EBD/wAALCAABAAEBAREA/8QAFAABAAAAAAAAAAAAAAAAAAAACf/EABQQAQAAAAAAAAAAAAAAAAAAAAD/2gAIAQEAAD8AVN//2Q=="
)


def test_pictures_are_shown_while_the_panel_is_open(calm: Console, observer: Observer, snap: Snap) -> None:
    def send(problem: str = "") -> None:
        message = CameraPicture(camera="ceiling", jpeg=PIXEL, problem=problem)
        observer.bus.publish(Keys("swarm").camera("ceiling"), message)
        observer.rest(0.3)

    toggle, panel, picture = calm.named("camera-toggle"), calm.named("camera-panel"), calm.named("camera-ceiling")
    expect(toggle).to_be_hidden()
    send()
    expect(toggle).to_be_visible()
    expect(panel).to_be_hidden()
    toggle.click()
    expect(picture).to_be_hidden()  # a browser would show it as broken
    expect(panel).to_contain_text("No picture yet.")
    send("the camera has moved")
    expect(panel).to_be_visible()
    expect(panel).to_contain_text("the camera has moved")
    expect(picture).to_have_attribute("src", f"data:image/jpeg;base64,{base64.b64encode(PIXEL).decode()}")
    expect(picture).to_be_visible()
    expect(panel.get_by_text("No picture yet.")).to_be_hidden()
    snap(calm.page, "camera")
    toggle.click()
    expect(panel).to_be_hidden()
    assert picture.get_attribute("src") is None
