"""A supervisory process as calculator (paper II.F.1): publishes what the true bodies did as the host ``truth``.

truth = Truth(...)                                       # fed with `look` after each step of the world
node = SupervisorCalculator(bus, keys, scheduler, truth)
"""

from __future__ import annotations

from fullswarm.bus.base import Bus
from fullswarm.keys import TRUTH, Keys
from fullswarm.messages import RobotMeasurement
from fullswarm.perf.truth import Truth
from fullswarm.runtime import Scheduler

PERIOD_S = 0.5


class SupervisorCalculator:
    """Publishes work, collisions, coverage, energy and arrival of all true bodies, twice a second.

    Parameters
    ----------
    process
        Unique per start of the process that sees the bodies.
    """

    def __init__(self, bus: Bus, keys: Keys, scheduler: Scheduler, truth: Truth, process: str = TRUTH) -> None:
        self._bus, self._keys, self._scheduler, self._truth = bus, keys, scheduler, truth
        self._process = process
        self._timer = scheduler.every(PERIOD_S, self.publish)

    def publish(self) -> None:
        """Publish everything now."""
        truth, now_s, keys = self._truth, self._scheduler.now_s(), self._keys
        ids = truth.ids
        self._bus.publish(keys.measurement("coverage", TRUTH), truth.coverage.message(TRUTH, ids, now_s))
        columns = {name: tuple(column.tolist()) for name, column in truth.columns().items()}
        numbers = RobotMeasurement(host=TRUTH, process=self._process, robots=ids, columns=columns, stamp_s=now_s)
        self._bus.publish(keys.measurement("robots", TRUTH), numbers)

    def close(self) -> None:
        """Tell the last of the story. Closing twice is fine."""
        self.publish()
        self._timer.cancel()
