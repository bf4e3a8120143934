"""Task allocation by auction: each robot bids for tasks with its distance, and drives to those that it wins.

The consensus-based auction algorithm (Choi, Brunet, How, Consensus-based decentralized auctions for robust task
allocation, IEEE T-RO 2009): a robot without a task bids for the nearest one for which its bid would be the best that it
knows of, one that is outbid bids again. Bids stand in the shared table, whose merge keeps the best of each task, so
that all robots come to agree on one robot per task without conflict. Where bids were made at one time the allocation is
that of the greedy algorithm, whose worth, a constant less the distance per task, is at least half of the optimum.

A robot stays `service_s` at its task and is then free for another one. It renews its claim all the time: the task of a
robot that is silent for `silent_s` is offered again. All end when all tasks are done.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from fullswarm.agent.view import Params, View
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array, Index
from fullswarm.memory import rows

MOST = 63
"""Tasks: a table has 64 keys."""
MERGE = {"task": max}
RENEW_S = 1.0
PERIOD_S = 0.1
"""Between two looks at the bids: no more are received."""
DONE_ROUND = 1e6
REACH_M = 0.15


class Bid(NamedTuple):
    """An entry of the table. Of two the greater stays: the later round, the smaller cost, the first of the request.

    A round begins when the robot that had won is silent. `beat` counts how often the winner has renewed its claim.
    """

    round: float = 0.0
    worth: float = -1e9
    minus_index: float = -1e9
    beat: float = 0.0

    @property
    def done(self) -> bool:
        """The task is done."""
        return self.round >= DONE_ROUND

    @property
    def claimed(self) -> bool:
        """Some robot has bid in this round."""
        return self.minus_index > -1e9

    @property
    def news(self) -> float:
        """A number that changes with the bid, its robot and its renewals."""
        return self.round * 1e4 + self.beat + (1e-4 * (1.0 - self.minus_index) if self.claimed else 0.0)

    def by(self, index: int) -> bool:
        """Tell whether it is that of a robot."""
        return self.minus_index == -float(index)


@dataclass
class Memory:
    """The task, until when it is done; when it is renewed and looked at again; of each bid what was seen and when."""

    task: Index = rows(fill=-1)
    until_s: Array = rows(fill=np.inf)
    renew_s: Array = rows()
    next_s: Array = rows(fill=-np.inf)
    beat: Array = rows(MOST)
    changed_s: Array = rows(MOST)


def velocity(view: View, params: Params, memory: Memory) -> Array:
    """Return the way to the task that the robot has won, (n, 2) m/s; zero without one."""
    tasks = np.array(params.tasks, float)
    desired = np.zeros_like(view.position)
    for row, here in enumerate(view.position):
        now_s, silent_s = float(view.time_s[row]), float(params.silent_s[row, 0])
        before = int(memory.task[row])
        mine = bid(view, row, memory, np.linalg.norm(tasks - here, axis=1), silent_s)
        if mine != before:
            memory.until_s[row] = np.inf
        if mine < 0:
            if memory.next_s[row] > now_s + 0.9 * PERIOD_S and all(each.done for each in bids(view, row, len(tasks))):
                view.finish([row], "arrived", "all tasks are done")
            continue
        to = tasks[mine] - here
        if np.linalg.norm(to) < REACH_M:
            memory.until_s[row] = min(memory.until_s[row], now_s + float(params.service_s[row, 0]))
            if now_s >= memory.until_s[row]:
                view.table.put(row, f"task/{mine}", Bid(DONE_ROUND, 0.0, -float(view.index[row])))
                memory.task[row], memory.until_s[row] = -1, np.inf
        desired[row] = params.speed_m_s[row] * to / max(float(np.linalg.norm(to)), 0.5)
    return desired


def bids(view: View, row: int, count: int) -> list[Bid]:
    """Return the best bid for each task that a robot knows of.

    Raises
    ------
    ConfigError
        There are more tasks than a table can hold.
    """
    if count > MOST:
        raise ConfigError(f"{count} tasks are too many", hint=f"{MOST} at most in one request")
    return [Bid(*view.table.get(row, f"task/{task}", ())) for task in range(count)]


def bid(view: View, row: int, memory: Any, cost: Sequence[float] | Array, silent_s: float) -> int:
    """Bid for the best of the tasks with these costs; return the task that robot `row` has won, -1: none.

    `memory` has the fields `task`, `renew_s`, `next_s`, `beat` and `changed_s`.
    """
    now_s, index = float(view.time_s[row]), int(view.index[row])
    if now_s < memory.next_s[row]:
        return int(memory.task[row])
    memory.next_s[row] = now_s + PERIOD_S - 1e-6
    known = bids(view, row, len(cost))
    beats = np.array([each.news for each in known])
    count = len(known)
    changed = beats != memory.beat[row, :count]
    memory.changed_s[row, :count] = np.where(changed, now_s, memory.changed_s[row, :count])
    memory.beat[row, :count] = beats
    mine = int(memory.task[row])
    if mine >= 0 and not known[mine].by(index):
        mine = -1
    if mine < 0:
        offers = [_offer(each, index, now_s - memory.changed_s[row, k] > silent_s) for k, each in enumerate(known)]
        rivals = [Bid(offer.round, -float(cost[k]), -float(index)) for k, offer in enumerate(offers)]
        free = [k for k, (rival, offer) in enumerate(zip(rivals, offers, strict=True)) if rival > offer]
        if free:
            mine = min(free, key=lambda k: (float(cost[k]), k))
            view.table.put(row, f"task/{mine}", rivals[mine])
            memory.renew_s[row] = now_s
    elif now_s - memory.renew_s[row] > RENEW_S:
        memory.renew_s[row] = now_s
        nearer = max(known[mine].worth, -float(cost[mine]))  # what a robot has driven counts for it
        view.table.put(row, f"task/{mine}", known[mine]._replace(worth=nearer, beat=known[mine].beat + 1.0))
    memory.task[row] = mine
    return mine


def _offer(known: Bid, index: int, silent: bool) -> Bid:
    """Return what has to be beaten for a task: the best bid, or none in a new round if its robot is silent."""
    if known.done:
        return known
    if known.by(index) or (silent and known.claimed):
        return Bid(known.round + 1.0)
    return known
