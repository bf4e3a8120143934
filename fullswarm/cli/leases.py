"""`fullswarm leases`: lists which operator holds which robots, and holds robots."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm import output
from fullswarm.cli import completion
from fullswarm.cli.options import Json, Take, robot_ids, shell_command
from fullswarm.errors import ConfigError, RequestRefused

if TYPE_CHECKING:
    from fullswarm.cli.options import NamedTarget, Target
    from fullswarm.messages import Leases
    from fullswarm.operator.session import Session

TIMEOUT_S = 3.0
"""The core reports the leases each second."""

leases_app = typer.Typer(help="List or hold leases: the right to move robots.")


@leases_app.callback(invoke_without_command=True)
@shell_command()
def leases(context: typer.Context, target: Target, as_json: Json = False) -> int:
    """List which operator holds which robots."""
    if context.invoked_subcommand is None:
        return _list(target, as_json)
    if any(str(context.get_parameter_source(name)) == "ParameterSource.COMMANDLINE" for name in context.params):
        raise typer.BadParameter(f"options go behind '{context.invoked_subcommand}'")  # here they would do nothing
    return 0


def _list(target: Target, as_json: bool) -> int:
    import msgspec
    from rich.markup import escape

    from fullswarm.messages import Leases
    from fullswarm.operator import session

    newest: Leases | None = None
    with session.connect(target) as connection:

        def receive(message: Leases) -> None:
            nonlocal newest
            newest = message
            connection.finish()

        connection.bus.subscribe(connection.keys.leases, Leases, receive)
        connection.run(TIMEOUT_S)
        if newest is None:
            raise connection.no_core(TIMEOUT_S)
    found = sorted(newest.leases, key=lambda lease: lease.robot)
    if as_json:
        output.data_json(msgspec.to_builtins(found))
    elif found:
        table = output.plain_table("robot", "held by", "for", "taken from")
        for lease in found:
            table.add_row(*map(escape, (lease.robot, lease.operator, duration(lease.age_s), lease.taken_from or "-")))
        output.data_table(table)
    else:
        output.progress("no robot is held: each obeys every operator")
    return 0


def duration(seconds: float) -> str:
    """Return a time as text: ``12 s``, ``3 min 05 s``, ``2 h 07 min``."""
    whole = int(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02} min"


@leases_app.command("hold")
@shell_command()
def leases_hold(
    target: NamedTarget,
    robots: Annotated[
        list[str], typer.Argument(metavar="ROBOT...", help="Robot ids and @groups.", autocompletion=completion.robots)
    ],
    take: Take = False,
) -> int:
    """Hold robots until Ctrl-C: only this operator's requests move them. Every operator may still stop them.

    Exit code 1: other operators took all of them over; 2: other operators hold all of them.
    """
    from fullswarm.operator import session

    ids = robot_ids(robots, groups=True)
    if not ids:
        raise ConfigError("no robot is named", where="leases hold", hint="e.g. fullswarm leases hold r1 r2")
    with session.connect(target) as connection:
        return _Holding(connection, ids, take).run()


class _Holding:
    """Holds robots and prints each change, until Ctrl-C or until none is left."""

    def __init__(self, connection: Session, ids: tuple[str, ...], take: bool) -> None:
        from fullswarm.operator.leases import SETTLE_S, LeaseHolder

        self._connection, self._ids = connection, ids
        self._holder = LeaseHolder(
            connection.bus,
            connection.keys,
            connection.runtime,
            connection.operator.name,
            on_change=lambda _: self._on_change(),
            on_lost=self._on_lost,
            on_refused=self._on_refused,
        )
        self._shown: tuple[str, ...] = ()
        self._granted = False
        self._refusals: list[str] = []
        connection.on_interrupt = connection.finish
        self._holder.hold(ids, take=take)
        # A report of the core after `SETTLE_S` is its answer, and it reports each second.
        connection.runtime.after(max(TIMEOUT_S, SETTLE_S + 1.0), self._end_unanswered)

    def run(self) -> int:
        name = self._connection.operator.name
        self._connection.run()
        received, held = self._holder.received, self._holder.held()
        self._holder.close()
        if not received:
            raise self._connection.no_core(TIMEOUT_S)
        if not self._granted and self._refusals:
            hint = "--take takes them over, `fullswarm leases` lists the holders"
            raise RequestRefused("; ".join(self._refusals), where="leases hold", hint=hint)
        if not self._granted:
            hint = "`fullswarm robots` lists the robots"
            raise RequestRefused(f"the core knows no {', '.join(self._ids)}", where="leases hold", hint=hint)
        if held:
            output.progress(f"{name} released {', '.join(held)}")
        return 0 if held else 1

    def _on_change(self) -> None:
        held = self._holder.held()
        if held != self._shown:
            self._shown = held
            self._granted |= bool(held)
            if held:
                output.progress(f"{self._connection.operator.name} holds {', '.join(held)}; Ctrl-C releases")

    def _on_lost(self, robots: tuple[str, ...], operator: str) -> None:
        output.progress(f"{', '.join(robots)}: taken over by {operator}")
        self._end_without_any()

    def _on_refused(self, robots: tuple[str, ...], operator: str) -> None:
        text = f"{', '.join(robots)} held by {operator}"
        self._refusals.append(text)
        output.progress(f"refused: {text}")
        self._end_without_any()

    def _end_unanswered(self) -> None:
        if not self._holder.received or not (self._granted or self._refusals):
            self._connection.finish()

    def _end_without_any(self) -> None:
        if not self._holder.held() and not self._holder.wanted():
            self._connection.finish()
