"""Who may not: pages of other origins, a page without the token, a page that only shows."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import httpx
import pytest
from playwright.sync_api import Browser, expect

from tests.browser.conftest import SIZE, Snap
from tests.browser.console import Console
from tests.browser.swarm import Demo, Observer

FETCH = """([url, options]) => fetch(url, options).then(
  (answer) => ({ type: answer.type, status: answer.status }), (error) => ({ error: String(error) }))"""
SOCKET = """([url, frames]) => new Promise((resolve) => {
  const socket = new WebSocket(url);
  const told = { opened: false, heard: 0 };
  socket.onopen = () => { told.opened = true; frames.forEach((frame) => socket.send(JSON.stringify(frame))); };
  socket.onmessage = () => { told.heard += 1; };
  socket.onclose = ({ code }) => resolve({ ...told, code });
  setTimeout(() => resolve({ ...told, code: 0 }), 5000);
})"""


class Evil(BaseHTTPRequestHandler):
    """A page on this machine that is not the console's."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<!doctype html><title>elsewhere</title>")

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002  (the base class's name)
        """Say nothing."""


@pytest.fixture
def elsewhere() -> Iterator[str]:
    """The address of the other origin: same machine, another port."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), Evil)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    thread.join()
    server.server_close()


def test_a_page_of_another_origin_can_do_nothing_even_with_the_token(
    calm: Console, browser: Browser, demo: Demo, observer: Observer, elsewhere: str
) -> None:
    calm.start("flocking_bc")
    observer.until(lambda: observer.all_run("flocking_bc") and not observer.stand(), 10.0, "the flock moves")
    own, _, token = demo.address.partition("#token=")
    hello = {"t": "hello", "token": token, "session": "elsewhere-session-1"}
    frames = [hello, {"t": "stop", "ref": 1, "robots": []}, {"t": "estop", "ref": 2, "robots": [], "reason": "evil"}]
    context = browser.new_context()
    page = context.new_page()
    page.goto(elsewhere)
    assert "error" in page.evaluate(FETCH, [own, {}])
    page.evaluate(FETCH, [own + "ws", {"mode": "no-cors", "method": "POST", "body": "{}"}])
    foreign = httpx.get(own, headers={"Origin": elsewhere.rstrip("/")})
    assert foreign.status_code == 403, "refused by the console, not merely hidden by the browser"
    told = page.evaluate(SOCKET, [own.replace("http", "ws") + "ws", frames])
    assert not told["opened"]
    assert told["heard"] == 0
    context.close()

    same = calm.page.evaluate(FETCH, [own, {}])
    assert same["status"] == 200, "the same from its own page is answered"
    observer.rest(1.0)
    assert observer.all_run("flocking_bc")
    assert not any(health.estop for health in observer.healths())


def test_without_the_token_nothing_is_shown(browser: Browser, demo: Demo) -> None:
    context = browser.new_context(viewport=SIZE)
    page = context.new_page()
    page.goto(demo.address.partition("#")[0])
    expect(page.get_by_test_id("link-state")).to_contain_text("token")
    assert page.evaluate("window.fullswarm.state.robots") == {}
    context.close()


def test_the_token_leaves_the_address_at_once(calm: Console, demo: Demo) -> None:
    assert calm.page.url == demo.address.partition("#")[0]


def test_a_page_that_only_shows_cannot_drive_or_stop(
    calm: Console, browser: Browser, demo: Demo, observer: Observer, snap: Snap
) -> None:
    with demo.read_only_console() as address:
        context = browser.new_context(viewport=SIZE)
        shown = Console(context.new_page(), address)
        expect(shown.named("link-state")).to_have_text("live", timeout=15_000)
        shown.until(lambda: len(shown.state["robots"]) == 8, 10.0, "it shows all robots")
        calm.start("flocking_bc")
        observer.until(lambda: observer.all_run("flocking_bc"), 10.0, "the flock moves")
        shown.press("Space")
        expect(shown.named("stop-receipts")).to_contain_text("NOT DONE: this console is read-only")
        shown.press("e")
        expect(shown.page.locator("#estop-title")).to_contain_text("NOT DONE: this console is read-only")
        expect(shown.page.get_by_text("read only").first).to_be_visible()
        snap(shown.page, "read-only")
        observer.rest(1.0)
        assert observer.all_run("flocking_bc")
        assert not any(health.estop for health in observer.healths())
        shown.faultless()
        context.close()
