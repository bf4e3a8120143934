"""Turns one camera's pictures into poses of robots: which tag is where, how sure that is, and what is refused.

A detection counts when its tag is of the plan, is in the picture once, has the size that its plan states at the height
that it states, is within reach of where it was, and the floor tags confirm where the camera is.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from fullswarm.geometry import wrap
from fullswarm.localization.camera.finder import Found, Grey, Picture, TagFinder
from fullswarm.localization.camera.mounting import MountWatch
from fullswarm.localization.camera.optics import Optics, fit_square
from fullswarm.localization.camera.plan import RobotTag, TagPlan

WRONG_SIZE = 0.13
"""A tag that is larger or smaller by this share is not at its height, not flat, or not ours."""
BENT = 0.12
SIGMA_PX = 0.35
"""Standard deviation of a tag's middle in the picture."""
SIGMA_HEIGHT_M = 0.004
LEAST_SIGMA_RAD = 0.006
FASTEST_M_S = 3.0
SLACK_M = 0.06
FORGOTTEN_S = 2.0
"""A tag that was not seen for so long may be anywhere."""
AGAIN_COUNT, AGAIN_S = 4, 0.25
"""A tag that jumps, as a robot that is carried, counts again after so many pictures over so long at the new place."""
AMBIGUOUS_S = 1.0
"""A tag that was seen at two places gives no fix for so long: the parts of the picture are searched in turn."""
ALL_S = 0.2


@dataclass(frozen=True, slots=True)
class TagPose:
    """Where a robot is by its tag. World frame.

    Attributes
    ----------
    covariance_m2 : xx, xy, yy
    """

    found: Found
    robot: RobotTag
    x_m: float
    y_m: float
    heading_rad: float
    covariance_m2: tuple[float, float, float]
    heading_sigma_rad: float

    @property
    def sigma_m(self) -> float:
        """Standard deviation along the worse axis."""
        xx, xy, yy = self.covariance_m2
        return math.sqrt((xx + yy) / 2.0 + math.hypot((xx - yy) / 2.0, xy))


@dataclass(slots=True)
class Outcome:
    """What a picture says.

    Attributes
    ----------
    poses : fixes
    refused : why a tag that was seen gives none, by number
    confirmed : the floor tags confirm the camera's pose
    """

    picture: Picture
    poses: list[TagPose] = field(default_factory=list)
    refused: dict[int, str] = field(default_factory=dict)
    confirmed: bool = True


@dataclass(slots=True)
class _Place:
    """Where a tag was taken to be last, and where it seems to be now."""

    x_m: float
    y_m: float
    time_s: float
    new: list[tuple[float, float, float]] = field(default_factory=list)  # time, x, y


class Tracker:
    """One camera.

    Attributes
    ----------
    mount : whether the camera is where its calibration says
    refusals : by kind
    """

    def __init__(self, optics: Optics, plan: TagPlan, floor: TagPlan | None = None) -> None:
        self.plan = plan
        self.mount = MountWatch(optics, dict((floor or plan).floor))
        self.finder = TagFinder((*plan.robots, *self.mount.tags))
        self.refusals: Counter[str] = Counter()
        self._places: dict[int, _Place] = {}
        self._twice_s: dict[int, float] = {}
        self._all_s, self._confirmed = -math.inf, True

    def look(self, grey: Grey, time_s: float) -> Outcome:
        """Take in a picture, (h, w), exposed at a time."""
        mount = self.mount
        if not self._confirmed and time_s - self._all_s >= ALL_S:
            self._all_s = time_s
            self.finder.search_everything()
        for tag, corners in mount.expected.items():
            self.finder.expect(tag, corners, time_s)
        picture = self.finder.find(grey, time_s)
        outcome = Outcome(picture, confirmed=mount.confirm(picture.tags, time_s))
        self._confirmed = outcome.confirmed
        for tag in picture.twice:
            self._twice_s[tag] = time_s
        for tag, found in picture.tags.items():
            robot = self.plan.robots.get(tag)
            if robot is None:
                continue
            self._judge(outcome, found, robot, time_s)
        self.refusals.update(outcome.refused.values())
        return outcome

    def _judge(self, outcome: Outcome, found: Found, robot: RobotTag, time_s: float) -> None:
        if not outcome.confirmed:
            outcome.refused[found.tag] = "the floor tags do not confirm the camera's pose"
            return
        if time_s - self._twice_s.get(found.tag, -math.inf) < AMBIGUOUS_S:
            outcome.refused[found.tag] = "the tag is at two places"
            return
        pose = self._pose(found, robot)
        if isinstance(pose, str):
            outcome.refused[found.tag] = pose
        elif self._reachable(pose, time_s):
            outcome.poses.append(pose)
        else:
            outcome.refused[found.tag] = "it cannot have come there so fast"

    def _pose(self, found: Found, robot: RobotTag) -> TagPose | str:
        optics = self.mount.optics
        corners = optics.places(found.corners, robot.height_m)
        if not np.isfinite(corners).all():
            return "it is not below the camera"
        fit = fit_square(corners)
        slack = WRONG_SIZE + 1.5 / max(found.side_px, 1.0)
        if abs(fit.side_m / robot.size_m - 1.0) > slack:
            return "its size does not fit its height"
        if fit.residual_m > BENT * robot.size_m + 0.02 * robot.size_m:
            return "it is not flat"
        centre = found.centre
        jacobian = optics.metres_per_pixel(centre, robot.height_m)
        sideways = (np.array((fit.x_m, fit.y_m)) - optics.position_m[:2]) / max(
            0.1, optics.position_m[2] - robot.height_m
        )
        covariance = (
            jacobian @ jacobian.T * (SIGMA_PX / found.quality**0.5) ** 2
            + np.outer(sideways, sideways) * SIGMA_HEIGHT_M**2
            + np.eye(2) * optics.sigma_m**2
        )
        pixel_m = float(np.abs(np.linalg.det(jacobian))) ** 0.5
        turn_sigma = math.hypot(LEAST_SIGMA_RAD, SIGMA_PX * pixel_m / (0.7 * robot.size_m) / found.quality**0.5)
        x_on, y_on, turned = robot.offset
        heading = wrap(fit.heading_rad - turned)
        cos, sin = math.cos(heading), math.sin(heading)
        return TagPose(
            found,
            robot,
            fit.x_m - cos * x_on + sin * y_on,
            fit.y_m - sin * x_on - cos * y_on,
            heading,
            (float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])),
            turn_sigma,
        )

    def _reachable(self, pose: TagPose, time_s: float) -> bool:
        """Return whether a robot can have come here; a place at which it stays counts after a while."""
        tag, x_m, y_m = pose.found.tag, pose.x_m, pose.y_m
        place = self._places.get(tag)
        if place is None:
            if pose.found.wrong_cells:  # once and not clearly: a second picture must agree
                self._places[tag] = _Place(math.inf, math.inf, time_s, [(time_s, x_m, y_m)])
                return False
            self._places[tag] = _Place(x_m, y_m, time_s)
            return True
        if time_s - place.time_s > FORGOTTEN_S and not place.new:
            place.x_m = place.y_m = math.inf
        reach = FASTEST_M_S * max(0.0, time_s - place.time_s) + SLACK_M
        if math.hypot(x_m - place.x_m, y_m - place.y_m) <= reach:
            place.x_m, place.y_m, place.time_s = x_m, y_m, time_s
            place.new.clear()
            return True
        if place.new:
            last_s, last_x, last_y = place.new[-1]
            if math.hypot(x_m - last_x, y_m - last_y) > FASTEST_M_S * (time_s - last_s) + SLACK_M:
                place.new.clear()
        place.new.append((time_s, x_m, y_m))
        needed = (2, 0.0) if math.isinf(place.x_m) else (AGAIN_COUNT, AGAIN_S)
        if len(place.new) >= needed[0] and time_s - place.new[0][0] >= needed[1]:
            place.x_m, place.y_m, place.time_s = x_m, y_m, time_s
            place.new.clear()
            return True
        return False
