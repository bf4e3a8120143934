"""Tracks the cameras that see the robots: which there are, what is wrong with them, and their newest pictures.

A picture is for those pages only that look at cameras, so that a page over a slow link takes none unasked.
"""

from __future__ import annotations

import base64
import math
from typing import Any

from fullswarm.messages import CameraPicture

SILENT_S = 3.0
"""A camera whose last picture is older gives none."""
MOST = 32


class Cameras:
    """The cameras of a swarm.

    Attributes
    ----------
    changed : what :meth:`shown` returns has changed
    """

    def __init__(self) -> None:
        self.changed = False
        self._known: dict[str, tuple[float, str]] = {}  # when the last picture came, the problem

    def add(self, message: CameraPicture, now_s: float) -> dict[str, Any] | None:
        """Take in a picture; return the frame for the pages that look; None: too many cameras."""
        before = self._known.get(message.camera)
        if before is None and len(self._known) >= MOST:
            return None
        self.changed |= before is None or before[1] != message.problem
        self._known[message.camera] = now_s, message.problem
        return {"t": "picture", "camera": message.camera, "jpeg": base64.b64encode(message.jpeg).decode("ascii")}

    def expire(self, now_s: float) -> None:
        """Note cameras that give no picture any more."""
        for name, (seen_s, _) in self._known.items():
            if now_s - seen_s > SILENT_S and not math.isinf(seen_s):
                self._known[name] = -math.inf, "no picture"
                self.changed = True

    def shown(self) -> dict[str, Any]:
        """Return the frame with all cameras."""
        cameras = [{"name": name, "problem": problem} for name, (_, problem) in sorted(self._known.items())]
        return {"t": "cameras", "cameras": cameras}
