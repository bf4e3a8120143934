"""``fullswarm leases``: who may drive which robots."""

from __future__ import annotations

from typing import Annotated

import typer

from fullswarm.cli import completion
from fullswarm.cli.options import Debug, Hub, Json, Operator, Swarm, Take, run, target_of

leases_app = typer.Typer(help="Show or hold the authority over robots.")


@leases_app.callback(invoke_without_command=True)
def leases(
    context: typer.Context, as_json: Json = False, hub: Hub = None, swarm: Swarm = "swarm", debug: Debug = False
) -> None:
    """List who holds which robots."""
    if context.invoked_subcommand is None:
        from fullswarm.operator import lease_command

        run(debug, lambda: lease_command.show(target_of(hub, swarm), as_json=as_json))
    elif any(str(context.get_parameter_source(name)) == "ParameterSource.COMMANDLINE" for name in context.params):
        raise typer.BadParameter(f"options go behind '{context.invoked_subcommand}'")  # here they would do nothing


@leases_app.command("hold")
def leases_hold(
    robots: Annotated[
        list[str], typer.Argument(metavar="ROBOT...", help="Robot ids and @groups.", autocompletion=completion.robots)
    ],
    take: Take = False,
    operator: Operator = "",
    hub: Hub = None,
    swarm: Swarm = "swarm",
    debug: Debug = False,
) -> None:
    """Hold robots until Ctrl-C: only this operator's requests move them. Anybody may still stop them."""

    def command() -> int:
        from fullswarm.operator import lease_command

        return lease_command.hold(target_of(hub, swarm, operator), robots, take=take)

    run(debug, command)
