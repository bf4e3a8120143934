"""The latched e-stops of an agent's robots: each order is carried out once, its receipt given as often as asked for."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.messages import EStop, EStopReceipt

if TYPE_CHECKING:
    from fullswarm.agent.node import AgentNode

REMEMBERED = 256
SETTLE_TIMEOUT_S = 5.0
"""A robot that still moves so long after an e-stop is reported as not standing, and not watched further."""

Key = tuple[str, bool]
"""An order: its id, engaged or released."""


@dataclass(slots=True)
class Rolling:
    """A robot between an e-stop and standing."""

    order: EStop
    since_s: float
    last_xy: tuple[float, float]
    rolled_m: float = 0.0


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

    def repeats(self, order: EStop) -> bool:
        """Tell whether the order was carried out before; then confirm it again where it still holds."""
        receipts = self._orders.get((order.id, order.engaged)) if order.id else None
        if receipts is None:
            return False
        for receipt in receipts.values():
            self._publish(receipt)
        return True

    def carry_out(self, order: EStop, rows: Iterable[int], now_s: float) -> None:
        """Latch or release the robots `rows`; confirm at once, an engaged one again when it stands."""
        agent, key = self._agent, (order.id, order.engaged)
        self._orders[key] = {}
        while len(self._orders) > REMEMBERED:
            self._orders.popitem(last=False)
        for row in rows:
            if agent.controller.estop[row] != order.engaged:
                self._overrule(row)
            agent.controller.estop[row] = order.engaged
            if order.engaged:
                x, y = float(agent.pose[row, 0]), float(agent.pose[row, 1])
                self._rolling[row, key] = Rolling(order, now_s, (x, y))
            self._confirm(row, EStopReceipt(id=order.id, robot=agent.fleet.ids[row], engaged=order.engaged))

    def watch(self, now_s: float) -> None:
        """Follow the robots that still roll; confirm again once they stand, with the distance."""
        agent = self._agent
        for (row, key), rolling in list(self._rolling.items()):
            x, y = float(agent.pose[row, 0]), float(agent.pose[row, 1])
            rolling.rolled_m += math.hypot(x - rolling.last_xy[0], y - rolling.last_xy[1])
            rolling.last_xy = (x, y)
            standing = bool(abs(agent.twist[row, 0]) < 0.005 and abs(agent.twist[row, 1]) < 0.02)
            # Two ticks at least: the first reading after the order still shows the motion before it.
            if (standing and now_s - rolling.since_s > 0.04) or now_s - rolling.since_s > SETTLE_TIMEOUT_S:
                del self._rolling[row, key]
                self._confirm(
                    row,
                    EStopReceipt(
                        id=rolling.order.id,
                        robot=agent.fleet.ids[row],
                        engaged=True,
                        rolled_m=rolling.rolled_m if math.isfinite(rolling.rolled_m) else 0.0,
                        standing=standing,
                    ),
                )

    def _overrule(self, row: int) -> None:
        for receipts in self._orders.values():
            receipts.pop(row, None)
        for each in [each for each in self._rolling if each[0] == row]:
            del self._rolling[each]

    def _confirm(self, row: int, receipt: EStopReceipt) -> None:
        receipts = self._orders.get((receipt.id, receipt.engaged))
        if receipts is not None:
            receipts[row] = receipt
        self._publish(receipt)

    def _publish(self, receipt: EStopReceipt) -> None:
        self._bus.publish(self._keys.estop_receipt(receipt.robot), receipt)
