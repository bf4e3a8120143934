"""The site that `make docs` builds: no warning, no dead link, nothing from elsewhere, each list and block of a page."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from collections import Counter
from functools import cached_property
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from markdown_it import MarkdownIt

ROOT = Path(__file__).parents[2]
BLOCKS = {"blockquote", "li", "ol", "pre", "table", "tr", "ul"}
LOADING = {"link": "href"} | dict.fromkeys(("audio", "embed", "iframe", "img", "script", "source", "video"), "src")
MADE_BY_A_TOOL = {"reference-python.md"}
"""Pages with more on the site than in the file."""

pytestmark = pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="the extra docs is not installed")


class Page(HTMLParser):
    """A page as a browser would read it: links, their targets, what it loads, blocks within the article."""

    def __init__(self, text: str, *, whole: bool = False) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.names: set[str] = set()
        self.blocks: Counter[str] = Counter()
        self._article = whole
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self._article |= tag == "article"
        self.names |= {given[key] or "" for key in ("id", "name") if key in given}
        if tag == "a" and given.get("href") is not None:
            self.links.append(given["href"] or "")
        if tag in LOADING and given.get(LOADING[tag]):
            self.loads.append(given[LOADING[tag]] or "")
        if self._article and tag in BLOCKS:
            self.blocks[tag] += 1

    def handle_endtag(self, tag: str) -> None:
        if tag == "article":
            self._article = False


class Site:
    """A site on the disk."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @cached_property
    def pages(self) -> dict[Path, Page]:
        return {path: Page(path.read_text(encoding="utf-8")) for path in sorted(self.folder.rglob("*.html"))}

    def target(self, page: Path, link: str) -> tuple[Path, str]:
        """Return the file that a link names, and the anchor within it."""
        parts = urlsplit(link)
        base = self.folder if parts.path.startswith("/") else page.parent
        path = (base / unquote(parts.path).lstrip("/")).resolve() if parts.path else page
        return path / "index.html" if path.is_dir() else path, unquote(parts.fragment)

    def dead(self, page: Path, link: str) -> bool:
        path, anchor = self.target(page, link)
        if not path.is_file() or not path.is_relative_to(self.folder):
            return True
        return bool(anchor) and path in self.pages and anchor not in self.pages[path].names


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    folder = tmp_path_factory.mktemp("site").resolve()
    # Not --quiet: then MkDocs counts no warnings, and --strict has no effect.
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    result = subprocess.run(
        command, cwd=ROOT, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True, timeout=300
    )
    assert result.returncode == 0, result.stderr
    assert "WARNING" not in result.stderr, result.stderr
    return Site(folder)


def external(link: str) -> bool:
    return bool(urlsplit(link).scheme or urlsplit(link).netloc)


def test_each_link_and_anchor_within_the_site_resolves(site: Site) -> None:
    links = {(path, link) for path, page in site.pages.items() for link in (*page.links, *page.loads)}
    inner = [(path, link) for path, link in links if not external(link)]
    assert len(inner) > 2000
    dead = [f"{path.relative_to(site.folder)}: {link}" for path, link in inner if site.dead(path, link)]
    assert sorted(dead) == []


def test_a_link_to_nowhere_would_be_found(site: Site) -> None:
    index = site.folder / "index.html"
    assert site.dead(index, "no-such-page.html")
    assert site.dead(index, "reference-cli.html#no-such-anchor")
    assert site.dead(index, "../outside.html")
    assert not site.dead(index, "reference-cli.html#request-and-watch")


def test_nothing_is_loaded_from_another_host(site: Site) -> None:
    assert [(path.name, load) for path, page in site.pages.items() for load in page.loads if external(load)] == []
    for sheet in site.folder.rglob("*.css"):
        assert not re.search(r"(url\(|@import)\s*['\"]?(https?:)?//", sheet.read_text(encoding="utf-8")), sheet


def test_each_page_is_reached_from_the_first_one(site: Site) -> None:
    index = site.folder / "index.html"
    reached, waiting = {index}, [index]
    while waiting:
        page = waiting.pop()
        for link in site.pages[page].links:
            path, _ = site.target(page, link)
            if not external(link) and path in site.pages and path not in reached:
                reached.add(path)
                waiting.append(path)
    assert set(site.pages) - reached == {site.folder / "404.html"}
    for file in (ROOT / "docs").rglob("*.md"):
        assert _built(site, file) in reached, file


def test_a_page_has_the_lists_tables_and_blocks_that_a_repository_shows(site: Site) -> None:
    """Another implementation, of CommonMark, counts them: MkDocs nests lists by other rules."""
    render = MarkdownIt("commonmark").enable("table").render
    for file in (*(ROOT / "docs").rglob("*.md"), ROOT / "README.md"):
        if file.name not in MADE_BY_A_TOOL:
            expected = Page(render(file.read_text(encoding="utf-8")), whole=True).blocks
            assert site.pages[_built(site, file)].blocks == expected, file


def test_a_file_outside_the_documentation_is_shown(site: Site) -> None:
    shown = (site.folder / "repository" / "LICENSE.html").read_text(encoding="utf-8")
    assert "Apache License" in shown


def _built(site: Site, file: Path) -> Path:
    """Return the page that is built of a Markdown file."""
    if file.parent == ROOT:
        return site.folder / "index.html"
    path = site.folder / file.relative_to(ROOT / "docs").with_suffix(".html")
    return path.with_name("index.html") if file.name == "README.md" else path
