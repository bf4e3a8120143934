"""The commands of the documentation, run page by page as a reader would; those that are not run say why."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.system.docs_shell import ROOT, File, Page, Shell, Step, available, commands, read_page

PAGES = [
    read_page(path)
    for path in (*sorted((ROOT / "docs").glob("*.md")), ROOT / "README.md")
    if not path.name.startswith("reference-")  # those list all; the blocks of the others are for doing
]

QUICK = {
    "behaviours", "how-to-audit", "how-to-bring-your-world", "how-to-camera", "how-to-charging",
    "how-to-connect-a-robot", "how-to-install", "how-to-look-back", "how-to-outside-controllers", "how-to-ranges",
    "how-to-run-a-study", "how-to-use-from-python", "tutorial-first-recording",
}  # fmt: skip
"""Pages of less than half a minute; the others together take ten minutes, and are run by `make test-all`."""


@pytest.mark.skipif(not available(), reason="needs namespaces of processes and networks")
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=Path(page.name).stem, marks=() if Path(page.name).stem in QUICK else pytest.mark.slow)
        for page in PAGES if page.runs
    ],
)  # fmt: skip
def test_the_commands_of_a_page_run(page: Page, tmp_path: Path) -> None:
    shell = Shell(tmp_path)
    try:
        for step in page.steps:
            if isinstance(step, File):
                step.write(shell.folder)
            elif not step.not_run:
                wrong = shell.run(step)
                assert wrong is None, f"{page.name}, {wrong}"
        wrong = shell.end()
        assert wrong is None, f"{page.name}, {wrong}"
    finally:
        shell.close()


def test_each_command_that_is_not_run_has_a_reason() -> None:
    skipped = [step for page in PAGES for step in page.steps if isinstance(step, Step) and step.not_run]
    assert all(len(step.not_run.split()) > 1 for step in skipped)
    assert sum(len(page.runs) for page in PAGES) > len(skipped)


def test_commands_are_told_from_their_output() -> None:
    text = "$ fullswarm stopp\nerror: no such command\n$ fullswarm a \\\n   --b\nfullswarm is output\n"
    assert [(step.command, step.line, step.refused) for step in commands(text, 5)] == [
        ("fullswarm stopp", 5, "error: no such command"), ("fullswarm a --b", 7, ""),
    ]  # fmt: skip
    text = "fullswarm a\n  output\nfullswarm b  # why\n"
    assert [step.command for step in commands(text, 1)] == ["fullswarm a", "fullswarm b  # why"]


@pytest.mark.skipif(not available(), reason="needs namespaces of processes and networks")
def test_a_command_that_fails_is_found(tmp_path: Path) -> None:
    shell = Shell(tmp_path)
    try:
        assert shell.run(Step("fullswarm --version", 1)) is None
        assert "exit code 2" in str(shell.run(Step("fullswarm dmeo", 2)))
        assert shell.run(Step("fullswarm dmeo", 3, refused="error: dmeo")) is not None  # another error than shown
        wrong = shell.run(Step("fullswarm metrics --no-such-option", 4)) or shell.end()
        assert "No such option" in str(wrong)
    finally:
        shell.close()
