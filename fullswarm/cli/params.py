"""``fullswarm params``: a layer's local database."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm.cli import completion
from fullswarm.cli.options import Json, Timeout, shell_command

if TYPE_CHECKING:
    from fullswarm.cli.options import Target

params_app = typer.Typer(no_args_is_help=True, help="Read, set and watch a layer's local database.")

Layer = Annotated[str, typer.Option(metavar="NAME", help="Whose database.", autocompletion=completion.layers)]
Key = Annotated[
    str,
    typer.Argument(help="The key; may end in * to mean all that begin so.", autocompletion=completion.database_keys),
]


@params_app.command("get")
@shell_command()
def params_get(
    target: Target,
    key: Key = "*",
    layer: Layer = "core",
    timeout: Timeout = 3.0,
    as_json: Json = False,
) -> int:
    """Print values with who set them, and when."""
    from fullswarm.operator import reads

    return reads.params_get(target, layer, key, timeout_s=timeout, as_json=as_json)


@params_app.command("set", context_settings={"ignore_unknown_options": True})  # -3 is a value
@shell_command()
def params_set(
    target: Target,
    key: Annotated[str, typer.Argument(help="The key.", autocompletion=completion.database_keys)],
    value: Annotated[str, typer.Argument(help="1.5, true, a word, or JSON; null takes the value away.")],
    layer: Layer = "core",
    timeout: Timeout = 3.0,
    as_json: Json = False,
) -> int:
    """Write a value; the layer uses it at once."""
    from fullswarm.operator import reads
    from fullswarm.operator.values import parse_stored

    stored = parse_stored(value, where=key)
    return reads.params_set(target, layer, key, stored, timeout_s=timeout, as_json=as_json)


@params_app.command("history")
@shell_command()
def params_history(
    target: Target,
    key: Key,
    layer: Layer = "core",
    timeout: Timeout = 3.0,
    as_json: Json = False,
) -> int:
    """Print the newest changes of a key, oldest first; 100 of each are kept."""
    from fullswarm.operator import reads

    return reads.params_history(target, layer, key, timeout_s=timeout, as_json=as_json)


@params_app.command("watch")
@shell_command()
def params_watch(
    target: Target,
    key: Key = "*",
    layer: Layer = "core",
    as_json: Json = False,
) -> int:
    """Print changes as they happen, until Ctrl-C."""
    from fullswarm.operator import reads

    return reads.params_watch(target, layer, key, as_json=as_json)
