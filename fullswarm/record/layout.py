"""Makes a layout for Foxglove and Lichtblick: arena, charts of each robot, log, and the table of all robots.

The format is that of Foxglove Studio 1.x (``LayoutData``), which Lichtblick reads and Foxglove imports. Charts name
robots, so a layout is made for those of a fleet file or of a live swarm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fullswarm.config.fleet_file import load_swarm
from fullswarm.errors import ConfigError
from fullswarm.messages import CameraPicture
from fullswarm.operator.session import Target, connect
from fullswarm.operator.view import FleetView
from fullswarm.record.scene import LOG, SCENE, WORLD
from fullswarm.record.table import ROBOTS

MOST_SERIES = 40
"""Of one chart; more lines cannot be distinguished."""
FIELD_OF_VIEW_DEG = 45.0
MARGIN = 1.15
"""How much more than the arena the camera sees."""
COLLECT_S = 1.2
"""Two periods of the health reports and of camera pictures."""
AROUND_M = 2.0
"""Shown around the robots of a live swarm, whose arena is not known."""
TITLES = ("foxglovePanelTitle", "lichtblickPanelTitle")
"""Keys of a panel's title in Foxglove and in Lichtblick."""

Panel = dict[str, object]
Split = str | dict[str, object]


@dataclass(frozen=True, slots=True)
class Arena:
    """What the camera shows, in m."""

    x_min_m: float = -5.0
    y_min_m: float = -5.0
    x_max_m: float = 5.0
    y_max_m: float = 5.0


@dataclass(frozen=True, slots=True)
class Contents:
    """What a layout is made for: names of robots and cameras, and the arena."""

    robots: tuple[str, ...]
    cameras: tuple[str, ...] = ()
    arena: Arena = Arena()


def of_fleet(path: Path) -> Contents:
    """Return what a fleet file names. Raises `ConfigError` when it is wrong."""
    config = load_swarm(path)
    return Contents(config.robots, tuple(each.name for each in config.camera), Arena(*config.bounds_m))


def of_swarm(target: Target) -> Contents:
    """Return what a live swarm shows within a second.

    Raises
    ------
    Unreachable
        No hub answers.
    ConfigError
        No robot is there.
    """
    cameras: set[str] = set()
    with connect(target) as session:
        view = FleetView(session.bus, session.keys, session.runtime)
        session.bus.subscribe(session.keys.camera(), CameraPicture, lambda each: cameras.add(each.camera), latest=True)
        session.run(COLLECT_S)
        rows = view.snapshot().robots
    if not rows:
        hint = "start them, or name a fleet file: fullswarm viewer layout FLEET.toml"
        raise ConfigError(f"no robot of swarm '{target.swarm}' is there", hint=hint)
    places = [(row.x_m, row.y_m) for row in rows if math.isfinite(row.x_m) and math.isfinite(row.y_m)]
    x_m, y_m = zip(*places, strict=True) if places else ((0.0,), (0.0,))
    arena = Arena(min(x_m) - AROUND_M, min(y_m) - AROUND_M, max(x_m) + AROUND_M, max(y_m) + AROUND_M)
    return Contents(tuple(row.robot for row in rows), tuple(sorted(cameras)), arena)


def layout(contents: Contents) -> dict[str, object]:
    """Return the layout as its JSON file has it; charts show the first `MOST_SERIES` robots, one panel a camera."""
    robots, cameras, arena = contents.robots, contents.cameras, contents.arena
    panels: dict[str, Panel] = {
        "3D!arena": _arena(arena),
        "Plot!speeds": _chart("Speed (m/s)", robots, "speed_m_s"),
        "Plot!batteries": {**_chart("Battery (0 to 1)", robots, "battery"), "minYValue": 0, "maxYValue": 1},
        "Plot!deviations": _chart("Changed by the safety filter (m/s)", robots, "deviation_m_s"),
        "RosOut!log": {**_titled("Log"), "topicToRender": LOG, "minLogLevel": 1, "searchTerms": []},
        "RawMessages!robots": {
            **_titled("Robots"), "topicPath": ROBOTS, "diffEnabled": False, "diffMethod": "previous message",
            "diffTopicPath": "", "showFullMessageForDiff": False,
        },
    }  # fmt: skip
    left: Split = _split("column", "3D!arena", "RosOut!log", 72)
    if cameras:
        topic = f"/camera/{cameras[0]}"
        panels["Image!camera"] = {**_titled("Camera"), "imageMode": {"imageTopic": topic}}
        left = _split("column", _split("row", "3D!arena", "Image!camera", 65), "RosOut!log", 72)
    charts = _split("column", "Plot!speeds", _split("column", "Plot!batteries", "Plot!deviations", 50), 34)
    return {
        "configById": panels, "globalVariables": {}, "userNodes": {}, "playbackConfig": {"speed": 1},
        "layout": _split("row", left, _split("column", charts, "RawMessages!robots", 70), 60),
    }  # fmt: skip


def _arena(arena: Arena) -> Panel:
    width_m, height_m = arena.x_max_m - arena.x_min_m, arena.y_max_m - arena.y_min_m
    middle = [0.5 * (arena.x_min_m + arena.x_max_m), 0.5 * (arena.y_min_m + arena.y_max_m), 0.0]
    size_m = max(width_m, height_m, 1.0)
    return {
        **_titled("Arena"),
        "cameraState": {
            "perspective": True, "distance": MARGIN * size_m / (2.0 * math.tan(math.radians(0.5 * FIELD_OF_VIEW_DEG))),
            "phi": 0, "thetaOffset": 0, "fovy": FIELD_OF_VIEW_DEG, "near": 0.5, "far": 5000,
            "target": middle, "targetOffset": [0, 0, 0], "targetOrientation": [0, 0, 0, 1],
        },
        "followTf": WORLD, "followMode": "follow-none", "scene": {"transforms": {"axisScale": 0, "showLabel": False}},
        "topics": {SCENE: {"visible": True}}, "transforms": {},
        "layers": {
            "grid": {
                "layerId": "foxglove.Grid", "instanceId": "grid", "label": "Grid", "visible": True, "order": 1,
                "frameId": WORLD, "frameLocked": True, "size": math.ceil(size_m), "divisions": math.ceil(size_m),
                "lineWidth": 1, "color": "#808080ff", "position": [*middle[:2], 0], "rotation": [0, 0, 0],
            }
        },
    }  # fmt: skip


def _chart(title: str, robots: Sequence[str], column: str) -> Panel:
    paths = [
        {
            "value": f'{ROBOTS}.robots[:]{{robot=="{robot}"}}.{column}', "label": robot, "enabled": True,
            "timestampMethod": "receiveTime",
        }
        for robot in robots[:MOST_SERIES]
    ]  # fmt: skip
    return {
        **_titled(title), "paths": paths, "showLegend": True, "legendDisplay": "floating", "isSynced": True,
        "showPlotValuesInLegend": False, "showXAxisLabels": True, "showYAxisLabels": True, "xAxisVal": "timestamp",
        "sidebarDimension": 240, "followingViewWidth": 60,
    }  # fmt: skip


def _titled(title: str) -> Panel:
    return dict.fromkeys(TITLES, title)


def _split(direction: str, first: Split, second: Split, percentage: float) -> dict[str, object]:
    return {"direction": direction, "first": first, "second": second, "splitPercentage": percentage}
