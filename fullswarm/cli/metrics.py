"""`fullswarm metrics`: serves the metrics of a live swarm to Prometheus."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm.cli.options import Json, shell_command

if TYPE_CHECKING:
    from fullswarm.cli.options import Target


@shell_command(logs=True)
def metrics(
    target: Target,
    listen: Annotated[
        str,
        typer.Option(
            metavar="HOST:PORT",
            help="The address to listen on; port 0: any free port. Programs that reach it can read the swarm's state.",
        ),
    ] = "127.0.0.1:9464",
    allow_host: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Accept this name of the server in requests.")
    ] = None,
    forget: Annotated[
        float,
        typer.Option(metavar="SECONDS", min=2, max=86400, help="Show robots no more that are silent for so long."),
    ] = 60.0,
    as_json: Json = False,
) -> int:
    """Serve the metrics of a live swarm for Prometheus until Ctrl-C. Print the address to scrape."""
    from fullswarm.launch.observer import need

    need(("prometheus_client", "starlette", "uvicorn", "websockets"), "the exporter", "metrics")
    from fullswarm.exporter.serve import run

    allowed = frozenset(each.strip().lower() for each in allow_host or () if each.strip())
    return run(target, listen, allowed, forget, as_json)
