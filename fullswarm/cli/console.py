"""`fullswarm console`: serves the web console."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm import output
from fullswarm.cli.options import Json, shell_command

if TYPE_CHECKING:
    from fullswarm.cli.options import Target
    from fullswarm.runtime import Scheduler


@shell_command()
def console(
    target: Target,
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
    open_page: Annotated[bool, typer.Option("--open", help="Open the page in this machine's browser.")] = False,
    insecure_network: Annotated[
        bool, typer.Option("--insecure-network", help="Listen beyond this machine: everyone on that network can drive.")
    ] = False,
    as_json: Json = False,
    study: Annotated[Path | None, typer.Option("--study", hidden=True)] = None,
    with_parent: Annotated[bool, typer.Option("--with-parent", hidden=True)] = False,
) -> int:
    """Serve the web console: watch, drive and stop the swarm from a browser. Print the address to open."""
    from fullswarm.drivers.make import makes
    from fullswarm.launch.liveness import report_alive
    from fullswarm.launch.web_console import open_browser
    from fullswarm.operator.console.serve import OPEN_S, Options, RedirectPage, serve

    options = Options(
        listen=listen,
        read_only=read_only,
        allow_hosts=tuple(allow_host or ()),
        token_file=token_file,
        insecure_network=insecure_network,
        study=study,
        icons={scheme: (make.icon.shape, make.icon.letter) for make in makes() for scheme in make.schemes},
    )
    with contextlib.ExitStack() as stack:

        def on_start(address: str, scheduler: Scheduler, leave: Callable[[], None]) -> None:
            if as_json:
                output.data_json({"url": address}, indent=None)
            else:
                output.data(address)
                output.progress("open this address in a browser; Ctrl-C ends")
            sys.stdout.flush()
            if open_page:
                page = RedirectPage(address)
                stack.callback(page.close)
                scheduler.after(OPEN_S, page.close)
                if problem := open_browser(page):
                    output.progress(problem)
            if with_parent:
                leave_with_parent(scheduler, leave)
                report_alive(scheduler)

        output.log_to_stderr(warnings_only=True)
        return serve(target, options, on_start)


def leave_with_parent(scheduler: Scheduler, leave: Callable[[], None]) -> None:
    """End this process when its parent has ended."""
    from fullswarm.launch.processes import PARENT, PARENT_CHECK_S

    parent = int(os.environ.get(PARENT) or os.getppid())

    def check() -> None:
        if os.getppid() != parent:
            leave()

    scheduler.every(PARENT_CHECK_S, check)
