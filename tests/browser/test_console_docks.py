"""Docks on the page: what a robot does that goes to charge, and its return to its task; then the next one goes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from fullswarm.messages import Value
from tests.browser.conftest import SIZE, Snap
from tests.browser.console import Console
from tests.browser.swarm import Demo, Observer

FLEET = """
[world]
engine = "kinematic"
bounds_m = [0.0, 0.0, 6.0, 4.0]

[world.battery]
start = 0.3
rest_per_h = 0.1
drive_per_m = 0.0001
charge_per_h = 60.0

[charging]
go_at = 0.4
leave_at = 0.9
reserve = 0.12

[[robot]]
id = "r1"
pose = [2.0, 1.0, 0.0]

[[robot]]
id = "r2"
pose = [2.0, 3.0, 0.0]

[[dock]]
id = "d1"
pose = [0.3, 2.0, 3.14159]
"""


@pytest.fixture
def charging(tmp_path: Path) -> Iterator[Demo]:
    """Two robots with hardly any charge, and one dock."""
    fleet = tmp_path / "charging.toml"
    fleet.write_text(FLEET)
    started = Demo("--seconds", "3600", "--fleet", str(fleet))
    yield started
    started.close()


def phase(console: Console) -> str:
    """Return what the page knows of the only dock."""
    docks = console.state["docks"]
    return str(docks[0]["phase"]) if docks else ""


def test_a_robot_charges_and_returns_before_the_eyes_of_the_operator(
    charging: Demo, browser: Browser, snap: Snap
) -> None:
    observer = Observer(charging.hub)
    context = browser.new_context(viewport=SIZE, color_scheme="light")
    console = Console(context.new_page(), charging.address)
    for robot, y_goal_m in (("r1", 1.0), ("r2", 3.0)):
        parameters: dict[str, Value] = {"goal": [5.0, y_goal_m]}
        observer.operator.request("move_to_goal_bc", (robot,), parameters, lambda _: None, take=True)
    observer.rest(1.0)
    console.until(lambda: phase(console) == "docking", 30.0, "one is at the dock")
    first = "r1" if "docking" in console.named("robot-row-r1").inner_text() else "r2"
    other = {"r1": "r2", "r2": "r1"}[first]
    row = console.named(f"robot-row-{first}")
    expect(row).to_contain_text("docking")
    snap(console.page, "docks-docking")
    console.until(lambda: phase(console) == "docked", 30.0, "it is in the dock")
    expect(row).to_contain_text("charging")
    x_m, y_m = console.places()[first]
    assert abs(x_m - 0.3) < 0.1
    assert abs(y_m - 2.0) < 0.1
    snap(console.page, "docks-docked")
    expect(row).to_contain_text("leaving its dock", timeout=90_000)
    assert observer.fresh().healths([first])[0].battery > 0.8
    console.until(lambda: console.places()[first][0] > 4.5, 60.0, "it has taken its task up again")
    expect(console.named(f"robot-row-{other}")).to_contain_text("charging", timeout=60_000)
    snap(console.page, "docks-other")
    console.faultless()
    context.close()
    observer.close()
