"""The interface for programs on a real port, with the real core and two simulated robots in this process."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import httpx
import websockets
from jsonschema import Draft202012Validator
from websockets.asyncio.client import ClientConnection

from fullswarm.clock import MonotonicClock
from fullswarm.operator.client import Operator
from fullswarm.operator.console.access import Names, uvicorn_server
from fullswarm.operator.console.api.server import Api
from fullswarm.operator.console.gateway import Gateway, Identity
from fullswarm.operator.console.serve import RuntimeLoop
from fullswarm.operator.console.server import Pages, Web
from fullswarm.operator.console.tokens import Doorkeeper, TokenFile
from tests.unit.whole_swarm import KEYS, Whole

PAGE_TOKEN = "a-token-of-24-characters"
WALL_S = 1.7e9
PATIENCE_S = 10.0
GOAL = {"behaviour": "move_to_goal_bc", "robots": ["r0"], "parameters": {"goal": [8.0, 10.0]}}


class ApiLab:
    """A console with the interface, its swarm, and tokens of each role."""

    def __init__(self, folder: Path, *, read_only: bool = False) -> None:
        self.whole = Whole(count=2, clock=MonotonicClock())
        self.runtime = self.whole.runtime
        self.errors: list[BaseException] = []
        self.wall_s = WALL_S
        self.file = TokenFile(folder / "tokens.json")
        self.tokens = {role: self.file.add(role, role, WALL_S) for role in ("operator", "driver", "observer")}
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.listener.setblocking(False)
        self.port = int(self.listener.getsockname()[1])
        self.origin = f"http://127.0.0.1:{self.port}"
        identity = Identity("base", "console@base:1", "9.9", read_only)
        self.gateway = Gateway(self.whole.bus, KEYS, self.runtime, identity, lambda: self.wall_s)
        self.pump = RuntimeLoop(self.runtime, asyncio.get_running_loop(), self.errors.append)
        keeper = Doorkeeper("", lambda: self.wall_s, file=TokenFile(self.file.path))
        self.api = Api(self.gateway, keeper, self.runtime.now_s, self.pump.wake, "console@base:1")
        web = Web(self.gateway, Doorkeeper(PAGE_TOKEN, lambda: self.wall_s), self.runtime.now_s, self.pump.wake)
        app = web.app(Names("127.0.0.1", self.port), Pages(folder), self.api.route())
        self.server = uvicorn_server(app)
        self.person = Operator(self.whole.bus, KEYS, self.runtime, "anna", name="anna")
        self.client = httpx.AsyncClient(base_url=f"{self.origin}/api/v1", trust_env=False, timeout=PATIENCE_S)

    # ------------------------------------------------------------------ calling
    async def call(
        self, method: str, path: str, body: Any = None, *, role: str = "operator", **more: Any
    ) -> httpx.Response:
        headers = {"Authorization": f"Bearer {self.tokens[role]}"} if role else {}
        headers |= more.pop("headers", {})
        if body is not None:
            more["json"] = body
        return await self.client.request(method, path, headers=headers, **more)

    async def ask(self, path: str, body: Any = None, *, role: str = "operator") -> dict[str, Any]:
        """Return the answer of a call that must succeed."""
        found = await self.call("GET" if body is None else "POST", path, body, role=role)
        assert found.status_code < 300, found.text
        answer: dict[str, Any] = found.json()
        return answer

    async def refused(self, status: int, path: str, body: Any = None, *, role: str = "operator") -> dict[str, Any]:
        """Return the problem of a call that must fail."""
        return problem(await self.call("GET" if body is None else "POST", path, body, role=role), status)

    async def hold(self, *robots: str, role: str = "operator", **more: Any) -> None:
        await self.ask("/leases", {"robots": robots or ["r0"], **more}, role=role)

    @contextlib.asynccontextmanager
    async def stream(self, role: str = "operator", **options: Any) -> AsyncIterator[ClientConnection]:
        options.setdefault("additional_headers", {"Authorization": f"Bearer {self.tokens[role]}"} if role else {})
        address = f"ws://127.0.0.1:{self.port}/api/v1/stream"
        async with websockets.connect(address, proxy=None, **options) as line:
            yield line

    # ------------------------------------------------------------------ waiting
    async def until(self, condition: Callable[[], bool], what: str, limit_s: float = PATIENCE_S) -> float:
        """Wait for a condition; return how long it took, s."""
        began_s = self.runtime.now_s()
        while not condition():
            assert self.runtime.now_s() - began_s < limit_s, f"not within {limit_s:g} s: {what}"
            await asyncio.sleep(0.002)
        return self.runtime.now_s() - began_s

    def ready(self) -> bool:
        robots = {row.robot for row in self.gateway.view.snapshot().robots if row.health}
        return self.server.started and self.gateway.context.world.known and robots == {"r0", "r1"}

    def driven(self, robot: str = "r0") -> bool:
        return robot in self.whole.driven()

    async def until_driven(self, robot: str = "r0") -> float:
        return await self.until(lambda: self.driven(robot), f"{robot} is driven")

    async def until_stopped(self, robot: str = "r0", limit_s: float = PATIENCE_S) -> float:
        return await self.until(lambda: not self.driven(robot), f"{robot} is not driven", limit_s)

    def holders(self) -> dict[str, str]:
        return self.gateway.view.snapshot().holders


def problem(found: httpx.Response, status: int) -> dict[str, Any]:
    """Return the problem in an answer, and check its form."""
    assert found.status_code == status, found.text
    assert found.headers["content-type"] == "application/problem+json"
    answer: dict[str, Any] = found.json()
    assert answer["status"] == status
    assert answer["title"]
    assert answer["detail"]
    assert "Traceback" not in found.text
    return answer


async def frame(line: ClientConnection, kind: str = "") -> dict[str, Any]:
    """Return the next frame, or the next of a kind."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            found: dict[str, Any] = json.loads(await line.recv())
            if kind in ("", found["type"]):
                return found


async def closing(line: ClientConnection) -> int:
    """Return the code with which the server ends the line."""
    async with asyncio.timeout(PATIENCE_S):
        with contextlib.suppress(websockets.ConnectionClosed):
            while True:
                await line.recv()
    assert line.close_code is not None
    return line.close_code


def validator(document: dict[str, Any], schema: dict[str, Any]) -> Draft202012Validator:
    """Return a validator of a schema of the document, by the reference implementation in Python."""
    return Draft202012Validator({**schema, "components": document["components"]})


def run(folder: Path, story: Callable[[ApiLab], Awaitable[None]], **options: Any) -> None:
    """Serve while a scenario runs."""

    async def main() -> None:
        lab = ApiLab(folder, **options)
        serving = asyncio.create_task(lab.server.serve([lab.listener]))
        lab.pump.wake()
        try:
            async with asyncio.timeout(60.0):
                await lab.until(lab.ready, "the swarm")
                async with lab.client:
                    await story(lab)
        finally:
            lab.server.should_exit = True
            await serving
            lab.api.close()
            lab.gateway.close()
            lab.pump.close()
            lab.whole.close()
        assert lab.errors == []

    asyncio.run(main())
