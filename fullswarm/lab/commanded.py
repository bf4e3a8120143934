"""The behaviour of robots that a program commands: desired twists or planar velocities from an array."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array


class Commanded:
    """What a program commands each of n robots.

    Parameters
    ----------
    rows : of the robots, by name

    Attributes
    ----------
    value : (n, 2) m/s and rad/s, or m/s east and north; stays until it is overwritten
    """

    def __init__(self, rows: Mapping[str, int]) -> None:
        self.value: Array = np.zeros((len(rows), 2))
        self._rows = rows

    def __call__(self, view: View, _params: Params) -> Array:
        """Return the rows of the robots of the view, (k, 2); the control law."""
        found: Array = self.value[[self._rows[name] for name in view.id.tolist()]]
        return found

    def law(self, *, planar: bool) -> Any:
        """Return what stands for the module of a control law."""
        return SimpleNamespace(velocity=self) if planar else SimpleNamespace(twist=self)
