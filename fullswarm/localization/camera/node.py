"""One camera in a swarm: pictures in; pose fixes, a report of what is seen, and a live picture out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

import structlog

from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.localization.camera.camera_file import CameraFile
from fullswarm.localization.camera.floor_mesh import floor_mesh
from fullswarm.localization.camera.optics import Optics
from fullswarm.localization.camera.overlay import drawn, jpeg
from fullswarm.localization.camera.plan import TagPlan
from fullswarm.localization.camera.preview import Preview
from fullswarm.localization.camera.sources import Shot
from fullswarm.localization.camera.tracker import Outcome, TagPose, Tracker
from fullswarm.localization.publisher import FixPublisher
from fullswarm.localization.sighting import Sighting
from fullswarm.messages import CameraPicture, FloorMesh
from fullswarm.runtime import Scheduler

log = structlog.get_logger()

SILENT_S = 1.0
WATCH_S = 0.1
PICTURE_S = 0.5
FROZEN_S = 1.0
EVERY = 16
"""Every so many pixels are compared to notice a picture that does not change: noise changes all of them."""


def sighting(pose: TagPose, time_s: float) -> Sighting:
    """Return a pose as what a source has seen."""
    return Sighting(
        name=pose.robot.robot,
        x_m=pose.x_m,
        y_m=pose.y_m,
        heading_rad=pose.heading_rad,
        position_sigma_m=pose.sigma_m,
        heading_sigma_rad=pose.heading_sigma_rad,
        time_s=time_s,
        covariance_m2=pose.covariance_m2,
        quality=pose.found.quality,
        marker=f"tag {pose.found.tag}",
    )


@dataclass(frozen=True, slots=True)
class Show:
    """The HTTP clients that receive the picture.

    Parameters
    ----------
    preview : the server of the live picture; None: there is none
    on_bus : send small ones to the consoles
    """

    preview: Preview | None = None
    on_bus: bool = True


class CameraNode:
    """Looks at the pictures of one camera, in the order in which they come.

    Parameters
    ----------
    name : of the camera
    file : its calibration, and `where` it is
    source_problem : why its source gives no picture; empty: it does

    Attributes
    ----------
    looked : pictures so far
    """

    def __init__(
        self, bus: Bus, scheduler: Scheduler, keys: Keys, publisher: FixPublisher, name: str, file: CameraFile,
        where: str, plan: TagPlan, source_problem: Callable[[], str], show: Show = Show(),
    ) -> None:  # fmt: skip
        self._bus, self._scheduler, self._keys, self._publisher = bus, scheduler, keys, publisher
        self._name, self._file, self._where, self._plan = name, file, where, plan
        self._source_problem, self._show = source_problem, show
        self._tracker: Tracker | None = None  # from the first picture on, whose size it needs
        self._size: tuple[int, int] | None = None
        self._arrived_s = self._changed_s = scheduler.now_s()
        self._pictured_s = -PICTURE_S
        self._sample = b""
        self._note = ""
        self._strange: set[int] = set()
        self._mesh: tuple[Optics, FloorMesh] | None = None  # of the camera where it is now
        self._tops_m = median([each.height_m for each in plan.robots.values()] or [0.0])
        self.looked = 0
        for tag, each in plan.robots.items():
            publisher.expect(each.robot, f"tag {tag}")
        self._timer = scheduler.every(WATCH_S, self._watch)

    def take(self, shot: Shot) -> None:
        """Look at a picture."""
        now_s = self._scheduler.now_s()
        size = shot.grey.shape[1], shot.grey.shape[0]
        if self._tracker is None or size != self._size:
            optics = self._file.optics(size, self._where)
            self._tracker, self._size = Tracker(optics, self._plan, self._file.with_floor_tags(self._plan)), size
        sample = shot.grey[::EVERY, ::EVERY].tobytes()
        if sample != self._sample:
            self._sample, self._changed_s = sample, now_s
        self._arrived_s = now_s
        if now_s - self._changed_s > FROZEN_S:
            return  # the stream repeats one picture; the watch reports it
        outcome = self._tracker.look(shot.grey, shot.time_s)
        for pose in outcome.poses:
            self._publisher.publish(sighting(pose, shot.time_s), now_s)
        self.looked += 1
        self._say(outcome)
        self._picture(shot, outcome, self._tracker)

    # ------------------------------------------------------------------ for people
    def _say(self, outcome: Outcome) -> None:
        if self._tracker is None:
            return
        mount = self._tracker.mount
        self._publisher.problem(mount.problem)
        if mount.note != self._note:
            self._note = mount.note
            if mount.note:
                log.warning(mount.note, camera=self._name)
        for tag in outcome.picture.strange - self._strange:
            if len(self._strange) < 100:
                self._strange.add(tag)
                log.warning("a tag of no robot of the fleet", camera=self._name, tag=tag)

    def _watch(self) -> None:
        now_s = self._scheduler.now_s()
        if now_s - self._arrived_s > SILENT_S:
            self._publisher.problem(self._source_problem() or f"no picture for more than {SILENT_S:g} s")
        elif now_s - self._changed_s > FROZEN_S:
            self._publisher.problem("the source repeats the same picture: no fixes")

    def _picture(self, shot: Shot, outcome: Outcome, tracker: Tracker) -> None:
        now_s, preview = self._scheduler.now_s(), self._show.preview
        for_bus = self._show.on_bus and now_s - self._pictured_s >= PICTURE_S
        for_viewers = preview is not None and preview.watched
        if not for_bus and not for_viewers:
            return
        problem = tracker.mount.problem
        picture = jpeg(drawn(shot.grey, outcome, tracker, problem))
        if preview is not None and for_viewers:
            preview.show(picture)
        if for_bus and picture:
            self._pictured_s = now_s
            mesh = self._placed(tracker.mount.optics) if outcome.confirmed and not problem else None
            message = CameraPicture(
                camera=self._name[:64], jpeg=picture, problem=problem, mesh=mesh, stamp_s=now_s
            )  # fmt: skip
            self._bus.publish(self._keys.camera(self._name), message)

    def _placed(self, optics: Optics) -> FloorMesh:
        """Return where the picture lies; a camera that hangs still has it made once."""
        if self._mesh is None or self._mesh[0] is not optics:
            self._mesh = optics, floor_mesh(optics, self._tops_m)
        return self._mesh[1]

    def close(self) -> None:
        """Stop."""
        self._timer.cancel()
        self._publisher.close()
        if self._show.preview is not None:
            self._show.preview.close()
