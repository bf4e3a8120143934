"""Agree by broadcasts on the mean of the x at which all robots started, then line up there.

Flow updating (P. Jesus et al., DAIS 2009): flows to and from a neighbour cancel, so lost broadcasts change no sum."""

from dataclasses import dataclass

import numpy as np
from fullswarm.memory import rows

MOST = 24  # robots of the request


@dataclass
class Memory:
    start_m: np.ndarray = rows(fill=np.nan)
    flow_m: np.ndarray = rows(MOST)  # passed on to each member
    mean_m: np.ndarray = rows()


@dataclass
class Says:
    mean_m: np.ndarray = rows()
    flow_m: np.ndarray = rows(MOST)


def velocity(view, params, memory):
    heard, flow = view.heard, memory.flow_m
    memory.start_m = np.where(np.isnan(memory.start_m), view.position[:, 0], memory.start_m)
    flow[heard.of, heard.index] = -heard.flow_m[np.arange(len(heard.of)), view.index[heard.of]]
    memory.mean_m = (memory.start_m - flow.sum(axis=1) + heard.sum(heard.mean_m)) / (1 + heard.count[:, 0])
    flow[heard.of, heard.index] += memory.mean_m[heard.of] - heard.mean_m
    view.say(mean_m=memory.mean_m, flow_m=flow)
    away = np.where(view.time_s < params.wait_s[:, 0], 0.0, memory.mean_m - view.position[:, 0])
    return params.gain * np.stack([away, 0.0 * away], axis=1)
