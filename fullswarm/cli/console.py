"""`fullswarm console`: serves the web console; `fullswarm console tokens`: the tokens of its operators."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fullswarm import logs, output
from fullswarm.cli.options import Json, shell_command
from fullswarm.errors import ConfigError

if TYPE_CHECKING:
    from fullswarm.cli.options import Target
    from fullswarm.operator.console.experiments import ExperimentOptions
    from fullswarm.operator.console.server import PageSource
    from fullswarm.operator.console.tokens import Role
    from fullswarm.runtime import Scheduler


console_app = typer.Typer()
tokens_app = typer.Typer(
    no_args_is_help=True, help="Add, list and revoke the tokens of named operators; a running console notices."
)
console_app.add_typer(tokens_app, name="tokens")
TokensFile = Annotated[
    Path | None,
    typer.Option("--tokens", metavar="FILE", help="The file with the tokens (default: one in your config folder)."),
]
OfPrograms = Annotated[
    bool, typer.Option("--api", help="Tokens of programs, for `console --api`, instead of people's.")
]
API_DAYS = 90.0


@console_app.callback(invoke_without_command=True)
@shell_command()
def console(
    context: typer.Context,
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
    named: Annotated[
        bool, typer.Option("--named", help="Only operators with tokens of their own: `console tokens add NAME`.")
    ] = False,
    tokens: Annotated[
        Path | None, typer.Option("--tokens", metavar="FILE", help="The same with their tokens in this file.")
    ] = None,
    owner: Annotated[
        str, typer.Option("--operator", metavar="NAME", help="Whose the token is; else each page may state a name.")
    ] = "",
    api: Annotated[
        bool, typer.Option("--api", help="Also serve programs by REST and WebSocket: `console tokens add NAME --api`.")
    ] = False,
    api_tokens: Annotated[
        Path | None, typer.Option("--api-tokens", metavar="FILE", help="The same with their tokens in this file.")
    ] = None,
    open_page: Annotated[bool, typer.Option("--open", help="Open the page in this machine's browser.")] = False,
    insecure_network: Annotated[
        bool, typer.Option("--insecure-network", help="Listen beyond this machine: everyone on that network can drive.")
    ] = False,
    recording: Annotated[
        Path | None,
        typer.Option(metavar="FILE.mcap", help="Show a recording in place of a live swarm: any moment of it."),
    ] = None,
    underlay: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw this under the map: a floor plan, a map of ROS (YAML), MBTiles."),
    ] = None,
    experiments: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Offer the experiment files in it, results beside them (default: experiments)."
        ),
    ] = None,
    as_json: Json = False,
    study: Annotated[Path | None, typer.Option("--study", hidden=True)] = None,
    recorded_to: Annotated[Path | None, typer.Option("--recorded-to", hidden=True)] = None,
    with_parent: Annotated[bool, typer.Option("--with-parent", hidden=True)] = False,
) -> int:
    """Serve the web console: watch, drive and stop the swarm from a browser. Print the address to open."""
    if context.invoked_subcommand is not None:
        if any(str(context.get_parameter_source(name)) == "ParameterSource.COMMANDLINE" for name in context.params):
            raise typer.BadParameter(f"options go behind '{context.invoked_subcommand}'")  # here they would do nothing
        return 0
    if (named or tokens) and (owner or token_file):
        raise ConfigError("--named and --tokens need neither --operator nor --token-file", where="console")
    if (api or api_tokens) and (study or recording):
        what = "a study has no programs that act" if study else "a recording has nothing for programs to read or drive"
        raise ConfigError(what, where="--api", hint="leave --api out")
    shown = None if recording is None else _recorded(recording)
    from fullswarm.drivers.make import makes
    from fullswarm.launch.liveness import report_alive
    from fullswarm.launch.web_console import api_address, open_browser
    from fullswarm.operator.console.serve import OPEN_S, Options, RedirectPage, serve
    from fullswarm.operator.session import operator_name

    options = Options(
        listen=listen,
        read_only=read_only,
        allow_hosts=tuple(allow_host or ()),
        token_file=token_file,
        tokens=tokens or (_tokens_file() if named else None),
        operator=operator_name(owner) if owner else "",
        insecure_network=insecure_network,
        study=study,
        underlay=underlay,
        api=api_tokens or (_tokens_file(of_programs=True) if api else None),
        recording=_recording_of(target, recorded_to),
        experiments=_experiments(target, experiments),
        icons={scheme: (make.icon.shape, make.icon.letter) for make in makes() for scheme in make.schemes},
    )
    with contextlib.ExitStack() as stack:

        def on_start(address: str, scheduler: Scheduler, leave: Callable[[], None]) -> None:
            if as_json:
                output.data_json({"url": address} | ({"api": api_address(address)} if options.api else {}), indent=None)
            else:
                output.data(address)
                output.progress("open this address in a browser; Ctrl-C ends")
                if options.tokens is not None:
                    output.progress("each operator opens the address that `console tokens add` has printed for them")
                if options.api is not None:
                    output.progress(f"programs: {api_address(address)}, with tokens of `console tokens add NAME --api`")
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

        logs.log_to_stderr(warnings_only=True)
        return serve(target, options, on_start, None if shown is None else partial(shown, icons=options.icons))


@tokens_app.command()
@shell_command()
def add(
    name: Annotated[str, typer.Argument(metavar="NAME", help="The operator, as leases and requests name them.")],
    observer: Annotated[bool, typer.Option("--observer", help="Show all, send nothing, not even a stop.")] = False,
    driver: Annotated[
        bool, typer.Option("--driver", help="Neither clear an e-stop nor take robots over from their holders.")
    ] = False,
    of_programs: OfPrograms = False,
    days: Annotated[
        float | None,
        typer.Option(metavar="N", min=0.001, max=36500, help="Let it end after so many days (with --api: 90)."),
    ] = None,
    once: Annotated[
        bool, typer.Option("--once", help="Let it open one browser tab, which stays in while it is used.")
    ] = False,
    tokens: TokensFile = None,
) -> int:
    """Make a token for an operator, in place of the one they have, and print it; it is shown this once."""
    from fullswarm.clock import wall_time_s
    from fullswarm.operator.console.tokens import TokenFile

    if observer and driver:
        raise ConfigError("a token has one role", where="console tokens add", hint="--observer or --driver")
    if of_programs and once:
        raise ConfigError("a program's token works for each call", where="--once", hint="leave it out, or use --days")
    file = TokenFile(tokens or _tokens_file(of_programs=of_programs))
    role: Role = "observer" if observer else "driver" if driver else "operator"
    days = API_DAYS if days is None and of_programs else days
    token = file.add(name, role, wall_time_s(), days=days, once=once)
    if of_programs:
        output.data(token)
        output.progress(f"{name} sends it as `Authorization: Bearer TOKEN`; it ends after {days:g} days")
        return 0
    output.data(f"#token={token}")
    output.progress(f"{name} opens the console's address with this behind its last /; it is not shown again")
    return 0


@tokens_app.command("list")
@shell_command()
def list_tokens(tokens: TokensFile = None, of_programs: OfPrograms = False, as_json: Json = False) -> int:
    """List the operators that have a token; with --api the programs."""
    from datetime import datetime

    from rich.markup import escape

    from fullswarm.clock import wall_time_s
    from fullswarm.operator.console.tokens import TokenFile

    found = TokenFile(tokens or _tokens_file(of_programs=of_programs)).tokens()
    if as_json:
        names = ("name", "role", "issued_s", "expires_s", "once", "used")
        output.data_json([{name: getattr(each, name) for name in names} for each in found])
        return 0
    table = output.plain_table("operator", "role", "made", "ends", "state")
    for each in found:
        ended = each.expires_s is not None and each.expires_s <= wall_time_s()
        times = [
            "never" if at_s is None else datetime.fromtimestamp(at_s).astimezone().strftime("%Y-%m-%d %H:%M")
            for at_s in (each.issued_s, each.expires_s)
        ]
        state = "ended" if ended else "used" if each.used else "once" if each.once else ""
        table.add_row(escape(each.name), each.role, *times, state)
    output.data_table(table)
    return 0


@tokens_app.command()
@shell_command()
def revoke(
    name: Annotated[str, typer.Argument(metavar="NAME", help="The operator.")],
    tokens: TokensFile = None,
    of_programs: OfPrograms = False,
) -> int:
    """Take an operator's token away; a running console closes their pages within a second, and refuses programs."""
    from fullswarm.operator.console.tokens import TokenFile

    TokenFile(tokens or _tokens_file(of_programs=of_programs)).revoke(name)
    return 0


def _recording_of(target: Target, given: Path | None) -> Callable[[], Path | None]:
    """Return what finds the recording that is made of a swarm on this machine; `given`: that of `up --record`."""
    from fullswarm.launch.recorder import can_record

    if not can_record():
        return lambda: None
    from fullswarm.record.session import RecordingFinder

    return RecordingFinder(target, given)


def _experiments(target: Target, folder: Path | None) -> ExperimentOptions:
    """Return where experiments are: in `folder`, else in ``experiments`` here, which need not be there yet."""
    from fullswarm.launch.processes import usual_audit_folder
    from fullswarm.operator.console.experiments import ExperimentOptions

    if folder is not None and not folder.is_dir():
        raise ConfigError("no such folder", where=f"--experiments {folder}", hint="make it, or name another one")
    return ExperimentOptions(folder or Path("experiments"), usual_audit_folder(f"{target.swarm}-experiments"))


def _recorded(file: Path) -> Callable[..., PageSource[Any]]:
    """Return what shows a recording; `ConfigError` if it is none."""
    from fullswarm.launch.recorder import need_recordings

    need_recordings()
    from fullswarm.record.playback import Playback, RecordedSwarm

    return partial(Playback, file, recorded=RecordedSwarm(file))


def _tokens_file(*, of_programs: bool = False) -> Path:
    import platformdirs

    return platformdirs.user_config_path("fullswarm") / ("api-tokens.json" if of_programs else "console-tokens.json")


def leave_with_parent(scheduler: Scheduler, leave: Callable[[], None]) -> None:
    """End this process when its parent has ended."""
    from fullswarm.launch.processes import PARENT, PARENT_CHECK_S

    parent = int(os.environ.get(PARENT) or os.getppid())

    def check() -> None:
        if os.getppid() != parent:
            leave()

    scheduler.every(PARENT_CHECK_S, check)
