"""Where a picture lies on the floor, against the renderer that made the picture: its lens and place share no code."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from fullswarm.localization.camera.floor_mesh import STEEPEST, floor_mesh
from fullswarm.localization.camera.optics import Optics
from fullswarm.messages import FloorMesh
from tests.unit import camera_lab as lab

pytest.importorskip("cv2")

SENT_PX = 960.0
"""Width of the pictures that are sent."""
TOPS_M = 0.1


def optics() -> Optics:
    return lab.calibrated().optics(lab.SIZE, "test")


def place(mesh: FloorMesh, pixel: NDArray[np.float64], height_m: float) -> NDArray[np.float64] | None:
    """Return the place of a pixel by straight lines between the points of the grid, as the page has it."""
    across = (pixel[0] + 0.5) / lab.SIZE[0] * mesh.columns
    along = (pixel[1] + 0.5) / lab.SIZE[1] * mesh.rows
    column, row = min(int(across), mesh.columns - 1), min(int(along), mesh.rows - 1)
    u, v = across - column, along - row

    def point(right: int, down: int) -> NDArray[np.float64]:
        k = (row + down) * (mesh.columns + 1) + column + right
        x_m, y_m = mesh.x_m[k], mesh.y_m[k]
        return np.array([np.nan if x_m is None else x_m, np.nan if y_m is None else y_m])

    if u + v <= 1.0:
        floor = point(0, 0) + u * (point(1, 0) - point(0, 0)) + v * (point(0, 1) - point(0, 0))
    else:
        floor = point(1, 1) + (1 - u) * (point(0, 1) - point(1, 1)) + (1 - v) * (point(1, 0) - point(1, 1))
    found: NDArray[np.float64] = floor + height_m / mesh.eye_m[2] * (np.array(mesh.eye_m[:2]) - floor)
    return found if np.isfinite(found).all() else None


@pytest.mark.parametrize("height_m", [0.0, TOPS_M])
def test_what_the_renderer_puts_at_a_pixel_lies_there_to_half_a_pixel_beside_the_error_of_the_calibration(
    height_m: float,
) -> None:
    mesh, made = floor_mesh(optics(), TOPS_M), lab.pictures().maker
    rng = np.random.default_rng(1)
    points = rng.uniform((0.05, 0.05), (lab.WIDTH_M - 0.05, lab.DEPTH_M - 0.05), (400, 2))
    pixels = made.pixels(np.column_stack((points, np.full(400, height_m))))
    away = [np.linalg.norm(found - point) for found, point in _pairs(mesh, pixels, points, height_m)]
    assert len(away) > 390  # the arena is in the picture
    pixel_m = optics().metres_per_pixel(np.array(lab.SIZE) / 2.0, height_m)[0, 0] * lab.SIZE[0] / SENT_PX
    assert 0.003 < pixel_m < 0.006
    assert np.percentile(away, 95) < 0.5 * pixel_m + 0.004
    assert max(away) < pixel_m + 0.004


def _pairs(
    mesh: FloorMesh, pixels: NDArray[np.float64], points: NDArray[np.float64], height_m: float
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    inside = ((pixels > 0.0) & (pixels < np.array(lab.SIZE) - 1.0)).all(axis=1)
    found = [(place(mesh, pixel, height_m), point) for pixel, point in zip(pixels[inside], points[inside], strict=True)]
    return [(each, point) for each, point in found if each is not None]


def test_the_grid_adds_less_than_half_a_pixel_to_the_lens_model() -> None:
    mesh, model = floor_mesh(optics(), TOPS_M), optics()
    rng = np.random.default_rng(2)
    pixels = rng.uniform((0.0, 0.0), (lab.SIZE[0] - 1.0, lab.SIZE[1] - 1.0), (500, 2))
    exact = model.places(pixels, 0.0)
    found = [place(mesh, pixel, 0.0) for pixel in pixels]
    shares = []
    for pixel, each, point in zip(pixels, found, exact, strict=True):
        assert each is not None
        pixel_m = np.linalg.norm(model.metres_per_pixel(pixel, 0.0), axis=0).max() * lab.SIZE[0] / SENT_PX
        shares.append(np.linalg.norm(each - point) / pixel_m)
    assert max(shares) < 0.5, max(shares)


def test_a_camera_that_sees_the_horizon_has_no_places_there() -> None:
    model = optics()
    cos, sin = np.cos(np.radians(75.0)), np.sin(np.radians(75.0))
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, cos, sin], [0.0, -sin, cos]])
    mesh = floor_mesh(replace(model, rotation=tilt @ model.rotation), TOPS_M)
    known = [each is not None for each in mesh.x_m]
    assert known == [each is not None for each in mesh.y_m]
    assert any(known)
    assert not all(known)
    for x_m, y_m in zip(mesh.x_m, mesh.y_m, strict=True):
        if x_m is not None and y_m is not None:
            assert np.hypot(x_m - mesh.eye_m[0], y_m - mesh.eye_m[1]) <= STEEPEST * mesh.eye_m[2] + 1e-9


def test_a_lens_that_folds_back_at_its_edge_has_no_places_there() -> None:
    model = optics()
    bent = replace(model.lens, distortion=np.array([-0.9, 0.0, 0.0, 0.0, 0.0]))
    mesh = floor_mesh(replace(model, lens=bent), TOPS_M)
    middle = (mesh.rows // 2) * (mesh.columns + 1) + mesh.columns // 2
    assert mesh.x_m[middle] is not None
    assert mesh.x_m[0] is None
