"""Tallies join the measurements of many hosts to results: what a summarizer needs of one, and that of coverage.

Pure bookkeeping: no clock, no bus. The tally of all that is one number per robot stands in ``robot_tally.py``.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import MessageError
from fullswarm.messages import CoverageMeasurement, Message
from fullswarm.perf.coverage import GridFrame, count_bits, unpack_bits
from fullswarm.perf.termination import Progress

Values = dict[str, float]
M = TypeVar("M", bound=Message)
M_contra = TypeVar("M_contra", bound=Message, contravariant=True)


class Result(NamedTuple):
    """What came of one metric."""

    values: Values  # of the swarm, by quantity
    per_robot: Values  # in the order of the names


Results = dict[str, Result]
"""By metric."""


class Tally(Protocol[M_contra]):
    """What a summarizer needs."""

    def add(self, message: M_contra) -> None:
        """Take in one measurement.

        Raises
        ------
        MessageError
            It makes no sense; nothing was taken in.
        """
        ...

    def progress(self, elapsed_s: float) -> Progress:
        """Return what the termination conditions look at; cheap, called for each measurement."""
        ...

    def results(self) -> Results:
        """Return the swarm's results."""
        ...


class CoverageTally:
    """Arena covered by any robot so far: `fraction` of cells, `area_m2`, `cells`, `refused_hosts`.

    Cells once covered stay so when their agent restarts. The first measurement sets the grid; hosts that use
    another one cannot be joined and are counted in `refused_hosts`. Per robot: the area in m² that it covered
    since its agent started, for hosts that carry one robot (the robots of a host share a grid).
    """

    def __init__(self) -> None:
        self._frame: GridFrame | None = None
        self._union: NDArray[np.uint8] = np.zeros(0, np.uint8)  # packed, eight cells to a byte
        self._covered = 0
        self._newest: dict[str, bytes] = {}  # host → grid as received, to skip what is known
        self._area_m2: Values = {}
        self._refused_hosts: set[str] = set()

    def add(self, message: CoverageMeasurement) -> None:
        """Join one host's grid to the swarm's."""
        try:
            self._join(message)
        except MessageError:
            self._refused_hosts.add(message.host)
            raise
        self._refused_hosts.discard(message.host)

    def progress(self, elapsed_s: float) -> Progress:
        """Return the time and the fraction covered."""
        return Progress(elapsed_s=elapsed_s, coverage=self._fraction())

    def results(self) -> Results:
        """Return what the swarm has covered, and m² per robot that has a host of its own."""
        values = {
            "fraction": self._fraction(),
            "area_m2": self._covered * (self._frame.cell_area_m2 if self._frame else 0.0),
            "cells": float(self._covered),
            "refused_hosts": float(len(self._refused_hosts)),
        }
        return {"coverage": Result(values, dict(sorted(self._area_m2.items())))}

    def _join(self, message: CoverageMeasurement) -> None:
        frame = GridFrame.of(message)
        if self._frame is not None and frame != self._frame:
            raise MessageError("another grid than the swarm's", where=message.host)
        if self._newest.get(message.host) == message.cells:
            return
        bits = unpack_bits(message.cells, frame)
        if self._frame is None:
            self._frame, self._union = frame, np.zeros_like(bits)
        self._newest[message.host] = message.cells
        self._union |= bits
        self._covered = count_bits(self._union)
        if len(message.robots) == 1:
            self._area_m2[message.robots[0]] = count_bits(bits) * frame.cell_area_m2

    def _fraction(self) -> float:
        return self._covered / self._frame.cells if self._frame else 0.0
