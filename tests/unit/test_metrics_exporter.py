"""Metrics for Prometheus: values, names, what disappears, and what strangers on the bus or on the port can do.

The text is read by the parsers of ``prometheus_client`` and by a plain reading of lines that is written here.
"""

from __future__ import annotations

import asyncio
import math
import re
import socket
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import pytest
from prometheus_client.openmetrics.parser import text_string_to_metric_families as read_openmetrics
from prometheus_client.parser import text_string_to_metric_families as read_text

from fullswarm.bus.local import LocalBus
from fullswarm.clock import MonotonicClock, SimClock
from fullswarm.exporter.newest import GONE_S, MOST_ROBOTS, SwarmNode
from fullswarm.exporter.serve import CACHE_S, Metrics
from fullswarm.keys import TRUTH, Keys
from fullswarm.messages import (
    ChargingStatus,
    DockState,
    HealthReport,
    Heartbeat,
    Interventions,
    Lease,
    Leases,
    Message,
    ProcessReport,
    ProcessState,
    RequestStatus,
    RobotCharge,
    RobotMeasurement,
    Summary,
)
from fullswarm.operator.console.access import Names, Server, uvicorn_server
from fullswarm.runtime import Runtime
from tests.unit.test_viewer import health
from tests.unit.wild import Wild

LINE = re.compile(r"(?P<name>[a-z_][a-z0-9_]*)(\{(?P<labels>.*)\})? (?P<value>\S+)\Z")
UNITS = re.compile(r"_(milli|kilo|micro|nano)|_(ms|us|km|cm|mm|percent|hours?|minutes?|degrees?|deg|celsius)(_|\Z)")
PATIENCE_S = 15.0


def openmetrics(text: str) -> Iterator[Any]:
    """Return the families of a text in the OpenMetrics format; a `ValueError` names what is wrong with it."""
    return iter(read_openmetrics(text))  # type: ignore[no-untyped-call]  # the library's parser has no types


class Bench:
    """An exporter on a bus within this process, in simulated time."""

    def __init__(self) -> None:
        self.clock = SimClock()
        self.runtime = Runtime(self.clock)
        self.bus, self.keys = LocalBus(self.runtime.mailbox), Keys("s")
        self.node = SwarmNode(self.bus, self.keys, self.runtime)
        self.metrics = Metrics("s", self.node, self.runtime.now_s)

    def say(self, key: str, message: Message) -> None:
        self.bus.publish(key, message)

    def run(self, seconds: float) -> None:
        self.runtime.run(seconds)

    def text(self, as_openmetrics: bool = False) -> str:
        self.run(2 * CACHE_S)
        return self.metrics._text(as_openmetrics).decode()

    def samples(self) -> dict[tuple[str, str], float]:
        """Return the values of this project's metrics by name and labels, as plain lines have them."""
        found = {}
        for line in self.text().splitlines():
            if line.startswith("fullswarm_"):
                match = LINE.match(line)
                assert match is not None, line
                key = match["name"].removeprefix("fullswarm_"), match["labels"] or ""
                assert key not in found, line
                found[key] = float(match["value"])
        return found


def swarm(bench: Bench) -> None:
    """Publish something of everything."""
    keys = bench.keys
    charge = RobotCharge(id="c1", dock="d1", phase="going")
    one = health(
        "r1", lifecycle="ACTIVE", behaviour="flocking", moving=True, battery=0.25, charging=False, collisions=3,
        contacts=1, deviation_m=1.5, deviation_m_s=0.25, position_sigma_m=0.01, charge=charge,
    )  # fmt: skip
    two = health(
        "r2", lifecycle="FAULT", estop=True, fault="no port", fault_code="driver", behaviour="flocking",
        stop_reason="its driver is in FAULT", stop_code="invented by somebody",
    )  # fmt: skip
    report = HealthReport(
        host="west", process="p1", version="1.0", robots=(*one.robots, *two.robots), ticks=100, late_ticks=7,
        missed_ticks=2, worst_late_s=0.05, dropped={"states": 4, "a b": 1, "c d": 2}, wall_offset_s=-0.5,
        round_trip_s=0.003,
    )  # fmt: skip
    bench.say(keys.health("west"), report)
    columns: dict[str, tuple[float, ...]] = {
        "x_m": (1.0, 2.0),
        "distance_m": (10.0, math.nan),
        "goal_m": (math.inf, 0.5),
    }
    totals = {"sent": 50.0, "received": 60.0}
    seen: dict[str, tuple[float, ...]] = {"x_m": (7.0, 8.0), "distance_m": (9.0, 9.0), "goal_m": (9.0, 9.0)}
    for host, values in (("west", columns), (TRUTH, seen)):
        measured = RobotMeasurement(
            host=host, process="p1", robots=("r1", "r2"), columns=values, totals=totals, stamp_s=0.0
        )  # fmt: skip
        bench.say(keys.measurement("robots", host), measured)
    bench.say(keys.heartbeat("core"), Heartbeat(node="core", process="p", sequence=1, active=("a", "b")))
    state = ProcessState(name="hub", phase="running", starts=2)
    bench.say(keys.processes("base"), ProcessReport(host="base", processes=(state,)))
    summed = {"total_m": 12.0, "truth_total_m": 11.0, "invented": 1.0, "elapsed_s": 3.0}
    bench.say(keys.summary("work"), Summary(metric="work", values=summed))
    bench.say(keys.summary("invented"), Summary(metric="invented", values={"total_m": 1.0}))
    for phase in ("accepted", "running", "running", "ended"):
        status = RequestStatus(request_id="q", behaviour="flocking", phase=phase)
        bench.say(keys.behaviour_status, status)
    bench.say(keys.leases, Leases(leases=(Lease(robot="r1", operator="anna", age_s=1.0),)))
    dock = DockState(dock="d1", x_m=0.0, y_m=0.0, heading_rad=0.0, approach_m=1.0, robot="r1", phase="going")
    bench.say(keys.charging_status, ChargingStatus(docks=(dock,), waiting=("r2",)))


def intervene(bench: Bench, *robots: str) -> None:
    many = len(robots)
    message = Interventions(
        host="west", robots=robots, x_m_s=(0.1,) * many, y_m_s=(0.0,) * many, reasons=("r2",) * many
    )
    bench.say(bench.keys.intervention("west"), message)


def test_a_scrape_has_what_the_swarm_reports() -> None:
    bench = Bench()
    swarm(bench)
    for robots in (("r1",), ("r1",), (), ("r1",)):
        intervene(bench, *robots)
        bench.run(0.2)
    found = bench.samples()
    expected = {
        ("exporter_hub_connected", ""): 1, ("swarm_info", 'swarm="s",version="0.1.0"'): 1,
        ("robot_moving", 'robot="r1"'): 1, ("robot_moving", 'robot="r2"'): 0,
        ("robot_estop", 'robot="r1"'): 0, ("robot_estop", 'robot="r2"'): 1,
        ("robot_battery_ratio", 'robot="r1"'): 0.25, ("robot_charging", 'robot="r1"'): 0,
        ("robot_collisions_total", 'robot="r1"'): 3, ("robot_contacts", 'robot="r1"'): 1,
        ("robot_filter_deviation_meters_total", 'robot="r1"'): 1.5,
        ("robot_position_sigma_meters", 'robot="r1"'): 0.01,
        ("robot_lifecycle", 'robot="r1",state="ACTIVE"'): 1, ("robot_lifecycle", 'robot="r2",state="ACTIVE"'): 0,
        ("robot_lifecycle", 'robot="r2",state="FAULT"'): 1,
        ("robot_behaviour", 'behaviour="flocking",robot="r1"'): 1,
        ("robot_fault", 'code="driver",robot="r2"'): 1, ("robot_stopped", 'code="other",robot="r2"'): 1,
        ("robot_charge_phase", 'phase="going",robot="r1"'): 1,
        ("robot_filter_active", 'robot="r1"'): 1, ("robot_filter_active", 'robot="r2"'): 0,
        ("robot_filter_interventions_total", 'robot="r1"'): 2,
        ("robot_x_meters", 'robot="r1"'): 1, ("robot_x_meters", 'robot="r2"'): 2,
        ("robot_distance_meters_total", 'robot="r1"'): 10, ("robot_goal_distance_meters", 'robot="r2"'): 0.5,
        ("agent_sent_messages_total", 'host="west"'): 50, ("agent_received_messages_total", 'host="west"'): 60,
        ("agent_ticks_total", 'host="west"'): 100, ("agent_late_ticks_total", 'host="west"'): 7,
        ("agent_missed_ticks_total", 'host="west"'): 2, ("agent_worst_tick_delay_seconds", 'host="west"'): 0.05,
        ("agent_dropped_messages_total", 'cause="states",host="west"'): 4,
        ("agent_dropped_messages_total", 'cause="other",host="west"'): 3,
        ("agent_core_round_trip_seconds", 'host="west"'): 0.003,
        ("agent_wall_clock_offset_seconds", 'host="west"'): -0.5,
        ("node_active_requests", 'node="core"'): 2,
        ("process_phase", 'host="base",phase="running",process="hub"'): 1,
        ("process_phase", 'host="base",phase="frozen",process="hub"'): 0,
        ("process_starts_total", 'host="base",process="hub"'): 2,
        ("requests_total", 'phase="running"'): 1, ("requests_total", 'phase="ended"'): 1,
        ("leases", ""): 1, ("docks", 'phase="going"'): 1, ("docks", 'phase="free"'): 0,
        ("docks_waiting_robots", ""): 1,
        ("summary", 'metric="work",quantity="total_m"'): 12, ("summary", 'metric="work",quantity="truth_total_m"'): 11,
    }  # fmt: skip
    assert {key: found.get(key) for key in expected} == expected
    absent = {
        ("robot_battery_ratio", 'robot="r2"'), ("robot_charging", 'robot="r2"'), ("robot_fault", 'code="",robot="r1"'),
        ("robot_distance_meters_total", 'robot="r2"'), ("robot_goal_distance_meters", 'robot="r1"'),
        ("agent_sent_messages_total", 'host="truth"'),
    }  # fmt: skip
    assert not absent & found.keys()
    assert not any("invented" in labels for _, labels in found)
    assert found["robot_last_message_age_seconds", 'robot="r1"'] == pytest.approx(0.8 + 2 * CACHE_S)


def test_names_and_units_are_those_of_prometheus() -> None:
    bench = Bench()
    swarm(bench)
    intervene(bench, "r1")
    for reader, text in ((read_text, bench.text()), (openmetrics, bench.text(as_openmetrics=True))):
        families = list(reader(text))
        assert len({each.name for each in families}) == len(families) > 30
        for each in families:
            for sample in each.samples:
                assert (each.type == "counter") == sample.name.endswith("_total"), sample
                assert all(len(value) <= 64 for value in sample.labels.values())
            if each.name.startswith("fullswarm_"):
                assert each.documentation.endswith(".")
                assert not UNITS.search(each.name)


def test_what_is_gone_disappears() -> None:
    bench = Bench()
    swarm(bench)
    bench.run(GONE_S - 1.0)
    assert ("robot_moving", 'robot="r1"') in bench.samples()
    bench.say(bench.keys.health("r3"), health("r3"))
    bench.run(2.0)
    found = {key for key in bench.samples() if "robot=" in key[1] or "host=" in key[1] or "node=" in key[1]}
    assert found
    assert all('"r3"' in labels for _, labels in found)
    assert not any(name in ("leases", "docks", "summary") for name, _ in bench.samples())
    bench.run(GONE_S + 10.0)
    assert not any("robot=" in labels for _, labels in bench.samples())
    assert not bench.node.robots._values


def test_invented_names_push_no_robot_out_and_fill_nothing() -> None:
    bench = Bench()
    for number in range(MOST_ROBOTS + 3000):
        if number % 400 == 0:
            bench.say(bench.keys.health("r1"), health("r1", battery=0.5))
            bench.run(0.5)
        name = f"x{number}"
        bench.say(bench.keys.health(name), health(name))
    odd = 'a"b\n{c}', "x" * 200, "", "ä"
    for name in odd:
        bench.say(bench.keys.health("odd"), health(name, make="y" * 5000, model='"\n\\'))
    found = bench.samples()
    robots = {labels for name, labels in found if name == "robot_moving"}
    assert 'robot="r1"' in robots
    assert len(robots) <= MOST_ROBOTS
    assert found["exporter_refused_messages_total", ""] >= len(odd)
    assert len(bench.node.robots._values) <= MOST_ROBOTS
    assert list(read_text(bench.text()))


@pytest.mark.parametrize("seed", range(4))
def test_any_message_that_decodes_leaves_a_text_that_prometheus_reads(seed: int) -> None:
    bench, wild = Bench(), Wild(seed, ("r1", "r2", "core", "work", "coverage", "truth"), misfits=0.0)
    kinds = (
        HealthReport, RobotMeasurement, Heartbeat, ProcessReport, Summary, RequestStatus, Interventions, Leases,
        ChargingStatus,
    )  # fmt: skip
    keys = bench.keys
    where: dict[type[Message], str] = {
        HealthReport: keys.health("r1"), RobotMeasurement: keys.measurement("robots", "r1"),
        Heartbeat: keys.heartbeat("core"), ProcessReport: keys.processes("h"), Summary: keys.summary("work"),
        RequestStatus: keys.behaviour_status, Interventions: keys.intervention("r1"), Leases: keys.leases,
        ChargingStatus: keys.charging_status,
    }  # fmt: skip
    for _ in range(100):
        kind = wild.chance.choice(kinds)
        bench.say(where[kind], wild.message(kind))
        bench.run(0.05)
        if wild.chance.random() < 0.2:
            assert list(read_text(bench.text()))
    assert list(openmetrics(bench.text(as_openmetrics=True)))


# ---------------------------------------------------------------- the port
class Port:
    """The exporter's server on a real port."""

    def __init__(self, bench: Bench, server: Server, number: int) -> None:
        self.bench, self.server, self.number = bench, server, number

    async def ask(self, text: str | bytes) -> tuple[int, bytes]:
        """Return status and body of the answer to raw bytes; 0: closed without one."""
        reader, writer = await asyncio.open_connection("127.0.0.1", self.number)
        writer.write(text.encode() if isinstance(text, str) else text)
        try:
            async with asyncio.timeout(PATIENCE_S):
                answer = await reader.read(-1)
        except ConnectionError:
            answer = b""
        finally:
            writer.close()
        head, _, body = answer.partition(b"\r\n\r\n")
        return (int(head.split()[1]) if head.startswith(b"HTTP/") else 0), body

    async def get(self, path: str = "/metrics", host: str = "", more: str = "") -> tuple[int, bytes]:
        host = host or f"127.0.0.1:{self.number}"
        return await self.ask(f"GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n{more}\r\n")


def on_port(test: Callable[[Port], Awaitable[None]]) -> None:
    async def run() -> None:
        bench = Bench()
        swarm(bench)
        bench.run(0.1)
        bench.metrics = Metrics("s", bench.node, MonotonicClock().now_s)
        with socket.create_server(("127.0.0.1", 0)) as listener:
            number = listener.getsockname()[1]
            server = uvicorn_server(bench.metrics.app(Names("127.0.0.1", number, frozenset({"base"}))))
            serving = asyncio.create_task(server.serve([listener]))
            try:
                async with asyncio.timeout(60):
                    await test(Port(bench, server, number))
            finally:
                server.should_exit = True
                await serving

    asyncio.run(run())


def test_prometheus_gets_the_format_that_it_asks_for() -> None:
    async def test(port: Port) -> None:
        code, body = await port.get()
        assert code == 200
        names = {each.name for each in read_text(body.decode())}
        assert {"fullswarm_robot_moving", "process_resident_memory_bytes"} <= names
        accept = "Accept: application/openmetrics-text;version=1.0.0;q=0.5,text/plain;version=0.0.4;q=0.3,*/*;q=0.1\r\n"
        code, body = await port.get(more=accept)
        assert code == 200
        assert body.endswith(b"# EOF\n")
        assert {each.name for each in openmetrics(body.decode())} >= {"fullswarm_robot_moving"}

    on_port(test)


def test_other_requests_are_refused() -> None:
    async def test(port: Port) -> None:
        host = f"Host: 127.0.0.1:{port.number}\r\n"
        assert (await port.get("/"))[0] == 200
        assert (await port.get("/etc/passwd"))[0] == 404
        assert (await port.get(host="evil.example"))[0] == 403
        assert (await port.get(host="base"))[0] == 200
        assert (await port.get(more="Origin: https://evil.example\r\n"))[0] == 403
        assert (await port.ask(f"POST /metrics HTTP/1.1\r\n{host}Connection: close\r\nContent-Length: 0\r\n\r\n"))[
            0
        ] == 405
        for garbage in (b"\x16\x03\x01\x02\x00\x01", b"GET\r\n\r\n", b"\x00" * 2000):
            assert (await port.ask(garbage))[0] == 400
        assert (await port.ask(f"GET /metrics HTTP/1.1\r\n{host}X: {'y' * 200_000}\r\n\r\n"))[0] in (0, 400)
        odd = "Accept: application/openmetrics-text; version=nonsense; escaping=a\r\n"
        assert (await port.get(more=odd))[0] == 200

    on_port(test)


def test_idle_connections_and_half_requests_keep_prometheus_out_for_no_time() -> None:
    async def test(port: Port) -> None:
        port.server.server_state.unverified.header_s = 0.5
        idle: list[Any] = []
        for number in range(400):
            made = socket.create_connection(("127.0.0.1", port.number))
            made.setblocking(False)
            made.send(b"GET /metrics HTTP/1.1\r\nX: " if number % 2 else b"G")
            idle.append(made)
            await asyncio.sleep(0)
        assert (await port.get())[0] == 200
        assert len(port.server.server_state.connections) <= 200
        async with asyncio.timeout(PATIENCE_S):
            while port.server.server_state.connections:  # closed as their headers do not end
                await asyncio.sleep(0.02)
        for each in idle:
            each.close()

    on_port(test)


def test_a_flood_of_scrapes_is_answered_from_one_text() -> None:
    made = 0

    async def test(port: Port) -> None:
        collect = port.bench.node.robots.items

        def counted() -> Any:
            nonlocal made
            made += 1
            return collect()

        port.bench.node.robots.items = counted  # type: ignore[method-assign]
        began_s = MonotonicClock().now_s()
        answers = await asyncio.gather(*(port.get() for _ in range(60)))
        took_s = MonotonicClock().now_s() - began_s
        assert [code for code, _ in answers].count(200) >= 30
        assert made <= 2 * (2 + took_s / CACHE_S)  # a text reads the table twice

    on_port(test)
