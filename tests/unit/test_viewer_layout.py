"""Layouts for Foxglove and Lichtblick, and the table of robots that their charts show.

The check of the format follows Lichtblick's source: ``LayoutData`` in ``CurrentLayoutContext/actions.ts``, the mosaic's
tree, the grammar of message paths in ``packages/message-path/src/grammar.ne``.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import pytest

from fullswarm.errors import ConfigError
from fullswarm.record.layout import MOST_SERIES, Arena, Contents, layout, of_fleet
from fullswarm.record.table import SCHEMA, Table
from tests.unit.test_recording import states
from tests.unit.test_viewer import health

PANELS = {"3D", "Plot", "RosOut", "RawMessages", "Image"}
"""Types of panels in Lichtblick's ``panels/index.ts``."""
PATH = re.compile(r"(?P<topic>/[A-Za-z0-9_/-]+)\.robots\[:\]\{robot==\"(?P<robot>[^\"]*)\"\}\.(?P<column>[a-z_]+)\Z")


def shown(node: Any) -> list[str]:
    """Return the panels in a mosaic's tree, checked."""
    if isinstance(node, str):
        return [node]
    assert set(node) == {"direction", "first", "second", "splitPercentage"}
    assert node["direction"] in ("row", "column")
    assert 0 < node["splitPercentage"] < 100
    return shown(node["first"]) + shown(node["second"])


@pytest.mark.parametrize("cameras", [(), ("hall", "door")])
def test_a_layout_is_one_that_lichtblick_reads(cameras: tuple[str, ...]) -> None:
    made = json.loads(
        json.dumps(layout(Contents(("r1", "r-2"), cameras, Arena(0.0, 0.0, 20.0, 10.0))), allow_nan=False)
    )
    assert set(made) == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    assert sorted(shown(made["layout"])) == sorted(made["configById"])
    assert {each.partition("!")[0] for each in made["configById"]} <= PANELS
    assert any(each.startswith("Image!") for each in made["configById"]) == bool(cameras)
    camera = made["configById"]["3D!arena"]["cameraState"]
    assert camera["target"] == [10.0, 5.0, 0.0]
    assert camera["distance"] > 20.0


def test_each_series_of_a_chart_finds_the_number_of_its_robot() -> None:
    table = Table()
    for number, robot in enumerate(("r1", "r-2"), 1):
        table.take(states(1.0, (robot,)), 0.0)
        table.take(health(robot, battery=0.1 * number, deviation_m_s=0.01 * number), 0.0)
    message = json.loads(table.whole(1.0).data)
    panels: dict[str, Any] = layout(Contents(("r1", "r-2")))["configById"]  # type: ignore[assignment]
    found = {}
    for name, panel in panels.items():
        for path in panel.get("paths", ()):
            match = PATH.match(path["value"])
            assert match is not None
            assert match["topic"] == table.whole(1.0).topic
            (value,) = (row[match["column"]] for row in message["robots"] if row["robot"] == match["robot"])
            found[name, path["label"]] = value
    assert found == {
        ("Plot!speeds", "r1"): 0.0, ("Plot!speeds", "r-2"): 0.0,
        ("Plot!batteries", "r1"): 0.1, ("Plot!batteries", "r-2"): 0.2,
        ("Plot!deviations", "r1"): 0.01, ("Plot!deviations", "r-2"): 0.02,
    }  # fmt: skip


def test_a_large_swarm_has_charts_of_some_robots(tmp_path: Path) -> None:
    fleet = tmp_path / "fleet.toml"
    fleet.write_text("[fleet]\ncount = 300\n[world]\nbounds_m = [-1, -2, 3, 4]\n")
    found = of_fleet(fleet)
    assert (len(found.robots), found.arena) == (300, Arena(-1.0, -2.0, 3.0, 4.0))
    panels: dict[str, Any] = layout(found)["configById"]  # type: ignore[assignment]
    assert len(panels["Plot!speeds"]["paths"]) == MOST_SERIES
    with pytest.raises(ConfigError):
        of_fleet(tmp_path / "none.toml")


def test_the_table_has_the_newest_of_each_robot_whatever_cell_its_states_come_from() -> None:
    table, validator = Table(), jsonschema.Draft202012Validator(json.loads(SCHEMA.data))
    table.take(states(1.0, ("r1", "r2")), 0.0)
    table.take(states(3.0, ("r2",)), 1.0)
    table.take(health("r3", battery=-1.0, stop_reason="no pose", estop=True), 1.0)
    rows = json.loads(table.whole(2.0).data)
    validator.validate(rows)
    assert [(each["robot"], each.get("x_m"), each["age_s"]) for each in rows["robots"]] == [
        ("r1", 1.0, 2.0), ("r2", 3.0, 1.0), ("r3", None, 1.0),
    ]  # fmt: skip
    third = rows["robots"][2]
    assert (third["battery"], third["stop_reason"], third["estop"]) == (None, "no pose", True)
    later = msgspec.json.decode(table.whole(10.5).data)
    assert [each["robot"] for each in later["robots"]] == ["r2", "r3"]
    assert json.loads(table.whole(60.0).data) == {"robots": []}
