"""What the operator's shell commands have in common: options, and how they run.

Only typer is imported here: whatever needs the bus is imported when a command runs, so that help stays quick.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm.cli import completion
from fullswarm.launch.guard import run_guarded

if TYPE_CHECKING:
    from fullswarm.operator.session import Target

ALL = "none: the whole swarm"
Hub = Annotated[
    str | None,
    typer.Option(envvar="FULLSWARM_HUB", metavar="ENDPOINT", help="The hub; none: tcp/127.0.0.1:7447."),
]
Swarm = Annotated[str, typer.Option(envvar="FULLSWARM_SWARM", metavar="NAME", help="Which swarm.")]
Operator = Annotated[
    str,
    typer.Option(envvar="FULLSWARM_OPERATOR", metavar="NAME", help="In whose name, for leases; none: user@host."),
]
Take = Annotated[bool, typer.Option("--take", help="Take robots over from an operator who holds them.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show where an error comes from.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Robots = Annotated[
    list[str] | None,
    typer.Option(metavar="A,B", help=f"Robot ids and @groups; {ALL}.", autocompletion=completion.robots),
]
Timeout = Annotated[float, typer.Option(metavar="SECONDS", min=0.1, max=3600, help="How long to wait.")]


def run(debug: bool, command: Callable[[], int]) -> None:
    """Run a command and end with its exit code; an error becomes one line."""
    raise typer.Exit(run_guarded(command, debug))


def target_of(hub: str | None, swarm: str, operator: str = "") -> Target:
    """Return which swarm a command line means, and in whose name; a malformed name raises `ConfigError`."""
    from fullswarm.operator.session import Target, operator_name

    return Target(hub, swarm, operator_name(operator) if operator else "")
