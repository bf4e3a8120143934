"""A gamepad, injected where the browser would show a real one: drives with the dead-man held, and not without."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from playwright.sync_api import Browser, expect

from tests.browser.conftest import ARGUMENTS, CHROMIUM, ROBOTS
from tests.browser.console import Console
from tests.browser.swarm import Demo, Observer

LB, RB, B = 4, 5, 1
PLUG = """
window.pad = {
  id: "Injected pad", index: 0, connected: true, mapping: "standard", timestamp: 0, axes: [0, 0, 0, 0],
  buttons: Array.from({ length: 17 }, () => ({ pressed: false, touched: false, value: 0 })),
};
navigator.getGamepads = () => [window.pad, null, null, null];
window.dispatchEvent(Object.assign(new Event("gamepadconnected"), { gamepad: window.pad }));
"""
SECOND = """
window.second = { ...window.pad, id: "Second pad", index: 1, axes: [0.6, -0.5, 0, 0] };
window.second.buttons = window.pad.buttons.map((button, n) => ({ ...button, pressed: n === 4 }));
navigator.getGamepads = () => [window.pad, window.second, null, null];
window.dispatchEvent(Object.assign(new Event("gamepadconnected"), { gamepad: window.second }));
"""
"""Another pad, its dead-man held and its stick pushed."""
UNPLUG_FIRST = """
navigator.getGamepads = () => [null, window.second, null, null];
window.dispatchEvent(Object.assign(new Event("gamepaddisconnected"), { gamepad: window.pad }));
"""
UNPLUG_SECOND = """
navigator.getGamepads = () => [null, null, null, null];
window.dispatchEvent(Object.assign(new Event("gamepaddisconnected"), { gamepad: window.second }));
"""
STIR = """(seconds) => new Promise((resolve) => {
  const send = WebSocket.prototype.send;
  let frames = 0;
  WebSocket.prototype.send = function (text) {
    frames += 1;
    return send.call(this, text);
  };
  const began_ms = performance.now();
  const thumb = setInterval(() => {
    const passed_s = (performance.now() - began_ms) / 1000;
    window.pad.axes = [0.7 + 0.2 * Math.sin(7 * passed_s), -0.4, 0, 0];
    if (passed_s < seconds) return;
    clearInterval(thumb);
    WebSocket.prototype.send = send;
    resolve(frames / passed_s);
  }, 20);
})"""
"""Moves the stick at each look for some seconds; frames that were sent in each."""
UNPLUG = """
navigator.getGamepads = () => [null, null, null, null];
window.dispatchEvent(Object.assign(new Event("gamepaddisconnected"), { gamepad: window.pad }));
"""
LOOKED_AT = "new Promise((resolve) => setTimeout(resolve, 200))"
"""The page has looked at the pad meanwhile: what is held when it is plugged in does not count as pressed."""
MOST_FRAMES_HZ = 32.0
"""The page says 30 at most, and timers of a browser are not exact; the console allows 60."""
LEAST_FRAMES_HZ = 1.0 / 0.3
"""An intent lapses after 0.3 s: it takes that many to drive on, also on a busy machine."""
LEFT_BEHIND_S = 0.3
"""A stick's intent lapses on the robot after so long, whatever has become of the operator's side."""
SLACK_S = 0.7
"""Braking from full speed, the way over the bus, and a machine that has a browser to draw."""


class Pad:
    """Somebody's thumbs."""

    def __init__(self, console: Console) -> None:
        self.page = console.page
        self.page.evaluate(PLUG)
        self.page.evaluate(LOOKED_AT)

    def button(self, number: int, down: bool) -> None:
        self.page.evaluate(
            "([n, down]) => { window.pad.buttons[n] = { pressed: down, touched: down, value: Number(down) }; }",
            [number, down],
        )

    def stick(self, right: float, forward: float) -> None:
        self.page.evaluate("([x, y]) => { window.pad.axes = [x, y, 0, 0]; }", [right, -forward])

    def unplug(self) -> None:
        self.page.evaluate(UNPLUG)


@pytest.fixture
def pad(calm: Console) -> Iterator[Pad]:
    calm.select(["r6"])
    plugged = Pad(calm)
    yield plugged
    plugged.unplug()


def drives(observer: Observer) -> bool:
    return not observer.stand(["r6"])


def test_without_the_dead_man_nothing_moves(pad: Pad, observer: Observer) -> None:
    pad.stick(0.0, 1.0)
    pad.button(RB, down=True)
    observer.rest(1.0)
    assert observer.stand()


def test_the_dead_man_drives_the_selection_and_letting_go_stops_it(calm: Console, pad: Pad, observer: Observer) -> None:
    pad.stick(0.6, 0.5)
    pad.button(LB, down=True)
    expect(calm.named("driving")).to_have_text("driving r6")
    observer.until(lambda: drives(observer), 5.0, "it drives")
    assert observer.stand([robot for robot in ROBOTS if robot != "r6"]), "nobody else does"
    pad.button(LB, down=False)
    took_s = observer.until(lambda: not drives(observer), 5.0, "it stands")
    assert took_s < LEFT_BEHIND_S + SLACK_S
    observer.rest(0.5)
    assert observer.stand(), "although the stick is still pushed"
    expect(calm.named("driving")).to_contain_text("gamepad ready, hold LB")


def test_a_pad_that_is_unplugged_stops_it(calm: Console, pad: Pad, observer: Observer) -> None:
    pad.stick(0.6, 0.5)
    pad.button(LB, down=True)
    observer.until(lambda: drives(observer), 5.0, "it drives")
    pad.unplug()
    took_s = observer.until(lambda: not drives(observer), 5.0, "it stands")
    assert took_s < LEFT_BEHIND_S + SLACK_S
    calm.page.evaluate(PLUG.replace("pressed: false", "pressed: true"))  # plugged in again, all buttons held
    observer.rest(0.7)
    assert observer.stand(["r6"]), "the dead-man must be let go first"


def test_another_pad_does_not_drive_on_in_its_place(calm: Console, pad: Pad, observer: Observer) -> None:
    pad.stick(0.6, 0.5)
    pad.button(LB, down=True)
    observer.until(lambda: drives(observer), 5.0, "it drives")
    calm.page.evaluate(SECOND)
    observer.rest(0.5)
    observer.until(lambda: drives(observer), 5.0, "a pad more changes nothing")  # but on a busy machine intents lapse
    calm.page.evaluate(UNPLUG_FIRST)
    took_s = observer.until(lambda: not drives(observer), 5.0, "it stands")
    assert took_s < LEFT_BEHIND_S + SLACK_S
    observer.rest(0.7)
    assert observer.stand(["r6"]), "the other pad's dead-man was down already"
    calm.page.evaluate(UNPLUG_SECOND)


def test_a_stick_that_moves_all_the_time_is_sent_thirty_times_a_second(
    calm: Console, pad: Pad, observer: Observer
) -> None:
    pad.button(LB, down=True)
    frames_hz = calm.page.evaluate(STIR, 5.0)
    assert LEAST_FRAMES_HZ < frames_hz < MOST_FRAMES_HZ
    observer.until(lambda: drives(observer), 5.0, "it drives")
    expect(calm.named("driving")).to_have_text("driving r6")


def test_a_stop_while_it_drives_is_shown_and_needs_a_new_press(calm: Console, pad: Pad, observer: Observer) -> None:
    pad.stick(0.6, 0.5)
    pad.button(LB, down=True)
    observer.until(lambda: drives(observer), 5.0, "it drives")
    observer.operator.stop(("r6",))
    expect(calm.named("driving")).to_contain_text("not driving: stopped while driving")
    observer.until(lambda: not drives(observer), 5.0, "it stands")
    observer.rest(0.7)
    assert observer.stand(["r6"]), "although the dead-man is still held"
    pad.button(LB, down=False)
    calm.page.evaluate(LOOKED_AT)
    pad.button(LB, down=True)
    observer.until(lambda: drives(observer), 5.0, "a new press drives")
    pad.button(LB, down=False)


def test_its_e_stop_needs_no_dead_man(calm: Console, pad: Pad, observer: Observer) -> None:
    pad.button(B, down=True)
    expect(calm.named("estop-receipts").get_by_role("listitem")).to_have_count(8)
    observer.until(lambda: all(health.estop for health in observer.healths()), 10.0, "all have latched")


def test_a_browser_that_is_killed_leaves_no_robot_driving(
    browser: Browser, demo: Demo, observer: Observer, calm: Console, tmp_path: Path
) -> None:
    own = browser.browser_type.launch_persistent_context(tmp_path / "profile", executable_path=CHROMIUM, args=ARGUMENTS)
    other = Console(own.pages[0], demo.address)
    expect(other.named("robot-row-r6")).to_be_visible(timeout=15_000)
    other.select(["r6"])
    pad = Pad(other)
    pad.stick(0.6, 0.5)
    pad.button(LB, down=True)
    observer.until(lambda: drives(observer), 10.0, "it drives")
    for each in psutil.process_iter(["cmdline"]):
        if any(str(tmp_path) in word for word in each.info["cmdline"] or ()):
            each.kill()
    took_s = observer.until(lambda: not drives(observer), 5.0, "it stands")
    assert took_s < LEFT_BEHIND_S + SLACK_S
    observer.rest(0.5)
    assert observer.stand(["r6"])
