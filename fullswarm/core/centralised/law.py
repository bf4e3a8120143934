"""A centralised control law as the node calls it: its function, what it returns, and the memory of one request."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from fullswarm import registry
from fullswarm.core.centralised.view import View
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array, Flags, Index
from fullswarm.memory import allocate, declared
from fullswarm.parameters import Params


@dataclass(frozen=True, slots=True)
class Law:
    """One law.

    Parameters
    ----------
    call : ``(view, params)``, with `memory` ``(view, params, memory)``
    planar : it returns planar velocities, not twists
    memory : the dataclass that declares its memory; None: it has none
    """

    name: str
    call: Callable[..., Array]
    planar: bool
    memory: type | None


def load(name: str) -> Law:
    """Return the centralised law `name`.

    Raises
    ------
    ConfigError
        There is none, or its module does not import or has no law.
    """
    module = registry.centralised_module(name)
    call = getattr(module, "velocity", None) or getattr(module, "twist", None)
    if not callable(call):
        hint = "define velocity(view, params) or twist(view, params)"
        raise ConfigError(f"the centralised law '{name}' has no function", where=str(module.__file__), hint=hint)
    memory = getattr(module, "Memory", None)
    if memory is not None:
        declared(memory)
    return Law(name, call, getattr(module, "velocity", None) is call, memory)


class State:
    """What lasts from call to call of one request: the memory of each robot, who was there, and when.

    Parameters
    ----------
    members : the robots of the request
    now_s : when the request was first computed
    """

    def __init__(self, law: Law, members: tuple[str, ...], now_s: float) -> None:
        self._law, self._members = law, members
        self.since_s = now_s
        self.last_s: float | None = None  # the newest call
        self._present: Flags = np.zeros(len(members), bool)
        self._rows = allocate(law.memory, len(members)) if law.memory else None

    def copy(self) -> State:
        """Return the same for a request that goes on where this one is."""
        other = State(self._law, self._members, self.since_s)
        other.last_s, other._present = self.last_s, self._present.copy()
        other._rows = copy.deepcopy(self._rows)
        return other

    def narrow(self, members: tuple[str, ...]) -> None:
        """Go on with other robots; those that stay keep what is remembered of them."""
        if members == self._members:
            return
        before, rows = {robot: row for row, robot in enumerate(self._members)}, self._rows
        self._members, self._present = members, np.zeros(len(members), bool)
        if rows is None or self._law.memory is None:
            return
        self._rows = allocate(self._law.memory, len(members))
        stay = [(row, before[robot]) for row, robot in enumerate(members) if robot in before]
        for name in declared(self._law.memory):
            for row, old in stay:
                getattr(self._rows, name)[row] = getattr(rows, name)[old]

    def appeared(self, index: Index) -> Flags:
        """Return which of the robots `index` (n,) were not there in the newest call, (n,)."""
        return ~self._present[index]

    def call(self, view: View, params: Params) -> Array:
        """Return what the law answers, (n, 2); a call that raises changes nothing that is remembered.

        Raises
        ------
        ValueError
            The answer is of another shape or not finite.
        Exception
            Whatever the law raises.
        """
        given: Any = None
        if self._law.memory is not None:
            given = allocate(self._law.memory, len(view.index))
            for name in declared(self._law.memory):
                getattr(given, name)[...] = getattr(self._rows, name)[view.index]
        found = np.asarray(self._law.call(view, params) if given is None else self._law.call(view, params, given))
        if found.shape != view.position.shape:
            raise ValueError(f"it returned shape {found.shape} for {len(view.position)} robots; expected (n, 2)")
        if not np.isfinite(found).all():
            raise ValueError("its answer is not finite")
        if given is not None and self._law.memory is not None:
            for name in declared(self._law.memory):
                getattr(self._rows, name)[view.index] = getattr(given, name)
        self._present[:] = False
        self._present[view.index] = True
        return found
