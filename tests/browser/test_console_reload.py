"""`fullswarm up --reload --console`: what the page shows of a law that is edited while robots run it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from tests.browser.conftest import SIZE, Snap
from tests.browser.console import Console
from tests.system.test_reload import LAW, RECORD, UnderDevelopment

TIMEOUT_MS = 20_000


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[UnderDevelopment]:
    made = UnderDevelopment(tmp_path / "my-lab", "--console")
    try:
        yield made
    finally:
        made.close()


def test_the_page_says_what_became_of_an_edited_law(lab: UnderDevelopment, browser: Browser, snap: Snap) -> None:
    lab.until(lambda: "#token=" in lab.log.read_text() and lab.ready(), "the page is served")
    address = re.search(r"http://\S+#token=\S+", lab.log.read_text())
    assert address is not None
    context = browser.new_context(viewport=SIZE, color_scheme="light")
    console = Console(context.new_page(), address[0])
    said = console.page.locator("#log .entry-text")
    console.start("glide")
    lab.until(lambda: lab.drives(0.3), "they drive")
    lab.law.write_text(LAW.format(speed=0.15))
    # Not only the last entry is looked at: on a busy machine, "received again" may have come after it.
    expect(said.filter(has_text="glide.py is loaded")).to_have_count(1, timeout=TIMEOUT_MS)
    lab.until(lambda: lab.drives(0.15), "they run the new law")
    lab.law.write_text("def velocity(view, params):\n    return (\n")
    problem = f"glide.py is not loaded, what ran before goes on: {lab.law}:2: SyntaxError: '(' was never closed"
    expect(said.filter(has_text=problem)).to_have_count(1, timeout=TIMEOUT_MS)
    snap(console.page, "reload-broken")
    lab.runtime.run(1.0)
    assert lab.drives(0.15)
    lab.law.write_text(LAW.format(speed="missing"))
    # Of both robots in one line, or in two where their reports came apart.
    why = re.compile(r"r[12](, r2)?: law 'glide': NameError: name 'missing' is not defined \(glide\.py:5\)")
    expect(said.filter(has_text=why).first).to_be_attached(timeout=TIMEOUT_MS)
    expect(console.named("robot-row-r1")).to_contain_text("STOPPED")
    lab.until(lambda: lab.drives(0.0), "a law that fails stops its robots")
    snap(console.page, "reload-failed")
    lab.law.write_text(LAW.format(speed=0.2))
    expect(said.filter(has_text="glide.py is loaded")).to_have_count(2, timeout=TIMEOUT_MS)
    lab.until(lambda: lab.drives(0.2), "they run the repaired law")
    expect(console.named("robot-row-r1")).to_contain_text("moving")
    lab.law.with_name("slide.py").write_text(LAW.format(speed=0.1))
    lab.law.with_name("slide.toml").write_text(RECORD.replace("glide", "slide"))
    project = lab.law.parents[1] / "pyproject.toml"
    project.write_text(project.read_text().replace("glide =", 'slide = "my_lab.slide"\nglide ='))
    expect(said.filter(has_text="slide.toml is loaded")).to_have_count(1, timeout=TIMEOUT_MS)
    console.start("slide")
    lab.until(lambda: lab.drives(0.1), "they run the behaviour that was added")
    snap(console.page, "reload-added")
    console.faultless()
    context.close()
