"""A part of a recording as a trajectory, for films: `fullswarm record clip` with a GIF or an MP4."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fullswarm.core.settings import BOUNDS, BOXES
from fullswarm.errors import ConfigError
from fullswarm.evaluate.pictures.film import Film, write_film
from fullswarm.evaluate.trial_folder import Trajectory
from fullswarm.messages import HealthReport, RobotStates
from fullswarm.output import Progress
from fullswarm.record.clip import Range, messages_in
from fullswarm.record.decoding import Decoder
from fullswarm.record.playback import RecordedSwarm

SAMPLE_S = 0.1
MARGIN_M = 1.0
"""Around the robots, where the recording names no arena."""
MOST_SAMPLES = 100_000
GIF_FPS, MP4_FPS = 10.0, 25.0
Pose = tuple[float, float, float]


@dataclass(slots=True)
class _Samples:
    """Poses on a grid of `SAMPLE_S`, as far as they were known by then."""

    from_s: float
    times_s: list[float] = field(default_factory=list)
    poses: list[dict[str, Pose]] = field(default_factory=list)
    hits: list[set[str]] = field(default_factory=list)
    radius_m: dict[str, float] = field(default_factory=dict)
    _pose: dict[str, Pose] = field(default_factory=dict)
    _contacts: dict[str, int] = field(default_factory=dict)
    _touched: set[str] = field(default_factory=set)

    def until(self, at_s: float) -> None:
        """Take all samples before a time."""
        start_s = max(0.0, self.from_s)
        while (due_s := start_s + SAMPLE_S * len(self.times_s)) <= at_s:
            if len(self.times_s) >= MOST_SAMPLES:
                raise ConfigError("this part is too long for a film", where="--from, --to")
            self.times_s.append(due_s)
            self.poses.append(dict(self._pose))
            self.hits.append(self._touched)
            self._touched = set()

    def take(self, message: object) -> None:
        """Take in a message; most are of no concern."""
        if isinstance(message, RobotStates):
            columns = zip(message.robots, message.x_m, message.y_m, message.heading_rad, message.radius_m, strict=True)
            for robot, x_m, y_m, heading_rad, radius_m in columns:
                if math.isfinite(x_m) and math.isfinite(y_m):
                    self._pose[robot] = (x_m, y_m, heading_rad)
                    self.radius_m[robot] = radius_m
        elif isinstance(message, HealthReport):
            for each in message.robots:
                if each.collisions > self._contacts.get(each.robot, each.collisions):
                    self._touched.add(each.robot)
                self._contacts[each.robot] = each.collisions


def trajectory_of(path: Path, wanted: Range) -> Trajectory:
    """Return where the robots were in a part of a recording; times in seconds from its first message.

    Raises
    ------
    ConfigError
        It is no recording, or no robot has reported a position by then.
    """
    swarm, decoder = RecordedSwarm(path), Decoder()
    samples = _Samples(1e-9 * (wanted.from_ns - swarm.first_ns))
    for at_s, _, schema, data in messages_in(path, wanted):
        samples.until(at_s)
        if decoder.knows(schema):
            samples.take(decoder.decode(schema, data))
    ids = tuple(sorted({robot for poses in samples.poses for robot in poses}))
    if not ids:
        raise ConfigError("no robot has reported a position then", where=str(path), hint="see --from and --to")
    pose = np.full((len(samples.poses), len(ids), 3), np.nan, np.float32)
    touching = np.zeros(pose.shape[:2], np.bool_)
    for row, (poses, hits) in enumerate(zip(samples.poses, samples.hits, strict=True)):
        for column, robot in enumerate(ids):
            pose[row, column] = poses.get(robot, (np.nan,) * 3)
            touching[row, column] = robot in hits
    return Trajectory(
        ids=ids,
        time_s=np.array(samples.times_s),
        pose=pose,
        touching=touching,
        goals=np.full((len(ids), 2), np.nan),
        goal_radius_m=0.0,
        radius_m=np.array([samples.radius_m[robot] for robot in ids]),
        boxes=_boxes(swarm),
        bounds_m=_bounds(swarm, pose),
    )


def _boxes(swarm: RecordedSwarm) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    stored = swarm.seeds.get(BOXES)
    rows = stored.get("boxes", []) if isinstance(stored, dict) else []
    return np.array(rows, np.float64).reshape(-1, 5)


def _bounds(
    swarm: RecordedSwarm, pose: np.ndarray[tuple[int, ...], np.dtype[np.float32]]
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    stored = swarm.seeds.get(BOUNDS)
    if isinstance(stored, list) and len(stored) == 2:
        return np.array(stored, np.float64).ravel()
    low, high = np.nanmin(pose[..., :2], axis=(0, 1)), np.nanmax(pose[..., :2], axis=(0, 1))
    return np.array([*(low - MARGIN_M), *(high + MARGIN_M)], np.float64)


def film(path: Path, out: Path, wanted: Range, speed: float, width_px: int) -> int:
    """Film a part of a recording, with progress on stderr; return how many frames that makes.

    Raises
    ------
    ConfigError
        As `trajectory_of` and :func:`fullswarm.evaluate.pictures.film.write_film`; or `out` is there already.
    MissingExtra
        What films is not installed.
    """
    if out.exists():
        raise ConfigError("this file is there already", where=str(out), hint="name another one with --out")
    fps = GIF_FPS if out.suffix.lower() == ".gif" else MP4_FPS
    settings = Film(speed=speed, fps=fps, width_px=width_px, caption=path.name)
    with Progress("frames") as progress:
        return write_film(trajectory_of(path, wanted), out, settings, progress.parts)
