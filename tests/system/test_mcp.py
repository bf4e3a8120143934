"""`fullswarm mcp` beside a real `fullswarm up`, asked by the client of the protocol's own SDK."""

from __future__ import annotations

import asyncio
import json
import math
import os
import random
import signal
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest
from anyio.from_thread import BlockingPortal, start_blocking_portal
from mcp import ClientSession, StdioServerParameters, stdio_client
from mcp.types import CallToolResult

from fullswarm import Swarm
from fullswarm.config import SwarmConfig
from fullswarm.errors import RequestRefused
from fullswarm.launch.network import on_free_ports
from tests.waiting import until

FLEET = """
[hub]
endpoint = "{hub}"
[core]
audit = "{audit}"
[world]
address = "{world}"
engine = "kinematic"
walls = false
[[robot]]
id = "r1"
pose = [3.0, 3.0, 0.0]
[[robot]]
id = "r2"
pose = [3.0, 5.0, 0.0]
"""
GOAL: dict[str, Any] = {"behaviour": "move_to_goal_bc", "robots": ["r1"], "parameters": {"goal": [5.0, 3.0]}}
FLOCK: dict[str, Any] = {"behaviour": "flocking_bc", "robots": ["r1", "r2"]}


class Up:
    """A running `fullswarm up` with two simulated robots."""

    def __init__(self, folder: Path) -> None:
        free = on_free_ports(SwarmConfig(), prefer_configured=False)
        self.fleet, self.audit, self.errors = folder / "fleet.toml", folder / "audit", folder / "mcp.log"
        self.hub = free.hub.endpoint
        self.fleet.write_text(FLEET.format(hub=self.hub, world=free.world_or_default.address, audit=self.audit))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "fullswarm", "up", str(self.fleet)], stderr=subprocess.PIPE, text=True
        )

    def cli(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "fullswarm", *arguments, "--hub", self.hub]
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)

    def ready(self) -> bool:
        found = self.cli("status", "--json")
        rows = json.loads(found.stdout)["robots"] if found.returncode == 0 else []
        return [each.get("lifecycle") for each in rows] == ["READY", "READY"]

    def close(self) -> None:
        self.process.send_signal(signal.SIGINT)
        try:
            self.process.communicate(timeout=30)
        finally:
            self.process.kill()


class Model:
    """A client with its server."""

    def __init__(self, portal: BlockingPortal, session: ClientSession) -> None:
        self._portal, self.session = portal, session

    def call(self, tool: str, **arguments: Any) -> CallToolResult:
        found: CallToolResult = self._portal.call(self.session.call_tool, tool, arguments)
        return found

    def ask(self, tool: str, **arguments: Any) -> dict[str, Any]:
        """Return the answer of a tool that must succeed."""
        found = self.call(tool, **arguments)
        assert not found.is_error, found.content
        assert json.loads(text_of(found)) == found.structured_content
        return dict(found.structured_content)

    def refused(self, tool: str, **arguments: Any) -> str:
        """Return the text of a tool that must fail."""
        found = self.call(tool, **arguments)
        assert found.is_error, found.structured_content
        assert "Traceback" not in text_of(found)
        return text_of(found)

    def do(self, what: Any, *arguments: Any) -> Any:
        return self._portal.call(what, *arguments)

    def send(self, request: dict[str, Any]) -> dict[str, Any]:
        """Try a request and send it."""
        return self.ask("request_behaviour", **request, dry_run=False, token=self.token(request))

    def token(self, request: dict[str, Any]) -> str:
        return str(self.ask("request_behaviour", **request)["token"])

    def row(self, robot: str) -> dict[str, Any]:
        found: dict[str, Any] = self.ask("swarm_status", robots=[robot])["robots"][0]
        return found

    def leases(self) -> list[str]:
        return [f"{each['robot']} {each['operator']}" for each in self.ask("list_leases")["leases"]]


def text_of(found: CallToolResult) -> str:
    text: str = found.content[0].text  # type: ignore[union-attr]
    return text


def slowly(condition: Any, within_s: float = 10.0) -> None:
    """Wait for what a model asks for, below its rate limit."""
    until(condition, within_s, each=lambda: asyncio.run(asyncio.sleep(0.1)))


@contextmanager
def model(up: Up, *options: str) -> Iterator[Model]:
    command = ["-m", "fullswarm", "mcp", "--hub", up.hub, "--operator", "claude", "--audit", str(up.audit), *options]

    @asynccontextmanager
    async def session() -> AsyncIterator[ClientSession]:
        with up.errors.open("a") as errors:
            server = StdioServerParameters(command=sys.executable, args=command, env=dict(os.environ))
            async with stdio_client(server, errlog=errors) as (inward, outward), ClientSession(inward, outward) as made:
                await made.initialize()
                yield made

    with start_blocking_portal() as portal, portal.wrap_async_context_manager(session()) as made:
        yield Model(portal, made)


@pytest.fixture(scope="module")
def up(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Up]:
    made = Up(tmp_path_factory.mktemp("up"))
    try:
        until(made.ready, 90.0, "the swarm is ready")
        yield made
    finally:
        made.close()


@pytest.fixture(scope="module")
def anna(up: Up) -> Iterator[Swarm]:
    with Swarm(up.hub, operator="anna") as person:
        yield person


@pytest.fixture(scope="module")
def claude(up: Up) -> Iterator[Model]:
    with model(up, "--allow-requests") as made:
        yield made


def test_a_model_reads_the_swarm_and_may_stop_it_but_has_no_tool_that_moves_robots(up: Up) -> None:
    with model(up, "--fleet", str(up.fleet)) as reader:
        tools = {each.name: each for each in reader.do(reader.session.list_tools).tools}
        assert {"take_lease", "request_behaviour", "release_lease"}.isdisjoint(tools)
        writes = {name for name, each in tools.items() if not each.annotations.read_only_hint}
        assert writes == {"engage_estop", "stop_robots"}
        status = reader.ask("swarm_status")
        assert [each["robot"] for each in status["robots"]] == ["r1", "r2"]
        assert status["robots"][0]["x_m"] == pytest.approx(3.0, abs=0.2)
        assert reader.ask("robot_status", robot="r2")["everything"]["robot"] == "r2"
        known = reader.ask("list_behaviours")["behaviours"]
        assert (known["flocking_bc"]["safety_filter"], known["flocking"]["safety_filter"]) == (True, False)
        record = reader.ask("describe_behaviour", name="move_to_goal_bc")["record"]
        assert record["parameters"]["goal"]["unit"] == "m"
        assert reader.ask("list_missions")["missions"] == []
        assert reader.ask("list_leases")["me"] == "mcp/claude"
        keys = [each["key"] for each in reader.ask("get_parameters", key="agent/*")["parameters"]]
        assert "agent/speed_limit_m_s" in keys
        assert reader.ask("list_docks")["docks"] == []
        assert "[[robot]]" in reader.ask("fleet_file")["lines"]
        assert "entries" in reader.ask("audit_log", limit=5)
        assert "--results" in reader.refused("experiment_results")
        assert "no tool 'request_behaviour'" in reader.refused("request_behaviour", **GOAL)
        assert "a model cannot release an e-stop" in reader.refused("release_estop")
        uris = {str(each.uri) for each in reader.do(reader.session.list_resources).resources}
        assert {"fullswarm://guide", "fullswarm://keys", "fullswarm://schema/EStop"} <= uris
        guide = reader.do(reader.session.read_resource, "fullswarm://guide").contents[0].text
        assert "fullswarm estop --clear" in guide
        with pytest.raises(Exception, match="no resource"):
            reader.do(reader.session.read_resource, "file:///etc/passwd")


def test_a_model_moves_only_robots_that_it_holds_and_what_it_has_tried_first(claude: Model, anna: Swarm) -> None:
    assert "you do not hold r1" in claude.refused("request_behaviour", **GOAL)
    held = claude.ask("take_lease", robots=["r1"], seconds=60)
    assert (held["held"], held["operator"]) == (["r1"], "mcp/claude")
    plain = {**GOAL, "behaviour": "move_to_goal"}
    assert "without the safety filter" in claude.refused("request_behaviour", **plain)
    assert "you do not hold r2" in claude.refused("request_behaviour", **{**GOAL, "robots": ["r1", "r2"]})
    wrong = claude.ask("request_behaviour", **{**GOAL, "parameters": {"gaol": [1, 1]}})
    assert "token" not in wrong
    assert "gaol" in wrong["problems"][0]
    tried = claude.ask("request_behaviour", **GOAL)
    assert (tried["core_accepts"], tried["would_send"]["robots"]) == (True, ["r1"])
    assert not claude.row("r1")["behaviour"], "a dry run moves nothing"
    assert "needs the token" in claude.refused("request_behaviour", **GOAL, dry_run=False)
    other = {**GOAL, "parameters": {"goal": [60.0, 3.0]}}
    assert "another request" in claude.refused("request_behaviour", **other, dry_run=False, token=tried["token"])
    token = claude.token(GOAL)
    sent = claude.ask("request_behaviour", **GOAL, dry_run=False, token=token)
    assert sent["status"]["running"] == ["r1"]
    assert "was used" in claude.refused("request_behaviour", **GOAL, dry_run=False, token=token)
    with pytest.raises(RequestRefused, match="held by mcp/claude"):
        anna.request("flocking_bc", robots="r1")
    place = {"r1": (0.0, 0.0)}

    def arrived() -> bool:
        place.update({row.robot: (row.x_m, row.y_m) for row in anna.state.robots})
        return math.dist(place["r1"], (5.0, 3.0)) < 0.3

    until(arrived, 30.0, lambda: str(place))
    entries = claude.ask("audit_log", operator="mcp/claude")["entries"]
    assert any(each["act"] == "request" and each["robots"] == ["r1"] for each in entries)
    assert claude.ask("release_lease")["released"] == ["r1"]
    assert "you do not hold r1" in claude.refused("request_behaviour", **GOAL)


def test_a_model_takes_no_robot_from_people_loses_robots_to_them_and_its_leases_end(claude: Model, anna: Swarm) -> None:
    with anna.lease("r2"):
        assert "r2 is held by anna" in claude.refused("take_lease", robots=["r1", "r2"])
        slowly(lambda: claude.leases() == ["r2 anna"])  # all or none
    claude.ask("take_lease", robots=["r2"])
    with anna.lease("r2", take=True):
        slowly(lambda: claude.leases() == ["r2 anna"])
        assert "you do not hold r2" in claude.refused("request_behaviour", **{**GOAL, "robots": ["r2"]})
    claude.ask("take_lease", robots=["r1"], seconds=1)
    slowly(lambda: claude.leases() == [])
    assert "you do not hold r1" in claude.refused("request_behaviour", **GOAL)


def test_an_estop_of_a_model_holds_until_a_person_releases_it(claude: Model, anna: Swarm, up: Up) -> None:
    claude.ask("take_lease", robots=["r1", "r2"])
    claude.send(FLOCK)
    found = claude.ask("engage_estop", reason="a person is there")
    assert sorted(found["latched"]) == ["r1", "r2"]
    assert all(each["standing"] for each in found["latched"].values())
    for name in ("release_estop", "clear_estop", "reset_estop"):
        assert "a model cannot release an e-stop" in claude.refused(name)
    assert "engaged" in claude.refused("engage_estop", engaged=False)
    slowly(lambda: claude.row("r1")["estop"] and claude.row("r2")["estop"])
    assert claude.ask("request_behaviour", **FLOCK)["latched_robots_refuse"] == ["r1", "r2"]
    token = claude.token(FLOCK)
    assert "e-stop is latched" in claude.refused("request_behaviour", **FLOCK, dry_run=False, token=token)
    status = json.loads(up.cli("status", "--json").stdout)["robots"]
    assert [each["estop"] for each in status] == [True, True]
    anna.clear_estop()
    claude.send(FLOCK)
    claude.ask("stop_robots")
    until(lambda: all(row.health and not row.health.behaviour for row in anna.state.robots))


def test_a_hostile_client_harms_neither_the_server_nor_the_swarm(claude: Model, anna: Swarm, up: Up) -> None:
    chance = random.Random(21)
    values: list[Any] = [
        None,
        -1,
        10**400,
        1e308,
        "x" * 10**5,
        "\u202e\x1b[2J",
        [[[]]] * 50,
        {"a": {"b": []}},
        True,
        ["r1"] * 999,
    ]
    tools = {each.name: each for each in claude.do(claude.session.list_tools).tools}
    names = [name for name in tools if name not in ("engage_estop", "stop_robots")]

    async def attack() -> bool:
        name = chance.choice(names)
        keys = [*tools[name].input_schema.get("properties", {}), "other"]
        given = {key: chance.choice(values) for key in chance.sample(keys, min(2, len(keys)))}
        found = await claude.session.call_tool(name, given)
        assert "bug in fullswarm" not in text_of(found), (name, text_of(found)[:300])
        assert not found.is_error or len(text_of(found)) < 1500
        return bool(found.is_error)

    async def flood() -> None:
        flooding = [asyncio.ensure_future(attack()) for _ in range(300)]
        await asyncio.sleep(0)  # they are sent before the stop
        stop = await claude.session.call_tool("stop_robots", {})
        assert not stop.is_error, "a stop is not refused in a flood"
        assert sum(await asyncio.gather(*flooding)) > 200

    claude.do(flood)
    server = next(each for each in psutil.Process().children(recursive=True) if "mcp" in each.cmdline())
    assert server.memory_info().rss < 300e6
    slowly(lambda: not claude.call("release_lease").is_error)
    assert [row.health.behaviour for row in anna.state.robots if row.health] == ["", ""]
    assert anna.request("flocking_bc").wait_started() == ("r1", "r2"), "the swarm is as before"
    anna.stop()
    assert "Traceback" not in up.errors.read_text()


def test_stdout_carries_the_protocol_only_and_without_a_hub_it_says_so() -> None:
    first = {
        "jsonrpc": "2.0", "id": 1, "method": "initialize",
        "params": {"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": {"name": "t", "version": "1"}},
    }  # fmt: skip
    call = {"jsonrpc": "2.0", "id": 2, "method": "tools/call", "params": {"name": "swarm_status"}}
    process = subprocess.Popen(
        [sys.executable, "-m", "fullswarm", "mcp", "--hub", "tcp/127.0.0.1:9"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("no message\n" + json.dumps(first) + "\n" + json.dumps(call) + "\n")
    process.stdin.flush()
    answers = [json.loads(process.stdout.readline()) for _ in range(3)]
    assert [each.get("id") for each in answers] == [None, 1, 2]
    assert "no hub answers" in answers[2]["result"]["content"][0]["text"]
    rest, errors = process.communicate(timeout=20)  # closes stdin, which ends it
    assert (process.returncode, rest) == (0, "")
    assert errors.startswith("MCP server for swarm 'swarm'")
    assert "Traceback" not in errors
