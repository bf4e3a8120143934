"""Joins the tiles of all hosts in one occupancy grid: the newest that anyone has measured of each cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fullswarm.maps.tiles import FREE, OCCUPIED, UNKNOWN, GridPlace, place_of, unpack
from fullswarm.messages import GridTiles

_ROS = np.full(4, -1, np.int8)
_ROS[FREE], _ROS[OCCUPIED] = 0, 100
"""Values of nav_msgs/OccupancyGrid by ours."""


class JoinedGrid:
    """The grid of a swarm; a message of another grid begins it anew.

    Attributes
    ----------
    place : where its cells lie; None: nothing has been received
    changed : since `cells` was called last
    """

    def __init__(self) -> None:
        self.place: GridPlace | None = None
        self.changed = False
        self._states: NDArray[np.uint8] = np.zeros((0, 0), np.uint8)

    def add(self, message: GridTiles) -> None:
        """Take in the tiles of one host.

        Raises
        ------
        MessageError
            They are none of its grid.
        """
        place, tiles = place_of(message), unpack(message)
        if place != self.place:
            self.place, self._states = place, np.zeros((place.rows, place.columns), np.uint8)
            self.changed = True
        for number, states in tiles:
            mine = place.tile(self._states, number)
            newer = (states != UNKNOWN) & (states != mine)
            if newer.any():
                mine[newer] = states[newer]
                self.changed = True

    def cells(self) -> NDArray[np.int8]:
        """Return -1 (unknown), 0 (free) or 100 (occupied) of each cell, row by row from the lower left corner."""
        self.changed = False
        found: NDArray[np.int8] = _ROS[self._states].ravel()
        return found
