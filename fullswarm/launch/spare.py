"""A spare process: it has imported what the processes of a swarm need, and becomes one of them when that has died.

Imports take most of a start: nearly a second of a processor, and several where sixteen agents share two of them. The
rest is mostly the command line's parser and the search for other packages' behaviours, which it has done too. The
supervisor keeps two; each waits for a line on its stdin that says what to become, and ends with its supervisor.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path

import msgspec

from fullswarm import registry
from fullswarm.config import load_swarm
from fullswarm.errors import FullswarmError
from fullswarm.launch.liveness import ALIVE, AlivePipe
from fullswarm.launch.processes import RUN, driver_url

FLEET = "fleet.toml"
"""The supervisor's file for its processes, in the run's folder."""
ROOM = 1000
"""Characters of the spare's command line in which that of the process can be shown that it becomes."""
MODULES = (
    "fullswarm.cli.main", "fullswarm.launch.nodes", "fullswarm.launch.network", "fullswarm.launch.on_board",
    "fullswarm.launch.reload", "fullswarm.bus.hub", "fullswarm.bus.zenoh_bus", "fullswarm.bus.versions",
    "fullswarm.launch.journals", "fullswarm.agent.node", "fullswarm.drivers.fleet", "fullswarm.drivers.guardian",
    "fullswarm.core.node", "fullswarm.core.audit", "fullswarm.core.centralised.node", "fullswarm.perf.performance_node",
    "fullswarm.perf.summarizers", "pydantic.type_adapter",
)  # fmt: skip
"""Not the simulated world's, which would double the memory."""


class Order(msgspec.Struct, frozen=True):
    """What a spare is to become: arguments of the ``fullswarm`` command, files for its stderr and stdout."""

    arguments: tuple[str, ...]
    log: str
    data: str


class Spare:
    """The supervisor's side.

    Parameters
    ----------
    environment : of the processes that it may become
    log : file for what it writes before it becomes one

    Attributes
    ----------
    process : the process; the caller's as soon as `become` has returned true
    pipe : the pipe on which it will show that its loop runs; the caller's then too
    """

    def __init__(self, environment: Mapping[str, str], log: Path) -> None:
        self.pipe = AlivePipe()
        with log.open("ab") as sink:
            self.process = subprocess.Popen(  # noqa: S603  (our own interpreter and our own module)
                [sys.executable, "-m", "fullswarm", "spare", " " * ROOM, "--with-parent"],
                stdin=subprocess.PIPE,
                stdout=sink,
                stderr=sink,
                env={**environment, ALIVE: str(self.pipe.inherited)},
                pass_fds=(self.pipe.inherited,),
                start_new_session=True,
            )
        self.pipe.close_inherited()

    def become(self, arguments: Sequence[str], log: Path, data: Path) -> bool:
        """Have it run a command with `log` as its stderr and `data` as its stdout; False: it has died."""
        stdin = self.process.stdin
        if self.process.poll() is not None or stdin is None:
            return False
        order = Order(tuple(arguments), str(log), str(data))
        try:
            with stdin:
                stdin.write(msgspec.json.encode(order) + b"\n")
        except OSError:
            return False
        return True

    def close(self) -> None:
        """End it; it holds nothing that would have to be left in order."""
        with suppress(OSError):
            if self.process.stdin is not None:
                self.process.stdin.close()
        with suppress(ProcessLookupError):
            self.process.kill()
        self.process.wait()
        self.pipe.close()


def wait_for_order() -> list[str]:
    """Import, wait, and return the arguments of the command that this process is to run from now on.

    Raises
    ------
    SystemExit
        There is none: the supervisor has ended.
    """
    _prepare()
    line = sys.stdin.buffer.readline()
    if not line:
        raise SystemExit(0)
    try:
        order = msgspec.json.decode(line, type=Order)
    except msgspec.DecodeError:
        sys.stderr.write("error: only `fullswarm up` and `fullswarm demo` start a spare process\n")
        raise SystemExit(2) from None
    for path, number, mode in ((order.log, 2, "ab"), (order.data, 1, "ab"), (os.devnull, 0, "rb")):
        with Path(path).open(mode) as file:
            os.dup2(file.fileno(), number)
    _show(order.arguments)
    return list(order.arguments)


def _prepare() -> None:
    for name in MODULES:
        import_module(name)
    import_module("fullswarm.cli.main").parser()
    with suppress(FullswarmError):  # the process that it becomes will say what is wrong
        config = load_swarm(Path(os.environ.get(RUN, "")) / FLEET)
        for each in config.robot:
            if not each.elsewhere:
                registry.driver_class(driver_url(config, each))
        registry.record_files()  # it keeps what it finds
    gc.collect()
    gc.freeze()  # else the process that it becomes looks through all of it once more


def _show(arguments: Sequence[str]) -> None:
    """Have ``ps`` and ``pkill -f`` see what this process has become, where the system has Linux's ``/proc``."""
    with suppress(OSError, ValueError):
        fields = Path("/proc/self/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        start, end = int(fields[45]), int(fields[46])  # proc_pid_stat(5): arg_start and arg_end, after pid and comm
        line = "\0".join((sys.executable, "-m", "fullswarm", *arguments)).encode() + b"\0"
        if 0 < len(line) < end - start:
            with Path("/proc/self/mem").open("r+b", buffering=0) as memory:
                memory.seek(start)
                memory.write(line.ljust(end - start, b"\0"))
