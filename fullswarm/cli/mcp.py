"""`fullswarm mcp`: serves a swarm to a language model by the Model Context Protocol."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm.cli.guide import page_of
from fullswarm.cli.options import shell_command
from fullswarm.errors import MissingExtra

if TYPE_CHECKING:
    from fullswarm.cli.options import NamedTarget


@shell_command(logs=True, needs="posix")
def mcp(
    context: typer.Context,
    target: NamedTarget,
    allow_requests: Annotated[
        bool,
        typer.Option(
            "--allow-requests", help="Let the model hold robots and request behaviours behind the safety filter."
        ),
    ] = False,
    fleet: Annotated[Path | None, typer.Option(metavar="FLEET.toml", help="Let the model read the fleet file.")] = None,
    results: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Let the model read the results of an experiment.")
    ] = None,
    audit: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="The audit log (default: that of the swarm's core on this machine)."),
    ] = None,
) -> int:
    """Serve the swarm to a language model over stdin and stdout; it may read and stop robots, no more by default.

    A client (the program with the model) starts this command. The operator's name begins with mcp/.
    """
    _check()
    from fullswarm.mcp_server.server import McpOptions, run

    return run(target, McpOptions(allow_requests, fleet, results, audit), page_of(context))


def _check() -> None:
    import importlib.util

    if importlib.util.find_spec("mcp") is None:
        raise MissingExtra("the Model Context Protocol is not installed", hint="pip install 'fullswarm[mcp]'")
