"""The documentation's site: axe finds nothing on the kinds of pages that it has, light and dark."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from typing import Literal

import pytest
from playwright.sync_api import Browser

from tests.browser.axe import NPM, violations

ROOT = Path(__file__).parents[2]
KINDS = ("index", "tutorial-first-swarm", "how-to-operate-from-a-browser", "decisions/index")
"""With pictures and tables, with output, with many links, with a long navigation."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    built = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(built)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True, timeout=300)
    return built


@pytest.mark.skipif(NPM is None, reason="no npm here to fetch axe-core: apt install nodejs npm")
@pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="the extra docs is not installed")
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_on_the_site(folder: Path, browser: Browser, scheme: Literal["light", "dark"]) -> None:
    page = browser.new_page(color_scheme=scheme)
    found = {}
    for kind in KINDS:
        page.goto((folder / f"{kind}.html").as_uri())
        found[kind] = violations(page)
    page.close()
    assert found == {kind: [] for kind in KINDS}
