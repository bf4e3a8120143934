"""Draws a swarm in Rerun: its robots from above, scans, obstacles and pictures, charts, requests and logs.

The same node draws a live swarm and a recording. Rerun opens recordings by itself, too, but draws only their frames and
pictures: it does not know Foxglove's scenes.
"""

from __future__ import annotations

import colorsys
import contextlib
import math
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from fullswarm.bus.base import Bus
from fullswarm.bus.endpoint import DEFAULT_HUB, credentials_at
from fullswarm.bus.local import LocalBus
from fullswarm.bus.renewal import renew_later
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock, SimClock, wall_time_s
from fullswarm.errors import ConfigError
from fullswarm.keys import Keys
from fullswarm.launch.processes import serve
from fullswarm.maps.scans import sensor_at, unpack
from fullswarm.messages import (
    CameraPicture,
    HealthReport,
    RangeReport,
    RequestStatus,
    RobotHealth,
    RobotStates,
    SeenObstacles,
)
from fullswarm.operator.session import CONNECT_S, Target
from fullswarm.operator.view import natural
from fullswarm.output import Progress, data, progress
from fullswarm.recent import Recent
from fullswarm.record.layout import MOST_SERIES, Arena, Contents
from fullswarm.record.live import NAME, logs_of
from fullswarm.record.playback import RecordedSwarm, feed
from fullswarm.record.recorder import LogTail
from fullswarm.record.scene import BODY_M, MOST_BODIES, MOST_HOSTS, SILENT_S, WALL_M
from fullswarm.runtime import Mailbox, Runtime, Scheduler

APPLICATION = "fullswarm"
TIMELINE = "time"
DRAW_S = 0.05
"""From one picture of the robots to the next: states come up to 20 times a second."""
CHART_S = 0.25
COLLECT_S = 1.5
"""What has come by then is arranged in the viewer: robots send their states and cameras their pictures each second."""
OBSTACLES_S = 1.0
MARGIN_M = 3.0
"""Shown around the places of the robots: with all obstacles of a large arena in sight they would be too small."""
HEIGHT = 1.2
"""The eye's height over the arena, in sizes of the arena."""
AHEAD = 1.6
"""Length of a robot's arrow, in its radii."""
GREY, WHITE, RED = (128, 128, 140, 230), (255, 255, 255, 255), (230, 60, 60, 255)
LEVELS = {"debug": "DEBUG", "info": "INFO", "warning": "WARN", "error": "ERROR"}
CHARTS = {
    "speed": "Speed (m/s)",
    "battery": "Battery (0 to 1)",
    "deviation": "Changed by the safety filter (m/s)",
}
"""Entities with a chart each, and their titles; below them is one series per robot."""


Corners = tuple[float, float, float, float]
"""Least x, least y, greatest x, greatest y, in m."""


class RerunView:
    """Draws what is on the bus into a stream of Rerun's.

    Parameters
    ----------
    stream : it may lead to a viewer or into a file; the owner closes it
    wall_s : returns seconds since 1970, of the moment that is drawn
    logs : folder of the processes' logs; None: they are not here
    """

    def __init__(
        self, bus: Bus, keys: Keys, scheduler: Scheduler, stream: rr.RecordingStream, wall_s: Callable[[], float],
        logs: Path | None = None,
    ) -> None:  # fmt: skip
        self._stream, self._scheduler, self._wall_s = stream, scheduler, wall_s
        self._logs = LogTail(logs)
        self._states: Recent[str, tuple[float, RobotStates, int]] = Recent(MOST_BODIES)  # by robot: arrival, row
        self._health: Recent[str, tuple[float, RobotHealth]] = Recent(MOST_BODIES)
        self._obstacles: Recent[str, SeenObstacles] = Recent(MOST_HOSTS)
        self._drawn: tuple[tuple[str, int], ...] = ()
        self._series: Recent[tuple[str, str], None] = Recent(len(CHARTS) * MOST_BODIES)  # those that have a colour
        self._cameras: set[str] = set()
        self._corners: Corners | None = None
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for path, title in CHARTS.items():
            stream.log(path, rr.TextDocument(title), static=True)
        self._subscriptions = [
            bus.subscribe(keys.state(), RobotStates, self._take_states),
            bus.subscribe(keys.health(), HealthReport, self._take_health),
            bus.subscribe(keys.obstacles(), SeenObstacles, self._take_obstacles),
            bus.subscribe(keys.range_report(), RangeReport, self._draw_scans),
            bus.subscribe(keys.camera(), CameraPicture, self._draw_picture),
            bus.subscribe(keys.behaviour_status, RequestStatus, self._draw_status),
        ]
        self._timers = [
            scheduler.every(DRAW_S, self._draw_robots),
            scheduler.every(CHART_S, self._draw_charts),
            scheduler.every(OBSTACLES_S, self._draw_obstacles),
        ]

    def close(self) -> None:
        """Draw no more."""
        self._draw_robots()
        for subscription in self._subscriptions:
            subscription.close()
        for timer in self._timers:
            timer.cancel()

    def contents(self) -> Contents:
        """Return what has been seen so far, for a blueprint; the arena is around the robots' places."""
        robots = tuple(sorted(self._states, key=natural))
        if self._corners is None:
            return Contents(robots, tuple(sorted(self._cameras)))
        x_min_m, y_min_m, x_max_m, y_max_m = self._corners
        arena = Arena(x_min_m - MARGIN_M, y_min_m - MARGIN_M, x_max_m + MARGIN_M, y_max_m + MARGIN_M)
        return Contents(robots, tuple(sorted(self._cameras)), arena)

    # ------------------------------------------------------------------ what comes
    def _take_states(self, states: RobotStates) -> None:
        now_s = self._scheduler.now_s()
        for row, robot in enumerate(states.robots):
            self._states[robot] = now_s, states, row

    def _take_health(self, report: HealthReport) -> None:
        now_s = self._scheduler.now_s()
        for each in report.robots:
            self._health[each.robot] = now_s, each

    def _take_obstacles(self, obstacles: SeenObstacles) -> None:
        self._obstacles[obstacles.host] = obstacles

    # ------------------------------------------------------------------ what is drawn
    def _at_now(self) -> None:
        self._stream.set_time(TIMELINE, timestamp=self._wall_s())

    def _present(self) -> list[tuple[str, RobotStates, int]]:
        now_s = self._scheduler.now_s()
        found = [(robot, states, row) for robot, (at_s, states, row) in self._states.items() if now_s - at_s < SILENT_S]
        return sorted(found, key=lambda each: natural(each[0]))

    def _draw_robots(self) -> None:
        present = self._present()
        drawn = tuple((robot, states.sequence) for robot, states, _ in present)
        if drawn == self._drawn:
            return  # nothing has moved
        self._drawn = drawn
        names = [robot for robot, _, _ in present]
        columns = np.array(
            [
                (states.x_m[row], states.y_m[row], states.heading_rad[row], states.radius_m[row])
                for _, states, row in present
            ]
        ).reshape(-1, 4)
        x_m, y_m, heading_rad, radius_m = columns.T
        seen = np.isfinite(columns).all(axis=1)
        middle = np.column_stack([x_m, y_m, np.full(len(x_m), 0.5 * BODY_M)])[seen]
        ahead = np.column_stack([np.cos(heading_rad), np.sin(heading_rad), np.zeros(len(x_m))])[seen]
        names = [name for name, shown in zip(names, seen, strict=True) if shown]
        radius_m = radius_m[seen]
        self._corners = _around(self._corners, middle)
        self._at_now()
        self._stream.log(
            "world/robots",
            rr.Cylinders3D(
                lengths=np.full(len(names), BODY_M), radii=radius_m, centers=middle,
                colors=[_colour(name) for name in names], labels=names, fill_mode="solid",
            ),
        )  # fmt: skip
        self._stream.log(
            "world/headings",
            rr.Arrows3D(
                origins=middle + np.array([0.0, 0.0, BODY_M]), vectors=AHEAD * radius_m[:, None] * ahead,
                radii=0.2 * radius_m,
                colors=[self._heading_colour(name) for name in names],
            ),
        )  # fmt: skip

    def _heading_colour(self, robot: str) -> tuple[int, int, int, int]:
        """Return red for a robot whose e-stop is latched or that has a fault."""
        found = self._health.get(robot)
        return RED if found is not None and (found[1].estop or found[1].fault) else WHITE

    def _draw_obstacles(self) -> None:
        rows = sorted({row for each in self._obstacles.values() for row in each.rows})
        self._at_now()
        self._stream.log(
            "world/obstacles",
            rr.Boxes3D(
                centers=[(row[0], row[1], 0.5 * WALL_M) for row in rows],
                half_sizes=[(row[2] + row[5], row[3] + row[5], 0.5 * WALL_M) for row in rows],
                quaternions=[
                    rr.Quaternion(xyzw=(0.0, 0.0, math.sin(0.5 * row[4]), math.cos(0.5 * row[4]))) for row in rows
                ],
                colors=[GREY] * len(rows), fill_mode="solid",
            ),
        )  # fmt: skip
        for process, line in self._logs.read():
            level = line.partition("[")[2].partition("]")[0].strip()
            self._stream.log(f"log/{process}", rr.TextLog(line, level=LEVELS.get(level, "INFO")))

    def _draw_charts(self) -> None:
        self._at_now()
        now_s = self._scheduler.now_s()
        for robot, states, row in self._present()[:MOST_SERIES]:
            self._chart("speed", robot, states.speed_m_s[row])
            found = self._health.get(robot)
            if found is not None and now_s - found[0] < SILENT_S:
                if found[1].battery >= 0.0:
                    self._chart("battery", robot, found[1].battery)
                self._chart("deviation", robot, found[1].deviation_m_s)

    def _chart(self, entity: str, robot: str, value: float) -> None:
        if (entity, robot) not in self._series:
            self._series[entity, robot] = None
            self._stream.log(f"{entity}/{robot}", rr.SeriesLines(colors=_colour(robot), names=robot), static=True)
        self._stream.log(f"{entity}/{robot}", rr.Scalars(value))

    def _draw_scans(self, report: RangeReport) -> None:
        self._at_now()
        for scan in report.scans:
            at, bins = sensor_at(scan), unpack(scan)
            if at is None:
                continue
            angles_rad = at[2] + bins.first_rad + bins.step_rad * np.arange(len(bins.distances_m))
            hit = np.isfinite(bins.distances_m)
            far_m = bins.distances_m[hit]
            x_m, y_m = at[0] + far_m * np.cos(angles_rad[hit]), at[1] + far_m * np.sin(angles_rad[hit])
            points = np.column_stack([x_m, y_m, np.full(len(x_m), BODY_M)])
            self._stream.log(
                f"world/scans/{report.robot}/{scan.sensor}",
                rr.Points3D(points, radii=0.02, colors=_colour(report.robot)),
            )

    def _draw_picture(self, picture: CameraPicture) -> None:
        if picture.jpeg:
            self._cameras.add(picture.camera)
            self._at_now()
            self._stream.log(
                f"camera/{picture.camera}", rr.EncodedImage(contents=picture.jpeg, media_type="image/jpeg")
            )

    def _draw_status(self, status: RequestStatus) -> None:
        self._at_now()
        text = f"{status.behaviour} ({', '.join(status.robots) or 'no robot'}): {status.phase}"
        level = "WARN" if status.phase == "refused" else "INFO"
        self._stream.log("log/requests", rr.TextLog(f"{text}; {status.reason}" if status.reason else text, level=level))


def _around(corners: Corners | None, places: np.ndarray) -> Corners | None:
    """Return the corners of a rectangle around places (n, 2 or more) as well."""
    if not len(places):
        return corners
    x_m, y_m = places[:, 0], places[:, 1]
    new = float(x_m.min()), float(y_m.min()), float(x_m.max()), float(y_m.max())
    if corners is None:
        return new
    return min(corners[0], new[0]), min(corners[1], new[1]), max(corners[2], new[2]), max(corners[3], new[3])


def _colour(robot: str) -> tuple[int, int, int, int]:
    hue = zlib.crc32(robot.encode()) % 360 / 360.0  # the same in each run, as in a recording's scenes
    red, green, blue = colorsys.hsv_to_rgb(hue, 0.6, 0.9)
    return round(255 * red), round(255 * green), round(255 * blue), 230


def blueprint(contents: Contents) -> rrb.Blueprint:
    """Return what a viewer shows at first: the arena from above, charts, the cameras, and what is logged."""
    arena = contents.arena
    middle = 0.5 * (arena.x_min_m + arena.x_max_m), 0.5 * (arena.y_min_m + arena.y_max_m), 0.0
    size_m = max(arena.x_max_m - arena.x_min_m, arena.y_max_m - arena.y_min_m, 1.0)
    above = rrb.Spatial3DView(
        origin="world", name="Arena",
        eye_controls=rrb.EyeControls3D(
            position=(middle[0], middle[1] - 0.01 * size_m, HEIGHT * size_m), look_target=middle, eye_up=(0.0, 0.0, 1.0)
        ),
    )  # fmt: skip
    charts: Sequence[rrb.TimeSeriesView] = [
        rrb.TimeSeriesView(origin=path, name=title) for path, title in CHARTS.items()
    ]
    log = rrb.TextLogView(origin="log", name="Log")
    left = rrb.Vertical(above, log, row_shares=[3, 1])
    right = rrb.Vertical(*charts)
    cameras = [rrb.Spatial2DView(origin=f"camera/{name}", name=name) for name in contents.cameras]
    columns = [left, rrb.Vertical(*cameras), right] if cameras else [left, right]
    return rrb.Blueprint(rrb.Horizontal(*columns, column_shares=[3, *[2] * (len(columns) - 1)]), collapse_panels=True)


# ---------------------------------------------------------------- the command
def show(target: Target, connect: str | None, save: Path | None) -> int:
    """Show a live swarm until Ctrl-C; see :func:`draw_recording` for the parameters.

    Raises
    ------
    ConfigError
        The file is there already, or the hub is secured and there is no certificate.
    Unreachable
        No hub answers.
    """
    runtime = Runtime(MonotonicClock(), Mailbox())
    hub, keys = target.hub or DEFAULT_HUB, Keys(target.swarm)
    credentials = credentials_at(hub, target.swarm, NAME, "observer")
    bus = ZenohBus(runtime.mailbox, hub=hub, credentials=credentials)
    try:
        bus.wait_connected(CONNECT_S)
        renew_later(bus, runtime, keys, credentials)
        with opened(f"{target.swarm}, live", connect, save) as stream:
            view = RerunView(bus, keys, runtime, stream, wall_time_s, logs_of(target))
            runtime.after(COLLECT_S, lambda: stream.send_blueprint(blueprint(view.contents())))
            progress(f"swarm '{target.swarm}' goes to {_where(connect, save)}; Ctrl-C ends it")
            return serve(runtime, [view], with_parent=False)
    finally:
        bus.close()


def draw_recording(path: Path, connect: str | None, save: Path | None) -> int:
    """Draw a recording.

    Parameters
    ----------
    connect : ``HOST:PORT`` or URL of a viewer that runs; None: one is started
    save : a new file in place of a viewer

    Raises
    ------
    ConfigError
        The recording cannot be read, or the new file is there already.
    """
    recorded = RecordedSwarm(path)
    runtime = Runtime(SimClock())
    bus, keys = LocalBus(runtime.mailbox), Keys(recorded.swarm or "swarm")
    with opened(path.name, connect, save) as stream, Progress("read") as shown:
        began_s = 1e-9 * recorded.first_ns
        view = RerunView(bus, keys, runtime, stream, lambda: began_s + runtime.now_s())
        for found in recorded.messages():
            feed(found, recorded.first_ns, runtime, bus, keys)
            shown.parts(round(1000 * recorded.share), 1000)
        runtime.run(DRAW_S)  # what the last messages changed
        view.close()
        stream.send_blueprint(blueprint(view.contents()))
    if save is not None:
        data(str(save))
    return 0


@contextlib.contextmanager
def opened(title: str, connect: str | None, save: Path | None) -> Iterator[rr.RecordingStream]:
    """Open a stream to a viewer or into a file, and have it flushed at the end."""
    stream = rr.RecordingStream(APPLICATION)
    stream.send_recording_name(title)
    if save is not None:
        try:
            save.open("xb").close()
            stream.save(save)
        except FileExistsError:
            raise ConfigError("this file is there already", where=str(save), hint="name another one") from None
        except OSError as error:
            raise ConfigError(f"cannot be written: {error.strerror}", where=str(save)) from None
    elif connect is not None:
        try:
            stream.connect_grpc(connect if "://" in connect else f"rerun+http://{connect}/proxy")
        except (RuntimeError, ValueError):
            hint = "HOST:PORT, or a URL such as rerun+http://127.0.0.1:9876/proxy"
            raise ConfigError(f"'{connect}' is no address of a viewer", where="--connect", hint=hint) from None
    else:
        stream.spawn()
    try:
        yield stream
    finally:
        stream.disconnect()


def _where(connect: str | None, save: Path | None) -> str:
    return str(save) if save is not None else connect or "Rerun's viewer"
