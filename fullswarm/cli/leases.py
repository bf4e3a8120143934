"""``fullswarm leases``: who may drive which robots."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm.cli import completion
from fullswarm.cli.options import Json, Take, shell_command

if TYPE_CHECKING:
    from fullswarm.cli.options import NamedTarget, Target

leases_app = typer.Typer(help="Show or hold the authority over robots.")


@leases_app.callback(invoke_without_command=True)
@shell_command()
def leases(context: typer.Context, target: Target, as_json: Json = False) -> int:
    """List who holds which robots."""
    if context.invoked_subcommand is None:
        from fullswarm.operator import lease_command

        return lease_command.show(target, as_json=as_json)
    if any(str(context.get_parameter_source(name)) == "ParameterSource.COMMANDLINE" for name in context.params):
        raise typer.BadParameter(f"options go behind '{context.invoked_subcommand}'")  # here they would do nothing
    return 0


@leases_app.command("hold")
@shell_command()
def leases_hold(
    target: NamedTarget,
    robots: Annotated[
        list[str], typer.Argument(metavar="ROBOT...", help="Robot ids and @groups.", autocompletion=completion.robots)
    ],
    take: Take = False,
) -> int:
    """Hold robots until Ctrl-C: only this operator's requests move them. Anybody may still stop them."""
    from fullswarm.operator import lease_command

    return lease_command.hold(target, robots, take=take)
