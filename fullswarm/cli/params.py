"""``fullswarm params``: a layer's local database."""

from __future__ import annotations

from typing import Annotated

import typer

from fullswarm.cli import completion
from fullswarm.cli.options import Debug, Hub, Json, Swarm, Timeout, run, target_of

params_app = typer.Typer(no_args_is_help=True, help="Read, set and watch a layer's local database.")

Layer = Annotated[str, typer.Option(metavar="NAME", help="Whose database.", autocompletion=completion.layers)]
Key = Annotated[
    str,
    typer.Argument(help="The key; may end in * to mean all that begin so.", autocompletion=completion.database_keys),
]


@params_app.command("get")
def params_get(
    key: Key = "*",
    layer: Layer = "core",
    timeout: Timeout = 3.0,
    as_json: Json = False,
    hub: Hub = None,
    swarm: Swarm = "swarm",
    debug: Debug = False,
) -> None:
    """Print values with who set them, and when."""

    def command() -> int:
        from fullswarm.operator import reads

        return reads.params_get(target_of(hub, swarm), layer, key, timeout_s=timeout, as_json=as_json)

    run(debug, command)


@params_app.command("set", context_settings={"ignore_unknown_options": True})  # -3 is a value
def params_set(
    key: Annotated[str, typer.Argument(help="The key.", autocompletion=completion.database_keys)],
    value: Annotated[str, typer.Argument(help="1.5, true, a word, or JSON; null takes the value away.")],
    layer: Layer = "core",
    timeout: Timeout = 3.0,
    as_json: Json = False,
    hub: Hub = None,
    swarm: Swarm = "swarm",
    debug: Debug = False,
) -> None:
    """Write a value; the layer uses it at once."""

    def command() -> int:
        from fullswarm.operator import reads
        from fullswarm.operator.values import parse_stored

        stored = parse_stored(value, where=key)
        return reads.params_set(target_of(hub, swarm), layer, key, stored, timeout_s=timeout, as_json=as_json)

    run(debug, command)


@params_app.command("history")
def params_history(
    key: Key,
    layer: Layer = "core",
    timeout: Timeout = 3.0,
    as_json: Json = False,
    hub: Hub = None,
    swarm: Swarm = "swarm",
    debug: Debug = False,
) -> None:
    """Print the newest changes of a key, oldest first; 100 of each are kept."""

    def command() -> int:
        from fullswarm.operator import reads

        return reads.params_history(target_of(hub, swarm), layer, key, timeout_s=timeout, as_json=as_json)

    run(debug, command)


@params_app.command("watch")
def params_watch(
    key: Key = "*",
    layer: Layer = "core",
    as_json: Json = False,
    hub: Hub = None,
    swarm: Swarm = "swarm",
    debug: Debug = False,
) -> None:
    """Print changes as they happen, until Ctrl-C."""

    def command() -> int:
        from fullswarm.operator import reads

        return reads.params_watch(target_of(hub, swarm), layer, key, as_json=as_json)

    run(debug, command)
