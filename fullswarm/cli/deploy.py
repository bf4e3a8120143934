"""The commands of deployment in one application; ``launch`` hangs it into ``fullswarm``."""

from __future__ import annotations

import typer

from fullswarm.cli import flash, fleet, release

deploy_app = typer.Typer(no_args_is_help=True)
deploy_app.command(rich_help_panel="Deploy")(release.bundle)
deploy_app.command(rich_help_panel="Deploy")(release.keys)
for command in (fleet.deploy, fleet.update, fleet.rollback, fleet.logs, fleet.shell, fleet.reboot):
    deploy_app.command(rich_help_panel="Deploy")(command)
deploy_app.command("fleet", rich_help_panel="Deploy")(fleet.fleet_table)
deploy_app.command(rich_help_panel="Deploy")(flash.flash)
