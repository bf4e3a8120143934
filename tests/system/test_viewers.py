"""`fullswarm viewer` and `fullswarm metrics` beside a swarm of real processes.

The viewer's client is the ``websockets`` library, the metrics are read by the parser of ``prometheus_client``.
"""

from __future__ import annotations

import contextlib
import json
import signal
import struct
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families
from rerun.chunk import RrdReader
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from fullswarm.config import SwarmConfig
from fullswarm.launch.network import on_free_ports
from tests.system.live import LiveSwarm
from tests.waiting import until

PATIENCE_S = 60.0
CONFIG = {"world": {"engine": "kinematic"}, "robot": [{"id": "r1"}, {"id": "r2"}]}


@pytest.fixture(scope="module")
def swarm() -> Iterator[LiveSwarm]:
    made = LiveSwarm(CONFIG, watch=False)
    yield made
    made.close()


@contextlib.contextmanager
def serving(swarm: LiveSwarm, *command: str) -> Iterator[dict[str, str]]:
    """Run a server beside the swarm; yield what it prints once it listens. At the end it obeys Ctrl-C."""
    process = swarm.spawn(*command, "--listen", "127.0.0.1:0", "--json")
    try:
        yield served(process)
        process.send_signal(signal.SIGINT)
        assert "Traceback" not in process.communicate(timeout=30)[1]
        assert process.returncode == 130
    finally:
        process.kill()
        process.communicate()


def served(process: subprocess.Popen[str]) -> dict[str, str]:
    """Return what a server prints once it listens."""
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line, process.stderr.read() if process.stderr else ""
    found: dict[str, str] = json.loads(line)
    return found


def messages(client: ClientConnection, *topics: str) -> Iterator[tuple[str, Any]]:
    """Subscribe to topics as they are announced; yield what comes of them."""
    names: dict[int, str] = {}
    while True:
        frame = client.recv(timeout=PATIENCE_S)
        if isinstance(frame, bytes):
            operation, number, _ = struct.unpack_from("<BIQ", frame)
            assert operation == 1
            yield names[number], json.loads(frame[13:])
            continue
        found = json.loads(frame)
        new = {each["id"]: each["topic"] for each in found.get("channels", ()) if each["topic"] in topics}
        names |= new
        if new:
            client.send(
                json.dumps({"op": "subscribe", "subscriptions": [{"id": each, "channelId": each} for each in new]})
            )


def test_a_viewer_sees_the_live_swarm_and_its_end_harms_nothing(swarm: LiveSwarm) -> None:
    with serving(swarm, "viewer", "foxglove") as address:
        assert address["foxglove"].endswith(address["url"])
        names = [Subprotocol("foxglove.sdk.v1")]
        with connect(address["url"], subprotocols=names, proxy=None, close_timeout=1) as client:
            seen: set[str] = set()
            for topic, message in messages(client, "/robots", "/state/all/r1", "/heartbeat/core"):
                rows = message["robots"] if topic == "/robots" else ()
                if topic != "/robots" or [each["lifecycle"] for each in rows] == ["READY", "READY"]:
                    seen.add(topic)
                if len(seen) == 3:
                    break
        taken = swarm.cli("viewer", "foxglove", "--listen", address["url"].removeprefix("ws://"))
        assert (taken.returncode, taken.stdout) == (3, "")
        assert "cannot listen" in taken.stderr
    swarm.until(swarm.ready, PATIENCE_S, "all robots and the core are there")


def test_a_layout_names_the_robots_of_the_live_swarm(swarm: LiveSwarm) -> None:
    made = swarm.cli("viewer", "layout")
    assert made.returncode == 0, made.stderr
    paths = json.loads(made.stdout)["configById"]["Plot!speeds"]["paths"]
    assert [each["label"] for each in paths] == ["r1", "r2"]


def values(url: str) -> dict[tuple[str, str], float]:
    """Return what a scrape has, by name and robot or node."""
    with urllib.request.urlopen(url, timeout=10) as answer:
        families = text_string_to_metric_families(answer.read().decode())
    return {
        (sample.name, sample.labels.get("robot", sample.labels.get("node", ""))): sample.value
        for each in families
        for sample in each.samples
    }


def test_prometheus_can_scrape_the_swarm(swarm: LiveSwarm) -> None:
    wanted = {(f"fullswarm_robot_{what}", robot) for what in ("x_meters", "estop") for robot in ("r1", "r2")}
    wanted.add(("fullswarm_node_heartbeat_age_seconds", "core"))
    with serving(swarm, "metrics") as address:
        url = address["url"]
        until(lambda: wanted <= values(url).keys(), PATIENCE_S, "all is there")
        found = values(url)
        assert found["fullswarm_exporter_hub_connected", ""] == 1
        assert found["fullswarm_robot_estop", "r1"] == 0
        assert found["fullswarm_node_heartbeat_age_seconds", "core"] < 5
        assert swarm.cli("estop", "r1").returncode == 0
        until(lambda: values(url)["fullswarm_robot_estop", "r1"] == 1, PATIENCE_S, "the e-stop shows")
        assert swarm.cli("estop", "--clear").returncode == 0


def test_an_exporter_waits_for_a_hub_and_a_viewer_says_that_there_is_none() -> None:
    free = on_free_ports(SwarmConfig(), prefer_configured=False).hub.endpoint
    exporter, viewer = (
        subprocess.Popen(
            [sys.executable, "-m", "fullswarm", *command, "--hub", free, "--listen", "127.0.0.1:0", "--json"],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for command in (("metrics",), ("viewer", "foxglove"))
    )  # fmt: skip
    try:
        with urllib.request.urlopen(served(exporter)["url"], timeout=10) as answer:
            assert b"fullswarm_exporter_hub_connected 0.0\n" in answer.read()
        out, err = viewer.communicate(timeout=PATIENCE_S)
        assert (viewer.returncode, out) == (3, "")
        assert "no hub answers" in err
    finally:
        for each in (exporter, viewer):
            each.kill()
            each.communicate()


def test_a_live_swarm_is_drawn_for_rerun_until_ctrl_c(swarm: LiveSwarm, tmp_path: Path) -> None:
    out = tmp_path / "live.rrd"
    process = swarm.spawn("viewer", "rerun", "--save", str(out))
    try:
        until(lambda: out.exists() and out.stat().st_size > 20_000, PATIENCE_S, "nothing is drawn")
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=30)[1]
    finally:
        process.kill()
        process.communicate()
    assert (process.returncode, "Traceback" in said) == (130, False)
    assert f"goes to {out}" in said
    names = [
        row["Cylinders3D:labels"]
        for chunk in RrdReader(out).stream()
        if chunk.entity_path == "/world/robots"
        for row in chunk.to_record_batch().to_pylist()
    ]
    assert names[-1] == ["r1", "r2"]
