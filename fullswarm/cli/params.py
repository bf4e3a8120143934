"""`fullswarm params`: a layer's local database (paper II.A)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm import output
from fullswarm.cli import completion
from fullswarm.cli.options import Json, Timeout, shell_command
from fullswarm.cli.values import parse_stored
from fullswarm.errors import ConfigError

if TYPE_CHECKING:
    from fullswarm.cli.options import Target
    from fullswarm.messages import ParamEntry

params_app = typer.Typer(no_args_is_help=True, help="Read, set and watch a layer's local database.")

Layer = Annotated[str, typer.Option(metavar="NAME", help="The layer.", autocompletion=completion.layers)]
Key = Annotated[
    str,
    typer.Argument(help="The key; a * at its end matches any ending.", autocompletion=completion.database_keys),
]


@params_app.command("get")
@shell_command()
def params_get(
    target: Target, key: Key = "*", layer: Layer = "core", timeout: Timeout = 3.0, as_json: Json = False
) -> int:
    """Print values with their authors and times of change."""
    from fullswarm.operator.params import ask

    entries = ask(target, layer, "get", key, timeout)
    if not entries and not key.endswith("*"):
        raise ConfigError(f"the {layer}'s database has no '{key}'", hint="`fullswarm params get '*'` lists all")
    return _print(entries, as_json)


@params_app.command("set", context_settings={"ignore_unknown_options": True})  # -3 is a value
@shell_command()
def params_set(
    target: Target,
    key: Annotated[str, typer.Argument(help="The key.", autocompletion=completion.database_keys)],
    value: Annotated[str, typer.Argument(help="1.5, true, a word, or JSON; null removes the value.")],
    layer: Layer = "core",
    timeout: Timeout = 3.0,
    as_json: Json = False,
) -> int:
    """Write a value, which takes effect at once, and print what the database then holds."""
    from fullswarm.operator.params import ask

    return _print(ask(target, layer, "set", key, timeout, parse_stored(value, where=key)), as_json)


@params_app.command("history")
@shell_command()
def params_history(
    target: Target, key: Key, layer: Layer = "core", timeout: Timeout = 3.0, as_json: Json = False
) -> int:
    """Print the newest changes of a key, oldest first; 100 of each are kept."""
    from fullswarm.operator.params import ask

    return _print(ask(target, layer, "history", key, timeout), as_json)


@params_app.command("watch")
@shell_command()
def params_watch(target: Target, key: Key = "*", layer: Layer = "core", as_json: Json = False) -> int:
    """Print changes as they happen, until Ctrl-C."""
    import msgspec

    from fullswarm.operator import session
    from fullswarm.operator.params import ParamClient

    def show(entry: ParamEntry) -> None:
        if as_json:
            output.data_json(msgspec.to_builtins(entry), indent=None)
        else:
            output.data(entry_line(entry))

    with session.connect(target) as connection:
        connection.on_interrupt = connection.finish
        client = ParamClient(connection.bus, connection.keys, connection.runtime, connection.source, layer=layer)
        client.watch(key, show)
        output.progress("watching; Ctrl-C ends")
        connection.run()
    return 0


def _print(entries: Sequence[ParamEntry], as_json: bool) -> int:
    import msgspec

    if as_json:
        output.data_json(msgspec.to_builtins(list(entries)))
    else:
        for entry in entries:
            output.data(entry_line(entry))
    return 0


def entry_line(entry: ParamEntry) -> str:
    """Return an entry with its author and local time: ``key = 1.5  (seed, 2025-01-31 12:00:00)``."""
    value = json.dumps(entry.value, ensure_ascii=False)
    changed = datetime.fromtimestamp(entry.changed).isoformat(sep=" ", timespec="seconds")
    return f"{entry.key} = {value}  ({entry.author or 'unknown'}, {changed})"
