"""The shell as a person meets it: wrong files, robots that are not there, pipes. Real processes throughout."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from fullswarm.launch.network import free_port
from tests.waiting import until

NOBODY = {**os.environ, "FULLSWARM_HUB": "tcp/127.0.0.1:9", "PYTHONUNBUFFERED": "1"}
WRONG = {
    "duplicate": ('swarm = "a"\nswarm = "b"\n', ["lab.toml:2: swarm: stands twice, first in line 1"]),
    "empty": ("", ["lab.toml:1: names no robot"]),
    "syntax": ("[[robot]]\nid = r1\n", ["lab.toml:2: not valid TOML"]),
    "many": (
        '[world]\nboxes = [[30, 5, 1, 1, 0]]\n[[robot]]\nid = "a"\nstart = [1, 1, 0]\n[agent]\nbattery_low = 15\n',
        ["lab.toml:5: robot[0].start: ", "lab.toml:7: agent.battery_low: "],
    ),
    "places": (
        '[world]\nboxes = [[30, 5, 1, 1, 0]]\n[[robot]]\nid = "a"\ndriver = "craete:///dev/tty0"\npose = [90, 1, 90]\n',
        ["lab.toml:2: world.boxes[0]: ", "lab.toml:5: robot[0].driver: ", "lab.toml:6: robot[0].pose", "lab.toml:6: "],
    ),
}


class Lines:
    """A command whose lines are collected with the time at which each came."""

    def __init__(self, *words: str, cwd: Path) -> None:
        self.lines: list[tuple[float, str]] = []
        self.began_s = time.monotonic()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "fullswarm", *words],
            cwd=cwd, env=NOBODY, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append((time.monotonic() - self.began_s, line.rstrip("\n")))

    def text(self) -> str:
        return "\n".join(line for _, line in self.lines)

    def end(self) -> int:
        self.process.send_signal(signal.SIGINT)
        code = self.process.wait(30.0)
        self._thread.join(5.0)
        assert self.process.stdout is not None
        self.process.stdout.close()
        return code


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_fleet_file_ends_with_code_2_and_a_line_per_mistake(name: str, tmp_path: Path) -> None:
    text, begins = WRONG[name]
    (tmp_path / "lab.toml").write_text(text)
    done = subprocess.run(
        [sys.executable, "-m", "fullswarm", "up", "lab.toml"],
        cwd=tmp_path, env=NOBODY, capture_output=True, text=True, timeout=60.0, check=False,
    )  # fmt: skip
    lines = [line.removeprefix("error: ") for line in done.stderr.splitlines() if not line.endswith("things are wrong")]
    assert (done.returncode, done.stdout) == (2, "")
    assert len(lines) == len(begins), done.stderr
    assert all(line.startswith(begin) for line, begin in zip(lines, begins, strict=True)), done.stderr


def test_up_says_that_a_port_is_not_there_and_watch_writes_lines_into_a_pipe(tmp_path: Path) -> None:
    hub = f"tcp/127.0.0.1:{free_port(17900)}"
    (tmp_path / "lab.toml").write_text(
        f'swarm = "absent"\nhub.endpoint = "{hub}"\n[[robot]]\nid = "n1"\ndriver = "null://n1"\n'
        '[[robot]]\nid = "c1"\ndriver = "create:///dev/ttyUSB77"\n'
    )
    up = Lines("up", "lab.toml", cwd=tmp_path)
    try:
        until(lambda: "c1: /dev/ttyUSB77: there is no such port" in up.text(), 90.0, up.text)
        (line,) = [line for _, line in up.lines if line.startswith("c1: ")]
        log = Path(line.rpartition("(log: ")[2].rstrip(")"))
        assert log.name == "c1.log"
        assert "there is no such port" in log.read_text()
        watch = Lines("watch", "--hub", hub, "--swarm", "absent", cwd=tmp_path)
        try:
            until(lambda: " c1: " in watch.text() and " n1: " in watch.text(), 60.0, watch.text)
            assert "\x1b" not in watch.text()
        finally:
            watch.end()
    finally:
        up.end()
    assert "Traceback" not in up.text() + watch.text()


def test_an_experiment_in_a_pipe_says_soon_how_many_trials_there_are(tmp_path: Path) -> None:
    ran = Lines("experiment", "run", "safety", "--small", "--jobs", "1", cwd=tmp_path)
    try:
        until(lambda: " trials, " in ran.text(), 60.0, ran.text)
    finally:
        ran.end()
    assert ran.lines[0][1].startswith("0 of ")
    assert "\r" not in ran.text()
