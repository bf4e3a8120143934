"""The commands of a documentation page, and a shell that runs them as a reader would.

Comments in a page, which no reader sees, each on a line in front of a block, say what cannot be read from it::

    <!-- not run: needs a robot -->                  the block
    <!-- not run [fullswarm deploy]: needs a robot -->   only its lines that begin so
    <!-- before: fullswarm up examples/demo.toml -->     what a reader has done already
    <!-- file: lab.toml -->                              the block is the content of this file
    <!-- last line of: mylab/mylab/orbit.py -->           the block replaces the last line of this file

What a page installs comes into an environment of its own, above the one that runs the tests.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sysconfig
import textwrap
import venv
from dataclasses import dataclass, field
from pathlib import Path

import platformdirs
from markdown_it import MarkdownIt

from tests.waiting import until

ROOT = Path(__file__).parents[2]
SHELLS = {"", "sh", "bash", "console"}
OTHERS = r"p?kill|cd|export|mv|cp|echo|printf|make|docker|sudo|ssh[a-z-]*|unshare|apt|curl|node"
PROGRAMS = rf"fullswarm|python|pip|rerun|ros\w+|{OTHERS}"
OURS = re.compile(rf"(\w+=\S+ )*({PROGRAMS}) ")
MARK = re.compile(r"<!-- (not run|before|file|last line of)(?: \[(.*?)\])?: (.*?) -->")
ENDLESS = re.compile(
    r"fullswarm (up|console(?! tokens)|watch|demo(?!.*--(lockstep|seconds|headless))|viewer foxglove|metrics|joystick"
    r"|emulate|fixes( play|$)|record start|track(?! (init|sheets|calibrate)|.*--video)|mcp|ros bridge"
    r"|viewer rerun(?!.*--save)|drive(?!.*--seconds))\b|fullswarm .* -f\b"
)
SWARMS = re.compile(r"fullswarm (up|demo(?!.*--lockstep))\b")
LIMIT_S = 300.0
"""Of one command, on a machine with other work."""
UNSHARE = ["unshare", *(["-r"] if os.getuid() else []), "--net", "--pid", "--fork", "--mount-proc", "--kill-child"]
ERROR = re.compile(r"^(error: |Error: |╭─ Error|Traceback)", re.MULTILINE)
ENDED = {0, 130}
"""Exit codes of a command that Ctrl-C has ended."""


@dataclass
class Step:
    """A command, where it stands in its page, and whether the page shows an error as its output."""

    command: str
    line: int
    refused: str = ""
    not_run: str = ""


@dataclass
class File:
    """A file that a reader writes, or whose last line a reader replaces."""

    name: str
    text: str
    last_line: bool

    def write(self, folder: Path) -> None:
        """Write it in a folder."""
        path = folder / self.name
        before = path.read_text().splitlines(keepends=True)[:-1] if self.last_line else []
        path.write_text("".join([*before, self.text]))


@dataclass
class Page:
    """What a page asks its reader to do, in its order: commands, and files to write."""

    name: str
    steps: list[Step | File] = field(default_factory=list)

    @property
    def runs(self) -> list[Step]:
        """The commands that are run."""
        return [step for step in self.steps if isinstance(step, Step) and not step.not_run]


def commands(text: str, first_line: int) -> list[Step]:
    """Return the commands of a block: lines with a prompt, or all that begin with a program that pages use."""
    prompts = any(line.lstrip().startswith("$ ") for line in text.splitlines())
    steps: list[Step] = []
    joined, began = "", first_line
    for row, line in enumerate(textwrap.dedent(text).splitlines(), first_line):
        joined, began = (joined + line.strip(), began) if joined else (line, row)
        if joined.endswith("\\"):
            joined = joined[:-1]
            continue
        line, joined = joined, ""
        if line.startswith("$ ") or (not prompts and OURS.match(line)):
            steps.append(Step(line.removeprefix("$ "), began))
        elif steps and line.startswith("error: "):
            steps[-1].refused = line
    return steps


def read_page(path: Path) -> Page:
    """Read a page; raise ValueError for a mark without a block."""
    page, marks = Page(path.relative_to(ROOT).as_posix()), list[tuple[str, str, str]]()
    for token in MarkdownIt("commonmark").enable("table").parse(path.read_text(encoding="utf-8")):
        if token.type == "html_block":
            marks += MARK.findall(token.content)
        elif token.type in ("fence", "code_block"):
            _add_block(page, token.content, token.info.strip(), (token.map or [0])[0] + 1, marks)
            marks = []
        elif token.type.endswith("_open") and marks and token.type not in ("bullet_list_open", "list_item_open"):
            raise ValueError(f"{page.name}: {marks} stands in front of no block")
    return page


def _add_block(page: Page, text: str, language: str, line: int, marks: list[tuple[str, str, str]]) -> None:
    for kind, _, value in marks:
        if kind in ("file", "last line of"):
            page.steps.append(File(value, text, last_line=kind != "file"))
        elif kind == "before":
            page.steps.append(Step(value, line))
    if (
        language not in SHELLS or any(kind == "file" for kind, _, _ in marks) or text.startswith("[")
    ):  # or a table of TOML
        return
    found = commands(text, line)
    for kind, start, value in marks:
        if kind == "not run":
            chosen = [step for step in found if step.command.startswith(start)]
            if not chosen:
                raise ValueError(f"{page.name}:{line}: no command begins with {start!r}")
            for step in chosen:
                step.not_run = value
    page.steps += found


class Shell:
    """One shell for a page, in an empty folder, with processes, network and home of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "work"
        self._log = folder / "shell.log"
        self._done = 0
        self._endless: list[tuple[Step, int, Path]] = []
        home = folder / "home"
        for each in (self.folder, home, folder / "tmp"):
            each.mkdir()
        (self.folder / "examples").symlink_to(ROOT / "examples")
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [*UNSHARE, "bash"], cwd=self.folder, stdin=subprocess.PIPE, stdout=log, stderr=subprocess.STDOUT,
                text=True, env=_environment(home, folder / "tmp"),
            )  # fmt: skip
        self._send("set -m; ip link set lo up")  # -m: else what runs in the background would not hear of Ctrl-C

    def run(self, step: Step) -> str | None:
        """Run a command; return what is wrong, or None. An endless one goes on until the next swarm, or the end."""
        if SWARMS.match(step.command) and (wrong := self.end()):
            return wrong
        if ENDLESS.match(step.command):
            return self._replace(step) or self._start(step)
        code, output = self._send(f"{{ {step.command}\n}} </dev/null")
        if step.refused:
            first = step.refused.split(" (")[0][:60]
            ok = code != 0 and first in " ".join(output.split())
        else:
            ok = code == 0
        return None if ok else f"line {step.line}: {step.command}: exit code {code}\n{output[-3000:]}"

    def end(self) -> str | None:
        """End what runs, the newest first, as Ctrl-C does; return what is wrong, or None."""
        found = [self._interrupt(*self._endless.pop()) for _ in range(len(self._endless))]
        return next(filter(None, found), None)

    def _replace(self, step: Step) -> str | None:
        """End what runs by the same command: it has the port."""
        name = step.command.split()[:2]
        same = [each for each in self._endless if each[0].command.split()[:2] == name]
        self._endless = [each for each in self._endless if each not in same]
        return next(filter(None, [self._interrupt(*each) for each in same]), None)

    def _interrupt(self, step: Step, job: int, log: Path) -> str | None:
        code, _ = self._send(f"kill -INT -- -{job} 2>/dev/null; wait {job}")
        if code in ENDED and not ERROR.search(log.read_text()):
            return None
        return f"line {step.line}: {step.command}: exit code {code} after Ctrl-C\n{log.read_text()[-3000:]}"

    def close(self) -> None:
        """Kill all that is left."""
        self._process.send_signal(signal.SIGKILL)
        self._process.communicate()

    def _start(self, step: Step) -> str | None:
        log = self.folder.parent / f"line-{step.line}-{self._done}.log"
        command = step.command.split(" #")[0].rstrip().removesuffix("&")
        log.touch()
        _, output = self._send(f"{command} >{log} 2>&1 </dev/null & echo job $!")
        job = int(output.split("job ")[1].split()[0])
        self._endless.append((step, job, log))
        until(lambda: _speaks(log) or self._over(job), LIMIT_S, f"output of {command}", each=_rest)
        if SWARMS.match(command):
            until(lambda: self._send("fullswarm status")[0] == 0 or self._over(job), LIMIT_S, lambda: log.read_text())
        if self._over(job):
            return f"line {step.line}: {step.command}: it ended\n{log.read_text()[-3000:]}"
        return None

    def _over(self, job: int) -> bool:
        return self._send(f"kill -0 {job} 2>/dev/null")[0] != 0

    def _send(self, command: str) -> tuple[int, str]:
        """Run one command; return exit code and output."""
        began, self._done = self._log.stat().st_size, self._done + 1
        mark = f"@@{self._done} "
        assert self._process.stdin is not None
        self._process.stdin.write(f"{command}\necho '{mark}'$?\n")
        self._process.stdin.flush()

        def output() -> str:
            with self._log.open("rb") as log:
                log.seek(began)
                return log.read().decode(errors="replace")

        until(
            lambda: re.search(rf"{mark}\d+\n", output()) is not None, LIMIT_S, lambda: f"{command}\n{output()[-2000:]}"
        )
        text, _, code = output().rpartition(mark)
        return int(code.split()[0]), text


def _rest() -> None:
    """Nothing: to be called between two looks makes them rarer, and leaves the processor to the commands."""


def _speaks(log: Path) -> bool:
    text = log.read_text()
    return "\n" in text and not text.startswith("Usage:")  # then it is about to end


def _environment(home: Path, temporary: Path) -> dict[str, str]:
    """Return a reader's environment: the checkout's programs, and compiled kernels, which take a minute else."""
    kept = {key: os.environ[key] for key in ("LANG", "LC_ALL", "TERM") if key in os.environ}
    cache = home / ".cache"
    cache.mkdir(parents=True)
    (cache / "fullswarm").symlink_to(platformdirs.user_cache_path("fullswarm", ensure_exists=True))
    path = os.pathsep.join([str(_programs(home / "venv")), os.environ["PATH"]])
    kept |= {"PATH": path, "HOME": str(home), "TMPDIR": str(temporary), "USER": "reader", "COLUMNS": "120"}
    return kept | {
        "BROWSER": "true",
        "PIP_NO_INDEX": "1",
        "PIP_NO_BUILD_ISOLATION": "0",
    }  # pip reads 0 as: no isolation


def _programs(folder: Path) -> Path:
    """Make an environment above this one, into which pages install; return the folder of its programs."""
    venv.create(folder, with_pip=False, symlinks=True)
    programs = folder / "bin"
    packages = next(folder.glob("lib/python3*/site-packages"))
    (packages / "tests.pth").write_text(f"import site; site.addsitedir({sysconfig.get_path('purelib')!r})\n")
    for name, module in (("fullswarm", "fullswarm"), ("pip", "pip")):
        (programs / name).write_text(f'#!/bin/sh\nexec {programs}/python -m {module} "$@"\n')
        (programs / name).chmod(0o755)
    return programs


def available() -> bool:
    """Tell whether this machine lets a test have processes and a network of its own."""
    return (
        shutil.which("unshare") is not None and subprocess.run([*UNSHARE, "true"], capture_output=True).returncode == 0
    )
