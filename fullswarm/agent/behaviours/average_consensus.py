"""Average consensus: robots at rest estimate the mean of what each has measured, and end with it as their result.

Flow updating (Jesus, Baquero, Almeida, Fault-tolerant aggregation by flow updating, DAIS 2009): each keeps a flow to
each neighbour, its estimate is its value less all flows, and a broadcast carries estimate and flows. What a robot hears
replaces what it knew, ``f_ij = -f_ji``, so that no lost, late or repeated broadcast changes the sum: the estimates
converge to the mean exactly on every connected network. A plain consensus would drift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fullswarm.agent.view import Params, View
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array
from fullswarm.memory import rows

MOST = 31
"""Robots of a request: with the estimate their flows fill one broadcast."""


@dataclass
class Memory:
    """What was measured, the flow to each member of the request, the estimate of the mean."""

    value: Array = rows(fill=np.nan)
    flow: Array = rows(MOST)
    mean: Array = rows()


@dataclass
class Says:
    """The estimate of the mean, and the flow to each member of the request."""

    mean: Array = rows()
    flow: Array = rows(MOST)


def velocity(view: View, params: Params, memory: Memory) -> Array:
    """Return zero, (n, 2)."""
    if len(view.members) > MOST:
        raise ConfigError(f"{len(view.members)} robots are too many to average", hint=f"request it for {MOST} at most")
    heard, flow = view.heard, memory.flow
    memory.value = np.where(np.isnan(memory.value), measured(view, str(params.quantity)), memory.value)
    flow[heard.of, heard.index] = -heard.flow[np.arange(len(heard.of)), view.index[heard.of]]
    memory.mean = (memory.value - flow.sum(axis=1) + heard.sum(heard.mean)) / (1.0 + heard.count[:, 0])
    flow[heard.of, heard.index] += memory.mean[heard.of] - heard.mean
    view.say(mean=memory.mean, flow=flow)
    for row in np.flatnonzero(view.time_s >= params.wait_s[:, 0]).tolist():
        view.finish([row], "arrived", f"mean {params.quantity}: {memory.mean[row]:.4g}")
    return np.zeros_like(view.position)


def measured(view: View, quantity: str) -> Array:
    """Return what each robot measures now, (n,): x or y in m, or the charge of its battery."""
    if quantity == "battery":
        return view.battery
    return view.position[:, int(quantity == "y")]
