"""Tracks the cameras that see the robots: which there are, what is wrong with them, and their newest pictures.

A picture is for those pages only that look at cameras, so that a page over a slow link takes none unasked.
"""

from __future__ import annotations

import base64
import math
from typing import Any

from fullswarm.messages import CameraPicture, FloorMesh

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
        jpeg = base64.b64encode(message.jpeg).decode("ascii")
        return {"t": "picture", "camera": message.camera, "jpeg": jpeg, "mesh": _shown(message.mesh)}

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


def _shown(mesh: FloorMesh | None) -> dict[str, Any] | None:
    """Return a grid as pages get it, in whole tenths of a millimetre: many digits are most of a frame."""
    if mesh is None:
        return None
    places = (
        None if x_m is None or y_m is None else [round(x_m, 4), round(y_m, 4)]
        for x_m, y_m in zip(mesh.x_m, mesh.y_m, strict=True)
    )
    return {
        "columns": mesh.columns, "rows": mesh.rows, "places": list(places), "eye_m": list(mesh.eye_m),
        "tops_m": mesh.tops_m,
    }  # fmt: skip
