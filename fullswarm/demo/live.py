"""Runs `fullswarm demo` in real time: one process per robot, a live table, the web console."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from fullswarm.bus.base import OPERATOR
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock, clock_id
from fullswarm.config import SwarmConfig
from fullswarm.demo.run import report
from fullswarm.demo.show import Show, acts_for
from fullswarm.errors import Unreachable
from fullswarm.keys import Keys
from fullswarm.launch import reload
from fullswarm.launch.network import on_free_ports, on_network
from fullswarm.launch.recorder import add_recorder, check_record
from fullswarm.launch.supervisor import Supervisor
from fullswarm.launch.web_console import INSTALL, WebConsole, graphical, missing_extra, open_browser
from fullswarm.operator.client import Operator
from fullswarm.operator.console.serve import OPEN_S, RedirectPage
from fullswarm.operator.render import fleet_table
from fullswarm.output import INTERRUPTED, progress
from fullswarm.runtime import Mailbox, Runtime

START_TIMEOUT_S = 60.0
REFRESH_S = 0.2
POLL_S = 0.1
HOW_TO = "click robots, then a goal; start a behaviour; Space stops all"
YIELDED = "you have control; Ctrl-C ends"
OVER = "the show is over and you have control; Ctrl-C ends"


@dataclass(frozen=True, slots=True)
class DemoOptions:
    """How the demo is run; None: decided by the terminal.

    Parameters
    ----------
    seconds : length of the show
    as_json, headless : for programs: the result as a document; no live table
    console : start the web console; usually unless it is for programs
    stay : do not end with the show, but with Ctrl-C; usually in a terminal, with a console
    develop : folder of a package whose behaviours are loaded again when their files change
    open_browser : show the page at once; usually in a terminal that has a screen
    """

    seconds: float = 45.0
    as_json: bool = False
    headless: bool = False
    console: bool | None = None
    stay: bool | None = None
    open_browser: bool | None = None
    develop: Path | None = None
    record: Path | None = None

    def settled(self, terminal: bool, screen: bool) -> DemoOptions:
        """Return it with each None decided: whether there is a `terminal`, and a `screen` for a browser."""
        headless = self.headless or self.as_json
        console = not headless if self.console is None else self.console
        stay = console and terminal and not headless if self.stay is None else self.stay
        opens = terminal and screen and not headless if self.open_browser is None else self.open_browser
        return replace(self, headless=headless, console=console, stay=stay, open_browser=opens)


class LiveDemo:
    """A swarm of this machine, its show, and its web console if wanted."""

    def __init__(self, config: SwarmConfig, options: DemoOptions) -> None:
        config = on_free_ports(config)
        self.options = options
        self.runtime = Runtime(MonotonicClock(), Mailbox())
        self.runtime.stop_on_signals()
        self.supervisor = Supervisor(config, self.runtime, develop=options.develop)
        if options.develop is not None:
            reload.watch(options.develop, self.runtime)
        if options.record is not None:
            add_recorder(self.supervisor, options.record)
        self.console: WebConsole | None = None
        self._redirect: RedirectPage | None = None
        if options.console:
            self._add_console()
        bus = ZenohBus(self.runtime.mailbox, hub=config.hub.endpoint)
        self.supervisor.report_to(bus)
        self._bus = on_network(bus, self.runtime, self.supervisor.config, OPERATOR)
        self._operator = Operator(self._bus, Keys(config.swarm), self.runtime, "demo", clock=clock_id())
        acts, watched = acts_for(config), options.console or not options.headless
        self.show = Show(self._bus, self.runtime, config, self._operator, options.seconds, acts, yields=watched)
        self._note = HOW_TO

    def run(self) -> int:
        """Run the show and what comes after it; return the exit code."""
        self._start()
        if not self._ended():
            self.show.start()
            self._watch(lambda: self.show.done or bool(self.show.yielded_to))
        if self._ended():
            return INTERRUPTED
        if self.show.yielded_to:
            self._announce(YIELDED)
            self._watch(lambda: self.show.done and not self.options.stay)
        code = report(self.show, self.options.as_json, self.show.real_time_factor())
        if self.options.stay and not self._ended():
            self._announce(OVER)
            self._watch(lambda: False)
        return code

    def close(self) -> None:
        """End all processes, the robots first."""
        if self._redirect is not None:
            self._redirect.close()
        self._operator.close()
        self.supervisor.close()
        self._bus.close()

    def _add_console(self) -> None:
        problem = missing_extra()
        if problem:
            progress(f"{problem} ({INSTALL})")
        else:
            self.console = WebConsole(self.supervisor, self.runtime, self._on_address, progress)

    def _on_address(self, address: str) -> None:
        progress(f"\nOpen {address}\n{HOW_TO}\n")
        if not self.options.open_browser:
            return
        self._redirect = redirect = RedirectPage(address)
        self.runtime.after(OPEN_S, redirect.close)
        if problem := open_browser(redirect):
            progress(problem)

    def _start(self) -> None:
        config, folder = self.supervisor.config, self.supervisor.folder
        progress(
            f"starting {len(config.robots)} robots, the core and the world; logs in {folder}\n"
            f"from another terminal: FULLSWARM_HUB={config.hub.endpoint} fullswarm watch"
        )
        if config.network.conditions is not None:
            progress(f"on a bad network: {config.network.conditions}; times of a partition count from now")
        self.supervisor.start()
        self._until(self.show.ready, START_TIMEOUT_S)
        if not self._ended() and not self.show.ready():
            raise Unreachable(
                f"the swarm was not ready within {START_TIMEOUT_S:.0f} s", where=str(self.supervisor.kept_folder()),
                hint="the logs there say why",
            )  # fmt: skip

    def _ended(self) -> bool:
        return self.runtime.exit_signal is not None

    def _announce(self, note: str) -> None:
        self._note = note
        progress(note)

    def _until(self, condition: Callable[[], bool], timeout_s: float = float("inf")) -> None:
        """Serve until `condition` holds, at most so long; Ctrl-C ends it too."""
        deadline_s = self.runtime.now_s() + timeout_s

        def check() -> None:
            if condition() or self.runtime.now_s() >= deadline_s:
                timer.cancel()
                self.runtime.pause()

        timer = self.runtime.every(POLL_S, check)
        self.runtime.run()

    def _watch(self, condition: Callable[[], bool]) -> None:
        """Show the fleet until `condition` holds or Ctrl-C ends it."""
        if self.options.headless:
            self._until(condition)
            return
        with Live(self._picture(), console=Console(stderr=True), auto_refresh=False, transient=True) as live:
            timer = self.runtime.every(REFRESH_S, lambda: live.update(self._picture(), refresh=True))
            self._until(condition)
            timer.cancel()

    def _picture(self) -> Group:
        """Return the address above the table of the fleet."""
        lines = Text()
        if self.console is not None and self.console.address:
            lines.append(self.console.address, style=f"bold link {self.console.address}")
            lines.append(f"\n{self._note}\n")
        return Group(lines, fleet_table(self.show.view.snapshot()))


def run_live(config: SwarmConfig, options: DemoOptions) -> int:
    """Run the demo with one process per robot, in real time; return the exit code.

    Raises
    ------
    Unreachable
        The swarm did not become ready.
    ConfigError, MissingExtra
        It is to be recorded, and cannot be.
    """
    if options.record is not None:
        check_record(options.record)
    demo = LiveDemo(config, options.settled(terminal=sys.stdout.isatty(), screen=graphical()))
    try:
        return demo.run()
    finally:
        demo.close()
