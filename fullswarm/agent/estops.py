"""The latched e-stops of an agent's robots: each order is carried out once, its receipt given as often as asked for."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fullswarm.agent.latch_folder import LatchFolder
from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.messages import EStop, EStopReceipt

if TYPE_CHECKING:
    from fullswarm.agent.node import AgentNode

REMEMBERED = 256
SETTLE_TIMEOUT_S = 5.0
"""A robot that still moves so long after an e-stop is reported as not standing; it is watched on."""
TWO_TICKS_S = 0.04
"""The first reading after the order may still show the rest before the motion that was just commanded."""
STANDING_M_S = 0.005
STANDING_RAD_S = 0.02

Key = tuple[str, bool]
"""An order: its id, engaged or released."""


@dataclass(slots=True)
class Rolling:
    """A robot between an e-stop and standing.

    The way is taken from odometry: a pose that is corrected or noisy adds metres that nobody rolled.
    """

    order: EStop
    since_s: float
    place: tuple[float, float]  # odometry, m
    seen_s: float
    rolled_m: float = 0.0
    told: bool = False  # that it does not come to rest

    def follow(self, place: tuple[float, float], stamp_s: float, fastest_m_s: float) -> None:
        """Add the way to `place`; a jump that no wheel can make is a driver that counts anew."""
        if self.seen_s == -math.inf:  # there was no reading yet when the order came
            self.place, self.seen_s = place, stamp_s
        if stamp_s <= self.seen_s:
            return
        step_m = math.dist(place, self.place)
        if step_m <= 2.0 * fastest_m_s * (stamp_s - self.seen_s) + 0.05:
            self.rolled_m += step_m
        self.place, self.seen_s = place, stamp_s


class EStops:
    """Engages and releases, and confirms.

    Orders are remembered by id. Operators repeat theirs until every robot has confirmed, so copies of an order come
    after somebody else's newer one: those must not undo it.
    """

    def __init__(self, bus: Bus, keys: Keys, agent: AgentNode) -> None:
        self._bus, self._keys, self._agent = bus, keys, agent
        # The receipts that still hold, by row; an order that a newer one has overruled has none.
        self._orders: OrderedDict[Key, dict[int, EStopReceipt]] = OrderedDict()
        self._rolling: dict[tuple[int, Key], Rolling] = {}
        self._folder: LatchFolder | None = None

    def remember(self, folder: LatchFolder) -> None:
        """Keep latches in `folder`, and latch whom it holds: a new process must not undo an e-stop."""
        self._folder = folder
        for row, robot in enumerate(self._agent.fleet.ids):
            if folder.holds(robot):
                self._agent.controller.estop[row] = True

    def repeats(self, order: EStop) -> bool:
        """Tell whether the order was carried out before; then confirm it again where it still holds."""
        receipts = self._orders.get((order.id, order.engaged)) if order.id else None
        if receipts is None:
            return False
        for receipt in receipts.values():
            self._publish(receipt)
        return True

    def carry_out(self, order: EStop, rows: Iterable[int], now_s: float) -> None:
        """Latch or release the robots `rows`; confirm at once, an engaged one again when it stands.

        The wheels come first, then the receipts, then the disk, which may take its time.
        """
        agent, key, rows = self._agent, (order.id, order.engaged), list(rows)
        self._orders[key] = {}
        while len(self._orders) > REMEMBERED:
            self._drop(self._orders.popitem(last=False)[0])
        changed = [row for row in rows if agent.controller.estop[row] != order.engaged]
        for row in changed:
            self._overrule(row)
            agent.controller.estop[row] = order.engaged
        for row in rows if order.engaged else ():
            place, stamp_s = self._place(row)
            self._rolling[row, key] = Rolling(order, now_s, place, stamp_s)
        agent.wake()
        for row in rows:
            self._confirm(row, EStopReceipt(id=order.id, robot=agent.fleet.ids[row], engaged=order.engaged))
        self._keep(order, [agent.fleet.ids[row] for row in rows])

    def watch(self, now_s: float) -> None:
        """Follow the robots that still roll; confirm again once they stand, with the distance."""
        for (row, key), rolling in list(self._rolling.items()):
            place, stamp_s = self._place(row)
            rolling.follow(place, stamp_s, float(self._agent.controller.speed_limit[row]))
            # An old reading tells nothing: who lost his driver is latched, but nobody has seen him stand.
            standing = stamp_s > rolling.since_s + TWO_TICKS_S and self._rests(row)
            late = now_s - rolling.since_s > SETTLE_TIMEOUT_S
            if standing:
                del self._rolling[row, key]
            if standing or (late and not rolling.told):
                rolling.told = True
                robot, rolled_m = self._agent.fleet.ids[row], rolling.rolled_m
                self._confirm(
                    row,
                    EStopReceipt(id=rolling.order.id, robot=robot, engaged=True, rolled_m=rolled_m, standing=standing),
                )

    def _place(self, row: int) -> tuple[tuple[float, float], float]:
        """Return the odometry of a robot, m, and the stamp of that reading, s; -inf when there is none."""
        reading = self._agent.reading
        if reading is None:
            return (0.0, 0.0), -math.inf
        return (float(reading.odometry[row, 0]), float(reading.odometry[row, 1])), float(reading.stamp_s[row])

    def _rests(self, row: int) -> bool:
        twist = self._agent.twist
        return bool(abs(twist[row, 0]) < STANDING_M_S and abs(twist[row, 1]) < STANDING_RAD_S)

    def _keep(self, order: EStop, robots: Iterable[str]) -> None:
        if self._folder is None:
            return
        for robot in robots:
            if order.engaged:
                self._folder.engage(robot, order)
            else:
                self._folder.release(robot)

    def _overrule(self, row: int) -> None:
        for receipts in self._orders.values():
            receipts.pop(row, None)
        for each in [each for each in self._rolling if each[0] == row]:
            del self._rolling[each]

    def _drop(self, key: Key) -> None:
        for each in [each for each in self._rolling if each[1] == key]:
            del self._rolling[each]

    def _confirm(self, row: int, receipt: EStopReceipt) -> None:
        receipts = self._orders.get((receipt.id, receipt.engaged))
        if receipts is not None:
            receipts[row] = receipt
        self._publish(receipt)

    def _publish(self, receipt: EStopReceipt) -> None:
        self._bus.publish(self._keys.estop_receipt(receipt.robot), receipt)
