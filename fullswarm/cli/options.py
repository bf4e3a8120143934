"""The decorator of all commands, and options that several of them have.

Only typer is imported here: whatever needs the bus is imported when a command runs, so that help appears at once.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from fullswarm.cli import completion
from fullswarm.errors import ConfigError
from fullswarm.keys import ROBOT_ID
from fullswarm.output import run_guarded

if TYPE_CHECKING:
    from fullswarm.operator.target import Target as Target

    NamedTarget = Target

ALL = "(default: the whole swarm)"
Hub = Annotated[
    str | None,
    typer.Option(envvar="FULLSWARM_HUB", metavar="ENDPOINT", help="The hub (default: tcp/127.0.0.1:7447)."),
]
Swarm = Annotated[str, typer.Option(envvar="FULLSWARM_SWARM", metavar="NAME", help="The name of the swarm.")]
Operator = Annotated[
    str,
    typer.Option(
        envvar="FULLSWARM_OPERATOR", metavar="NAME", help="The operator that holds leases (default: user@host)."
    ),
]
Take = Annotated[bool, typer.Option("--take", help="Take robots over from the operator that holds them.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Robots = Annotated[
    list[str] | None,
    typer.Option(metavar="A,B", help=f"Robot ids and @groups {ALL}.", autocompletion=completion.robots),
]
RobotArguments = Annotated[
    list[str] | None,
    typer.Argument(metavar="[ROBOT]...", help=f"Robot ids {ALL}.", autocompletion=completion.robot_ids),
]
Timeout = Annotated[float, typer.Option(metavar="SECONDS", min=0.1, max=3600, help="Wait this long for an answer.")]
Yes = Annotated[bool, typer.Option("--yes", help="Skip the confirmation prompt.")]


def robot_ids(names: Iterable[str] | None, *, groups: bool = False) -> tuple[str, ...]:
    """Return the ids in ``a,b c`` and the like, each once; none means all.

    Parameters
    ----------
    groups
        Accept ``@name`` too: for what goes through the core, which knows the members of a group.

    Raises
    ------
    ConfigError
        A name that no robot can have, or a group where robots are addressed directly.
    """
    from fullswarm.operator.leases import GROUP

    ids = [part.strip() for name in names or () for part in name.split(",")]
    for each in ids:
        if each.startswith(GROUP) and not groups:
            raise ConfigError(
                f"'{each}' is a group, and this order goes straight to the robots, which have no groups",
                hint="name the robots, or none to mean all of them",
            )
        if not ROBOT_ID.match(each.removeprefix(GROUP)):
            raise ConfigError(f"'{each}' cannot name a robot", where="--robots", hint="e.g. --robots r1,r2")
    return tuple(dict.fromkeys(ids))


def shell_command(
    *, logs: bool = False, needs: Literal["", "posix", "linux"] = ""
) -> Callable[[Callable[..., int]], Callable[..., None]]:
    """Make a command of a function that returns an exit code. Every command of ``fullswarm`` has this decorator.

    It adds ``--debug``; a parameter ``target: Target`` becomes ``--hub`` and ``--swarm``, and a ``NamedTarget``
    ``--operator`` as well, behind the command's own options. An error becomes one line on stderr and an exit code: see
    :func:`~fullswarm.output.run_guarded`.

    Parameters
    ----------
    logs : log lines go to stderr; for commands that run parts of a swarm in this process
    needs : the operating system; on another one the command is refused, with exit code 2
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
                if needs:
                    from fullswarm.portability import check_system

                    check_system("this command", needs)
                if logs:
                    from fullswarm.logs import log_to_stderr

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
    """Return the swarm that a command line names, and its operator; a malformed name raises `ConfigError`."""
    from fullswarm.operator.target import Target, operator_name

    return Target(hub, swarm, operator_name(operator) if operator else "")


HUB_AND_SWARM = (_option("hub", Hub, None), _option("swarm", Swarm, "swarm"))
TARGETS = {"Target": HUB_AND_SWARM, "NamedTarget": (_option("operator", Operator, ""), *HUB_AND_SWARM)}
