"""The operator's shell commands. ``launch`` hangs `operator_app` into the program ``fullswarm``.

Only typer is imported here: whatever needs the bus is imported when a command runs, so that help stays quick.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm.operator.guard import run_guarded

if TYPE_CHECKING:
    from fullswarm.operator.session import Target

__all__ = ["operator_app", "params_app", "run_guarded"]

operator_app = typer.Typer(no_args_is_help=True, help="Ask a swarm for behaviours and watch it.")
params_app = typer.Typer(no_args_is_help=True, help="Read, set and watch a layer's local database.")
operator_app.add_typer(params_app, name="params")

_ALL = "none: the whole swarm"
Hub = Annotated[
    str | None,
    typer.Option(envvar="FULLSWARM_HUB", metavar="ENDPOINT", help="The hub; none: tcp/127.0.0.1:7447."),
]
Swarm = Annotated[str, typer.Option(envvar="FULLSWARM_SWARM", metavar="NAME", help="Which swarm.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show where an error comes from.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Robots = Annotated[list[str] | None, typer.Option(metavar="A,B", help=f"Robot ids; {_ALL}.")]
RobotArguments = Annotated[list[str] | None, typer.Argument(metavar="[ROBOT]...", help=f"Robot ids; {_ALL}.")]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="A parameter: 1.5, true, 5,5 (a point), [[0, 0], [1, 1]], or a word."
    ),
]
Timeout = Annotated[float, typer.Option(metavar="SECONDS", min=0.1, max=3600, help="How long to wait.")]
Layer = Annotated[str, typer.Option(metavar="NAME", help="Whose database.")]
Behaviour = Annotated[str, typer.Argument(help="Its name; `fullswarm behaviours` lists them.")]
Stick = Annotated[float, typer.Option(min=-1, max=1, help="Share of the robot's full rate, -1 to 1.")]


def _run(debug: bool, command: Callable[[], int]) -> None:
    raise typer.Exit(run_guarded(command, debug))


def _target(hub: str | None, swarm: str) -> Target:
    from fullswarm.operator.session import Target

    return Target(hub, swarm)


@operator_app.command()
def request(
    behaviour: Behaviour,
    robots: Robots = None,
    settings: Settings = None,
    wait: Annotated[bool, typer.Option("--wait", help="Until all robots present have confirmed.")] = False,
    timeout: Timeout = 5.0,
    as_json: Json = False,
    hub: Hub = None,
    swarm: Swarm = "swarm",
    debug: Debug = False,
) -> None:
    """Ask for a behaviour. Exit code 0: accepted; 2: refused; 3: no hub or no core; 1: not all confirmed."""

    def command() -> int:
        from fullswarm.operator import orders
        from fullswarm.operator.values import parse_parameters

        parameters = parse_parameters(settings or ())
        return orders.request(
            _target(hub, swarm),
            behaviour,
            robots or (),
            parameters,
            wait=wait,
            timeout_s=timeout,
            as_json=as_json,
        )

    _run(debug, command)


@operator_app.command()
def stop(robots: RobotArguments = None, hub: Hub = None, swarm: Swarm = "swarm", debug: Debug = False) -> None:
    """Make robots stand still now, whatever they do. They start again on the next request."""

    def command() -> int:
        from fullswarm.operator import orders

        return orders.stop(_target(hub, swarm), robots or ())

    _run(debug, command)


@operator_app.command()
def estop(
    robots: RobotArguments = None,
    clear: Annotated[bool, typer.Option("--clear", help="Release the latched e-stop instead.")] = False,
    reason: Annotated[str, typer.Option(help="Why; robots and logs repeat it.")] = "",
    timeout: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", min=0.1, max=86400, help="Give up then; none: on Ctrl-C, with --clear 5 s."),
    ] = None,
    fleet: Annotated[
        Path | None,
        typer.Option(
            envvar="FULLSWARM_FLEET", metavar="FILE", help="Whose robots must confirm, also if no core knows them."
        ),
    ] = None,
    as_json: Json = False,
    hub: Hub = None,
    swarm: Swarm = "swarm",
    debug: Debug = False,
) -> None:
    """Emergency stop: latched until --clear. Presses until all confirm.

    Exit code 4 when a robot did not confirm, 3 when none was heard or no hub answers.
    """

    def command() -> int:
        from fullswarm.operator import estop_command

        return estop_command.estop(
            _target(hub, swarm),
            robots or (),
            engaged=not clear,
            reason=reason,
            timeout_s=timeout,
            fleet=fleet,
            as_json=as_json,
        )

    _run(debug, command)


@operator_app.command()
def drive(
    linear: Stick = 0.0,
    angular: Stick = 0.0,
    robots: Robots = None,
    seconds: Annotated[float | None, typer.Option(min=0.05, help="End after this; none: on Ctrl-C.")] = None,
    timeout: Timeout = 3.0,
    hub: Hub = None,
    swarm: Swarm = "swarm",
    debug: Debug = False,
) -> None:
    """Drive robots by hand until Ctrl-C, then stop them."""

    def command() -> int:
        from fullswarm.operator import orders

        return orders.drive(_target(hub, swarm), linear, angular, robots or (), seconds, timeout)

    _run(debug, command)


@operator_app.command()
def mock(
    behaviour: Behaviour,
    rate: Annotated[float, typer.Option(min=0.01, max=200, help="Requests per second.")] = 1.0,
    count: Annotated[int, typer.Option(min=0, help="How many; 0: until Ctrl-C.")] = 1,
    robots: Robots = None,
    settings: Settings = None,
    timeout: Timeout = 5.0,
    hub: Hub = None,
    swarm: Swarm = "swarm",
    debug: Debug = False,
) -> None:
    """Mock publisher: send one request again and again."""

    def command() -> int:
        from fullswarm.operator import orders
        from fullswarm.operator.values import parse_parameters

        parameters = parse_parameters(settings or ())
        target = _target(hub, swarm)
        return orders.mock(target, behaviour, robots or (), parameters, rate_hz=rate, count=count, timeout_s=timeout)

    _run(debug, command)


@operator_app.command()
def status(as_json: Json = False, hub: Hub = None, swarm: Swarm = "swarm", debug: Debug = False) -> None:
    """Show the swarm once."""

    def command() -> int:
        from fullswarm.operator import reads

        return reads.status(_target(hub, swarm), as_json=as_json)

    _run(debug, command)


@operator_app.command()
def watch(hub: Hub = None, swarm: Swarm = "swarm", debug: Debug = False) -> None:
    """Show the swarm live, until Ctrl-C."""

    def command() -> int:
        from fullswarm.operator import reads

        return reads.watch(_target(hub, swarm))

    _run(debug, command)


@operator_app.command()
def robots(as_json: Json = False, hub: Hub = None, swarm: Swarm = "swarm", debug: Debug = False) -> None:
    """List the robots: make, model, driver, firmware, battery."""

    def command() -> int:
        from fullswarm.operator import reads

        return reads.robots(_target(hub, swarm), as_json=as_json)

    _run(debug, command)


@operator_app.command()
def behaviours(
    name: Annotated[str | None, typer.Argument(help="Show this one's parameters.")] = None,
    timeout: Timeout = 3.0,
    as_json: Json = False,
    hub: Hub = None,
    swarm: Swarm = "swarm",
    debug: Debug = False,
) -> None:
    """List the behaviours that can be asked for, or the parameters of one."""

    def command() -> int:
        from fullswarm.operator import reads

        return reads.behaviours(_target(hub, swarm), name, timeout_s=timeout, as_json=as_json)

    _run(debug, command)


Key = Annotated[str, typer.Argument(help="The key; may end in * to mean all that begin so.")]


@params_app.command("get")
def params_get(
    key: Key = "*",
    layer: Layer = "core",
    timeout: Timeout = 3.0,
    as_json: Json = False,
    hub: Hub = None,
    swarm: Swarm = "swarm",
    debug: Debug = False,
) -> None:
    """Print values with who set them, and when."""

    def command() -> int:
        from fullswarm.operator import reads

        return reads.params_get(_target(hub, swarm), layer, key, timeout_s=timeout, as_json=as_json)

    _run(debug, command)


@params_app.command("set", context_settings={"ignore_unknown_options": True})  # -3 is a value
def params_set(
    key: Annotated[str, typer.Argument(help="The key.")],
    value: Annotated[str, typer.Argument(help="1.5, true, a word, or JSON; null takes the value away.")],
    layer: Layer = "core",
    timeout: Timeout = 3.0,
    as_json: Json = False,
    hub: Hub = None,
    swarm: Swarm = "swarm",
    debug: Debug = False,
) -> None:
    """Write a value; the layer uses it at once."""

    def command() -> int:
        from fullswarm.operator import reads
        from fullswarm.operator.values import parse_stored

        stored = parse_stored(value, where=key)
        return reads.params_set(_target(hub, swarm), layer, key, stored, timeout_s=timeout, as_json=as_json)

    _run(debug, command)


@params_app.command("history")
def params_history(
    key: Key,
    layer: Layer = "core",
    timeout: Timeout = 3.0,
    as_json: Json = False,
    hub: Hub = None,
    swarm: Swarm = "swarm",
    debug: Debug = False,
) -> None:
    """Print every change of a key, oldest first."""

    def command() -> int:
        from fullswarm.operator import reads

        return reads.params_history(_target(hub, swarm), layer, key, timeout_s=timeout, as_json=as_json)

    _run(debug, command)


@params_app.command("watch")
def params_watch(
    key: Key = "*",
    layer: Layer = "core",
    as_json: Json = False,
    hub: Hub = None,
    swarm: Swarm = "swarm",
    debug: Debug = False,
) -> None:
    """Print changes as they happen, until Ctrl-C."""

    def command() -> int:
        from fullswarm.operator import reads

        return reads.params_watch(_target(hub, swarm), layer, key, as_json=as_json)

    _run(debug, command)
