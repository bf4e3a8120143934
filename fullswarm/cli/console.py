"""`fullswarm console`: serves the web console."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from fullswarm.cli.options import Hub, Json, Swarm, shell_command
from fullswarm.runtime import Scheduler


@shell_command()
def console(
    listen: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="The address to listen on; port 0: any free port.")
    ] = "127.0.0.1:8807",
    read_only: Annotated[
        bool, typer.Option("--read-only", help="Show the swarm only: the page can neither drive nor stop.")
    ] = False,
    allow_host: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Accept this name of the server in browsers' requests.")
    ] = None,
    token_file: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="File with the token (default: FULLSWARM_CONSOLE_TOKEN, or a new one)."),
    ] = None,
    open_browser: Annotated[bool, typer.Option("--open", help="Open the page in this machine's browser.")] = False,
    insecure_network: Annotated[
        bool, typer.Option("--insecure-network", help="Listen beyond this machine: everyone on that network can drive.")
    ] = False,
    as_json: Json = False,
    hub: Hub = None,
    swarm: Swarm = "swarm",
    with_parent: Annotated[bool, typer.Option("--with-parent", hidden=True)] = False,
) -> int:
    """Serve the web console: watch, drive and stop the swarm from a browser. Print the address to open."""
    from fullswarm.drivers.make import makes
    from fullswarm.operator.console.serve import Options, serve
    from fullswarm.operator.session import Target

    options = Options(
        listen=listen,
        read_only=read_only,
        allow_hosts=tuple(allow_host or ()),
        token_file=token_file,
        open_browser=open_browser,
        insecure_network=insecure_network,
        as_json=as_json,
        icons={scheme: (make.icon.shape, make.icon.letter) for make in makes() for scheme in make.schemes},
    )
    return serve(Target(hub, swarm), options, leave_with_parent if with_parent else None)


def leave_with_parent(scheduler: Scheduler, leave: Callable[[], None]) -> None:
    """End this process when its parent has ended."""
    from fullswarm.launch.processes import PARENT, PARENT_CHECK_S

    parent = int(os.environ.get(PARENT) or os.getppid())

    def check() -> None:
        if os.getppid() != parent:
            leave()

    scheduler.every(PARENT_CHECK_S, check)
