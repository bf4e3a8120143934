"""Experiments on the console: who may start and stop them, one at a time, what pages are shown; played processes."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import pytest

from fullswarm.operator.console import children, frames
from fullswarm.operator.console import experiments as module
from fullswarm.operator.console.experiments import MISSING, ExperimentOptions
from fullswarm.operator.console.sessions import NO_EXPERIMENTS, NOT_OFFERED, OBSERVER, READ_ONLY
from fullswarm.operator.console.tokens import Role
from tests.unit.console_bench import ConsoleBench, Page
from tests.waiting import until

RESULTS: dict[str, Any] = {
    "trials": 4, "finished": 1, "failed": 0, "collisions": 0, "unexpected": 0, "arrived_fraction": 1.0, "over": False,
    "going": False, "left_s": None, "older": 0, "unreadable": 0, "cells": [], "more_cells": 0, "failures": [],
    "report": "",
}  # fmt: skip


def entry(name: str, **fields: Any) -> dict[str, Any]:
    plain = {
        "id": f"file:{name}.toml", "kind": "file", "name": name, "source": f"lab/{name}.toml", "out": f"lab/{name}",
        "description": "", "fault": "", "trials": 4, "small_trials": 1, "seeds": "0-3", "small_seeds": "0",
        "results": None,
    }  # fmt: skip
    return {**plain, **fields}


class Process:
    """A child that does nothing."""

    def __init__(self, arguments: Sequence[str], log: IO[bytes]) -> None:
        self.arguments, self.log, self.pid = list(arguments), log, 1
        self.code: int | None = None
        self.interrupted = self.killed = 0

    def poll(self) -> int | None:
        return self.code

    def wait(self, timeout: float | None = None) -> int:
        del timeout
        self.code = 130 if self.code is None else self.code
        return self.code

    def value(self, name: str) -> str:
        return self.arguments[self.arguments.index(name) + 1]


class Lab:
    """A console with played children."""

    def __init__(self, folder: Path, **options: Any) -> None:
        self.processes: list[Process] = []
        bench = options.pop("bench", ExperimentOptions(folder / "lab", folder / "audit"))
        self.bench = ConsoleBench(bench=bench, **options)
        self.page, self.session = self.bench.join()

    def start_child(self, arguments: Sequence[str], log: IO[bytes]) -> Process:
        self.processes.append(Process(arguments, log))
        return self.processes[-1]

    def children(self, verb: str) -> list[Process]:
        return [each for each in self.processes if each.arguments[:2] == ["experiment", verb]]

    @property
    def run(self) -> Process:
        return self.children("run")[-1]

    def say(self, op: str, page: Page | None = None, **fields: Any) -> str:
        reason: str = self.bench.say(self.session, page or self.page, "experiment", op=op, **fields)["reason"]
        return reason

    def has(self, *entries: dict[str, Any], **fields: Any) -> None:
        """Have the reader write a list, and the console take it in."""
        file = Path(self.children("list")[-1].value("--to"))
        document = {"format": module.FORMAT, "experiments": entries, **fields}
        part = file.with_suffix(".part")
        part.write_text(json.dumps(document))
        part.replace(file)
        self.bench.run(0.6)

    def shown(self, name: str) -> dict[str, Any]:
        found: dict[str, Any] = next(
            each for each in self.page.last("experiment_list")["entries"] if each["name"] == name
        )
        return found

    def join(self, role: Role) -> None:
        self.page = Page()
        self.session = self.bench.gateway.join("session-2", "olga", self.page, named=True, role=role)


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Lab]]:
    labs: list[Lab] = []

    def make(**options: Any) -> Lab:
        lab = Lab(tmp_path, **options)
        monkeypatch.setattr(children, "start", lab.start_child)
        labs.append(lab)
        return lab

    def interrupt(process: Process) -> None:
        process.interrupted += 1

    def end(process: Process) -> None:
        process.killed += process.code is None
        process.code = -9 if process.code is None else process.code

    monkeypatch.setattr(children, "interrupt", interrupt)
    monkeypatch.setattr(children, "end", end)
    yield make
    for lab in labs:
        lab.bench.gateway.close()


@pytest.fixture
def lab(make: Callable[..., Lab]) -> Lab:
    lab = make()
    assert lab.say("watch") == ""
    lab.has(entry("meet"), entry("other"))
    return lab


def test_nothing_is_read_before_a_page_looks_nor_long_after(make: Callable[..., Lab]) -> None:
    lab = make()
    lab.bench.run(5.0)
    assert lab.processes == []
    assert lab.page.last("experiments")["running"] is None
    lab.say("watch")
    reader = lab.children("list")[0]
    assert reader.value("--parent") == str(os.getpid())
    assert lab.page.last("experiment_list")["entries"] is None
    lab.say("unwatch")
    lab.bench.run(module.IDLE_S - 1.0)
    assert reader.killed == 0
    lab.bench.run(2.0)
    assert reader.killed == 1
    lab.say("watch")
    lab.bench.gateway.leave(lab.session, lab.page)
    lab.bench.run(module.IDLE_S + 1.0)
    assert all(each.killed for each in lab.processes), "a page that is closed looks no more"


def test_a_page_that_asks_again_and_again_costs_little(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    encoded: list[str] = []
    encode = frames.encode

    def counted(frame: dict[str, Any]) -> str:
        encoded.append(frame["t"])
        return encode(frame)

    monkeypatch.setattr(frames, "encode", counted)
    for _ in range(50):
        lab.say("unwatch")
        lab.say("watch")
    assert encoded.count("experiment_list") <= 1
    assert len(lab.children("list")) == 1


def test_the_shells_command_is_started_in_lockstep_and_continues(lab: Lab) -> None:
    assert lab.say("start", id="file:meet.toml", seeds="3-4") == ""
    assert lab.run.arguments == [
        "experiment", "run", "lab/meet.toml", "--out", "lab/meet", "--parent", str(os.getpid()), "--small",
        "--seeds", "3-4",
    ]  # fmt: skip
    assert lab.page.log("request")[-1].endswith("starts the experiment meet (small, seeds 3-4)")
    lab.has(entry("meet", results=RESULTS), entry("other"))
    assert lab.shown("meet")["state"] == "running"
    assert lab.page.last("experiments")["running"]["done"] == 1
    other, _ = lab.bench.join("session-9", "bert")
    assert other.last("experiments")["running"]["name"] == "meet", "another page sees the same"


def test_there_is_one_at_a_time(lab: Lab) -> None:
    lab.say("start", id="file:meet.toml", small=False)
    assert "--small" not in lab.run.arguments
    reason = lab.say("start", id="file:other.toml")
    assert reason.startswith("meet is running, started by console anna@base")
    assert len(lab.children("run")) == 1


def test_a_stop_is_that_of_a_shell_and_what_is_kept_is_said(lab: Lab) -> None:
    lab.say("start", id="file:meet.toml")
    assert lab.say("stop", id="file:other.toml") == "this experiment is not running here"
    assert lab.say("stop", id="file:meet.toml") == ""
    assert lab.say("stop", id="file:meet.toml") == ""
    assert lab.run.interrupted == 1
    lab.has(entry("meet", results=RESULTS))
    assert lab.shown("meet")["stopping"]
    lab.run.code = 130
    lab.bench.run(module.SETTLE_S + 1.0)
    meet = lab.shown("meet")
    assert (meet["state"], meet["bad"], meet["results"]["finished"]) == ("stopped", False, 1)
    assert "was stopped by console anna@base" in meet["words"]
    assert meet["report"].startswith("/report/")
    assert lab.page.last("experiments")["running"] is None
    assert lab.say("start", id="file:meet.toml") == "", "and it continues"


def test_a_run_that_does_not_end_is_killed(lab: Lab) -> None:
    lab.say("start", id="file:meet.toml")
    run = lab.run
    lab.say("stop")
    lab.bench.run(module.STOP_S + 1.0)
    assert run.killed


@pytest.mark.parametrize(
    ("code", "said", "words", "bad"),
    [
        (0, b"", "has ended", False),
        (1, b"", "has ended: trials failed, or robots collided where that is not expected", True),
        (2, b"a line\nerror: groups: is missing\n", "could not be run: groups: is missing", True),
        (2, b"\xff" * 10_000, "could not be run: ", True),
        (-9, b"", "was ended by signal 9", True),
    ],
)
def test_what_became_of_it_is_said(lab: Lab, code: int, said: bytes, words: str, bad: bool) -> None:
    lab.say("start", id="file:meet.toml")
    lab.run.log.write(said)
    lab.run.code = code
    lab.bench.run(module.SETTLE_S + 1.0)
    meet = lab.shown("meet")
    assert meet["words"].startswith(words)
    assert len(meet["words"]) <= module.MOST_WORDS
    assert meet["bad"] == bad


def test_states_come_from_the_results(lab: Lab) -> None:
    over = RESULTS | {"finished": 4, "over": True, "report": "fresh"}
    going = RESULTS | {"going": True}
    lab.has(
        entry("a", results=over), entry("b", results=going), entry("c", fault="no"), entry("d", results=RESULTS),
        entry("e", source="", kind="folder", results=RESULTS), entry("f"),
    )  # fmt: skip
    states = {name: lab.shown(name)["state"] for name in "abcdef"}
    assert states == {"a": "ended", "b": "elsewhere", "c": "faulty", "d": "stopped", "e": "stopped", "f": "new"}
    assert [bool(lab.shown(name)["report"]) for name in "abcdef"] == [True, False, False, True, True, False]
    assert [lab.shown(name)["can_start"] for name in "abcdef"] == [True, True, False, True, False, True]
    assert "out" not in lab.shown("a")
    assert "source" not in lab.shown("a")


@pytest.mark.parametrize("name", ["c", "e", "gone", "../../etc/passwd", ""])
def test_only_what_the_list_offers_is_started(lab: Lab, name: str) -> None:
    lab.has(entry("c", fault="it is wrong"), entry("e", source=""))
    assert lab.say("start", id=f"file:{name}.toml") != ""
    assert lab.children("run") == []


@pytest.mark.parametrize(
    "fields",
    [
        {"op": "start", "id": 5}, {"op": "start", "id": "x" * 301}, {"op": "start", "seeds": "1; rm"},
        {"op": "start", "seeds": "--live"}, {"op": "start", "seeds": "1-2-3"}, {"op": "start", "small": "yes"},
        {"op": "start", "live": True}, {"op": "run"}, {}, {"op": "start", "seeds": "٣"},
    ],
)  # fmt: skip
def test_garbage_is_refused(lab: Lab, fields: dict[str, Any]) -> None:
    found = frames.read_command(json.dumps({"t": "experiment", "ref": 1, **fields}))
    assert isinstance(found, frames.Answer)
    assert not found.ok


@pytest.mark.parametrize(("role", "reason"), [("observer", OBSERVER), ("driver", NO_EXPERIMENTS), ("operator", "")])
def test_who_looks_on_watches_and_operators_start(lab: Lab, role: Role, reason: str) -> None:
    lab.join(role)
    assert lab.say("watch") == ""
    assert [each["name"] for each in lab.page.last("experiment_list")["entries"]] == ["meet", "other"]
    assert lab.say("start", id="file:meet.toml") == reason
    assert lab.say("stop") == (reason or "")


def test_a_console_that_only_shows_starts_none(make: Callable[..., Lab]) -> None:
    lab = make(read_only=True)
    assert lab.say("watch") == ""
    lab.has(entry("meet"))
    assert lab.say("start", id="file:meet.toml") == READ_ONLY


def test_a_console_without_experiments_offers_none(make: Callable[..., Lab]) -> None:
    lab = make(bench=None)
    assert lab.say("watch") == NOT_OFFERED
    assert lab.page.all("experiments") == []


def test_without_the_extra_the_page_says_what_to_install(
    make: Callable[..., Lab], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "NEEDED", ("jinja2", "no_such_package"))
    lab = make()
    assert lab.page.last("experiments")["refusal"] == MISSING
    lab.say("watch")
    lab.bench.run(1.0)
    assert lab.page.last("experiment_list")["problem"] == MISSING
    assert lab.say("start", id="file:meet.toml") == MISSING
    assert lab.processes == []


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"[]", b"\xff", b'{"format":"other","experiments":[]}', b'{"experiments":5}', b" " * 4_000_001],
)
def test_a_list_that_cannot_be_read_is_said_and_the_last_one_stays(lab: Lab, content: bytes) -> None:
    Path(lab.children("list")[-1].value("--to")).write_bytes(content)
    lab.bench.run(0.6)
    shown = lab.page.last("experiment_list")
    assert shown["problem"].startswith("the list of experiments cannot be read")
    assert len(shown["problem"]) <= module.MOST_WORDS
    assert len(shown["entries"]) == 2
    lab.has(entry("meet"))
    assert lab.page.last("experiment_list")["problem"] == ""


def test_a_reader_that_ends_is_started_again_later(lab: Lab) -> None:
    reader = lab.children("list")[-1]
    reader.log.write(b"error: it needs more memory\n")
    reader.code = 2
    lab.bench.run(1.0)
    assert lab.page.last("experiment_list")["problem"] == "it needs more memory"
    assert len(lab.children("list")) == 1
    lab.bench.run(module.AGAIN_S)
    assert len(lab.children("list")) == 2


def test_the_run_ends_with_the_console(lab: Lab) -> None:
    lab.say("start", id="file:meet.toml")
    lab.bench.gateway.close()
    assert lab.run.interrupted == 1
    assert lab.children("list")[-1].killed
    assert not Path(lab.children("list")[-1].value("--to")).parent.exists()


@pytest.mark.skipif(sys.platform != "linux", reason="as a core's log")
def test_the_audit_log_has_who_started_and_stopped_it(lab: Lab, tmp_path: Path) -> None:
    lab.say("start", id="file:meet.toml", seeds="7")
    lab.say("stop")
    lab.run.code = 130
    lab.bench.run(module.SETTLE_S + 1.0)
    lab.bench.gateway.close()
    lines = [
        json.loads(each) for file in (tmp_path / "audit").glob("*.jsonl") for each in file.read_text().splitlines()
    ]
    assert [(each["act"], each["operator"]) for each in lines] == [("experiment", "console anna@base sess")] * 3
    assert [each["result"] for each in lines] == [
        "started", "stopped", "ended: was stopped by console anna@base sess",
    ]  # fmt: skip
    assert lines[0]["what"]["seeds"] == "7"
    from fullswarm.audit.verify import verify

    assert not verify(tmp_path / "audit", None, {}).problems


def test_a_command_that_cannot_be_started_is_refused(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    def no(_arguments: Sequence[str], _log: IO[bytes]) -> Process:
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(children, "start", no)
    assert lab.say("start", id="file:meet.toml") == "not started: Resource temporarily unavailable"
    assert lab.page.last("experiments")["running"] is None


# -------------------------------------------------------------------- real processes
def test_a_child_is_niced_and_ends_with_all_it_started(tmp_path: Path) -> None:
    least = min(19, os.getpriority(os.PRIO_PROCESS, 0) + children.NICENESS)
    with (tmp_path / "log").open("w+b") as log:
        process = children.start(["experiment", "list", str(tmp_path / "missing")], log)
        try:
            until(lambda: os.getpriority(os.PRIO_PROCESS, process.pid) == least or process.poll() is not None)
            assert os.getsid(process.pid) == process.pid
            assert process.wait(90.0) == 2
            assert "no such folder" in children.last_line(log)
        finally:
            children.end(process)
        again = children.start(["experiment", "list", str(tmp_path), "--to", str(tmp_path / "l"), "--parent", "0"], log)
        children.end(again)
        assert again.returncode in (-signal.SIGKILL, 0)
