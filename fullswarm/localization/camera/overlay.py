"""Draws into a picture what a camera has found: tags with their robots, what was refused, the state of the camera."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fullswarm.localization.camera.finder import Grey
from fullswarm.localization.camera.optics import opencv
from fullswarm.localization.camera.tracker import Outcome, Tracker

WIDTH_PX = 960
QUALITY = 70
GOOD, FLOOR, BAD = (80, 200, 60), (200, 160, 40), (50, 60, 230)
"""Blue, green, red, as OpenCV has them."""


def drawn(grey: Grey, outcome: Outcome, tracker: Tracker, problem: str) -> NDArray[np.uint8]:
    """Return a smaller picture in colours, (h, w, 3), with everything that was found."""
    cv2 = opencv()
    factor = min(1.0, WIDTH_PX / grey.shape[1])
    small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    image: NDArray[np.uint8] = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
    used = {pose.found.tag: pose for pose in outcome.poses}
    for tag, found in outcome.picture.tags.items():
        corners = np.round((found.corners + 0.5) * factor - 0.5).astype(np.int32)
        colour = GOOD if tag in used else FLOOR if tag in tracker.mount.tags else BAD
        cv2.polylines(image, [corners.reshape(-1, 1, 2)], True, colour, 1, cv2.LINE_AA)
        words = f"{used[tag].robot.robot}" if tag in used else f"{tag}"
        if tag in used:
            ahead = (found.corners[0] + found.corners[1]) / 2.0 - found.centre
            end = np.round((found.centre + 2.2 * ahead + 0.5) * factor - 0.5).astype(int)
            middle = np.round((found.centre + 0.5) * factor - 0.5).astype(int)
            cv2.arrowedLine(image, tuple(middle.tolist()), tuple(end.tolist()), colour, 2, cv2.LINE_AA, tipLength=0.3)
        if tag in outcome.refused:
            words += f": {outcome.refused[tag]}"
        _write(cv2, image, words, int(corners[:, 0].max()) + 4, int(corners[:, 1].min()), colour)
    if problem:
        _write(cv2, image, problem, 10, 24, BAD, 0.6)
    return image


def jpeg(image: NDArray[np.uint8]) -> bytes:
    """Return a picture as JPEG."""
    cv2 = opencv()
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return bytes(data) if done else b""


def _write(
    cv2: Any, image: NDArray[np.uint8], words: str, x: int, y: int, colour: tuple[int, int, int], size: float = 0.42
) -> None:
    plain = words.encode("ascii", "replace").decode()  # what OpenCV's letters have
    for line, start in enumerate(range(0, len(plain), 110)):
        at = x, max(12, y) + line * math.ceil(34 * size)
        cv2.putText(image, plain[start : start + 110], at, cv2.FONT_HERSHEY_SIMPLEX, size, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(image, plain[start : start + 110], at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)
