"""Formats help as plain text, commands under the headings that they were given.

Typer's own help is drawn with rich, whose markdown, tracebacks and syntax colours take longer to import than all else
that `--help` does.
"""

from __future__ import annotations

import inspect
from typing import Any

from typer.core import TyperGroup

COMMANDS = "Commands"


class PlainGroup(TyperGroup):
    """A group of commands whose help is plain text."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the options in front of the command.

        Typer's own switches (help, completion) are None by default, for which it loads pydantic. False is taken as is.
        """
        found: list[Any] = super().get_params(ctx)
        for each in found:
            if getattr(each, "is_flag", False) and each.default is None:
                each.default = False
        return found

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands with the first line of their help, by heading."""
        panels: dict[str, list[tuple[str, str]]] = {}
        for name in self.list_commands(ctx):
            command: Any = self.get_command(ctx, name)
            if command is None or command.hidden:
                continue
            panel = getattr(command, "rich_help_panel", None)
            first = inspect.cleandoc(command.help or "").partition("\n")[0]
            panels.setdefault(panel if isinstance(panel, str) else COMMANDS, []).append((name, first))
        for heading, rows in panels.items():
            with formatter.section(heading):
                formatter.write_dl(rows)
