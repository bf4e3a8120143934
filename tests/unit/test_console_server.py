"""The console's server on a real port: access, closed connections, and that no page delays the others."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import json
import socket
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
import websockets
from websockets.asyncio.client import ClientConnection

from fullswarm.bus import LocalBus
from fullswarm.clock import MonotonicClock
from fullswarm.messages import BehaviourRequest, StopRequest
from fullswarm.operator.console import server as console_server
from fullswarm.operator.console.access import MOST_NEW_EACH, MOST_UNVERIFIED, Names, uvicorn_server
from fullswarm.operator.console.gateway import Gateway, Identity
from fullswarm.operator.console.serve import RuntimeLoop
from fullswarm.operator.console.server import Pages, Web
from fullswarm.operator.console.tokens import Doorkeeper, TokenFile
from fullswarm.runtime import Runtime
from tests.unit.console_bench import KEYS

TOKEN = "a-token-of-24-characters"
HELLO = {"t": "hello", "token": TOKEN, "session": "session-1", "name": "anna"}
PATIENCE_S = 10.0


class Served:
    """A console without a swarm, served by the running loop."""

    def __init__(self, folder: Path, *, read_only: bool = False, tokens: TokenFile | None = None) -> None:
        self.runtime = Runtime(MonotonicClock())
        self.bus = LocalBus(self.runtime.mailbox)
        self.stops: list[StopRequest] = []
        self.errors: list[BaseException] = []
        self.requests: list[BehaviourRequest] = []
        self.bus.subscribe(KEYS.stop, StopRequest, self.stops.append)
        self.bus.subscribe(KEYS.behaviour_request, BehaviourRequest, self.requests.append)
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.listener.setblocking(False)
        self.port = int(self.listener.getsockname()[1])
        self.origin = f"http://127.0.0.1:{self.port}"
        identity = Identity("base", "console@base:1", "9.9", read_only)
        self.gateway = Gateway(self.bus, KEYS, self.runtime, identity, lambda: 0.0)
        self.pump = RuntimeLoop(self.runtime, asyncio.get_running_loop(), self.errors.append)
        self.web = Web(self.gateway, Doorkeeper(TOKEN, lambda: 0.0, file=tokens), self.runtime.now_s, self.pump.wake)
        self.server = uvicorn_server(self.web.app(Names("127.0.0.1", self.port), Pages(folder)))

    def connect(self, **options: Any) -> Any:
        options.setdefault("origin", self.origin)
        return websockets.connect(f"ws://127.0.0.1:{self.port}/ws", max_size=None, proxy=None, **options)

    @contextlib.asynccontextmanager
    async def page(self, session: str = "session-1") -> AsyncIterator[ClientConnection]:
        async with self.connect() as line:
            await line.send(json.dumps({**HELLO, "session": session}))
            assert (await frame(line))["t"] == "hello"
            yield line


async def frame(line: ClientConnection, kind: str = "") -> dict[str, Any]:
    """Return the next frame, or the next of a kind."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            found: dict[str, Any] = json.loads(await line.recv())
            if kind in ("", found["t"]):
                return found


async def closing(line: ClientConnection) -> int:
    """Return the code with which the server ends the line."""
    async with asyncio.timeout(PATIENCE_S):
        with contextlib.suppress(websockets.ConnectionClosed):
            while True:
                await line.recv()
    assert line.close_code is not None
    return line.close_code


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "secret.txt").write_text("not a page")
    page = tmp_path / "page"
    page.mkdir()
    (page / "index.html").write_text("<!doctype html><title>c</title>")
    (page / "app.js").write_text("export {}")
    (page / "notes.py").write_text("no page is made of this")
    return page


def run(folder: Path, story: Callable[[Served], Awaitable[None]], **options: Any) -> None:
    """Serve while a scenario runs."""

    async def main() -> None:
        served = Served(folder, **options)
        serving = asyncio.create_task(served.server.serve([served.listener]))
        served.pump.wake()
        try:
            async with asyncio.timeout(60.0):
                while not served.server.started:
                    await asyncio.sleep(0.0)
                await story(served)
        finally:
            served.server.should_exit = True
            await serving
            served.gateway.close()
            served.pump.close()
        assert served.errors == []

    asyncio.run(main())


# -------------------------------------------------------------------- the page's files
def test_files_of_the_page_and_no_others(folder: Path) -> None:
    async def story(served: Served) -> None:
        async with httpx.AsyncClient(base_url=served.origin, trust_env=False) as client:
            index = await client.get("/")
            assert index.status_code == 200
            assert index.headers["content-type"] == "text/html; charset=utf-8"
            assert "script-src 'self'" in index.headers["content-security-policy"]
            assert "unsafe" not in index.headers["content-security-policy"]
            assert index.headers["x-content-type-options"] == "nosniff"
            assert index.headers["referrer-policy"] == "no-referrer"
            script = await client.get("/page/app.js")
            assert script.headers["content-type"].startswith("text/javascript")
            again = await client.get("/page/app.js", headers={"If-None-Match": script.headers["etag"]})
            assert (again.status_code, again.content) == (304, b"")
            for path in (
                "/page/../secret.txt", "/page/%2e%2e/secret.txt", "/page/..%2fsecret.txt", "/page//etc/passwd",
                "/page/notes.py", "/page/none.js", "/page/", "/page/a%00.js", "/page/" + "a" * 5000 + ".js", "/docs",
            ):  # fmt: skip
                answer = await client.get(path)
                assert answer.status_code == 404, path
                assert "content-security-policy" in answer.headers
            assert (await client.post("/")).status_code == 405

    run(folder, story)


def test_a_link_out_of_the_folder_leads_nowhere(folder: Path) -> None:
    (folder / "out.txt").symlink_to(folder.parent / "secret.txt")
    assert Pages(folder).find("out.txt") is None
    assert Pages(folder).find("app.js") == folder / "app.js"


def test_another_host_or_origin_is_refused(folder: Path) -> None:
    async def story(served: Served) -> None:
        async with httpx.AsyncClient(base_url=served.origin, trust_env=False) as client:
            for headers in (
                {"Host": "evil.example"}, {"Host": f"evil.example:{served.port}"}, {"Host": "127.0.0.1:1"},
                {"Origin": "http://evil.example"}, {"Origin": "null"}, {"Origin": f"https://127.0.0.1:{served.port}"},
                {"Origin": f"http://localhost:{served.port}"},
            ):  # fmt: skip
                answer = await client.get("/", headers=headers)
                assert answer.status_code == 403, headers
                assert "content-security-policy" in answer.headers
            assert (await client.get("/", headers={"Origin": served.origin})).status_code == 200

    run(folder, story)


# -------------------------------------------------------------------- the line
def test_a_page_of_another_origin_cannot_open_a_line(folder: Path) -> None:
    async def story(served: Served) -> None:
        for origin in ("http://evil.example", "null", f"http://localhost:{served.port}", None):
            with pytest.raises(websockets.InvalidStatus) as refused:
                async with served.connect(origin=origin):
                    pytest.fail(f"{origin} came in")
            assert refused.value.response.status_code == 403
        with pytest.raises(websockets.InvalidStatus):
            async with served.connect(
                origin=f"http://evil.example:{served.port}", additional_headers={"Host": f"evil.example:{served.port}"}
            ):
                pytest.fail("another host came in")

    run(folder, story)


@pytest.mark.parametrize(
    "first",
    [
        {**HELLO, "token": "wrong"},
        {**HELLO, "token": ""},
        {**HELLO, "token": TOKEN + "x"},
        {**HELLO, "session": "x"},
        {"t": "stop", "ref": 1},
        "no json",
    ],
)
def test_a_wrong_greeting_closes_the_socket_before_anything_is_sent(folder: Path, first: Any) -> None:
    async def story(served: Served) -> None:
        async with served.connect() as line:
            await line.send(first if isinstance(first, str) else json.dumps(first))
            await line.send('{"t":"stop","ref":1}')
            assert await closing(line) == console_server.BAD_TOKEN
        assert served.stops == []

    run(folder, story)


def test_a_line_without_a_greeting_ends(folder: Path) -> None:
    async def story(served: Served) -> None:
        served.web.hello_s = 0.2
        async with served.connect() as line:
            assert await closing(line) == console_server.NO_HELLO

    run(folder, story)


def test_a_page_gets_frames_and_stops_the_swarm(folder: Path) -> None:
    async def story(served: Served) -> None:
        async with served.page() as line:
            for _ in range(3):
                await frame(line, "fleet")
            await line.send('{"t":"stop","ref":4}')
            assert await frame(line, "answer") == {
                "t": "answer", "ref": 4, "ok": True, "reason": "", "request_id": "",
            }  # fmt: skip
        assert served.stops

    run(folder, story)


def test_what_is_not_understood_is_answered_and_the_line_goes_on(folder: Path) -> None:
    async def story(served: Served) -> None:
        async with served.page() as line:
            for text in ("{", '{"t":"fly","ref":9}', '{"t":"stop","ref":9,"x":1}', "[]"):
                await line.send(text)
                assert not (await frame(line, "answer"))["ok"]
            await line.send(b'{"t":"ping","ref":10}')
            assert (await frame(line, "answer"))["ok"]

    run(folder, story)


def test_a_frame_too_big_ends_the_line(folder: Path) -> None:
    async def story(served: Served) -> None:
        for size, code in ((70_000, console_server.TOO_BIG), (5_000_000, 1009)):
            async with served.page() as line:
                with contextlib.suppress(websockets.ConnectionClosed):
                    await line.send(json.dumps({"t": "estop", "ref": 1, "reason": "x" * size}))
                assert await closing(line) == code

    run(folder, story)


def test_a_flood_ends_the_line(folder: Path) -> None:
    async def story(served: Served) -> None:
        async with served.page() as line:
            with contextlib.suppress(websockets.ConnectionClosed):
                for number in range(1000):
                    await line.send(json.dumps({"t": "ping", "ref": number}))
            assert await closing(line) == console_server.TOO_MANY

    run(folder, story)


def test_a_flood_of_seeks_ends_the_line_and_the_other_page_looks_on(folder: Path) -> None:
    async def story(served: Served) -> None:
        async with served.page() as flooding, served.page("session-2") as other:
            with contextlib.suppress(websockets.ConnectionClosed):
                for number in range(1000):
                    await flooding.send(json.dumps({"t": "look", "ref": number, "at": float(number)}))
            for number in range(3):
                await other.send(json.dumps({"t": "look", "ref": number, "at": 0.0}))
                assert (await frame(other, "history"))["t"] == "history"
                assert (await frame(other, "fleet"))["t"] == "fleet"  # what is live comes on
            assert await closing(flooding) == console_server.TOO_MANY

    run(folder, story)


def test_a_clip_needs_the_key_of_its_page(folder: Path) -> None:
    async def story(served: Served) -> None:
        async with httpx.AsyncClient() as client:
            for key in ("x", "..%2f..%2fetc%2fpasswd", "%00", "a" * 4000):
                assert (await client.get(f"{served.origin}/clip/{key}")).status_code == 404

    run(folder, story)


def test_there_is_an_end_of_pages(folder: Path) -> None:
    async def story(served: Served) -> None:
        async with contextlib.AsyncExitStack() as stack:
            for number in range(console_server.MOST_CLIENTS):
                await stack.enter_async_context(served.page(f"session-{number}"))
            async with served.connect() as line:
                await line.send(json.dumps({**HELLO, "session": "one-too-many"}))
                assert await closing(line) == console_server.TOO_MANY
        async with asyncio.timeout(PATIENCE_S):
            while served.web.clients:
                await asyncio.sleep(0.01)
        async with served.page():
            pass

    run(folder, story)


def test_lines_without_a_greeting_take_no_place_of_a_page(folder: Path) -> None:
    async def story(served: Served) -> None:
        async with contextlib.AsyncExitStack() as stack:
            for _ in range(2 * console_server.MOST_CLIENTS):
                await stack.enter_async_context(served.connect())
            async with served.page() as line:
                await line.send('{"t":"stop","ref":1}')
                assert (await frame(line, "answer"))["ok"]
            assert served.web.clients <= 1
        assert served.stops

    run(folder, story)


@pytest.mark.parametrize("sent", [b"", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Half: "])
def test_a_connection_without_a_whole_request_ends(folder: Path, sent: bytes) -> None:
    async def story(served: Served) -> None:
        served.server.server_state.unverified.header_s = 0.2
        reader, writer = await asyncio.open_connection("127.0.0.1", served.port)
        writer.write(sent)
        async with asyncio.timeout(PATIENCE_S):
            with contextlib.suppress(ConnectionResetError):
                assert await reader.read() == b""
        writer.close()

    run(folder, story)


def test_the_oldest_connection_without_a_request_makes_room_and_no_page_does(folder: Path) -> None:
    async def story(served: Served) -> None:
        unverified = served.server.server_state.unverified
        async with served.page() as page, served.connect() as asked:
            assert len(unverified) == 1  # the page has sent the token
            silent = [await asyncio.open_connection("127.0.0.1", served.port) for _ in range(MOST_UNVERIFIED)]
            async with asyncio.timeout(PATIENCE_S):
                with contextlib.suppress(ConnectionResetError):
                    assert await silent[0][0].read() == b""
            assert len(unverified) == MOST_UNVERIFIED
            assert not silent[1][0].at_eof()
            await asked.send(json.dumps({**HELLO, "session": "session-2"}))
            assert (await frame(asked))["t"] == "hello"
            await page.send('{"t":"ping","ref":1}')
            assert (await frame(page, "answer"))["ok"]
            for _, writer in silent:
                writer.close()

    run(folder, story)


def test_operator_is_named_by_the_token_whatever_the_page_states(folder: Path, tmp_path: Path) -> None:
    tokens = TokenFile(tmp_path / "tokens.json")
    anna, ben = tokens.add("anna", "operator", 0.0), tokens.add("ben", "observer", 0.0)

    async def story(served: Served) -> None:
        async with served.connect() as line, served.connect() as other:
            await line.send(json.dumps({**HELLO, "token": anna, "name": "ben"}))
            hello = await frame(line)
            assert (hello["operator"], hello["read_only"]) == ("anna", False)
            await line.send(json.dumps({"t": "request", "ref": 1, "behaviour": "flocking"}))
            assert (await frame(line, "answer"))["ok"]
            assert {each.operator for each in served.requests} == {"anna"}
            await line.send(json.dumps({"t": "stop", "ref": 2}))
            assert (await frame(line, "answer"))["ok"]
            assert {each.source for each in served.stops} == {"console@base:1/1:anna"}
            # An observer with the same secret of the page gets a session of its own, and sends nothing.
            await other.send(json.dumps({**HELLO, "token": ben, "name": "anna"}))
            hello = await frame(other)
            assert (hello["operator"], hello["read_only"]) == ("ben", True)
            for number, order in enumerate(("stop", "estop", "clear", "request")):
                extra = {"behaviour": "flocking"} if order == "request" else {}
                await other.send(json.dumps({"t": order, "ref": number, **extra}))
                answer = await frame(other, "answer")
                assert (answer["ok"], "observer" in answer["reason"]) == (False, True)
            # Hers are repeated, and there are no others.
            assert {each.source for each in served.stops} == {"console@base:1/1:anna"}
            assert {each.source for each in served.requests} == {"console@base:1/1:anna"}
            assert len({each.id for each in served.stops}) == 1

    run(folder, story, tokens=tokens)


def test_pass_opens_a_page_and_ends_with_its_token_within_a_second(folder: Path, tmp_path: Path) -> None:
    tokens = TokenFile(tmp_path / "tokens.json")
    anna = tokens.add("anna", "operator", 0.0)

    async def story(served: Served) -> None:
        async with served.connect() as line:
            await line.send(json.dumps({**HELLO, "token": anna}))
            given = (await frame(line, "pass"))["token"]
            async with served.connect() as again:
                await again.send(json.dumps({**HELLO, "token": given}))
                assert (await frame(again))["operator"] == "anna"
                began_s = time.monotonic()
                TokenFile(tokens.path).revoke("anna")
                assert [await closing(line), await closing(again)] == [4401, 4401]
                assert time.monotonic() - began_s < 1.5
        async with served.connect() as line:
            await line.send(json.dumps({**HELLO, "token": given}))
            assert await closing(line) == 4401

    run(folder, story, tokens=tokens)


def opened_from(address: str, port: int, count: int, first: bytes = b"") -> list[socket.socket]:
    """Open connections from an address of this machine without giving the server's loop a turn."""
    found = []
    for _ in range(count):
        each = socket.socket()
        each.bind((address, 0))
        each.connect(("127.0.0.1", port))
        each.send(first)
        found.append(each)
    return found


async def still_open(connections: list[socket.socket]) -> list[bool]:
    """Tell which connections the server has not closed, once it has looked at all of them."""
    await asyncio.sleep(0.3)
    found = []
    for each in connections:
        each.setblocking(False)
        try:
            found.append(each.recv(65536, socket.MSG_PEEK) != b"")
        except BlockingIOError:
            found.append(True)
        except ConnectionError:
            found.append(False)
    return found


def test_only_the_newest_of_many_connections_at_once_are_served_and_each_address_has_its_own(folder: Path) -> None:
    async def story(served: Served) -> None:
        with contextlib.ExitStack() as stack:
            theirs = opened_from("127.0.0.2", served.port, 200)
            ours = opened_from("127.0.0.1", served.port, 1)
            theirs += opened_from("127.0.0.2", served.port, 200)
            for each in (*theirs, *ours):
                stack.callback(each.close)
            assert await still_open(ours) == [True]
            assert await still_open(theirs) == [False] * (400 - MOST_NEW_EACH) + [True] * MOST_NEW_EACH

    run(folder, story)


def test_address_that_fills_the_pool_displaces_its_own_connections_only(folder: Path) -> None:
    async def story(served: Served) -> None:
        request = f"GET /page/app.js HTTP/1.1\r\nHost: 127.0.0.1:{served.port}\r\n\r\n".encode()
        with contextlib.ExitStack() as stack:
            ours = opened_from("127.0.0.1", served.port, 1)  # slow: it has sent nothing yet
            stack.callback(ours[0].close)
            pool = served.server.server_state.unverified
            for _ in range(2 * MOST_UNVERIFIED // MOST_NEW_EACH):
                for each in opened_from("127.0.0.2", served.port, MOST_NEW_EACH, request):
                    stack.callback(each.close)
                await asyncio.sleep(0.1)
                assert len(pool) <= MOST_UNVERIFIED
            assert len(pool) == MOST_UNVERIFIED
            assert await still_open(ours) == [True]
            # And it goes on to be a page, while they go on.
            async with served.page() as line:
                await line.send(json.dumps({"t": "stop", "ref": 1}))
                assert (await frame(line, "answer"))["ok"]

    run(folder, story)


def test_without_file_descriptors_the_oldest_connection_without_the_token_makes_room(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def story(served: Served) -> None:
        silent = opened_from("127.0.0.1", served.port, 3)
        with contextlib.ExitStack() as stack:
            for each in silent:
                stack.callback(each.close)
            assert await still_open(silent) == [True] * 3
            failures = [OSError(errno.EMFILE, "Too many open files")]
            accept = socket.socket.accept

            def fail_once(listener: socket.socket) -> Any:
                if failures:
                    raise failures.pop()
                return accept(listener)

            monkeypatch.setattr(socket.socket, "accept", fail_once)
            async with served.page():
                assert await still_open(silent) == [False, True, True]

    run(folder, story)


def test_read_only_answers_no(folder: Path) -> None:
    async def story(served: Served) -> None:
        async with served.page() as line:
            await line.send('{"t":"stop","ref":1}')
            assert "--read-only" in (await frame(line, "answer"))["reason"]
        assert served.stops == []

    run(folder, story, read_only=True)


def test_a_page_that_takes_nothing_does_not_hold_up_the_others(folder: Path) -> None:
    async def story(served: Served) -> None:
        served.web.stalled_s = 1.0
        async with served.page("session-2") as good, served.connect(max_queue=1) as slow:
            await slow.send(json.dumps(HELLO))
            slow.transport.pause_reading()
            gone = False
            loop = asyncio.get_running_loop()
            worst_s, before_s = 0.0, loop.time()
            while not gone and loop.time() < before_s + PATIENCE_S + 10.0:
                served.gateway._send({"t": "rows", "charts": ["x" * 100_000]})
                began_s = loop.time()
                await good.send('{"t":"ping","ref":1}')
                await frame(good, "answer")
                worst_s = max(worst_s, loop.time() - began_s)
                await asyncio.sleep(0.02)  # 50 Hz, as a page might be told
                gone = served.web.clients == 1
            assert gone
            assert worst_s < 0.5
            slow.transport.abort()

    run(folder, story)


def test_a_page_that_is_gone_no_longer_drives(folder: Path) -> None:
    async def story(served: Served) -> None:
        async with served.page() as line:
            session = served.gateway._sessions["session-1"]
            assert len(session.listeners) == 1
            line.transport.abort()
        async with asyncio.timeout(PATIENCE_S):
            while session.listeners:
                await asyncio.sleep(0.01)

    run(folder, story)


def test_what_a_node_raises_ends_the_server_and_is_not_swallowed(folder: Path) -> None:
    async def main() -> None:
        served = Served(folder)

        def broken() -> None:
            raise RuntimeError("a bug")

        served.runtime.after(0.01, broken)
        served.pump.wake()
        async with asyncio.timeout(PATIENCE_S):
            while not served.errors:
                await asyncio.sleep(0.01)
        served.listener.close()
        assert str(served.errors[0]) == "a bug"

    asyncio.run(main())
