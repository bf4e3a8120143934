"""Runs `fullswarm track`: the live cameras of a fleet, a recorded video, and the steps of a calibration."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import structlog

from fullswarm import output
from fullswarm.bus.base import WORLD, Bus
from fullswarm.clock import Clock, MonotonicClock
from fullswarm.config import SwarmConfig
from fullswarm.config.models import CameraConfig
from fullswarm.errors import ConfigError, Unreachable, did_you_mean
from fullswarm.keys import Keys
from fullswarm.localization.camera.calibrate import (
    PICTURES,
    LensCalibration,
    floor_from_board,
    floor_from_tags,
    lens_part,
)
from fullswarm.localization.camera.camera_file import CameraFile, read_camera, write_camera
from fullswarm.localization.camera.node import CameraNode, Show
from fullswarm.localization.camera.plan import RobotTag, TagPlan, plan_of
from fullswarm.localization.camera.preview import Preview
from fullswarm.localization.camera.rehearsal import SCHEME, RobotsInPictures, SimulatedCamera, board_views
from fullswarm.localization.camera.sources import LiveSource, Shot, is_live, recorded, shown
from fullswarm.localization.camera.tracker import Tracker
from fullswarm.localization.publisher import FixPublisher, Names
from fullswarm.messages import TruePoses
from fullswarm.runtime import Mailbox, Runtime

if TYPE_CHECKING:
    from fullswarm.identity import Role
    from fullswarm.launch.nodes import Node

log = structlog.get_logger()

IDENTITY = "fixes"
"""Name of the certificate with which it connects to a secured hub, as `fullswarm fixes`; its role is ``source``."""
GOOD_VIEWS, GOOD_SHARE = 30, 0.85
SAY_S = 2.0


def calibration_of(camera: CameraConfig) -> Path:
    """Return the file of a camera's calibration."""
    return camera.calibration or Path(f"camera-{camera.name}.toml")


def cameras_of(config: SwarmConfig, names: Iterable[str], fleet: Path) -> list[CameraConfig]:
    """Return the cameras of a fleet file with these names; none: all.

    Raises
    ------
    ConfigError
        It has no camera, or none of a name.
    """
    if not config.camera:
        hint = "add [[camera]] with name and source, or write a file that has one: fullswarm track init"
        raise ConfigError("has no camera", where=str(fleet), hint=hint)
    known = {each.name: each for each in config.camera}
    for name in names:
        if name not in known:
            raise ConfigError(f"has no camera '{name}'", where=str(fleet), hint=did_you_mean(name, known))
    return [known[name] for name in names] or list(config.camera)


def one_camera(config: SwarmConfig, name: str | None, fleet: Path) -> CameraConfig:
    """Return the camera of a name, or the only one there is; ``ConfigError`` if that is not clear."""
    cameras = cameras_of(config, [name] if name else [], fleet)
    if len(cameras) > 1:
        names = ", ".join(each.name for each in cameras)
        raise ConfigError("has several cameras", where=str(fleet), hint=f"say which: --camera with one of {names}")
    return cameras[0]


# ---------------------------------------------------------------- live
class WorldSource:
    """Pictures that are rendered of the simulated world's true poses, at most `rate_hz` a second.

    Attributes
    ----------
    problem : why there is no picture; empty: there is
    """

    def __init__(
        self, bus: Bus, keys: Keys, pictures: RobotsInPictures, rate_hz: float, on_shot: Callable[[Shot], None]
    ) -> None:
        self._pictures, self._period_s, self._on_shot = pictures, 1.0 / rate_hz, on_shot
        self._due_s, self._number = 0.0, 0
        self.problem = "the simulated world sends no poses: is it running, and does its fleet file have this camera?"
        self._subscription = bus.subscribe(keys.true_poses, TruePoses, self._take, latest=True)

    def _take(self, message: TruePoses) -> None:
        if message.stamp_s < self._due_s - 0.25 * self._period_s:
            return
        self._due_s = max(self._due_s + self._period_s, message.stamp_s)
        self.problem = ""
        self._number += 1
        poses = zip(message.x_m, message.y_m, message.heading_rad, strict=True)
        twists = zip(message.speed_m_s, message.turn_rad_s, strict=True)
        picture = self._pictures.picture(
            dict(zip(message.robots, poses, strict=True)), dict(zip(message.robots, twists, strict=True))
        )
        self._on_shot(Shot(picture, message.stamp_s, self._number))

    def close(self) -> None:
        """Take no more."""
        self._subscription.close()


@dataclass(frozen=True, slots=True)
class Live:
    """The options of `fullswarm track run`; None: as in the fleet file."""

    source: str | None = None
    show: str | None = None
    insecure_network: bool = False
    with_parent: bool = False


def run_live(config: SwarmConfig, cameras: list[CameraConfig], options: Live) -> int:
    """Publish fixes from cameras until Ctrl-C, SIGTERM or the parent's end; return the exit code.

    Raises
    ------
    ConfigError
        A calibration is missing or wrong, or a source is malformed.
    """
    from fullswarm.launch.processes import serve_on_bus

    if len(cameras) > 1 and (options.source or options.show):
        raise ConfigError("--source and --show are of one camera", hint="say which: --camera NAME")
    plan = plan_of(config)
    files = {each.name: read_camera(calibration_of(each)) for each in cameras}
    for each in cameras:
        if files[each.name].floor is None:
            raise ConfigError(
                "has a lens but no floor", where=str(calibration_of(each)), hint="run `fullswarm track calibrate floor`"
            )

    def build(bus: Bus, runtime: Runtime) -> list[Node]:
        built: list[Node] = []
        for camera in cameras:
            built += _build(bus, runtime, config, camera, files[camera.name], plan, options)
        return built

    identity: tuple[str, Role] = (IDENTITY, "source")
    return serve_on_bus(config, options.with_parent, build, WORLD, identity)


def _build(
    bus: Bus,
    runtime: Runtime,
    config: SwarmConfig,
    camera: CameraConfig,
    file: CameraFile,
    plan: TagPlan,
    options: Live,
) -> list[Node]:
    keys, source = Keys(config.swarm), options.source or camera.source
    sensor = f"camera {camera.name}"[:64]
    publisher = FixPublisher(bus, runtime, keys, Names(), sensor=sensor)
    listen = camera.show if options.show is None else options.show
    preview = Preview(listen, options.insecure_network) if listen else None
    feed: LiveSource | WorldSource | None = None
    node = CameraNode(
        bus, runtime, keys, publisher, camera.name, file, str(calibration_of(camera)), plan,
        lambda: feed.problem if feed is not None else "", Show(preview),
    )  # fmt: skip
    if urlsplit(source).scheme == SCHEME:
        pictures = RobotsInPictures(SimulatedCamera.of_url(source), config, plan)
        feed = WorldSource(bus, keys, pictures, camera.rate_hz, node.take)
    elif is_live(source):
        feed = LiveSource(
            source, runtime.clock, runtime.mailbox, node.take, rate_hz=camera.rate_hz, latency_s=camera.latency_s
        )
        feed.start()
    else:
        hint = "v4l2:///dev/video0, rtsp://..., http://..., world://; a video file: fullswarm track --video FILE"
        raise ConfigError("is no live source", where=shown(source), hint=hint)
    tags = len(file.floor.tag) if file.floor else 0
    if not tags:
        log.warning("this camera's calibration has no floor tags: nothing notices it if it moves", camera=camera.name)
    log.info("camera", name=camera.name, source=shown(source), floor_tags=tags, picture=preview and preview.address)
    return [node, feed]


# ---------------------------------------------------------------- a recorded video
def judge(video: str, file: CameraFile, where: str, plan: TagPlan, *, as_json: bool) -> int:
    """Print a line for each tag of each picture of a video; return 1 if no robot is found in it."""
    tracker: Tracker | None = None
    lines, problem = 0, ""
    for shot in recorded(video):
        if tracker is None:
            optics = file.optics((shot.grey.shape[1], shot.grey.shape[0]), where)
            tracker = Tracker(optics, plan, file.with_floor_tags(plan))
        outcome = tracker.look(shot.grey, shot.time_s)
        for pose in sorted(outcome.poses, key=lambda each: each.found.tag):
            lines += 1
            values = {
                "frame": shot.number,
                "time_s": round(shot.time_s, 6),
                "tag": pose.found.tag,
                "robot": pose.robot.robot,
                "x_m": round(pose.x_m, 5),
                "y_m": round(pose.y_m, 5),
                "heading_rad": round(pose.heading_rad, 5),
                "sigma_m": round(pose.sigma_m, 5),
                "heading_sigma_rad": round(pose.heading_sigma_rad, 5),
                "quality": round(pose.found.quality, 3),
            }
            _print(values, as_json)
        if tracker.mount.problem != problem:
            problem = tracker.mount.problem
            output.progress(f"{shot.time_s:.2f} s: {problem or tracker.mount.note or 'fixes again'}")
    if tracker is not None and tracker.refusals:
        refused = ", ".join(f"{why}: {count}" for why, count in tracker.refusals.most_common())
        output.progress(f"refused: {refused}")
    return 0 if lines else 1


def _print(values: dict[str, Any], as_json: bool) -> None:
    if as_json:
        output.data_json(values, indent=None)
        return
    output.data(
        f"{values['frame']:6d} {values['time_s']:9.3f} s  tag {values['tag']:3d} {values['robot']:12}"
        f" x {values['x_m']:8.3f} y {values['y_m']:8.3f} m  heading {values['heading_rad']:6.3f} rad"
        f"  sigma {1000 * values['sigma_m']:4.1f} mm  quality {values['quality']:.2f}"
    )


def plain_plan(robots: int, size_m: float, height_m: float) -> TagPlan:
    """Return a plan without a fleet file: tags 1 to `robots` on robots r1 and so on."""
    return TagPlan({n: RobotTag(n, f"r{n}", size_m, height_m) for n in range(1, robots + 1)}, {})


# ---------------------------------------------------------------- calibration
def calibrate_lens(camera: CameraConfig, source: str, square_m: float, seconds: float) -> int:
    """Find a lens from views of the board, and write it to the camera's file.

    Raises
    ------
    ConfigError
        The views do not give a good lens; nothing is written.
    """
    found = LensCalibration(square_m)
    said_s = 0.0
    for shot in _pictures(camera, source, seconds, board=True):
        found.add(shot.grey, shown(source))
        now_s = time.monotonic()
        if now_s - said_s > SAY_S:
            said_s = now_s
            output.progress(
                f"{found.looked} pictures, {found.views} views of the board, in {found.covered:.0%} of the picture"
            )
        if is_live(source) and found.views >= GOOD_VIEWS and found.covered >= GOOD_SHARE:
            break
    lens = found.lens(shown(source))
    path = calibration_of(camera)
    write_camera(CameraFile(name=camera.name, lens=lens_part(lens)), path)
    output.progress(
        f"{path}: lens from {lens.views} views, error {lens.rms_px:.2f} px. Next: fullswarm track calibrate floor"
    )
    return 0


def calibrate_floor(
    config: SwarmConfig,
    camera: CameraConfig,
    source: str,
    board_at: tuple[float, float, float] | None,
    seconds: float,
    square_m: float,
) -> int:
    """Find where a camera hangs, and write it to the camera's file.

    Raises
    ------
    ConfigError
        The floor tags or the board are not seen, or do not fit; nothing is written.
    """
    path, plan = calibration_of(camera), plan_of(config)
    file = read_camera(path)
    pictures = (shot.grey for shot in _first(_pictures(camera, source, seconds, config=config, plan=plan), PICTURES))
    if board_at is None:
        floor = floor_from_tags(file, pictures, plan, shown(source))
    else:
        floor = floor_from_board(file, pictures, board_at, plan, shown(source), square_m)
    write_camera(file.model_copy(update={"floor": floor}), path)
    x_m, y_m, z_m = floor.position_m
    tags = ", ".join(f"{each.tag} ({each.residual_mm:.1f} mm)" for each in floor.tag) or "none"
    output.progress(
        f"{path}: the camera is at x {x_m:.2f}, y {y_m:.2f}, {z_m:.2f} m above the floor; error {floor.rms_px:.2f} px, "
        f"{floor.rms_mm:.1f} mm; floor tags: {tags}"
    )
    if not floor.tag:
        output.progress("warning: no floor tag is seen, so nothing will notice if the camera moves")
    return 0


def _pictures(
    camera: CameraConfig, source: str, seconds: float, *, board: bool = False, config: SwarmConfig | None = None,
    plan: TagPlan | None = None,
) -> Iterator[Shot]:  # fmt: skip
    """Yield pictures of any source: of the board, or of the floor of `config`."""
    if urlsplit(source).scheme == SCHEME:
        simulated = SimulatedCamera.of_url(source)
        if board:
            yield from (Shot(grey, float(number), number) for number, grey in enumerate(board_views(simulated)))
        elif config is not None and plan is not None:
            floor = RobotsInPictures(simulated, config, plan)
            yield from (Shot(floor.picture({}, {}), float(number), number) for number in range(PICTURES))
    elif is_live(source):
        yield from _live_pictures(source, camera.rate_hz, seconds)
    else:
        yield from recorded(source)


def _live_pictures(source: str, rate_hz: float, seconds: float) -> Iterator[Shot]:
    """Yield the pictures of a live source for some seconds; ``Unreachable`` if there is none."""
    clock: Clock = MonotonicClock()
    runtime = Runtime(clock, Mailbox())
    waiting: list[Shot] = []

    def take(shot: Shot) -> None:
        waiting.append(shot)
        runtime.pause()

    feed = LiveSource(source, clock, runtime.mailbox, take, rate_hz=min(rate_hz, 10.0))
    feed.start()
    until_s, count = clock.now_s() + seconds, 0
    try:
        while clock.now_s() < until_s:
            runtime.run(min(1.0, max(0.01, until_s - clock.now_s())))
            for shot in waiting:
                count += 1
                yield shot
            waiting.clear()
    finally:
        feed.close()
    if not count:
        raise Unreachable(feed.problem or "no picture", where=shown(source))


def _first(shots: Iterator[Shot], count: int) -> Iterator[Shot]:
    for number, shot in enumerate(shots, 1):
        yield shot
        if number >= count:
            return
