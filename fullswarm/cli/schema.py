"""`fullswarm schema`: prints the JSON Schemas of the messages, and the keys of the bus."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fullswarm import output
from fullswarm.cli.options import Json, shell_command
from fullswarm.errors import ConfigError


@shell_command()
def schema(
    message: Annotated[
        str | None, typer.Argument(metavar="[MESSAGE]", help="Its name (default: list all messages).")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write the schema of each message, and keys.json, into a folder.")
    ] = None,
    page: Annotated[bool, typer.Option("--page", help="Print the page docs/reference-messages.md.")] = False,
    as_json: Json = False,
) -> int:
    """Print the JSON Schema of a message, or list all messages, for programs in other languages."""
    from fullswarm import schemas

    if sum((message is not None, out is not None, page)) > 1:
        raise ConfigError("MESSAGE, --out and --page exclude each other", where="schema")
    if out is not None:
        written = schemas.write_all(out)
        output.progress(f"{out}: {len(written)} files")
    elif page:
        output.data(schemas.page().rstrip())
    elif message is not None:
        output.data_json(schemas.json_schema(schemas.message_named(message)))
    elif as_json:
        output.data_json({name: schemas.tag_of(kind) for name, kind in schemas.messages().items()})
    else:
        for kind in schemas.messages().values():
            output.data(f"{schemas.tag_of(kind):26} {(kind.__doc__ or '').strip().partition(chr(10))[0]}")
    return 0
