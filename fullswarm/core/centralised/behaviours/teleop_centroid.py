"""Teleoperation of the centroid: a stick moves all robots alike, and each keeps its place around the centroid."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fullswarm.core.centralised.view import View
from fullswarm.kernels import Array
from fullswarm.memory import rows
from fullswarm.parameters import Params


@dataclass
class Memory:
    """What is kept of each robot."""

    offset: Array = rows(2, fill=math.nan)  # (n, 2) m, its place around the centroid; NaN: not seen yet


def velocity(view: View, params: Params, memory: Memory) -> Array:
    """Return the stick's velocity plus ``K (offset_i - (p_i - centroid))``, (n, 2) m/s."""
    around = view.position - view.position.mean(axis=0)
    memory.offset = np.where(np.isnan(memory.offset), around, memory.offset)
    place = memory.offset - memory.offset.mean(axis=0)  # robots may have dropped out since
    stick = np.hstack([params.vx, params.vy]) * params.speed_m_s
    desired: Array = stick + params.gain * (place - around)
    return desired
