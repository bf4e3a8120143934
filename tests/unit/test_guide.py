"""The page of `fullswarm guide`: what it names exists."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import tomlkit
import typer
from typer.testing import CliRunner

from fullswarm.bringup.guide import DOCUMENTS, EXAMPLES, FIRST
from fullswarm.cli.main import app
from fullswarm.core.behaviours import load_records
from fullswarm.registry import DRIVERS

ROOT = Path(__file__).parents[2]
PROGRAM = typer.main.get_command(app)
GLOBAL = {"--help"}


@pytest.fixture(scope="module")
def page() -> str:
    result = CliRunner().invoke(app, ["guide"])
    assert result.exit_code == 0, result.output
    return result.stdout


def commands(page: str) -> list[str]:
    """Return each command line that the page shows, in the text and in blocks."""
    named = re.findall(r"`fullswarm ([^`]+)`", page)
    shown = re.findall(r"^    fullswarm ([^#\n]+)", page, re.MULTILINE)
    return [each.strip() for each in (*named, *shown)]


def resolve(line: str) -> tuple[object, list[str]]:
    """Return the command that a line names, and what follows."""
    command: object = PROGRAM
    words = line.split()
    while words and words[0] in getattr(command, "commands", {}):
        command = command.commands[words.pop(0)]  # type: ignore[attr-defined]
    return command, words


def test_each_command_and_option_of_the_page_exists(page: str) -> None:
    found = commands(page)
    assert len(found) > 60
    for line in found:
        if line == "COMMAND --help":
            continue
        command, rest = resolve(line)
        assert command is not PROGRAM, line
        known = {option for each in command.params for option in (*each.opts, *each.secondary_opts)}  # type: ignore[attr-defined]
        assert {word for word in rest if word.startswith("-")} <= known | GLOBAL, line


def test_each_command_of_the_program_is_on_the_page(page: str) -> None:
    def names(group: object, words: str = "fullswarm") -> list[str]:
        found = []
        for name, each in getattr(group, "commands", {}).items():
            if not each.hidden:
                found += [f"`{words} {name}`", *names(each, f"{words} {name}")]
        return found

    assert [name for name in names(PROGRAM) if name not in page] == []


def test_it_has_ten_commands_to_begin_with(page: str) -> None:
    assert len(FIRST) == 10
    assert all(example.startswith(f"fullswarm {name}") for name, example in FIRST)
    assert all(f"`{example}`" in page for _, example in FIRST)


def test_its_facts_are_those_of_the_code(page: str) -> None:
    for name in load_records():
        assert f"`{name.removesuffix('_bc')}`" in page or f"`{name}`" in page
    assert all(f"`{scheme}://`" in page for scheme in DRIVERS)
    extras = tomlkit.parse((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert all(f"- `{name}`:" in page for name in extras if name not in ("all",))
    for code in (0, 1, 2, 3, 4, 70, 130):
        assert re.search(rf"^- {code}: .", page, re.MULTILINE)


def test_each_document_and_example_that_it_names_is_there(page: str) -> None:
    for path in (*(path for path, _ in DOCUMENTS), *EXAMPLES):
        assert (ROOT / path).exists(), path
        assert f"`{path}`" in page


def test_the_behaviour_commands_of_the_page_do_what_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["behaviours", "new", "orbit"])
    assert result.exit_code == 0, result.output
    written = {path.name for path in tmp_path.rglob("*orbit*")}
    assert {"orbit.py", "orbit.toml", "test_orbit.py"} <= written
