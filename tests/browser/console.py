"""The page as its user sees it: what to click, and where to read its texts."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from typing import Any

from playwright.sync_api import ConsoleMessage, Locator, Page, Response, expect

CLS = 0.01
"""Cumulative layout shift that no click or key caused; 0.1 counts as good on the web."""
LASSO_MARGIN_M, LEAST_GAP_M = 0.3, 0.15
Point = tuple[float, float]
SAID = """([id, pattern]) => {
  const words = () => document.querySelector(`[data-testid="${id}"]`).textContent;
  const said = new RegExp(pattern);
  return new Promise((resolve) => {
    const look = () => (said.test(words()) ? resolve(performance.now()) : requestAnimationFrame(look));
    look();
  });
}"""
SHIFTS = """
window.shifts = [];
new PerformanceObserver((list) => {
  for (const entry of list.getEntries()) {
    if (entry.hadRecentInput) continue;
    const where = entry.sources.map((each) => each.node?.id || each.node?.className || each.node?.nodeName);
    window.shifts.push({ value: entry.value, at_s: entry.startTime / 1000, where });
  }
}).observe({ type: "layout-shift", buffered: true });
"""
RETURNING = "try { localStorage.setItem('guide', 'seen'); } catch {}"
"""The guide for a first visit is not shown, except to tests of it; a blank page has no storage."""


class Console:
    """One page of the web console, and all that went wrong in it."""

    def __init__(self, page: Page, address: str, *, first_visit: bool = False) -> None:
        self.page = page
        self.errors: list[str] = []
        page.add_init_script(SHIFTS if first_visit else SHIFTS + RETURNING)
        page.on("console", self._heard)
        page.on("pageerror", lambda error: self.errors.append(f"uncaught: {error}"))
        page.on("response", self._answered)
        page.goto(address)

    def _heard(self, message: ConsoleMessage) -> None:
        if message.type in ("error", "warning"):
            self.errors.append(f"{message.type}: {message.text} ({message.location})")

    def _answered(self, response: Response) -> None:
        if response.status >= 400:
            self.errors.append(f"{response.status} for {response.url.partition('#')[0]}")

    def faultless(self) -> None:
        """Complain of errors in the browser's console and of parts of the page that moved by themselves, since last."""
        errors, self.errors = self.errors, []
        shifts = self.page.evaluate("window.shifts.splice(0)")
        assert not errors, "\n".join(errors)
        assert layout_shift(shifts) < CLS, shifts

    def forgive(self, words: str) -> None:
        """Forget complaints that contain `words`: what a test did on purpose."""
        self.errors = [error for error in self.errors if words not in error]

    # ------------------------------------------------------------------ looking
    def named(self, testid: str) -> Locator:
        return self.page.get_by_test_id(testid)

    @property
    def state(self) -> dict[str, Any]:
        """What the page knows: robots, selection, goals, …"""
        state: dict[str, Any] = self.page.evaluate("window.fullswarm.state")
        return state

    def charts(self) -> list[dict[str, Any]]:
        """Return what each chart shows: title, lines, times, values, or why there are none."""
        found: list[dict[str, Any]] = self.page.evaluate("window.fullswarm.charts")
        return found

    def places(self) -> dict[str, Point]:
        return {robot: (each["x"], each["y"]) for robot, each in self.state["robots"].items()}

    def says(self, testid: str, pattern: str) -> None:
        """Begin to wait, in the page, for words; :meth:`said_ms` gives the moment."""
        self.page.evaluate(f"(words) => {{ window.said = ({SAID})(words); }}", [testid, pattern])

    def said_ms(self) -> float:
        moment: float = self.page.evaluate("window.said")
        return moment

    def now_ms(self) -> float:
        """Return the page's own clock."""
        moment: float = self.page.evaluate("performance.now()")
        return moment

    def until(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Wait for what cannot be read off one element.

        Playwright's own way evaluates a string again and again, which the page's security policy rightly forbids.
        """
        deadline_s = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline_s, f"waited {timeout_s:g} s for: {what}\n{self.state}"
            self.page.wait_for_timeout(20)

    # ------------------------------------------------------------------ doing
    def at(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Return where a point of the floor is on the page, px."""
        x_px, y_px = self.page.evaluate("([x, y]) => window.fullswarm.toScreen(x, y)", [x_m, y_m])
        return x_px, y_px

    def click_floor(self, x_m: float, y_m: float) -> None:
        self.page.mouse.click(*self.at(x_m, y_m))

    def select(self, robots: Iterable[str]) -> None:
        """Select in the fleet's table."""
        self.press("Escape")
        for robot in robots:
            self.named(f"robot-row-{robot}").get_by_role("checkbox").check()

    def lasso(self, corners: list[Point]) -> None:
        """Draw a closed line through points of the floor."""
        mouse = self.page.mouse
        mouse.move(*self.at(*corners[0]))
        mouse.down()
        for corner in (*corners[1:], corners[0]):
            mouse.move(*self.at(*corner), steps=5)
        mouse.up()

    def press(self, key: str) -> None:
        """Press a key while no field has the focus."""
        self.page.evaluate("document.activeElement?.blur()")
        self.page.keyboard.press(key)

    def start(self, behaviour: str, **values: object) -> None:
        """Choose a behaviour, fill its form in, and start it for the selection."""
        if self.named("behaviour-form").is_visible():
            self.named("form-back").click()
        self.named(f"behaviour-{behaviour}").click()
        for name, value in values.items():
            field = self.named("behaviour-form").locator(f'[name="{name}"]').first
            field.fill(str(value))
        self.named("start").click()

    def clear_the_map(self) -> None:
        """Close or wait for what lies over the map, so that it can be clicked everywhere."""
        if self.named("stop-receipts").is_visible():
            self.page.locator("#stop-close").click()
        expect(self.page.locator("#estop-panel")).to_be_hidden(timeout=15_000)

    def give_back(self) -> None:
        """Give all leases back."""
        if self.named("release-all").is_enabled():
            self.named("release-all").click()
        expect(self.named("release-all")).to_be_disabled()


def layout_shift(shifts: list[dict[str, Any]]) -> float:
    """Return the metric CLS: the worst sum over 5 s of shifts that are less than 1 s apart."""
    worst = total = 0.0
    began_s = last_s = -math.inf
    for each in shifts:
        if each["at_s"] - last_s >= 1.0 or each["at_s"] - began_s >= 5.0:
            began_s, total = each["at_s"], 0.0
        last_s = each["at_s"]
        total += each["value"]
        worst = max(worst, total)
    return worst


def outer_threes(places: dict[str, Point]) -> list[tuple[list[str], list[Point]]]:
    """Return threes of robots that a straight line parts from all others, each with the corners of a lasso."""
    found = []
    for angle in (math.radians(degrees) for degrees in range(0, 360, 10)):
        forward, left = (math.cos(angle), math.sin(angle)), (-math.sin(angle), math.cos(angle))
        ahead = {robot: x * forward[0] + y * forward[1] for robot, (x, y) in places.items()}
        *others, one, two, three = sorted(ahead, key=ahead.__getitem__)
        gap = ahead[one] - ahead[others[-1]]
        if gap < LEAST_GAP_M:
            continue
        left_of = [places[each][0] * left[0] + places[each][1] * left[1] for each in (one, two, three)]
        near, far_off = ahead[one] - gap / 2.0, ahead[three] + LASSO_MARGIN_M
        sides = (min(left_of) - LASSO_MARGIN_M, max(left_of) + LASSO_MARGIN_M)
        box = ((near, sides[0]), (far_off, sides[0]), (far_off, sides[1]), (near, sides[1]))
        corners = [(a * forward[0] + b * left[0], a * forward[1] + b * left[1]) for a, b in box]
        found.append((sorted((one, two, three)), corners))
    return found
