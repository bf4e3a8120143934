"""Share out tasks by auction: each robot bids its distance in the shared table, and drives to the task that it wins.

A robot bids for the nearest task for which it would be the best bidder; one that is outbid bids again.
"""

from dataclasses import dataclass

import numpy as np
from fullswarm.memory import rows

MERGE = {"task": min}  # of two bids, (distance, place in the request), the lower one wins on all robots


@dataclass
class Memory:
    task: np.ndarray = rows(fill=-1)


def velocity(view, params, memory):
    tasks = np.array(params.tasks)
    bids = np.linalg.norm(view.position[:, None] - tasks, axis=2)
    for row, me in enumerate(view.index.tolist()):
        best = [view.table.get(row, f"task/{task}", (np.inf, -1)) for task in range(len(tasks))]
        if memory.task[row] >= 0 and best[memory.task[row]][1] != me:
            memory.task[row] = -1
        free = [task for task, bid in enumerate(best) if (bids[row, task], me) < bid]
        if memory.task[row] < 0 and free:
            memory.task[row] = task = min(free, key=lambda each: bids[row, each])
            view.table.put(row, f"task/{task}", [bids[row, task], me])
    to = np.where(memory.task[:, None] < 0, view.position, tasks[memory.task])
    return params.gain * (to - view.position)
