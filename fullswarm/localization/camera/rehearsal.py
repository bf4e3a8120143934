"""The simulated camera: what `world://` shows of the simulated world, and of the calibration board.

    world://?height_m=3.4&tilt_deg=4&noise=3&seed=7

Its lens and its place are what calibration has to find: nothing here is read by what finds it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from urllib.parse import parse_qsl, urlsplit

import numpy as np

from fullswarm.config import SwarmConfig
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.localization.camera.board import COLUMNS, ROWS, SQUARE_M, board_picture
from fullswarm.localization.camera.finder import CELLS, FAMILY, Grey, pattern
from fullswarm.localization.camera.optics import opencv
from fullswarm.localization.camera.plan import TagPlan
from fullswarm.simulation.pictures import FEW_SAMPLES, Disturbance, Lens, Mount, PictureMaker, Placed, Plate, lying

SCHEME = "world"
WHITE, BLACK = 235, 22
BOX_GREY = 95
BOARD_VIEWS = 36
EDGE_M = 0.35
"""So much more than the arena is in the picture."""
WIDER = 0.93
"""The lens bends inwards, so that more is in the picture than with a straight one."""


@dataclass(frozen=True, slots=True)
class SimulatedCamera:
    """The settings in a `world://` URL; what is 0 for `height_m` follows from the size of the arena."""

    height_m: float = 0.0
    x_m: float = math.nan
    y_m: float = math.nan
    turn_deg: float = 1.5
    tilt_deg: float = 3.0
    width: int = 1920
    high: int = 1080
    focal_px: float = 1100.0
    k1: float = -0.18
    k2: float = 0.03
    exposure_ms: float = 4.0
    noise: float = 3.0
    placing_mm: float = 2.0
    seed: int = 0

    @classmethod
    def of_url(cls, url: str) -> SimulatedCamera:
        """Read a URL.

        Raises
        ------
        ConfigError
            It has a setting that there is not, or one with a wrong value.
        """
        kinds = {each.name: int if each.type == "int" else float for each in fields(cls)}
        given: dict[str, float] = {}
        for key, text in parse_qsl(urlsplit(url).query, keep_blank_values=True):
            if key not in kinds:
                raise ConfigError(f"unknown setting '{key}'", where=url, hint=did_you_mean(key, kinds))
            try:
                given[key] = kinds[key](text)
            except ValueError:
                raise ConfigError(f"'{text}' is not a number", where=f"{url}: {key}") from None
        camera = cls(**given)  # type: ignore[arg-type]
        if not (64 <= camera.width <= 8000 and 64 <= camera.high <= 8000 and camera.focal_px > 10.0):
            raise ConfigError("width, high or focal_px is no camera's", where=url)
        return camera

    def lens(self) -> Lens:
        """Return its lens; the axis is not in the middle, as in real ones."""
        centre = (self.width - 1) / 2.0 + 9.0, (self.high - 1) / 2.0 - 7.0
        return Lens(self.width, self.high, self.focal_px, centre, (self.k1, self.k2, 0.0), (0.0004, -0.0003))

    def mount(self, bounds_m: tuple[float, float, float, float], top_m: float) -> Mount:
        """Return where it hangs: above the middle, so high that tags at `top_m` are seen all over the arena."""
        x_min, y_min, x_max, y_max = bounds_m
        reach_x = ((x_max - x_min) / 2.0 + EDGE_M) * self.focal_px / (self.width / 2.0)
        reach_y = ((y_max - y_min) / 2.0 + EDGE_M) * self.focal_px / (self.high / 2.0)
        height_m = self.height_m or max(reach_x, reach_y) * WIDER + top_m
        x_m = (x_min + x_max) / 2.0 if math.isnan(self.x_m) else self.x_m
        y_m = (y_min + y_max) / 2.0 if math.isnan(self.y_m) else self.y_m
        tilt = math.radians(self.tilt_deg)
        # Tilted about a point of the floor, so that the arena stays in the middle.
        mount = Mount(x_m, y_m, height_m, math.radians(self.turn_deg), tilt, -0.6 * tilt)
        ahead = mount.axes[2]
        return Mount(
            x_m - height_m * ahead[0] / -ahead[2], y_m - height_m * ahead[1] / -ahead[2], height_m,
            mount.turn_rad, mount.tilt_x_rad, mount.tilt_y_rad,
        )  # fmt: skip


def tag_plate(tag: int, size_m: float, disc_radius_m: float = 0.0) -> Plate:
    """Return a tag with its white edge of one cell."""
    cv2 = opencv()
    white = pattern(cv2, cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, FAMILY)), tag)
    cells = np.full((CELLS + 2, CELLS + 2), WHITE, np.uint8)
    cells[1:-1, 1:-1] = np.where(white, WHITE, BLACK)
    outer = size_m * (CELLS + 2) / CELLS
    return Plate(cells, (outer, outer), disc_radius_m)


class RobotsInPictures:
    """Pictures of a fleet's robots, on the floor of its world, with the floor tags of its plan."""

    def __init__(self, camera: SimulatedCamera, config: SwarmConfig, plan: TagPlan) -> None:
        world = config.world_or_default
        rng = np.random.default_rng((camera.seed, 1))
        self._camera, self._plan = camera, plan
        self._plates = {
            each.robot: (each, tag_plate(tag, each.size_m, world.of_body(each.robot).radius_m))
            for tag, each in plan.robots.items()
        }
        boxes = [
            lying(Plate(np.full((1, 1), BOX_GREY, np.uint8), (size_y, size_x)), x, y, yaw)
            for x, y, size_x, size_y, yaw in world.boxes
        ]
        placing = camera.placing_mm / 1000.0
        tags = [
            lying(
                tag_plate(tag, each.size_m),
                each.x_m + placing * rng.standard_normal(),
                each.y_m + placing * rng.standard_normal(),
                each.heading_rad + 0.01 * rng.standard_normal(),
            )
            for tag, each in plan.floor.items()
        ]
        top_m = max((each.height_m for each in plan.robots.values()), default=0.0)
        self.maker = PictureMaker(
            camera.lens(), camera.mount(config.bounds_m, top_m), (*boxes, *tags), camera.seed, samples=FEW_SAMPLES
        )

    def picture(
        self, poses: Mapping[str, tuple[float, float, float]], twists: Mapping[str, tuple[float, float]]
    ) -> Grey:
        """Return the picture of robots at poses, which drive with twists meanwhile (m/s, rad/s)."""
        things: list[Placed] = []
        for robot, (x_m, y_m, heading_rad) in poses.items():
            if robot not in self._plates:
                continue
            tag, plate = self._plates[robot]
            x_on, y_on, turned = tag.offset
            cos, sin = math.cos(heading_rad), math.sin(heading_rad)
            speed, turn = twists.get(robot, (0.0, 0.0))
            things.append(
                lying(
                    plate,
                    x_m + cos * x_on - sin * y_on,
                    y_m + sin * x_on + cos * y_on,
                    heading_rad + turned,
                    tag.height_m,
                    velocity_m_s=(speed * cos, speed * sin),
                    turn_rad_s=turn,
                )
            )
        return self.maker.picture(things, Disturbance(self._camera.exposure_ms / 1000.0, self._camera.noise))


def board_views(camera: SimulatedCamera, views: int = BOARD_VIEWS) -> Iterator[Grey]:
    """Yield pictures of the board, held near the camera in all parts of the picture and in many directions."""
    rng = np.random.default_rng((camera.seed, 2))
    lens = camera.lens()
    # The camera looks down from above; the board is below it, as if it were waved from a ladder.
    maker = PictureMaker(lens, Mount(z_m=2.0), seed=camera.seed, plain=True, samples=FEW_SAMPLES)
    paper = np.full((ROWS * 40 + 40, COLUMNS * 40 + 40), WHITE, np.uint8)
    paper[20:-20, 20:-20] = np.where(board_picture(40) > 127, WHITE, BLACK)
    plate = Plate(paper, (SQUARE_M * paper.shape[1] / 40.0, SQUARE_M * paper.shape[0] / 40.0))
    for number in range(views):
        away_m = float(rng.uniform(0.26, 0.5))
        column, row = number % 5, number // 5 % 4
        u = lens.width_px * ((column + 0.5) / 5.0 - 0.5) * 0.82 / lens.focal_px
        v = lens.height_px * ((row + 0.5) / 4.0 - 0.5) * 0.72 / lens.focal_px
        turn, tip, roll = (
            float(rng.uniform(-math.pi, math.pi)),
            float(rng.uniform(-0.6, 0.6)),
            float(rng.uniform(-0.6, 0.6)),
        )
        cos, sin = math.cos(turn), math.sin(turn)
        ahead, left = np.array([cos, sin, 0.0]), np.array([-sin, cos, 0.0])
        up = np.array([0.0, 0.0, 1.0])
        ahead = math.cos(tip) * ahead + math.sin(tip) * up
        left = math.cos(roll) * left + math.sin(roll) * np.cross(ahead, left)
        left -= ahead * (ahead @ left)
        left /= np.linalg.norm(left)
        centre = np.array([u * away_m, -v * away_m, 2.0 - away_m])
        placed = Placed(plate, tuple(centre.tolist()), tuple(ahead.tolist()), tuple(left.tolist()))
        yield maker.picture([placed], Disturbance(0.0, camera.noise))
