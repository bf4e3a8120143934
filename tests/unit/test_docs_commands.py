"""Command lines in the documentation: each command, option and value is one that the program accepts."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import typer
from markdown_it import MarkdownIt
from typer.testing import CliRunner

from fullswarm.cli.main import app

ROOT = Path(__file__).parents[2]
PROGRAM: Any = typer.main.get_command(app)
PAGES = sorted(path for path in (ROOT / "docs").rglob("*.md") if path.parent.name != "decisions")  # those are history
PLACEHOLDER = re.compile(r".*(\b[A-Z]{2,}\b|…)|N$")
EXCEPTIONS = {
    ("COMMAND", "--help"): "stands for every command",
}
SHELL = re.compile(r"\s*(\$ )?(\w+=\S+ )*fullswarm (?!: )|\s*\$ |.*(\||&&|;) fullswarm ")
ASSIGNMENT = re.compile(r"[A-Z_]+=")
RUN = {("guide",), ("schema",), ("scenario", "list"), ("scenario", "show"), ("scenario", "export"), ("--version",)}
"""Commands that need no swarm and take less than a second."""


@dataclass(frozen=True)
class Line:
    """A command of a page: its words after ``fullswarm``; ``block``: it stands in a block, where readers copy it."""

    page: str
    words: tuple[str, ...]
    block: bool


def commands(text: str) -> Iterator[tuple[str, ...]]:
    """Return the words of each command of fullswarm in a line of a shell, without comments and redirections."""
    lexer = shlex.shlex(re.sub(r"<(\w+)>", "ID", text), posix=True, punctuation_chars="|&;<>")
    lexer.whitespace_split = True
    statement: list[str] = []
    for word in (*lexer, ";"):
        if word and set(word) <= set("|&;<>"):
            while statement and (statement[0] == "$" or ASSIGNMENT.match(statement[0])):
                del statement[0]
            if statement[:1] == ["fullswarm"]:
                pairs = pairwise(statement)  # an ellipsis is the value of an option, or "and so on"
                yield tuple(word for before, word in pairs if word not in ("…", "...") or before.startswith("-"))
            statement = []
        else:
            statement.append(word)


def lines(page: Path) -> Iterator[Line]:
    """Return the commands of a page: of blocks, and those within sentences."""
    name = page.relative_to(ROOT).as_posix()
    for token in MarkdownIt("commonmark").enable("table").parse(page.read_text(encoding="utf-8")):
        if token.type in ("fence", "code_block"):
            for line in token.content.replace("\\\n", " ").splitlines():
                if SHELL.match(line):
                    balanced = line if line.count("'") % 2 == 0 or " #" in line else line.replace("'", "")  # sh -c '…'
                    yield from (Line(name, words, block=True) for words in commands(balanced))
        for child in token.children or ():
            if child.type == "code_inline" and child.content.startswith("fullswarm "):
                yield from (Line(name, words, block=False) for words in commands(child.content))


LINES = [line for page in (*PAGES, ROOT / "README.md") for line in lines(page) if line.words not in EXCEPTIONS]


def resolve(given: list[str]) -> tuple[Any, list[str], tuple[str, ...]]:
    """Return the command that words name, the words that follow, and the name."""
    command, name = PROGRAM, []
    while given and given[0] in getattr(command, "commands", {}):
        name.append(given[0])
        command, given = command.commands[given[0]], given[1:]
    return command, given, tuple(name)


def mistake(line: Line) -> str | None:
    """Return what the program's own parser would refuse, or None."""
    command, rest, name = resolve(list(line.words))
    if command is PROGRAM and rest and not rest[0].startswith("-"):
        return f"no command {rest[0]}"
    context = type(command).context_class(command, info_name="fullswarm")
    try:
        values, left, _ = command.make_parser(context).parse_args(list(rest))
    except Exception as error:  # the parser of whichever click typer brings
        return str(error) or type(error).__name__
    if left and hasattr(command, "commands"):
        return f"no command {left[0]} of {' '.join(name)}"
    if left:
        return f"too many arguments: {left}"
    for each in command.params:
        value = values.get(each.name)
        given = [word for word in (value if isinstance(value, (list, tuple)) else [value]) if isinstance(word, str)]
        if each.required and not given and line.block:
            return f"{each.name} is missing"
        if given and not any(PLACEHOLDER.match(word) for word in given) and "Path" not in str(each.type_descriptor):
            try:
                each.process_value(context, value)
            except Exception as error:
                return f"{each.name}: {error}"
    return None


def test_each_command_line_of_the_documentation_is_accepted() -> None:
    assert sum(line.block for line in LINES) > 150
    assert len(LINES) > 250
    wrong = [f"{line.page}: {' '.join(line.words)}: {found}" for line in LINES if (found := mistake(line))]
    assert wrong == []


@pytest.mark.parametrize(
    "text",
    [
        "fullswarm dmeo",
        "fullswarm mission shwo",
        "fullswarm demo --no-such-option",
        "fullswarm demo --seconds",
        "fullswarm demo --seconds long",
        "fullswarm demo --seconds 1",
        "fullswarm demo mixed",
        "fullswarm request",
        "fullswarm up a.toml | fullswarm dmeo",
    ],
)
def test_a_wrong_line_would_be_found(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    (tmp_path / "page.md").write_text(f"Text.\n\n    {text}  # a comment\n")
    assert any(mistake(line) for line in lines(tmp_path / "page.md"))


def test_lines_are_found_in_blocks_lists_and_sentences(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    (tmp_path / "page.md").write_text(
        "Use `fullswarm a`.\n\n1. One\n\n    ```sh\n    $ fullswarm b\n    ```\n\n2. Two\n\n"
        "Text\n\n    FULL=1 && fullswarm c \\\n      --d\n    error: fullswarm is not a line\n"
    )
    assert [line.words for line in lines(tmp_path / "page.md")] == [("a",), ("b",), ("c", "--d")]


def test_commands_that_need_no_swarm_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    ran = set()
    for given in sorted({line.words for line in LINES}):
        _, rest, name = resolve(list(given))
        if (name or given[:1]) not in RUN or any(PLACEHOLDER.match(word) for word in rest):
            continue
        if "show" in name and any(word.endswith(".toml") and not Path(word).exists() for word in rest):
            continue
        result = CliRunner().invoke(app, given)
        assert result.exit_code == 0, (given, result.output)
        ran.add(name or given[:1])
    assert ran == RUN
