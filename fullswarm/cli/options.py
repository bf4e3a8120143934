"""The decorator of all commands, and options that several of them have.

Only typer is imported here: whatever needs the bus is imported when a command runs, so that help stays quick.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fullswarm.cli import completion
from fullswarm.output import run_guarded

if TYPE_CHECKING:
    from fullswarm.operator.session import Target as Target

    NamedTarget = Target

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


def shell_command(*, logs: bool = False) -> Callable[[Callable[..., int]], Callable[..., None]]:
    """Make a command of a function that returns an exit code. Every command of ``fullswarm`` has this decorator.

    It adds ``--debug``; a parameter ``target: Target`` becomes ``--hub`` and ``--swarm``, and a ``NamedTarget``
    ``--operator`` as well, behind the command's own options. An error becomes one line on stderr and an exit code: see
    :func:`~fullswarm.launch.guard.run_guarded`.

    Parameters
    ----------
    logs : log lines go to stderr; for commands that run parts of a swarm in this process
    """

    def decorate(call: Callable[..., int]) -> Callable[..., None]:
        shown: list[inspect.Parameter] = []
        behind, target = [_option("debug", Debug, False)], ""
        for each in inspect.signature(call, locals={name: name for name in TARGETS}, eval_str=True).parameters.values():
            if each.annotation in TARGETS:
                target, behind = each.name, [*TARGETS[each.annotation], *behind]
            else:
                shown.append(each)

        @functools.wraps(call)
        def command(*, debug: bool, **given: Any) -> None:
            def run() -> int:
                if logs:
                    from fullswarm.output import log_to_stderr

                    log_to_stderr()
                if target:
                    given[target] = _target(given.pop("hub"), given.pop("swarm"), given.pop("operator", ""))
                return call(**given)

            context, code = given.get("context"), run_guarded(run, debug)
            if code or context is None or context.invoked_subcommand is None:
                raise typer.Exit(code)

        command.__signature__ = inspect.Signature([*shown, *behind])  # type: ignore[attr-defined]
        command.__annotations__ = {each.name: each.annotation for each in (*shown, *behind)}
        return command

    return decorate


def _option(name: str, kind: object, default: object) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)


def _target(hub: str | None, swarm: str, operator: str) -> Target:
    """Return the swarm a command line means, and the operator it acts for; a malformed name raises `ConfigError`."""
    from fullswarm.operator.session import Target, operator_name

    return Target(hub, swarm, operator_name(operator) if operator else "")


HUB_AND_SWARM = (_option("hub", Hub, None), _option("swarm", Swarm, "swarm"))
TARGETS = {"Target": HUB_AND_SWARM, "NamedTarget": (_option("operator", Operator, ""), *HUB_AND_SWARM)}
