"""``from fullswarm import Swarm`` against real processes, with and without asyncio."""

from __future__ import annotations

import ast
import asyncio
import math
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fullswarm import AsyncSwarm, Swarm
from fullswarm.errors import ConfigError, FullswarmError, RequestRefused, TimedOut, Unreachable
from fullswarm.messages import MissionStatus
from tests.system.live import START_S, LiveSwarm

ROBOTS = ("r1", "r2", "r3")


@pytest.fixture(scope="module")
def live() -> Iterator[LiveSwarm]:
    poses = [{"id": robot, "pose": (3.0, 3.0 + 2.0 * row, 0.0)} for row, robot in enumerate(ROBOTS)]
    made = LiveSwarm({"world": {"engine": "kinematic", "walls": False}, "robot": poses}, watch=False)
    yield made
    made.close()


@pytest.fixture
def hub(live: LiveSwarm) -> str:
    return live.config.hub.endpoint


@pytest.fixture
def swarm(hub: str) -> Iterator[Swarm]:
    before = set(threading.enumerate())
    with Swarm(hub, operator="anna") as made:
        made.stop()
        yield made
    left = [each for each in threading.enumerate() if each not in before and each.is_alive()]
    assert left == [], "a thread is left"


def places(swarm: Swarm) -> dict[str, tuple[float, float]]:
    return {row.robot: (row.x_m, row.y_m) for row in swarm.state.robots}


def behaviours(swarm: Swarm) -> list[str]:
    return [row.health.behaviour if row.health else "" for row in swarm.state.robots]


def until(condition: Any, within_s: float = 5.0) -> None:
    end_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def test_a_request_runs_until_its_robots_have_arrived(swarm: Swarm) -> None:
    assert swarm.robots == ROBOTS
    x_m = 5.0 if places(swarm)["r1"][0] < 4.0 else 3.0
    run = swarm.request("move_to_goal_bc", robots="r1", goal=[x_m, 3.0])
    assert run.wait_started() == ("r1",)
    assert run.running
    with pytest.raises(TimedOut, match="has not brought all robots to its goal") as caught:
        run.wait_arrived(0.1)
    assert isinstance(caught.value, TimeoutError)
    assert run.wait_arrived(40.0) == ("r1",)
    assert math.dist(places(swarm)["r1"], (x_m, 3.0)) < 0.2
    swarm.stop()
    far = swarm.request("move_to_goal_bc", robots="r1", goal=[x_m, 15.0])
    swarm.stop()
    with pytest.raises(FullswarmError, match="ended before"):
        far.wait_arrived(10.0)
    with pytest.raises(ConfigError, match="no goal"):
        swarm.request("flocking_bc").wait_arrived()


def test_a_behaviour_that_ends_itself_has_results(swarm: Swarm) -> None:
    x_m, y_m = places(swarm)["r2"]
    run = swarm.request("area_sweep_bc", robots=["r2"], area=[[x_m, y_m - 0.5], [x_m + 1.0, y_m + 0.5]], lane_m=0.5)
    assert {robot: each.outcome for robot, each in run.wait(60.0).items()} == {"r2": "arrived"}
    assert not run.running


def test_refusals_are_errors_with_the_reason(swarm: Swarm) -> None:
    with pytest.raises(RequestRefused, match="flocking_bc"):
        swarm.request("flockign_bc")
    with pytest.raises(RequestRefused, match="r9"):
        swarm.request("flocking_bc", robots=["r9"])
    with pytest.raises(RequestRefused, match="gaol"):
        swarm.request("move_to_goal_bc", gaol=[1.0, 1.0])
    assert behaviours(swarm) == ["", "", ""]


def test_stop_and_cancel_end_what_runs(swarm: Swarm) -> None:
    run = swarm.request("flocking_bc")
    assert run.wait_started() == ROBOTS
    swarm.stop("r1")
    until(lambda: behaviours(swarm) == ["", "flocking_bc", "flocking_bc"])
    other = swarm.request("rendezvous_bc", robots=["r2"])
    other.wait_started()
    run.cancel()
    until(lambda: behaviours(swarm) == ["", "rendezvous_bc", ""])
    run.wait(5.0)
    assert run.phase in ("ended", "superseded")
    swarm.stop()
    other.wait(5.0)
    assert not other.running


def test_an_estop_returns_the_receipts_and_refuses_requests(swarm: Swarm) -> None:
    swarm.request("flocking_bc").wait_started()
    receipts = swarm.estop(reason="test")
    assert sorted(receipts) == list(ROBOTS)
    assert all(each.standing for each in receipts.values())
    with pytest.raises(FullswarmError, match="e-stop"):
        swarm.request("flocking_bc").wait_started()
    assert sorted(swarm.clear_estop()) == list(ROBOTS)
    assert swarm.request("flocking_bc").wait_started() == ROBOTS


def test_an_estop_that_a_robot_never_confirms_is_repeated_once_only(swarm: Swarm) -> None:
    orders = swarm._client._operator._orders
    before = len(orders)
    for _ in range(4):
        with pytest.raises(Unreachable, match="no confirmation of the e-stop from r9"):
            swarm.estop("r9", timeout_s=0.2)
    repeated = [each for each in list(orders.values())[before:] if each._timer is not None and each._timer.active]
    assert len(repeated) == 1
    repeated[0].close()


def test_leases_are_held_for_the_length_of_a_with(swarm: Swarm, hub: str) -> None:
    with Swarm(hub, operator="bert") as other:
        with swarm.lease("r1", "r2") as held:
            assert set(held.robots) == {"r1", "r2"}
            time.sleep(3.0)  # longer than a lease lives without being renewed
            with pytest.raises(RequestRefused, match="held by anna"):
                other.request("flocking_bc", robots=["r1"])
            with pytest.raises(RequestRefused, match="held by anna"), other.lease("r1"):
                pass
            swarm.request("flocking_bc", robots=["r1"]).wait_started()
            with other.lease("r2", take=True):
                until(lambda: held.lost == {"r2": "bert"})
        until(lambda: not swarm.state.leases)
        other.request("flocking_bc", robots=["r1"]).wait_started()


def test_states_come_newest_first_and_end_with_the_swarm(hub: str) -> None:
    swarm = Swarm(hub, operator="anna")
    states = swarm.states()
    next(states)
    time.sleep(1.0)  # a slow reader
    began_s = time.monotonic()
    assert max(row.age_s for row in next(states).robots) < 0.5, "what came meanwhile is left out"
    for _ in range(10):
        next(states)
    assert 0.1 < time.monotonic() - began_s < 5.0
    swarm.close()
    assert list(states) == []
    with pytest.raises(FullswarmError, match="closed"):
        swarm.stop()
    swarm.close()


def test_it_goes_on_when_the_core_is_started_again(swarm: Swarm, live: LiveSwarm) -> None:
    with swarm.lease("r3"):
        run = swarm.request("flocking_bc")
        run.wait_started()
        live.supervisor.kill("core")
        live.supervisor.revive("core")
        until(lambda: any(node.node == "core" and node.age_s < 0.3 for node in swarm.state.nodes), START_S)
        until(lambda: {each.robot for each in swarm.state.leases} == {"r3"}, 10.0)
        until(lambda: behaviours(swarm) == ["flocking_bc"] * 3, 10.0)
        swarm.stop()
        run.wait(10.0)
    swarm.request("rendezvous_bc").wait_started()


def test_the_end_of_a_request_is_learnt_although_it_was_missed(swarm: Swarm) -> None:
    run = swarm.request("flocking_bc")
    run.wait_started()
    client, pending = swarm._client, run._pending
    client.call(lambda: client._operator._pending.pop(run.id)).result()  # deaf to what the core says of it
    swarm.stop()
    time.sleep(4.0)  # the core does not repeat it by itself any more
    assert run.running
    client.call(lambda: client._operator._pending.update({run.id: pending})).result()
    assert run.wait(10.0) == {}
    assert run.phase in ("ended", "superseded")
    assert behaviours(swarm) == ["", "", ""], "asking is not requesting"


WALK: dict[str, Any] = {
    "name": "walk",
    "robots": ["r1", "r2"],
    "steps": [
        {"name": "flock", "behaviour": "flocking_bc", "done": {"confirm": "Enough?"}},
        {"name": "meet", "behaviour": "rendezvous_bc", "done": {"time_s": 0.5}},
    ],
}


def test_a_mission_is_paused_resumed_confirmed_and_waited_for(swarm: Swarm) -> None:
    mission = swarm.start_mission(WALK)
    assert (mission.name, mission.phase, mission.ended) == ("walk", "running", False)
    assert mission.wait_question(10.0) == {"main/flock": "Enough?"}
    until(lambda: behaviours(swarm) == ["flocking_bc", "flocking_bc", ""])
    mission.pause()
    assert (mission.phase, mission.reason) == ("paused", "by anna")
    until(lambda: behaviours(swarm) == ["", "", ""])
    with pytest.raises(RequestRefused, match="does not run: it is paused"):
        mission.confirm()
    with pytest.raises(TimedOut, match=r"has not ended within 0\.1 s: it is paused \(by anna\)"):
        mission.wait(0.1)
    mission.resume()
    assert mission.phase == "running"
    until(lambda: behaviours(swarm) == ["flocking_bc", "flocking_bc", ""])
    with pytest.raises(RequestRefused, match="no step of mission 'walk' waits"):
        mission.confirm("main/meet")
    mission.confirm("main/flock")
    ended = mission.wait(20.0)
    assert (ended.phase, mission.ended, mission.questions) == ("done", True, {})
    assert [step.phase for track in ended.tracks for step in track.steps] == ["done", "done"]
    with pytest.raises(RequestRefused, match="has ended already: done"):
        mission.abort()
    with pytest.raises(FullswarmError, match="is done and asks nothing"):
        mission.wait_question(5.0)


def test_a_mission_of_another_program_is_found_and_aborted(swarm: Swarm, hub: str, tmp_path: Path) -> None:
    file = tmp_path / "roam.toml"
    file.write_text('[[steps]]\nbehaviour = "flocking_bc"\nrobots = ["r3"]\ndone = { time_s = 600 }\n')
    mine = swarm.start_mission(file)
    until(lambda: behaviours(swarm) == ["", "", "flocking_bc"])
    with Swarm(hub, operator="bert") as other:
        (found,) = (each for each in other.missions() if not each.ended)
        assert (found.id, found.name, found.phase) == (mine.id, "roam", "running")
        mine.pause()
        with other.lease("r3"), pytest.raises(RequestRefused, match="r3 is held by bert"):
            mine.resume()
        mine.resume()
        found.abort()
    ended = mine.wait(5.0)
    assert (ended.phase, ended.reason) == ("aborted", "by bert")
    until(lambda: behaviours(swarm) == ["", "", ""])


def test_a_wrong_mission_starts_nothing_and_names_all_that_is_wrong(swarm: Swarm, tmp_path: Path) -> None:
    file = tmp_path / "wrong.toml"
    file.write_text('[[steps]]\nbehaviour = "flockign_bc"\nrobots = ["r9"]\ndone = { time_s = 1 }\n')
    for act in (swarm.start_mission, swarm.check_mission):
        with pytest.raises(ConfigError, match=r"wrong.toml:2: .*flockign_bc") as caught:
            act(file)
        assert "wrong.toml:3" in str(caught.value)
    with pytest.raises(ConfigError, match=r"mission: steps\[0\].robots: .*r9"):
        swarm.start_mission({"steps": [{"robots": ["r9"], "done": {"time_s": 1.0}}]})
    with pytest.raises(ConfigError, match="no such file"):
        swarm.start_mission("missing.toml")
    before = len(swarm.missions())
    swarm.check_mission(WALK)
    assert len(swarm.missions()) == before
    assert behaviours(swarm) == ["", "", ""]


def test_the_end_of_a_mission_is_learnt_although_it_was_missed(swarm: Swarm, hub: str) -> None:
    mission = swarm.start_mission(WALK)
    client = swarm._client
    *_, statuses = client._missions._subscriptions
    client.call(statuses.close).result()  # deaf to what the core says of it by itself
    with Swarm(hub, operator="bert") as other:
        next(each for each in other.missions() if each.id == mission.id).abort()
        waiting = client.mission_ended(mission.id, 20.0)
        with pytest.raises(FullswarmError, match="does not know this mission any more"):
            waiting.result()  # asked, and heard nothing
        assert mission.phase == "running"
        client.call(
            lambda: client._bus.subscribe(client.keys.mission_status, MissionStatus, client._missions._received)
        ).result()
        assert mission.wait(10.0).phase == "aborted"


def test_missions_with_asyncio(hub: str) -> None:
    async def program() -> None:
        async with AsyncSwarm(hub, operator="anna") as swarm:
            await swarm.stop()
            await swarm.check_mission(WALK)
            mission = await swarm.start_mission(WALK)
            assert await mission.wait_question(10.0) == {"main/flock": "Enough?"}
            await mission.pause()
            assert mission.phase == "paused"
            await mission.resume()
            waiting = asyncio.create_task(mission.wait())
            await asyncio.sleep(0.1)
            waiting.cancel()
            with pytest.raises(asyncio.CancelledError):
                await waiting
            assert mission.phase == "running"
            await mission.confirm()
            assert (await mission.wait(20.0)).phase == "done"
            assert mission.id in [each.id for each in await swarm.missions()]
            other = await swarm.start_mission(WALK)
            await other.abort()
            assert other.phase == "aborted"

    asyncio.run(program())


def test_without_hub_or_core_there_is_an_error_that_says_so(hub: str, live: LiveSwarm) -> None:
    threads = threading.active_count()
    with pytest.raises(Unreachable, match="no hub answers"):
        Swarm("tcp/127.0.0.1:9")
    with pytest.raises(ConfigError):
        Swarm("127.0.0.1")
    with Swarm(hub, swarm="another") as swarm, pytest.raises(Unreachable, match="'another' did not answer"):
        swarm.request("flocking_bc")
    with Swarm(hub, swarm="another") as swarm, pytest.raises(Unreachable, match="'another' did not answer"):
        swarm.start_mission(WALK)
    until(lambda: threading.active_count() <= threads)


def test_ctrl_c_ends_the_waiting_and_leaves_the_robots_running(hub: str, swarm: Swarm) -> None:
    script = f"""
import signal
from fullswarm import Swarm
signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever runs the tests may ignore it
with Swarm({hub!r}) as swarm:
    run = swarm.request("flocking_bc")
    run.wait_started()
    try:
        print("waits", flush=True)
        run.wait(20.0)
    except KeyboardInterrupt:
        print("interrupted", run.phase, flush=True)
"""
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "waits\n"
        process.send_signal(signal.SIGINT)
        assert process.stdout.readline() == "interrupted running\n"
        assert process.wait(5.0) == 0
    time.sleep(0.5)
    assert behaviours(swarm) == ["flocking_bc"] * 3


def test_the_same_with_asyncio(hub: str) -> None:
    async def program() -> None:
        async with AsyncSwarm(hub, operator="anna") as swarm:
            assert swarm.robots == ROBOTS
            async with swarm.lease("r1") as held:
                assert held.robots == ("r1",)
                run = await swarm.request("flocking_bc", robots=ROBOTS)
                assert await run.wait_started() == ROBOTS
                count = 0
                async for state in swarm.states():
                    count += 1
                    assert {row.robot for row in state.robots} == set(ROBOTS)
                    if count == 5:
                        break
                waiting = asyncio.create_task(run.wait())
                await asyncio.sleep(0.1)
                waiting.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await waiting
                with pytest.raises(TimedOut):
                    await run.wait(0.1)
                both = await asyncio.gather(run.wait(10.0), swarm.stop())
                assert both[0] == {}
            with pytest.raises(RequestRefused):
                await swarm.request("flockign")
            assert len(await swarm.estop()) == 3
            await swarm.clear_estop()

    threads = threading.active_count()
    asyncio.run(program())
    until(lambda: threading.active_count() <= threads)


def test_a_program_that_does_not_close_it_ends(hub: str) -> None:
    script = f"from fullswarm import Swarm; swarm = Swarm({hub!r}); print(len(swarm.robots))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=30.0, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "3\n", "")


def test_the_examples_of_the_documentation_run(
    swarm: Swarm, hub: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (Path(__file__).parents[2] / "docs" / "how-to-use-from-python.md").read_text(encoding="utf-8")
    section = page.partition("## A live swarm\n")[2].partition("\n## ")[0]
    first, second = re.findall(r"```python\n(.*?)```", section, re.DOTALL)
    monkeypatch.setenv("FULLSWARM_HUB", hub)
    exec(first, {})
    assert all(math.dist(places(swarm)[robot], (5.0, 5.0)) < 1.0 for robot in ("r1", "r2"))
    compile(second, "asyncio", "exec", flags=ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
    (example,) = re.findall(
        r"```python\n(.*?)```", page.partition("## A mission\n")[2].partition("\n## ")[0], re.DOTALL
    )
    assert example.count("\n") <= 40
    exec(example, {})
    assert capsys.readouterr().out.splitlines()[-2:] == ["main/look: Are the pictures taken?", "done "]
