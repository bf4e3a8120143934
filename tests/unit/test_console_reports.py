"""Reports of experiments on the console's server: only by keys that pages have, only their files, made when needed."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import sys
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import IO, Any

import httpx
import pytest

from fullswarm.clock import SimClock
from fullswarm.operator.console import children
from fullswarm.operator.console import experiments as module
from fullswarm.operator.console.access import Names, uvicorn_server
from fullswarm.operator.console.experiments import ExperimentOptions, Experiments
from fullswarm.operator.console.reports import POLICY, Reports
from fullswarm.operator.console.server import Pages, Web
from fullswarm.operator.console.tokens import Doorkeeper
from fullswarm.runtime import Runtime
from tests.unit.console_bench import Page
from tests.unit.test_console_experiments import RESULTS, entry
from tests.unit.test_console_experiments import Process as NoProcess

OVER = RESULTS | {"finished": 4, "over": True}


class Lab:
    """The experiments of a console with a played reader, and a server for their reports."""

    def __init__(self, folder: Path) -> None:
        self.runtime = Runtime(SimClock())
        self.readers: list[NoProcess] = []
        self.page = Page()
        self.experiments = Experiments(
            ExperimentOptions(folder), self.runtime, "console", lambda: 0.0, lambda _: None, lambda _text, _by: None
        )
        self.reports = Reports(self.experiments)
        self.folder = folder

    def has(self, *entries: dict[str, Any]) -> dict[str, str]:
        """Have the reader list these; return the addresses of their reports."""
        self.experiments.watch(self.page, True)
        file = Path(self.readers[-1].value("--to"))
        file.write_text(json.dumps({"format": module.FORMAT, "experiments": entries}))
        self.runtime.run(0.6)
        return {each["name"]: each["report"] for each in self.page.last("experiment_list")["entries"]}

    @contextlib.asynccontextmanager
    async def served(self) -> AsyncIterator[httpx.AsyncClient]:
        listener = socket.create_server(("127.0.0.1", 0))
        port = int(listener.getsockname()[1])
        web = Web(None, Doorkeeper("a-token-of-24-characters", lambda: 0.0), self.runtime.now_s, lambda: None)  # type: ignore[arg-type]  # no page connects
        server = uvicorn_server(web.app(Names("127.0.0.1", port), Pages(), self.reports.route()))
        task = asyncio.create_task(server.serve([listener]))
        async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{port}", trust_env=False) as client:
            yield client
        self.reports.close()
        server.should_exit = True
        await task


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    lab, start = Lab(tmp_path), children.start

    def play(arguments: Sequence[str], log: IO[bytes]) -> Any:
        if arguments[0] != "experiment":
            return start(arguments, log)
        lab.readers.append(NoProcess(arguments, log))
        return lab.readers[-1]

    monkeypatch.setattr(children, "start", play)
    out = tmp_path / "meet"
    (out / "trials" / "a-s0-0123").mkdir(parents=True)
    (out / "trials" / "a-s0-0123" / "result.json").write_text("{}")
    for name in ("report.html", "results.csv", "experiment.json"):
        (out / name).write_text(f"<p>{name}")
    (tmp_path / "secret.txt").write_text("secret")
    yield lab
    for each in lab.readers:
        each.code = 0
    lab.experiments.close()


def test_a_report_is_served_with_a_policy_of_its_own(lab: Lab) -> None:
    address = lab.has(entry("meet", out=str(lab.folder / "meet"), results=OVER | {"report": "fresh"}))["meet"]

    async def ask() -> None:
        async with lab.served() as client:
            found = await client.get(address)
            assert (found.status_code, found.text) == (200, "<p>report.html")
            assert found.headers["content-type"] == "text/html; charset=utf-8"
            assert found.headers.get_list("content-security-policy") == [POLICY]
            assert found.headers["x-content-type-options"] == "nosniff"
            assert found.headers["cache-control"] == "no-store"
            assert (await client.get(address, headers={"Host": "evil.example"})).status_code == 403
            assert (await client.get(address, headers={"Origin": "http://evil.example"})).status_code == 403
            page = await client.get("/")
            assert "script-src 'self'" in page.headers["content-security-policy"]
            linked = await client.get(f"{address}results.csv")
            assert linked.text == "<p>results.csv"
            assert linked.headers["content-disposition"].startswith("attachment")
            assert (await client.get(f"{address}trials/a-s0-0123/result.json")).status_code == 200

    asyncio.run(ask())


OTHERS = (
    "../secret.txt", "..%2fsecret.txt", "%2e%2e/secret.txt", "trials/../../secret.txt", "experiment.json",
    "trials/.hidden/result.json", "link", "trials/link/result.json", "/etc/passwd", "%00", "trials",
    "trials/a-s0-0123", "trials/" + "a" * 300 + "/result.json", "report.html/x", "..\\secret.txt",
)  # fmt: skip


def test_nothing_else_is_served(lab: Lab) -> None:
    address = lab.has(entry("meet", out=str(lab.folder / "meet"), results=OVER | {"report": "fresh"}))["meet"]
    (lab.folder / "other").mkdir()
    (lab.folder / "other" / "result.json").write_text("secret")
    (lab.folder / "meet" / "link").symlink_to(lab.folder / "secret.txt")
    (lab.folder / "meet" / "trials" / "link").symlink_to(lab.folder / "other")

    async def ask(port: int, path: str) -> bytes:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)  # httpx would tidy the path
        writer.write(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\n\r\n".encode())
        answer = await asyncio.wait_for(reader.read(), 10.0)
        writer.close()
        return answer

    async def ask_all() -> dict[str, bytes]:
        async with lab.served() as client:
            port = client.base_url.port or 0
            keys = {f"/report/{key}/": "" for key in ("", "x", "meet", "file:meet.toml", "%c3%a9", "%ff", "a" * 5000)}
            return {path: await ask(port, path) for path in (*(address + each for each in OTHERS), *keys)}

    for path, answer in asyncio.run(ask_all()).items():
        assert answer.split(b" ", 2)[1] in (b"404", b"400"), (path, answer)
        assert b"secret" not in answer.partition(b"\r\n\r\n")[2], path


def test_a_running_experiment_has_none_yet(lab: Lab) -> None:
    out = str(lab.folder / "meet")
    address = lab.has(entry("meet", out=out, results=OVER | {"report": "fresh"}))["meet"]
    lab.has(entry("meet", out=out, results=RESULTS | {"going": True}))

    async def ask() -> int:
        async with lab.served() as client:
            return (await client.get(address)).status_code

    assert asyncio.run(ask()) == 409


def test_what_cannot_be_made_says_why_and_the_loop_goes_on(lab: Lab) -> None:
    """`fullswarm results report` is really run, on a folder that holds no trials."""
    out = lab.folder / "empty"
    out.mkdir()
    address = lab.has(entry("meet", out=str(out), results=OVER))["meet"]

    async def ask() -> None:
        async with lab.served() as client:
            late = asyncio.create_task(client.get(address, timeout=90.0))
            also = asyncio.create_task(client.get(address, timeout=90.0))
            loop, longest_s = asyncio.get_running_loop(), 0.0
            while not late.done():
                began_s = loop.time()
                await asyncio.sleep(0.01)
                longest_s = max(longest_s, loop.time() - began_s)
            for answer in (await late, await also):
                assert answer.status_code == 500
                assert answer.text.startswith("no report: ")
                assert "Traceback" not in answer.text
            assert longest_s < 1.0

    asyncio.run(ask())


@pytest.mark.skipif(sys.platform != "linux", reason="looks at processes")
def test_what_is_being_made_ends_with_the_console(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    ended: list[bool] = []

    class Slow(NoProcess):
        returncode = 0

    monkeypatch.setattr(children, "start", Slow)
    monkeypatch.setattr(children, "end", lambda process: ended.append(isinstance(process, Slow)))
    lab.readers.append(NoProcess(["", "--to", "x"], None))  # type: ignore[arg-type]  # no log
    monkeypatch.setattr(lab.experiments, "reported", lambda _key: (_entry(lab), ""))

    async def ask() -> str:
        async with lab.served() as client:
            late = asyncio.create_task(client.get("/report/key/"))
            while not lab.reports._making:
                await asyncio.sleep(0.01)
            lab.reports.close()
            return (await late).text

    assert "the console has ended" in asyncio.run(ask())
    assert ended == [True]


def _entry(lab: Lab) -> module.Entry:
    import msgspec

    return msgspec.convert(entry("meet", out=str(lab.folder / "meet"), results=OVER), module.Entry)
