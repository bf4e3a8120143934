"""Keeps the newest broadcast of each sender, and what a control law sees of it: `view.heard`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from fullswarm.agent.messaging.declaration import Layout
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array, Index

EXPIRY_S = 1.0
"""A broadcast counts for so long, or for `EXPIRY_PERIODS` of its rate if that is longer."""
EXPIRY_PERIODS = 3.0


class Received:
    """The newest values of each sender of one team; senders are rows of ``Neighbours``.

    Attributes
    ----------
    values : (m, width)
    arrival_s : (m,) on this machine's clock; -inf: nothing was received
    expiry_s : after how long a value does not count any more
    """

    def __init__(self, layout: Layout, rate_hz: float) -> None:
        self.layout = layout
        self.expiry_s = max(EXPIRY_S, EXPIRY_PERIODS / rate_hz)
        self.values = np.zeros((0, layout.width))
        self.arrival_s = np.zeros(0)

    def put(self, rows: Index, values: Array, now_s: float) -> None:
        """Take in the values (k, width) of senders (k,)."""
        if len(rows):
            self.cover(int(rows.max()) + 1)
            self.values[rows] = values
            self.arrival_s[rows] = now_s

    def cover(self, count: int) -> None:
        """Have a row for each of `count` senders."""
        if count > len(self.values):
            more = max(count, 2 * len(self.values)) - len(self.values)
            self.values = np.vstack([self.values, np.zeros((more, self.layout.width))])
            self.arrival_s = np.concatenate([self.arrival_s, np.full(more, -math.inf)])


class Heard:
    """The broadcasts that n robots have received, as pairs sorted by robot. Each declared field is an array (e, ...).

    Attributes
    ----------
    of : (e,) the robot that received it
    offset, distance : (e, 2), (e,) m, from it to the sender
    age_s : (e,) s, since it was sent, as nearly as is known
    """

    def __init__(
        self, count: int, of: Index, offset: Array, distance: Array, rows: Index, received: Received, age_s: Array,
        names: Sequence[str], members: Sequence[str],
    ) -> None:  # fmt: skip
        self._robots, self._rows, self._received = count, rows, received
        self._names, self._members = names, members
        self.of, self.offset, self.distance, self.age_s = of, offset, distance, age_s

    @cached_property
    def sender(self) -> np.ndarray[Any, np.dtype[np.str_]]:
        """Ids of the senders, (e,)."""
        return np.array([self._names[row] for row in self._rows.tolist()], np.str_)

    @cached_property
    def index(self) -> Index:
        """Places of the senders among the request's members, (e,); -1: it is not among them."""
        place = {robot: number for number, robot in enumerate(self._members)}
        return np.array([place.get(self._names[row], -1) for row in self._rows.tolist()], np.int64)

    @cached_property
    def count(self) -> Array:
        """From how many senders each robot has received something, (n, 1)."""
        return np.bincount(self.of, minlength=self._robots).astype(float)[:, None]

    def sum(self, values: Array) -> Array:
        """Add up values of pairs (e, ...) per receiving robot: (n, ...)."""
        total = np.zeros((self._robots, *values.shape[1:]))
        np.add.at(total, self.of, values)
        return total

    def __getattr__(self, name: str) -> Any:
        """Return a declared field, (e, ...)."""
        received = self.__dict__.get("_received")
        if received is None or name not in received.layout.fields:
            known = ", ".join(received.layout.fields) if received is not None else ""
            raise ConfigError(f"view.heard has no '{name}'", hint=f"the class Says of the law declares: {known}")
        found = received.layout.read(name, received.values[self._rows])
        self.__dict__[name] = found
        return found
