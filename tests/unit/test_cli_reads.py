from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import typer

from fullswarm.cli.main import app

DOERS = {
    *(
        "up",
        "hub",
        "core",
        "centralised",
        "agent",
        "sim",
        "console",
        "fixes",
        "fixes record",
        "fixes play",
        "init",
        *("mcp", "ros bridge"),
        *("track run", "track init", "track sheets", "track calibrate lens", "track calibrate floor"),
    ),  # run, or make, something
    *(
        "stop",
        "drive",
        "mock",
        "leases hold",
        *("mission pause", "mission resume", "mission abort", "mission confirm"),
        "joystick",
        "joystick map",
        "joystick test",
        "shell",
        "study run",
    ),  # move, or wait for, people
    *("keys issue", "keys renew", "keys revoke", "console tokens add", "console tokens revoke"),
    *("record start", "record stop", "record repair"),
    "guide",  # a page
    "viewer layout",  # prints nothing but JSON
    "viewer rerun",  # shows in another program, or writes a file
    *("signing root", "signing rotate", "signing revoke"),  # make and withdraw keys
    *(
        "experiment replay",
        "results export",
        "results map",
        "results report",
        "scenario export",
        "study export",
    ),  # write a file
}


def commands(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Yield all commands by the words that call them; a group that does something by itself too."""
    verbs = getattr(command, "commands", {})
    if not verbs or (path and command.invoke_without_command):
        yield " ".join(path), command
    for name, each in verbs.items():
        yield from commands(each, (*path, name))


def test_every_command_that_reads_can_print_json() -> None:
    found = dict(commands(typer.main.get_command(app)))
    assert {"status", "watch", "robots", "robots find", "info", "params get", "results list", "leases"} <= set(found)
    silent = {name for name, each in found.items() if not any("--json" in parameter.opts for parameter in each.params)}
    assert silent - DOERS == set()


def test_every_command_and_option_has_a_help_text() -> None:
    for name, each in commands(typer.main.get_command(app)):
        assert each.help, name
        for parameter in each.params:
            assert getattr(parameter, "hidden", False) or getattr(parameter, "help", ""), (name, parameter.name)
