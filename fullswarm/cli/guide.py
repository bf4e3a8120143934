"""`fullswarm guide`: prints one page on how to use and extend fullswarm."""

from __future__ import annotations

import typer

from fullswarm import output
from fullswarm.cli.options import shell_command


@shell_command()
def guide(context: typer.Context) -> int:
    """Print one page on how to use and extend fullswarm, as Markdown: for people and for language models."""
    output.data(page_of(context))
    return 0


def page_of(context: typer.Context) -> str:
    """Return the page, with the commands of the program that `context` belongs to."""
    from fullswarm.bringup.guide import Command, page

    def commands_of(group: object, words: tuple[str, ...] = ()) -> list[Command]:
        found = []
        for name, each in getattr(group, "commands", {}).items():
            if each.hidden:
                continue
            panel = getattr(each, "rich_help_panel", None)
            options = tuple(text for option in each.params for text in option.opts if text.startswith("--"))
            text = (each.help or "").partition("\n\n")[0]
            found.append(
                Command((*words, name), " ".join(text.split()), panel if isinstance(panel, str) else "", options)
            )
            found += commands_of(each, (*words, name))
        return found

    return page(commands_of(context.find_root().command))
