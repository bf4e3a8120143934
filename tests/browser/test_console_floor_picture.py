"""A camera's picture under the map, to scale: a detector of its own finds the tags in what the page has drawn.

The picture is rendered of robots at known places (`simulation.pictures`); where it lies is what the calibrated camera
says. The middle of each tag, as OpenCV's ArUco detector finds it in the pixels of the map, is compared with the truth.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from fullswarm.localization.camera.finder import FAMILY
from fullswarm.localization.camera.floor_mesh import floor_mesh
from fullswarm.localization.camera.plan import plan_of
from fullswarm.messages import CameraPicture, FloorMesh
from fullswarm.operator.console.cameras import Cameras
from tests.browser.axe import NPM, violations
from tests.browser.conftest import Snap
from tests.browser.console import Console
from tests.browser.played import play, sent
from tests.unit import camera_lab as lab

cv2 = pytest.importorskip("cv2")

SENT_PX = 960
TOPS_M = 0.1
LEAST_TAGS = 5
"""Of the robots: lines of the map's grid go through others, which no detector reads then."""
Places = dict[int, tuple[float, float]]


@cache
def jpeg() -> bytes:
    """Return a picture without what a camera draws into it, for the detector's sake."""
    grey = lab.pictures().picture(lab.in_circles(0.0), {})
    small = cv2.resize(grey, None, fx=SENT_PX / lab.SIZE[0], fy=SENT_PX / lab.SIZE[0], interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 90])
    return bytes(data.tobytes())


def frame(mesh: FloorMesh | None) -> dict[str, Any]:
    """Return a picture as the console sends it."""
    found = Cameras().add(CameraPicture(camera="ceiling", jpeg=jpeg(), mesh=mesh), 0.0)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def mesh() -> FloorMesh:
    return floor_mesh(lab.calibrated().optics(lab.SIZE, "test"), TOPS_M)


@pytest.fixture(scope="module")
def console(browser: Browser, mesh: FloorMesh) -> Iterator[Console]:
    """A large page, so that the detector has pixels."""
    console = play(browser, {"width": 1900, "height": 1100}, 1, color_scheme="light", device_scale_factor=2)
    arena = {"t": "world", "arena": [0, 0, lab.WIDTH_M, lab.DEPTH_M], "boxes": [], "behaviours": {}}
    say(console, arena)
    console.press("f")
    say(console, {"t": "cameras", "cameras": [{"name": "ceiling", "problem": ""}]})
    console.named("camera-toggle").click()
    console.named("camera-under").select_option("ceiling")
    console.named("camera-opacity").fill("100")
    console.page.locator("#camera-close").click()
    yield console
    console.faultless()
    console.page.context.close()


def say(console: Console, message: dict[str, Any]) -> None:
    console.page.evaluate("(message) => fake.say(message)", message)


def show(console: Console, picture: dict[str, Any]) -> Places:
    """Send a picture until all robots' tags are on the map; return all tags there."""
    found: Places = {}

    def drawn() -> bool:
        nonlocal found
        say(console, picture)
        console.page.wait_for_timeout(100)
        found = on_the_map(console)
        return len(found.keys() & set(range(1, 9))) >= LEAST_TAGS

    console.until(drawn, 20.0, "the picture is under the map")
    return found


def on_the_map(console: Console) -> Places:
    """Return the middle of each tag that is drawn, in metres: tag → x, y."""
    ground = console.page.evaluate("document.querySelector('#map-ground').toDataURL('image/png')")
    image = cv2.imdecode(np.frombuffer(base64.b64decode(ground.partition(",")[2]), np.uint8), cv2.IMREAD_GRAYSCALE)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, FAMILY))
    corners, tags, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(image)
    box = console.named("map").bounding_box()
    assert box is not None
    (left, low), (right, _) = console.at(0.0, 0.0), console.at(1.0, 0.0)
    found = {}
    for square, tag in zip(corners, () if tags is None else tags.ravel(), strict=True):
        # Pixels are counted from the centre of the first.
        x_px, y_px = (square.reshape(4, 2).mean(axis=0) + 0.5) / (image.shape[1] / box["width"])
        found[int(tag)] = ((x_px + box["x"] - left) / (right - left), (low - y_px - box["y"]) / (right - left))
    return found


def plane(console: Console, name: str) -> None:
    console.named("camera-toggle").click()
    console.named("camera-plane").select_option(name)
    console.page.locator("#camera-close").click()


def away_m(found: Places, truth: Places) -> list[float]:
    return [math.dist(found[tag], truth[tag]) for tag in sorted(found.keys() & truth.keys())]


def pixel_m(mesh: FloorMesh) -> float:
    """Return the size of a pixel of the picture in its middle."""
    k = (mesh.rows // 2) * (mesh.columns + 1) + mesh.columns // 2
    one, other = mesh.x_m[k], mesh.x_m[k + 1]
    assert one is not None
    assert other is not None
    return abs(other - one) / (SENT_PX / mesh.columns)


def test_tags_on_the_floor_are_drawn_where_they_lie(console: Console, mesh: FloorMesh, snap: Snap) -> None:
    found = show(console, frame(mesh))
    truth = {tag: (each.x_m, each.y_m) for tag, each in plan_of(lab.fleet()).floor.items()}
    away = away_m(found, truth)
    snap(console.page, "floor-picture")
    assert len(away) >= 4
    assert max(away) < pixel_m(mesh), away


def test_tags_on_robots_are_drawn_where_their_robots_are_to_the_scale_of_their_tops(
    console: Console, mesh: FloorMesh
) -> None:
    truth = {int(robot[1:]): (x_m, y_m) for robot, (x_m, y_m, _) in lab.in_circles(0.0).items()}
    on_floor = away_m(show(console, frame(mesh)), truth)
    plane(console, "tops")
    console.until(lambda: max(away_m(show(console, frame(mesh)), truth)) < max(on_floor), 10.0, "it is laid anew")
    away = away_m(on_the_map(console), truth)
    assert len(away) >= LEAST_TAGS
    assert max(away) < pixel_m(mesh), away
    assert max(on_floor) > 3 * max(away)  # a tag is nearer to the camera than the floor
    plane(console, "floor")


def test_the_page_itself_has_little_to_do(console: Console, mesh: FloorMesh) -> None:
    show(console, frame(mesh))
    taken = []
    for _ in range(5):
        say(console, frame(mesh))
        taken.append(console.state["picture"]["page_ms"])
        console.page.wait_for_timeout(50)
    assert sorted(taken)[2] < 10.0


def test_a_picture_that_has_no_place_or_grows_old_is_not_drawn(console: Console, mesh: FloorMesh) -> None:
    show(console, frame(mesh))
    say(console, frame(None))
    console.page.evaluate("fake.skip(3000)")
    expect(console.named("camera-floor-words")).to_contain_text("not known where the camera looks")
    console.until(lambda: not console.state["picture"]["shown"], 5.0, "it is gone")
    show(console, frame(mesh))
    expect(console.named("camera-floor-words")).to_be_empty()


@pytest.mark.parametrize(
    "broken",
    [
        {"jpeg": "bm9uZQ=="},
        {"mesh": {"columns": 1, "rows": 1, "places": [[0, 0]] * 4, "eye_m": [0, 0, 3], "tops_m": 0.1}},
        {"mesh": {"columns": 1, "rows": 1, "places": [None] * 4, "eye_m": [0, 0, 3], "tops_m": 0.1}},
        {"mesh": {"columns": 1, "rows": 1, "places": [[-1e7, 0], [1e7, 0], [0, 0], [0, 1e-9]],
                  "eye_m": [0, 0, 1e-9], "tops_m": 100}},
        {"mesh": {"columns": 60, "rows": 60, "places": [[(k * 7919) % 4001, (k * 104729) % 3989] for k in range(3721)],
                  "eye_m": [0, 0, 3], "tops_m": 0.1}},
    ],
    ids=["no picture", "no extent", "no place", "endless", "tangled"],
)  # fmt: skip
def test_what_is_no_picture_harms_nothing(console: Console, mesh: FloorMesh, broken: dict[str, Any]) -> None:
    say(console, frame(mesh) | broken)
    assert len(show(console, frame(mesh))) > LEAST_TAGS


def test_pictures_are_sent_as_long_as_one_is_shown_anywhere(console: Console) -> None:
    assert [each["on"] for each in sent(console, "watch")] == [True]
    console.named("camera-toggle").click()
    console.named("camera-under").select_option("")
    assert [each["on"] for each in sent(console, "watch")] == [True]
    if NPM is not None:
        assert violations(console.page) == []
    console.page.locator("#camera-close").click()
    assert [each["on"] for each in sent(console, "watch")] == [True, False]
