"""The web console beside a swarm of this machine: one more process, its address, and a browser to show it."""

from __future__ import annotations

import importlib.util
import json
import os
import secrets
import sys
from collections.abc import Callable

from fullswarm.config import SwarmConfig
from fullswarm.launch.network import free_port
from fullswarm.launch.supervisor import CONSOLE, Supervisor
from fullswarm.operator.console.serve import RedirectPage
from fullswarm.runtime import Scheduler

PORT = 8807
"""Another one if it is taken; chosen here, so that a console that is started again has the address of the first."""
TOKEN = "FULLSWARM_CONSOLE_TOKEN"  # noqa: S105  (the name of a variable, not a token)
LOOK_S = 0.05
INSTALL = "pip install 'fullswarm[console]'"
EXTRA = ("starlette", "uvicorn", "websockets")


def missing_extra() -> str:
    """Return why the console cannot run here; empty: it can."""
    return "" if all(importlib.util.find_spec(each) for each in EXTRA) else "the web console is not installed"


def api_address(page: str) -> str:
    """Return where programs call the console that has a page at this address."""
    return page.partition("#")[0] + "api/v1/"


def graphical() -> bool:
    """Return whether a browser's window can be seen where this process runs."""
    if sys.platform in ("darwin", "win32"):
        return "SSH_CONNECTION" not in os.environ
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


class WebConsole:
    """Has the supervisor run a console for its swarm, and reports its address.

    Parameters
    ----------
    supervisor : not started yet
    on_address : called once with the address, which holds the token, as soon as the page can be opened
    on_failure : called once with a line of text if there will be no console
    options : more options of `fullswarm console`

    Attributes
    ----------
    address : empty until it is known
    """

    def __init__(
        self,
        supervisor: Supervisor,
        scheduler: Scheduler,
        on_address: Callable[[str], None],
        on_failure: Callable[[str], None],
        options: tuple[str, ...] = (),
    ) -> None:
        self.address = ""
        self._supervisor, self._on_address, self._on_failure = supervisor, on_address, on_failure
        supervisor.add(CONSOLE, *self._arguments(supervisor.config), *options, guest=True)
        self._timer = scheduler.every(LOOK_S, self._look)

    def _arguments(self, config: SwarmConfig) -> tuple[str, ...]:
        listen = ("--listen", f"127.0.0.1:{free_port(PORT)}", "--hub", config.hub.endpoint, "--swarm", config.swarm)
        if os.environ.get(TOKEN):
            return ("console", "--json", *listen)
        # In a file, because every user of this machine can read a command line, but only this user the folder.
        file = self._supervisor.folder / "console.token"
        file.touch(mode=0o600)
        file.write_text(secrets.token_urlsafe(16))
        return ("console", "--json", "--token-file", str(file), *listen)

    def _look(self) -> None:
        child = self._supervisor.children[CONSOLE]
        if child.given_up:
            self._timer.cancel()
            self._on_failure(f"no web console: {child.given_up.removeprefix('error: ')}")
            return
        output = self._supervisor.output(CONSOLE)
        try:
            self.address = str(json.loads(output.read_text())["url"])
        except (OSError, ValueError):
            return  # not written yet, or not to its end
        self._timer.cancel()
        self._on_address(self.address)


def open_browser(redirect: RedirectPage) -> str:
    """Show the page in the user's browser; return what to print if that is not possible, else an empty text."""
    if not graphical() and "BROWSER" not in os.environ:
        return "there is no screen for a browser here: open the address yourself"
    return "" if redirect.open() else "found no browser to open: open the address yourself"
