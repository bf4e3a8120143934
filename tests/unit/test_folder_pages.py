"""The page of each folder (its ``__init__`` docstring) names each of its files, and no file that is not there."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

import fullswarm

PACKAGE = Path(fullswarm.__file__).parent
PAGES = sorted(page for page in PACKAGE.rglob("__init__.py") if any(page.parent.glob("[!_]*.py")))


def text_of(page: Path) -> str:
    return ast.get_docstring(ast.parse(page.read_text(encoding="utf-8"))) or ""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.parent.relative_to(PACKAGE.parent)))
def test_a_page_names_what_is_in_its_folder(page: Path) -> None:
    folder, text = page.parent, text_of(page)
    files = {path.stem for path in folder.glob("[!_]*.py")}
    folders = {path.parent.name for path in folder.glob("*/__init__.py")}
    unnamed = [
        name
        for name in sorted(files)
        if not re.search(rf"(?<!\w){name}\.py\b|``{name}``|:class:`[^`]*\.{name}\.", text)
    ]
    unnamed += [name for name in sorted(folders) if not re.search(rf"(?<!\w){name}/|``{name}``", text)]
    assert unnamed == [], f"add a line for each to the docstring of {page}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.parent.relative_to(PACKAGE.parent)))
def test_a_page_names_no_file_that_is_gone(page: Path) -> None:
    named = set(re.findall(r"``([a-z_0-9]+)\.py``", text_of(page)))
    there = {path.stem for path in page.parent.rglob("*.py")}
    assert named <= there


def test_the_page_of_the_console_names_its_modules() -> None:
    console = PACKAGE / "operator" / "console"
    there = {path.name for path in (console / "page").glob("*.js")}
    assert set(re.findall(r"\b\w+\.js\b", text_of(console / "__init__.py"))) == there
