"""The stick on the screen, with real touches: whatever takes the thumb away ends the driving at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from playwright.sync_api import Browser, ViewportSize, expect

from tests.browser.console import Console
from tests.browser.played import change, play, sent
from tests.browser.states import show

PHONE: ViewportSize = {"width": 390, "height": 844}
AT_ONCE_MS = 30.0
"""Between the event in the page and the frame: no timer lies between them."""
NOTE = """() => {
  window.events = [];
  const note = (event) => {
    window.events.push(performance.now());
    if (event.type === "pointerdown") window.thumb ??= event.pointerId;
  };
  const touches = ["pointerdown", "pointerup", "pointercancel", "lostpointercapture"];
  const others = ["blur", "visibilitychange", "pagehide", "keydown", "resize"];
  for (const name of [...touches, ...others]) addEventListener(name, note, { capture: true });
}"""
"""Notes when something happens that may end the driving, and the first finger."""


class Hand:
    """Fingers on the screen, each with a number."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self.session = console.page.context.new_cdp_session(console.page)
        self.fingers: dict[int, tuple[float, float]] = {}

    def _send(self, kind: str) -> None:
        points = [{"x": x, "y": y, "id": number} for number, (x, y) in self.fingers.items()]
        self.session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    def down(self, number: int, x: float, y: float) -> None:
        self.fingers[number] = (x, y)
        self._send("touchStart")

    def move(self, number: int, x: float, y: float) -> None:
        self.fingers[number] = (x, y)
        self._send("touchMove")

    def up(self, number: int) -> None:
        del self.fingers[number]
        self._send("touchMove" if self.fingers else "touchEnd")  # the protocol: an end has no fingers left

    def cancel(self) -> None:
        """Take all away as the system does, for a call or a gesture of its own."""
        self.fingers.clear()
        self._send("touchCancel")

    def centre(self, selector: str) -> tuple[float, float]:
        box = self.console.page.locator(selector).bounding_box()
        assert box is not None
        return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def push(self, dx: float, dy: float) -> None:
        """Put the thumb on the middle of the stick, and push it."""
        x, y = self.centre("#stick")
        self.down(1, x, y)
        self.move(1, x + dx, y + dy)

    def lift_all(self) -> None:
        for number in list(self.fingers):
            self.up(number)


@pytest.fixture(scope="module")
def opened(browser: Browser) -> Iterator[Console]:
    console = play(browser, PHONE, has_touch=True)
    console.page.evaluate(NOTE)
    yield console
    console.page.context.close()


@pytest.fixture
def console(opened: Console) -> Iterator[Console]:
    show(opened, "fleet")
    opened.select(["r1"])
    show(opened, "drive")
    opened.page.evaluate("fake.sent.length = 0; window.events.length = 0; window.thumb = null")
    yield opened
    opened.page.evaluate("window.shifts.splice(0)")
    opened.faultless()


@pytest.fixture
def hand(console: Console) -> Iterator[Hand]:
    made = Hand(console)
    yield made
    made.lift_all()


def drives(console: Console, *, linear: float, angular: float = 0.0) -> None:
    """Wait until frames say so."""

    def says() -> bool:
        frames = sent(console, "drive")
        return bool(frames) and frames[-1]["sticks"] == pytest.approx({"linear": linear, "angular": angular}, abs=0.01)

    console.until(says, 5.0, f"it drives at {linear}, {angular}")


def ended(console: Console) -> None:
    """Check that a release followed at once, and no further frame, though the finger may still be there."""
    console.until(lambda: bool(sent(console, "release")), 2.0, "the stick is released")
    released_ms = sent(console, "release")[0]["at_ms"]
    causes: list[float] = console.page.evaluate("window.events")
    assert min(abs(released_ms - cause_ms) for cause_ms in causes) < AT_ONCE_MS
    console.page.wait_for_timeout(250)
    assert all(frame["at_ms"] <= released_ms for frame in sent(console, "drive"))
    assert len(sent(console, "release")) == 1
    assert not console.state["driving"]
    assert console.page.locator("#stick-knob").evaluate("(knob) => knob.style.transform") == ""


def test_a_thumb_drives_at_half_speed_and_turns(console: Console, hand: Hand) -> None:
    hand.push(0, -300)  # beyond the edge: it counts as the edge
    drives(console, linear=0.5)
    expect(console.named("stick-words")).to_have_text("driving r1")
    x, y = hand.centre("#stick")
    hand.move(1, x + 300, y)
    drives(console, linear=0.0, angular=-0.5)
    hand.move(1, x, y + 2)
    drives(console, linear=0.0)  # the dead zone
    hand.move(1, x, y + 300)
    drives(console, linear=-0.5)
    frames = sent(console, "drive")
    assert {tuple(frame["robots"]) for frame in frames} == {("r1",)}
    assert console.page.evaluate("getSelection().toString()") == ""
    assert console.page.evaluate("[scrollX, scrollY]") == [0, 0]
    assert console.state["selection"] == ["r1"]


LOSE = """() => {
  const lost = new PointerEvent("lostpointercapture", { pointerId: window.thumb });
  document.getElementById("stick").dispatchEvent(lost);
}"""
WAYS: dict[str, Callable[[Console, Hand], object]] = {
    "lifted": lambda _, hand: hand.up(1),
    "cancelled": lambda _, hand: hand.cancel(),
    "lost capture": lambda console, _: console.page.evaluate(LOSE),
    "blur": lambda console, _: console.page.evaluate("dispatchEvent(new Event('blur'))"),
    "hidden": lambda console, _: hide(console),
    "pagehide": lambda console, _: console.page.evaluate("dispatchEvent(new Event('pagehide'))"),
    "other selection": lambda console, _: console.page.keyboard.press("]"),
    "stop key": lambda console, _: console.page.keyboard.press("Space"),
    "e-stop key": lambda console, _: console.page.keyboard.press("e"),
    "turned": lambda console, _: console.page.set_viewport_size({"width": 844, "height": 390}),
}


def hide(console: Console) -> None:
    """Hide the page as far as it can see; a headless browser shows all its pages at all times."""
    console.page.evaluate("""() => {
      Object.defineProperty(document, "hidden", { value: true, configurable: true });
      document.dispatchEvent(new Event("visibilitychange"));
      delete document.hidden;
    }""")


@pytest.mark.parametrize("way", WAYS)
def test_whatever_takes_the_thumb_away_ends_it_at_once(console: Console, hand: Hand, way: str) -> None:
    hand.push(0, -120)
    drives(console, linear=0.5)
    console.page.evaluate("window.events.length = 0")
    WAYS[way](console, hand)
    ended(console)
    if hand.fingers:
        x, y = hand.centre("#stick")
        hand.move(1, x, y - 60)
        console.page.wait_for_timeout(150)
        assert not console.state["driving"], "the same touch does not drive on"
        hand.up(1)
    console.page.set_viewport_size(PHONE)
    hand.push(0, -120)
    console.until(lambda: console.state["driving"], 5.0, "a fresh touch drives")


def test_a_second_finger_presses_the_e_stop_while_the_first_drives(console: Console, hand: Hand) -> None:
    for button in ("stop", "estop"):
        console.page.evaluate("fake.sent.length = 0")
        hand.push(0, -120)
        drives(console, linear=0.5)
        console.page.evaluate("window.events.length = 0")
        hand.down(2, *hand.centre(f"#{button}"))
        ended(console)
        assert len(sent(console, button)) == 1, "though no click comes of it"
        assert sent(console, button)[0]["at_ms"] - sent(console, "release")[0]["at_ms"] < AT_ONCE_MS
        hand.lift_all()
        console.page.wait_for_timeout(100)
        assert len(sent(console, button)) == 1, "once"
    console.page.evaluate("fake.say({ t: 'stop', standing: fake.ids(), moving: [], silent: [], done: true })")
    console.page.locator("#stop-close").click()


def test_a_tap_on_the_stop_sends_one(console: Console) -> None:
    console.named("stop").tap()
    console.page.wait_for_timeout(300)
    assert len(sent(console, "stop")) == 1
    console.page.locator("#stop-close").click()


def test_one_finger_owns_the_stick_and_others_move_the_map(console: Console, hand: Hand) -> None:
    hand.push(0, -120)
    drives(console, linear=0.5)
    x, y = hand.centre("#stick")
    hand.down(2, x + 20, y + 20)  # a second one on the stick
    hand.move(2, x + 60, y + 60)
    hand.up(2)
    drives(console, linear=0.5)
    wide = console.at(10.0, 0.0)[0] - console.at(0.0, 0.0)[0]
    mx, my = hand.centre("#map")
    hand.down(3, mx - 20, my)
    hand.down(4, mx + 20, my)
    for step in range(1, 6):
        hand.move(3, mx - 20 - 10 * step, my)
        hand.move(4, mx + 20 + 10 * step, my)
    assert console.at(10.0, 0.0)[0] - console.at(0.0, 0.0)[0] > 2.0 * wide, "pinched"
    assert console.state["driving"]
    hand.up(3)
    hand.up(4)
    drives(console, linear=0.5)
    assert sent(console, "release") == []
    console.page.locator("#zoom-fit").evaluate("(fit) => fit.click()")


def test_without_robots_it_says_why_and_sends_nothing(console: Console, hand: Hand) -> None:
    console.press("Escape")
    hand.push(0, -120)
    expect(console.named("stick-words")).to_have_text("not driving: select robots")
    console.page.wait_for_timeout(150)
    assert sent(console, "drive") == []


@pytest.mark.parametrize(("width", "height"), [(390, 844), (844, 390), (768, 1024), (1024, 700), (1440, 900)])
def test_it_is_within_reach_of_either_thumb(console: Console, width: int, height: int) -> None:
    """At most as far from the edge as a thumb reaches, about 350 px; the choice is kept."""
    page = console.page
    page.set_viewport_size({"width": width, "height": height})
    toggle = console.named("drive-toggle")
    if toggle.is_visible():
        toggle.click()
    sides = []
    for _ in range(2):
        box = console.named("stick").bounding_box()
        assert box is not None
        assert min(box["width"], box["height"]) >= 120
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= width
        assert box["y"] + box["height"] <= height
        left, right = box["x"], width - box["x"] - box["width"]
        sides.append("left" if left < right else "right")
        if width < 1240:
            assert min(left, right) < 60
        console.named("hand").click()
    assert sides == ["right", "left"] or width >= 1240
    if toggle.is_visible():
        toggle.click()
    page.set_viewport_size(PHONE)


SIGNALS = """() => {
  window.given = { tones: 0, shakes: 0 };
  const start = OscillatorNode.prototype.start;
  OscillatorNode.prototype.start = function (...args) {
    window.given.tones += 1;
    return start.apply(this, args);
  };
  navigator.vibrate = () => ((window.given.shakes += 1), true);
}"""


GIVEN = """() => {
  const { tones, shakes } = window.given;
  window.given = { tones: 0, shakes: 0 };
  return [tones, shakes];
}"""
"""Since last."""


def test_an_e_stop_and_a_lost_link_are_heard_and_felt(console: Console) -> None:
    page = console.page
    page.evaluate(SIGNALS)
    change(console, estop=["r2"])  # of its own
    console.until(lambda: console.state["robots"]["r2"]["estop"], 5.0, "it is known")
    assert page.evaluate(GIVEN) == [3, 1]
    page.wait_for_timeout(500)
    assert page.evaluate(GIVEN) == [0, 0], "once"
    change(console, estop=[])
    page.emulate_media(reduced_motion="reduce")
    change(console, mute=True)
    expect(console.named("link-state")).to_contain_text("no data")
    page.wait_for_timeout(200)
    assert page.evaluate(GIVEN) == [2, 0], "heard; a vibration is a motion"
    change(console, mute=False)
    expect(console.named("link-state")).to_have_text("live")
    page.emulate_media(reduced_motion="no-preference")
    console.named("bar-fold").tap()
    page.locator("#signals").tap()
    expect(page.locator("#signals")).to_have_text("Sound: off")
    assert page.evaluate("localStorage.getItem('signals')") == "off"
    page.evaluate(GIVEN)
    change(console, estop=["r2"])
    page.wait_for_timeout(500)
    assert page.evaluate(GIVEN) == [0, 0]
    change(console, estop=[])
    page.locator("#signals").tap()
    page.locator("#map").tap(position={"x": 5, "y": 5})
    expect(page.locator("#estop-panel")).to_be_hidden(timeout=15_000)
