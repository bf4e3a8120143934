"""The console as people start it, with a real swarm behind it: driven over its socket as a page does."""

from __future__ import annotations

import contextlib
import json
import resource
import socket
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import psutil
import pytest
from websockets.client import ClientProtocol
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin
from websockets.uri import parse_uri

from tests.system.live import LiveSwarm

CONFIG = {
    "world": {"engine": "kinematic", "bounds_m": [0, 0, 10, 10]},
    "robot": [{"id": f"r{number}", "pose": [2.0 * number, 2.0, 0.0]} for number in (1, 2, 3)],
    "groups": {"scouts": ["r1", "r2"]},
}
TOLD_S = 1.5


class Browser:
    """A page: one line to the console, and everything it was told."""

    def __init__(self, swarm: LiveSwarm, url: str, session: str) -> None:
        self.swarm, self.ref = swarm, 0
        self.frames: list[dict[str, Any]] = []
        origin, _, token = url.partition("/#token=")
        self.stack = ExitStack()
        self.line: ClientConnection = self.stack.enter_context(
            connect(origin.replace("http", "ws") + "/ws", origin=Origin(origin), max_size=None, proxy=None)
        )
        self.line.send(json.dumps({"t": "hello", "token": token, "session": session, "name": "test"}))
        self.took_s = self.until(lambda: bool(self.all("hello")), "the greeting")

    def read(self) -> None:
        """Take what has come, and wait for nothing."""
        while True:
            try:
                self.frames.append(json.loads(self.line.recv(timeout=0.0)))
            except TimeoutError:
                return

    def all(self, kind: str) -> list[dict[str, Any]]:
        return [frame for frame in self.frames if frame["t"] == kind]

    def last(self, kind: str) -> dict[str, Any]:
        return self.all(kind)[-1]

    def until(self, condition: Callable[[], bool], what: str, timeout_s: float = 20.0) -> float:
        def check() -> bool:
            self.read()
            return condition()

        return self.swarm.until(check, timeout_s, what)

    def say(self, t: str, **fields: Any) -> dict[str, Any]:
        self.ref += 1
        self.line.send(json.dumps({"t": t, "ref": self.ref, **fields}))
        self.until(lambda: any(each["ref"] == self.ref for each in self.all("answer")), f"an answer to {t}")
        return next(each for each in self.all("answer") if each["ref"] == self.ref)

    def sees_all(self) -> bool:
        if not (self.all("fleet") and self.all("state") and self.last("fleet")["core_age_s"] is not None):
            return False
        return len(self.last("fleet")["robots"]) == len(self.last("state")["robots"]) == 3

    def x_m(self, robot: str) -> float:
        return next(float(row[1]) for row in self.last("state")["robots"] if row[0] == robot)

    def moving(self) -> set[str]:
        return {each["robot"] for each in self.last("fleet")["robots"] if each["moving"]}


@pytest.fixture(scope="module")
def swarm() -> Iterator[LiveSwarm]:
    live = LiveSwarm(CONFIG, watch=False)
    yield live
    live.close()


@pytest.fixture(scope="module")
def console(swarm: LiveSwarm) -> Iterator[str]:
    process = swarm.spawn("console", "--listen", "127.0.0.1:0", "--json")
    try:
        yield _url(process)
    finally:
        process.terminate()
        _, errors = process.communicate(timeout=10.0)
        assert process.returncode == 0, errors
        assert errors == ""


def _url(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line, "the console says nothing"
    return str(json.loads(line)["url"])


@pytest.fixture
def page(swarm: LiveSwarm, console: str) -> Iterator[Browser]:
    browser = Browser(swarm, console, "session-1")
    browser.until(browser.sees_all, "the page shows the swarm")
    yield browser
    browser.stack.close()


def test_a_request_moves_only_who_is_named_and_space_stops_all(page: Browser) -> None:
    before = {robot: page.x_m(robot) for robot in ("r1", "r2", "r3")}
    asked = page.say("request", behaviour="move_to_goal_bc", robots=["@scouts"], parameters={"goal": [5.0, 8.0]})
    assert asked["ok"]
    page.until(lambda: page.moving() == {"r1", "r2"}, "both scouts move")
    page.until(lambda: abs(page.x_m("r1") - before["r1"]) > 0.2, "r1 has come a way")
    assert page.x_m("r3") == pytest.approx(before["r3"], abs=0.02)
    assert page.last("goals")["robots"]["r1"]["goal"] == [5.0, 8.0]
    page.until(lambda: {each["robot"] for each in page.last("leases")["leases"] if each["mine"]} == {"r1", "r2"},
               "they are ours")  # fmt: skip
    assert page.say("stop")["ok"]
    page.until(lambda: bool(page.all("stop")) and page.last("stop")["done"], "all stand")
    page.until(lambda: page.moving() == set(), "nobody moves")


def test_a_refusal_comes_with_its_reason(page: Browser) -> None:
    asked = page.say("request", behaviour="move_to_goal_bc", parameters={"goal": [1.0, 2.0], "gain": 99.0})
    page.until(lambda: any(each["request_id"] == asked["request_id"] for each in page.all("request")), "a status")
    assert "outside" in page.last("request")["reason"]


def test_an_estop_gets_a_receipt_of_each_robot(page: Browser) -> None:
    page.say("request", behaviour="flocking_bc")
    page.until(lambda: len(page.moving()) == 3, "all move")
    page.say("estop", reason="a test")
    page.until(lambda: bool(page.all("estop")) and page.last("estop")["done"], "all receipts are there")
    assert [each["robot"] for each in page.last("estop")["receipts"]] == ["r1", "r2", "r3"]
    assert all(each["standing"] for each in page.last("estop")["receipts"])
    page.say("clear")
    page.until(lambda: not page.last("estop")["engaged"] and page.last("estop")["done"], "all are released")


def test_a_stick_drives_while_it_is_held_and_not_when_the_page_is_gone(swarm: LiveSwarm, console: str) -> None:
    page = Browser(swarm, console, "session-2")
    page.until(page.sees_all, "the page shows the swarm")

    def hold() -> None:
        sticks = {"angular": 0.5}
        page.line.send(
            json.dumps({"t": "drive", "ref": 1, "behaviour": "drive_bc", "robots": ["r3"], "sticks": sticks})
        )

    held = swarm.runtime.every(0.05, hold)
    page.until(lambda: page.moving() == {"r3"}, "r3 turns")
    held.cancel()
    page.line.socket.shutdown(socket.SHUT_RDWR)  # no goodbye

    def stands() -> bool:
        health = swarm.row("r3").health
        return health is not None and not health.moving

    took_s = swarm.until(stands, 5.0, "r3 stands")
    assert took_s < 1.0


def test_a_dead_core_is_told_and_found_again(swarm: LiveSwarm, page: Browser) -> None:
    page.until(lambda: (page.last("fleet")["core_age_s"] or 9.0) < 0.5, "the core is there")
    swarm.supervisor.kill("core")
    took_s = page.until(lambda: page.last("fleet")["core_age_s"] > 1.0, "the page says so")
    assert took_s < TOLD_S
    assert page.last("fleet")["hub"]
    swarm.supervisor.revive("core")
    page.until(lambda: page.last("fleet")["core_age_s"] < 0.5, "the core is back")
    asked = page.say("request", behaviour="rendezvous_bc", robots=["r2"])
    page.until(
        lambda: any(each["request_id"] == asked["request_id"] and each["running"] for each in page.all("request")),
        "the new core obeys",
    )
    page.say("stop")


def test_a_reload_in_mid_run_loses_nothing(swarm: LiveSwarm, console: str, page: Browser) -> None:
    page.say("request", behaviour="move_to_goal_bc", robots=["r1"], parameters={"goal": [9.0, 9.0]})
    page.until(lambda: page.moving() == {"r1"}, "r1 moves")
    page.stack.close()
    again = Browser(swarm, console, "session-1")
    again.until(lambda: bool(again.all("leases") and again.all("goals")), "the leases")
    hello = again.last("hello")
    assert hello["history"]["trails"]["r1"]
    # By its title, once the console has received the behaviours' records.
    mine = [entry["text"] for entry in hello["history"]["log"] if entry["mine"]]
    assert any("move_to_goal_bc" in text or "Move to goal" in text for text in mine), hello["history"]["log"]
    assert again.last("goals")["robots"]["r1"]["goal"] == [9.0, 9.0]
    assert [each["mine"] for each in again.last("leases")["leases"] if each["robot"] == "r1"] == [True]
    again.say("stop")
    again.until(lambda: again.moving() == set(), "all stand")
    again.stack.close()


def flood(origin: str, count: int, first: bytes = b"") -> list[socket.socket]:
    """Open connections as fast as that goes, of people without the token; each sends `first` and nothing more."""
    address = ("127.0.0.1", int(origin.rpartition(":")[2]))
    opened = [socket.socket() for _ in range(count)]
    for each in opened:
        each.setblocking(False)
        each.connect_ex(address)
    for each in opened:
        with contextlib.suppress(OSError):  # thrown out already
            each.send(first)
    return opened


@pytest.mark.alone
def test_a_thousand_connections_without_a_token_keep_no_operator_out(swarm: LiveSwarm) -> None:
    own = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (own[1], own[1]))
    with contextlib.ExitStack() as stack:
        process = swarm.spawn("console", "--listen", "127.0.0.1:0", "--json")
        stack.callback(process.kill)
        url = _url(process)
        psutil.Process(process.pid).rlimit(psutil.RLIMIT_NOFILE, (1024, 1024))  # usual, and fewer than will come
        origin = url.partition("/#")[0]
        first = Browser(swarm, url, "session-1")
        stack.enter_context(first.stack)
        first.until(first.sees_all, "the page shows the swarm")
        first.say("request", behaviour="flocking_bc")
        first.until(lambda: len(first.moving()) == 3, "all move")
        half = f"GET / HTTP/1.1\r\nHost: {origin.removeprefix('http://')}\r\nX-Half: ".encode()
        upgrade = half.replace(b"/ ", b"/ws ", 1).replace(b"X-Half: ", (
            f"Origin: {origin}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n").encode())  # fmt: skip
        for connections in (flood(origin, 1000), flood(origin, 500, half), flood(origin, 100, upgrade)):
            for each in connections:
                stack.callback(each.close)
        flooded_s = swarm.clock.now_s()
        operator = Browser(swarm, url, "session-2")
        stack.enter_context(operator.stack)
        in_s = swarm.clock.now_s() - flooded_s
        assert operator.say("estop", reason="a test")["ok"]
        swarm.until(lambda: all(row.health and row.health.estop for row in swarm.view.snapshot().robots), 5.0, "e-stop")
        assert in_s < 1.0
        operator.until(lambda: bool(operator.all("estop")) and operator.last("estop")["done"], "all receipts are there")
        operator.say("clear")
        operator.until(lambda: not operator.last("estop")["engaged"] and operator.last("estop")["done"], "released")
        process.terminate()
        took_s = swarm.until(lambda: process.poll() is not None, 10.0, "the console ends")
        assert took_s < 1.0
        assert (process.returncode, process.communicate()[1]) == (0, "")
    resource.setrlimit(resource.RLIMIT_NOFILE, own)


@pytest.mark.alone
def test_it_ends_within_a_second_although_a_page_answers_nothing(swarm: LiveSwarm) -> None:
    process = swarm.spawn("console", "--listen", "127.0.0.1:0", "--json")
    origin, _, token = _url(process).partition("/#token=")
    protocol = ClientProtocol(parse_uri(origin.replace("http", "ws") + "/ws"), origin=Origin(origin))
    with socket.create_connection(("127.0.0.1", int(origin.rpartition(":")[2]))) as line:

        def send() -> None:
            for each in protocol.data_to_send():
                line.sendall(each)

        protocol.send_request(protocol.connect())
        send()
        protocol.receive_data(line.recv(4096))
        protocol.send_text(json.dumps({"t": "hello", "token": token, "session": "session-3"}).encode())
        send()
        assert b'"swarm"' in line.recv(4096)  # it is in, and reads no further
        process.terminate()
        took_s = swarm.until(lambda: process.poll() is not None, 10.0, "the console ends")
    assert took_s < 1.0
    assert (process.returncode, process.communicate()[1]) == (0, "")


def test_ctrl_c_ends_it_and_tells_the_pages(swarm: LiveSwarm) -> None:
    process = swarm.spawn("console", "--listen", "127.0.0.1:0", "--json", "--read-only")
    page = Browser(swarm, _url(process), "session-3")
    assert page.last("hello")["read_only"]
    process.send_signal(2)
    swarm.until(lambda: process.poll() is not None, 10.0, "the console ends")
    assert process.returncode == 130
    with contextlib.suppress(ConnectionClosed):
        while True:
            page.line.recv(timeout=5.0)
    assert page.line.protocol.close_code == 1012
    assert process.communicate()[1] == ""
