"""Renders what a camera sees of flat things in the simulated world, with known truth: for rehearsal and for tests.

Each pixel is a ray; the ray meets the plane of a thing; the thing's pattern there is the pixel's grey. So perspective,
lens distortion and the height of a thing follow from the geometry, and a moving thing is blurred over the exposure.
What reads these pictures (:mod:`fullswarm.localization.camera`) is not imported and shares no code with this file.
World frame (ENU), metres; pixels from the centre of the upper left one, x right, y down.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]
Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

INVERSE_ROUNDS = 25
SAMPLES = 4
"""A pixel of a thing is the mean of so many by so many rays; each is at another time of the exposure, too."""
FEW_SAMPLES = 2
FLOOR_GREY, FLOOR_SPREAD = 150.0, 14.0
NOISE_BANK = 7


@dataclass(frozen=True, slots=True)
class Lens:
    """A lens with radial and tangential distortion (Brown and Conrady).

    Parameters
    ----------
    width_px, height_px : of the picture
    focal_px : both axes
    centre_px : where the optical axis meets the picture; None: its middle
    radial : k1, k2, k3
    tangential : p1, p2
    """

    width_px: int = 1920
    height_px: int = 1080
    focal_px: float = 1100.0
    centre_px: tuple[float, float] | None = None
    radial: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)

    @property
    def middle_px(self) -> tuple[float, float]:
        """Where the optical axis meets the picture."""
        return self.centre_px or ((self.width_px - 1) / 2.0, (self.height_px - 1) / 2.0)

    def bent(self, x: Doubles, y: Doubles) -> tuple[Doubles, Doubles]:
        """Return where a ray through (x, y) at distance 1 leaves the lens."""
        (k1, k2, k3), (p1, p2) = self.radial, self.tangential
        square = x * x + y * y
        factor = 1.0 + square * (k1 + square * (k2 + square * k3))
        return (
            x * factor + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
            y * factor + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
        )

    def straight(self, u_px: Doubles, v_px: Doubles) -> tuple[Doubles, Doubles]:
        """Return the point at distance 1 whose ray arrives at a pixel: the inverse of :meth:`bent`, by iteration."""
        middle_x, middle_y = self.middle_px
        to_x, to_y = (u_px - middle_x) / self.focal_px, (v_px - middle_y) / self.focal_px
        x, y = to_x.copy(), to_y.copy()
        for _ in range(INVERSE_ROUNDS):
            bent_x, bent_y = self.bent(x, y)
            x, y = x + (to_x - bent_x), y + (to_y - bent_y)
        return x, y


@dataclass(frozen=True, slots=True)
class Mount:
    """Where a camera is and where it looks: straight down, then tilted about its own axes.

    Parameters
    ----------
    x_m, y_m, z_m : of its optical centre
    turn_rad : about the vertical; 0: the right of the picture is east
    tilt_x_rad, tilt_y_rad : about the picture's right and down axes
    """

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 3.0
    turn_rad: float = 0.0
    tilt_x_rad: float = 0.0
    tilt_y_rad: float = 0.0

    @property
    def axes(self) -> Doubles:
        """The picture's right, down and the way ahead in the world, as rows, (3, 3)."""
        cos, sin = math.cos(self.turn_rad), math.sin(self.turn_rad)
        down = np.array([[cos, sin, 0.0], [sin, -cos, 0.0], [0.0, 0.0, -1.0]])
        cx, sx = math.cos(self.tilt_x_rad), math.sin(self.tilt_x_rad)
        cy, sy = math.cos(self.tilt_y_rad), math.sin(self.tilt_y_rad)
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
        about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
        turned: Doubles = about_x @ about_y @ down
        return turned


@dataclass(frozen=True, slots=True)
class Plate:
    """A flat thing: a pattern of grey cells in a square or rectangle, on a plain disc or without one.

    Parameters
    ----------
    pattern : (rows, columns) grey; its upper edge points ahead, along the x axis of its pose
    size_m : width (across) and length (ahead) of the pattern
    disc_radius_m, disc_grey : what it lies on; 0: nothing
    """

    pattern: Grey
    size_m: tuple[float, float]
    disc_radius_m: float = 0.0
    disc_grey: float = 50.0


@dataclass(frozen=True, slots=True)
class Placed:
    """Where a plate is at the middle of the exposure, and how it moves.

    Parameters
    ----------
    origin_m : (3,) of the plate's centre
    ahead, left : (3,) unit vectors of its x and y axis
    velocity_m_s : (3,)
    turn_rad_s : about its normal
    """

    plate: Plate
    origin_m: tuple[float, float, float]
    ahead: tuple[float, float, float] = (1.0, 0.0, 0.0)
    left: tuple[float, float, float] = (0.0, 1.0, 0.0)
    velocity_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_rad_s: float = 0.0


def lying(
    plate: Plate, x_m: float, y_m: float, heading_rad: float, height_m: float = 0.0, *,
    velocity_m_s: tuple[float, float] = (0.0, 0.0), turn_rad_s: float = 0.0,
) -> Placed:  # fmt: skip
    """Return a plate that lies level at a height."""
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    return Placed(
        plate, (x_m, y_m, height_m), (cos, sin, 0.0), (-sin, cos, 0.0), (*velocity_m_s, 0.0), turn_rad_s
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Disturbance:
    """What makes a picture worse.

    Parameters
    ----------
    exposure_s : the picture is the mean over this time
    noise : standard deviation of a pixel's grey, 0 to 255
    glare : (x, y, radius) in pixels of spots that are blown out
    covers : (x, y, width, height) in pixels of what hangs between the camera and the floor
    light : brightness of the whole picture
    """

    exposure_s: float = 0.0
    noise: float = 0.0
    glare: tuple[tuple[float, float, float], ...] = ()
    covers: tuple[tuple[float, float, float, float], ...] = ()
    light: float = 1.0


@dataclass(slots=True)
class PictureMaker:
    """A camera with a lens on a mount; its pictures of plates on a floor.

    Parameters
    ----------
    floor : plates that do not move; they and the floor's texture are rendered once
    seed : of the floor's texture and the noise
    plain : the background is one grey, as in front of a wall
    """

    lens: Lens
    mount: Mount
    floor: tuple[Placed, ...] = ()
    seed: int = 0
    plain: bool = False
    samples: int = SAMPLES
    _rays: Floats = field(init=False)  # (h, w, 3) world directions
    _steps: tuple[Floats, Floats] = field(init=False)  # their change per pixel, x and y
    _background: Floats = field(init=False)
    _noise: Floats = field(init=False)
    _rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        lens = self.lens
        v, u = np.mgrid[0 : lens.height_px, 0 : lens.width_px].astype(float)
        x, y = lens.straight(u, v)
        right, down, ahead = self.mount.axes
        rays = x[..., None] * right + y[..., None] * down + ahead
        self._rays = rays.astype(np.float32)
        self._steps = (
            np.gradient(rays, axis=1).astype(np.float32),
            np.gradient(rays, axis=0).astype(np.float32),
        )
        self._rng = np.random.default_rng(self.seed)
        shape = (lens.height_px + NOISE_BANK * 8, lens.width_px + NOISE_BANK * 8)
        self._noise = self._rng.standard_normal(shape, np.float32)
        self._background = np.full((lens.height_px, lens.width_px), FLOOR_GREY, np.float32)
        if not self.plain:
            self._background += self._texture()
        for each in self.floor:
            self._draw(self._background, each, 0.0, SAMPLES)

    def picture(self, things: Sequence[Placed], disturbance: Disturbance = Disturbance()) -> Grey:
        """Return a picture, (h, w); later things cover earlier ones."""
        image = self._background.copy()
        for each in things:
            self._draw(image, each, disturbance.exposure_s, self.samples)
        for x, y, width, height in disturbance.covers:
            image[max(0, int(y)) : max(0, int(y + height)), max(0, int(x)) : max(0, int(x + width))] = 35.0
        if disturbance.light != 1.0:
            image *= disturbance.light
        for x, y, radius in disturbance.glare:
            self._dazzle(image, x, y, radius)
        if disturbance.noise > 0.0:
            row, column = self._rng.integers(0, NOISE_BANK * 8, 2)
            height, width = image.shape
            image += disturbance.noise * self._noise[row : row + height, column : column + width]
        np.clip(image, 0.0, 255.0, out=image)
        return image.astype(np.uint8)

    def pixels(self, points_m: Doubles) -> Doubles:
        """Return where points of the world, (n, 3), are in the picture, (n, 2); NaN for what is behind."""
        mount, lens = self.mount, self.lens
        seen = (np.asarray(points_m, float) - (mount.x_m, mount.y_m, mount.z_m)) @ mount.axes.T
        with np.errstate(divide="ignore", invalid="ignore"):
            ahead = np.where(seen[:, 2] > 1e-6, seen[:, 2], np.nan)
            x, y = lens.bent(seen[:, 0] / ahead, seen[:, 1] / ahead)
        middle_x, middle_y = lens.middle_px
        return np.column_stack((x * lens.focal_px + middle_x, y * lens.focal_px + middle_y))

    # ------------------------------------------------------------------ parts
    def _texture(self) -> Floats:
        """Return spots of a floor at several sizes, (h, w), from coarse random grids."""
        height, width = self._background.shape
        total = np.zeros((height, width), np.float32)
        for cell, share in ((97, 0.5), (31, 0.3), (9, 0.2)):
            coarse = self._rng.standard_normal((height // cell + 2, width // cell + 2)).astype(np.float32)
            v, u = np.arange(height) / cell, np.arange(width) / cell
            rows, columns = v.astype(int), u.astype(int)
            dv, du = (v - rows)[:, None].astype(np.float32), (u - columns)[None].astype(np.float32)
            upper = coarse[rows][:, columns] * (1 - du) + coarse[rows][:, columns + 1] * du
            lower = coarse[rows + 1][:, columns] * (1 - du) + coarse[rows + 1][:, columns + 1] * du
            total += share * (upper * (1 - dv) + lower * dv)
        return FLOOR_SPREAD * total

    def _dazzle(self, image: Floats, x: float, y: float, radius: float) -> None:
        reach = int(2.5 * radius)
        top, left = max(0, int(y) - reach), max(0, int(x) - reach)
        part = image[top : max(0, int(y) + reach), left : max(0, int(x) + reach)]
        v, u = np.mgrid[0 : part.shape[0], 0 : part.shape[1]].astype(np.float32)
        part += 420.0 * np.exp(-((u + left - x) ** 2 + (v + top - y) ** 2) / (2.0 * (radius / 1.5) ** 2))

    def _window(self, each: Placed, exposure_s: float) -> tuple[int, int, int, int] | None:
        """Return top, bottom, left, right of the pixels in which a plate may be; None: outside."""
        width, length = each.plate.size_m
        reach = max(math.hypot(width, length) / 2.0, each.plate.disc_radius_m)
        reach += exposure_s * float(np.linalg.norm(each.velocity_m_s)) / 2.0
        around = np.linspace(0.0, 2.0 * math.pi, 16, endpoint=False)
        edge = (
            np.array(each.origin_m)
            + 1.05 * reach * np.cos(around)[:, None] * np.array(each.ahead)
            + 1.05 * reach * np.sin(around)[:, None] * np.array(each.left)
        )
        seen = self.pixels(edge)
        if np.isnan(seen).any():
            return None
        left, top = np.floor(seen.min(axis=0)).astype(int) - 1
        right, bottom = np.ceil(seen.max(axis=0)).astype(int) + 2
        top, left = max(0, top), max(0, left)
        bottom, right = min(self.lens.height_px, bottom), min(self.lens.width_px, right)
        return (top, bottom, left, right) if top < bottom and left < right else None

    def _draw(self, image: Floats, each: Placed, exposure_s: float, samples: int) -> None:
        window = self._window(each, exposure_s)
        if window is None:
            return
        top, bottom, left, right = window
        part = slice(top, bottom), slice(left, right)
        rays, step_x, step_y = self._rays[part], self._steps[0][part], self._steps[1][part]
        total, inside = np.zeros(rays.shape[:2], np.float32), np.zeros(rays.shape[:2], np.float32)
        count = samples * samples
        # Neighbouring rays of a pixel are at times far apart, so that neither edges nor blur show steps.
        times = (np.arange(count) * 7 % count + 0.5) / count - 0.5
        for number in range(count):
            across = (number % samples + 0.5) / samples - 0.5
            down = (number // samples + 0.5) / samples - 0.5
            grey, hit = self._sample(each, rays + across * step_x + down * step_y, times[number] * exposure_s)
            total += grey
            inside += hit
        here = image[part]
        here *= 1.0 - inside / count
        here += total / count

    def _sample(self, each: Placed, rays: Floats, after_s: float) -> tuple[Floats, Floats]:
        """Return the grey where rays meet a plate, 0 outside, and whether they meet it, (h, w) each."""
        mount, plate = self.mount, each.plate
        turned = each.turn_rad_s * after_s
        cos, sin = math.cos(turned), math.sin(turned)
        e_ahead, e_left = np.array(each.ahead), np.array(each.left)
        ahead, left = cos * e_ahead + sin * e_left, cos * e_left - sin * e_ahead
        centre = np.array(each.origin_m) + after_s * np.array(each.velocity_m_s)
        camera = np.array((mount.x_m, mount.y_m, mount.z_m))
        normal = np.cross(ahead, left)
        distance = np.float32(normal @ (centre - camera)) / (rays @ normal.astype(np.float32))
        base = camera - centre
        x = (rays @ ahead.astype(np.float32)) * distance + np.float32(base @ ahead)
        y = (rays @ left.astype(np.float32)) * distance + np.float32(base @ left)
        rows, columns = plate.pattern.shape
        width, length = plate.size_m
        row = np.floor((0.5 - x / length) * rows).astype(np.int32)
        column = np.floor((0.5 - y / width) * columns).astype(np.int32)
        hit = (row >= 0) & (row < rows) & (column >= 0) & (column < columns) & (distance > 0)
        grey = np.zeros(x.shape, np.float32)
        grey[hit] = plate.pattern[row[hit], column[hit]]
        if plate.disc_radius_m > 0.0:
            disc = (x * x + y * y <= plate.disc_radius_m**2) & (distance > 0) & ~hit
            grey[disc] = plate.disc_grey
            hit |= disc
        return grey, hit.astype(np.float32)
