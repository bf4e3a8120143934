"""The console's page with a console that is played in the page itself: no process, and any state at once."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from playwright.sync_api import Browser, Route, ViewportSize

import fullswarm.operator.console
from fullswarm.core.behaviours import load_records, make_record
from fullswarm.operator.console.access import HEADERS
from tests.browser.console import Console

ADDRESS = "http://localhost:8807/"
"""Nothing listens there: the browser is given the page's files before it asks the network."""
FOLDER = Path(fullswarm.operator.console.__file__).with_name("page")
SCRIPT = Path(__file__).with_name("fake_console.js")
TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}


@cache
def behaviours() -> dict[str, Any]:
    """Return the records of the built-in behaviours: the forms are as long as they are."""
    tables = load_records()
    return {name: make_record(name, tables).model_dump(mode="json", exclude_none=True) for name in tables}


def serve(route: Route) -> None:
    """Answer a request for a file of the page, with the console's own headers."""
    path = urlsplit(route.request.url).path
    file = FOLDER / ("index.html" if path == "/" else path.removeprefix("/page/"))
    route.fulfill(body=file.read_bytes(), content_type=TYPES[file.suffix], headers=HEADERS)


def play(
    browser: Browser, size: ViewportSize, robots: int = 8, *, first_visit: bool = False, **options: Any
) -> Console:
    """Open the page before a played console with some robots; `options` are those of the browser's context."""
    context = browser.new_context(viewport=size, **options)
    page = context.new_page()
    page.route(f"{ADDRESS}**", serve)
    page.add_init_script(f"({SCRIPT.read_text()})({json.dumps({'robots': robots, 'behaviours': behaviours()})})")
    console = Console(page, ADDRESS, first_visit=first_visit)
    console.until(lambda: len(console.state["robots"]) == robots, 15.0, "all robots are on the map")
    return console


def change(console: Console, **state: Any) -> None:
    """Set what the played swarm is like, and let the page know at once."""
    console.page.evaluate("(state) => { Object.assign(fake.swarm, state); fake.tick(); }", state)


def sent(console: Console, kind: str) -> list[dict[str, Any]]:
    """Return the frames of a kind that the page has sent."""
    frames: list[dict[str, Any]] = console.page.evaluate("(t) => fake.sent.filter((each) => each.t === t)", kind)
    return frames
