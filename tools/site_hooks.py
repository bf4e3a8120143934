"""Extends MkDocs for `make docs`: README as the first page, and repository files outside ``docs/`` as pages.

A link in ``docs/`` or in the README is relative, so that it works in the repository. Here a link that leaves ``docs/``
becomes a link to a page that shows the file, because the site contains nothing else of the repository.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

FIRST = "README.md"
LINK = re.compile(r"(?<=\]\()(?!#|[a-z]+:)(?P<path>[^)\s#]+)(?P<anchor>#[^)\s]*)?(?=\))")
LANGUAGES = {".ipynb": "json", ".py": "python", ".toml": "toml"}
ROLE = re.compile(r":(?:attr|class|func|meth|mod):(?=<code>)")
GENERATED: dict[str, str] = {}
"""Repository paths of generated pages, by their path in the site."""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Replace each pattern of the navigation by the pages that it matches."""
    docs = Path(config.docs_dir)

    def expanded(entries: list[object]) -> Iterator[object]:
        for entry in entries:
            if isinstance(entry, dict):
                yield {title: list(expanded(below)) for title, below in entry.items()}
            elif isinstance(entry, str) and "*" in entry:
                found = sorted(path for path in docs.glob(entry) if path.name != FIRST)
                yield from (path.relative_to(docs).as_posix() for path in found)
            else:
                yield entry

    config.nav = list(expanded(config.nav or []))
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the README and every file outside ``docs/`` that a page links to."""
    root = Path(config.config_file_path).parent
    GENERATED.clear()
    _add(files, config, root, FIRST)
    pages = [f"docs/{file.src_uri}" for file in files.documentation_pages() if file.src_uri not in GENERATED]
    waiting = [FIRST, *pages]
    while waiting:
        page = waiting.pop()
        for found in LINK.finditer((root / page).read_text(encoding="utf-8")):
            target = _target(page, found["path"])
            if _outside(root, target) and _place(target) not in GENERATED:
                _add(files, config, root, target)
                if target.endswith(".md"):
                    waiting.append(target)
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Point links to repository files at the pages that show them."""
    del files
    root = Path(config.config_file_path).parent
    here = page.file.src_uri
    path = GENERATED.get(here, f"docs/{here}")
    if not path.endswith(".md"):
        return markdown

    def moved(found: re.Match[str]) -> str:
        target = _target(path, found["path"])
        if not (root / target).exists():
            return found[0]  # MkDocs reports it
        return posixpath.relpath(_place(target), posixpath.dirname(here)) + (found["anchor"] or "")

    return LINK.sub(moved, markdown)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Remove Sphinx roles of docstrings, which Markdown does not know: ``:meth:`` before a name."""
    del page, config, files
    return ROLE.sub("", html)


def _target(page: str, link: str) -> str:
    """Return the repository path of a link in a file."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(page), link))


def _outside(root: Path, target: str) -> bool:
    return not target.startswith(("docs/", "..")) and (root / target).exists()


def _place(target: str) -> str:
    """Return where a repository file is in the site."""
    if target == FIRST:
        return "index.md"
    if target.startswith("docs/"):
        return target.removeprefix("docs/")
    return f"repository/{target}" if target.endswith(".md") else f"repository/{target}.md"


def _add(files: Files, config: MkDocsConfig, root: Path, target: str) -> None:
    place, source = _place(target), root / target
    GENERATED[place] = target
    if source.is_dir():
        content = f"# `{target}/`\n\n" + "".join(f"- `{each.name}`\n" for each in sorted(source.iterdir()))
    elif target.endswith(".md"):
        content = source.read_text(encoding="utf-8")
    else:
        language = LANGUAGES.get(source.suffix, "text")
        content = f"# `{target}`\n\n`````{language}\n{source.read_text(encoding='utf-8')}\n`````\n"
    level = InclusionLevel.UNDEFINED if target == FIRST else InclusionLevel.NOT_IN_NAV
    files.append(File.generated(config, place, content=content, inclusion=level))
