"""Latches and releases e-stops: carries each order out once, confirms it whenever asked for, keeps latches on disk.

The newest stop of each robot is kept beside them, until the robot starts something: a core that was down when it was
sent must learn of it from the robot, also when the robot's agent has been restarted in between. The requests that stops
have ended are kept for longer: a core whose disk was full comes back with one of them.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np
import structlog

from fullswarm.agent.state import AgentState
from fullswarm.bus.base import Bus
from fullswarm.drivers.base import Fleet
from fullswarm.files import MACHINE_DISK, Disk
from fullswarm.kernels import Array
from fullswarm.keys import Keys
from fullswarm.messages import EStop, EStopReceipt, Halt
from fullswarm.recent import Recent

REMEMBERED = 256
CLOCKS = 64
"""Clocks of which the newest stamp is remembered."""
SETTLE_TIMEOUT_S = 5.0
"""A robot that still moves so long after an e-stop is reported as not at standstill, and still watched."""
TICKS = 2.0
"""For so many periods after the order a reading may still show the standstill before a motion just commanded."""

Key = tuple[str, bool]
"""An order: its id, engaged or released."""


@dataclass(slots=True)
class Decelerating:
    """A robot between an e-stop and standstill.

    The distance is taken from odometry: a pose that is corrected or noisy adds metres that no wheel rolled. It is
    summed over legs longer than the odometry wanders at standstill, so that noise adds nothing.
    """

    order: EStop
    since_s: float
    place: tuple[float, float]  # odometry, m
    seen_s: float
    wander_m: float
    rolled_m: float = 0.0
    reported: bool = False  # that it is not at standstill in time
    leg: tuple[float, float] = field(init=False)  # where the present leg begins

    def __post_init__(self) -> None:
        self.leg = self.place

    def follow(self, place: tuple[float, float], stamp_s: float, fastest_m_s: float) -> None:
        """Add the distance to `place`; a jump that no wheel can make is an odometry that was reset."""
        if self.seen_s == -math.inf:  # there was no reading yet when the order came
            self.place, self.leg, self.seen_s = place, place, stamp_s
        if stamp_s <= self.seen_s:
            return
        if math.dist(place, self.place) > 2.0 * fastest_m_s * (stamp_s - self.seen_s) + 0.05:
            self.leg = self.leg[0] + place[0] - self.place[0], self.leg[1] + place[1] - self.place[1]
        leg_m = math.dist(place, self.leg)
        if leg_m > self.wander_m:
            self.rolled_m += leg_m
            self.leg = place
        self.place, self.seen_s = place, stamp_s


class EStops:
    """Engages and releases, and confirms.

    Orders are remembered by id. Operators repeat theirs until every robot has confirmed, so copies of an order come
    after another operator's newer one: those must not undo it.
    """

    def __init__(
        self, bus: Bus, keys: Keys, control_rate_hz: float, fleet: Fleet, state: AgentState, speed_limit_m_s: Array,
        wake: Callable[[], None],
    ) -> None:  # fmt: skip
        self._bus, self._keys, self._fleet, self._state = bus, keys, fleet, state
        self._speed_limit_m_s, self._wake = speed_limit_m_s, wake
        self._commanded_s = TICKS / control_rate_hz
        # The receipts that still hold, by row; an order that a newer one has overruled has none.
        self._orders: OrderedDict[Key, dict[int, EStopReceipt]] = OrderedDict()
        self._decelerating: dict[tuple[int, Key], Decelerating] = {}
        self._engaged_s: Recent[str, Array] = Recent(CLOCKS)  # by clock: stamp of the newest engaged order, (n,)
        self._folder: LatchFolder | None = None

    def remember(self, folder: LatchFolder) -> None:
        """Keep latches in `folder`, and latch the robots that it names: a new process must not undo an e-stop."""
        self._folder = folder
        for row, robot in enumerate(self._fleet.ids):
            if folder.holds(robot):
                self._state.estop[row] = True

    def repeats(self, order: EStop) -> bool:
        """Tell whether the order was carried out before; then confirm it again where it still holds."""
        receipts = self._orders.get((order.id, order.engaged)) if order.id else None
        if receipts is None:
            return False
        for receipt in receipts.values():
            self._publish(receipt)
        return True

    def in_force(self, order: EStop, rows: Iterable[int]) -> list[int]:
        """Return the robots that an order counts for: a release, not where a newer e-stop of its clock was received.

        So a copy of a release that comes late, or that someone has kept, releases nothing.
        """
        rows = list(rows)
        newest_s = self._engaged_s.get(order.clock)
        if not order.engaged:
            return rows if newest_s is None else [row for row in rows if order.stamp_s >= newest_s[row]]
        if order.clock:
            if newest_s is None:
                newest_s = self._engaged_s[order.clock] = np.full(len(self._fleet.ids), -math.inf)
            newest_s[rows] = np.maximum(newest_s[rows], order.stamp_s)
        return rows

    def carry_out(self, order: EStop, rows: Iterable[int], now_s: float) -> None:
        """Latch or release the robots `rows`; confirm at once, an engaged one again at standstill.

        The wheels come first, then the receipts, then the disk, which may take its time.
        """
        key, rows = (order.id, order.engaged), list(rows)
        self._orders[key] = {}
        while len(self._orders) > REMEMBERED:
            self._drop(self._orders.popitem(last=False)[0])
        changed = [row for row in rows if self._state.estop[row] != order.engaged]
        for row in changed:
            self._overrule(row)
            self._state.estop[row] = order.engaged
        for row in rows if order.engaged else ():
            place, stamp_s = self._place(row)
            wander_m = self._fleet.descriptions[row].standstill.wander_m
            self._decelerating[row, key] = Decelerating(order, now_s, place, stamp_s, wander_m)
        self._wake()
        for row in rows:
            self._confirm(row, EStopReceipt(id=order.id, robot=self._fleet.ids[row], engaged=order.engaged))
        self._keep(order, [self._fleet.ids[row] for row in rows])

    def watch(self, now_s: float) -> None:
        """Follow the robots that still move; confirm again at standstill, with the distance."""
        for (row, key), robot in list(self._decelerating.items()):
            place, stamp_s = self._place(row)
            robot.follow(place, stamp_s, float(self._speed_limit_m_s[row]))
            # An old reading proves nothing: a robot without a driver is latched, but its standstill is unverified.
            measured = bool(robot.since_s <= self._state.standstill_since_s[row] < math.inf)
            at_standstill = measured and stamp_s > robot.since_s + self._commanded_s
            late = now_s - robot.since_s > SETTLE_TIMEOUT_S
            if at_standstill:
                del self._decelerating[row, key]
            if at_standstill or (late and not robot.reported):
                robot.reported = True
                receipt = EStopReceipt(
                    id=robot.order.id, robot=self._fleet.ids[row], engaged=True, rolled_m=robot.rolled_m,
                    standing=at_standstill,
                )  # fmt: skip
                self._confirm(row, receipt)

    def _place(self, row: int) -> tuple[tuple[float, float], float]:
        """Return the odometry of a robot, m, and the stamp of that reading, s; -inf when there is none."""
        reading = self._state.reading
        if reading is None:
            return (0.0, 0.0), -math.inf
        return (float(reading.odometry[row, 0]), float(reading.odometry[row, 1])), float(reading.stamp_s[row])

    def _keep(self, order: EStop, robots: Iterable[str]) -> None:
        if self._folder is None:
            return
        for robot in robots:
            if order.engaged and self._folder.kept(robot):
                continue  # that the file is there is the latch
            if order.engaged:
                self._folder.engage(robot, order)
            else:
                self._folder.release(robot)

    def _overrule(self, row: int) -> None:
        for receipts in self._orders.values():
            receipts.pop(row, None)
        for each in [each for each in self._decelerating if each[0] == row]:
            del self._decelerating[each]

    def _drop(self, key: Key) -> None:
        for each in [each for each in self._decelerating if each[1] == key]:
            del self._decelerating[each]

    def _confirm(self, row: int, receipt: EStopReceipt) -> None:
        receipts = self._orders.get((receipt.id, receipt.engaged))
        if receipts is not None:
            receipts[row] = receipt
        self._publish(receipt)

    def _publish(self, receipt: EStopReceipt) -> None:
        self._bus.publish(self._keys.estop_receipt(receipt.robot), receipt)


log = structlog.get_logger()


class KeptHalt(msgspec.Struct, frozen=True):
    """What a file ``<robot>.stop`` holds; `clock`: on which the stamp of the halt is, see ``clock_id``."""

    clock: str = ""
    halt: Halt | None = None  # None: the robot has started something since
    voided: tuple[str, ...] = ()  # requests that stops have ended, the newest last


class LatchFolder:
    """Files ``<robot>.estop``. What is in them is for people; that a file is there is the latch.

    So a file that was cut short by a power loss, or that cannot be read, still holds the robot. The newest stop or
    e-stop of a robot that has started nothing since is in ``<robot>.stop``, with the requests that stops have ended.

    Parameters
    ----------
    clock : the name of this process's clock, see ``clock_id``; empty: it has none, all kept stops are as of now
    disk : that holds the folder
    """

    def __init__(self, folder: Path, clock: str = "", disk: Disk = MACHINE_DISK) -> None:
        self._folder, self._clock, self._disk = folder, clock, disk
        self._engaged: set[str] = set()  # robots whose latch this process has written

    def keep_halt(self, robot: str, halt: Halt | None, voided: Iterable[str] = ()) -> None:
        """Keep a stop, and which requests stops have ended; no stop: the robot has started something since.

        It does not wait for the disk: what it guards against is the end of the process.
        """
        kept = KeptHalt(self._clock, halt, tuple(voided))
        try:
            self._disk.replace(self._halt_file(robot), msgspec.json.encode(kept) + b"\n")
        except OSError as error:
            log.error("a restart of this agent would not know of its stops", robot=robot, error=str(error))

    def halt_of(self, robot: str, now_s: float) -> KeptHalt:
        """Return what was kept; the stop as of `now_s` where its time is not known, which is the safe side."""
        try:
            kept = msgspec.json.decode(self._disk.read(self._halt_file(robot)), type=KeptHalt)
        except (FileNotFoundError, NotADirectoryError):
            return KeptHalt()
        except (OSError, msgspec.DecodeError, UnicodeDecodeError) as error:
            log.error("cannot read its last stop: it is taken for stopped", robot=robot, error=str(error))
            return KeptHalt(halt=Halt(id=f"unread {now_s:.3f}", stamp_s=now_s))
        halt = kept.halt
        if halt is None or (self._clock and kept.clock == self._clock and halt.stamp_s <= now_s):
            return kept
        return msgspec.structs.replace(kept, halt=msgspec.structs.replace(halt, stamp_s=now_s))

    def holds(self, robot: str) -> bool:
        """Tell whether `robot` was latched and never released; when in doubt it was."""
        try:
            return self._disk.exists(self._file(robot))
        except OSError as error:
            log.error("cannot tell whether its e-stop was latched: it is taken for so", robot=robot, error=str(error))
        return True

    def kept(self, robot: str) -> bool:
        """Tell whether the latch of `robot` is known to be on the disk."""
        return robot in self._engaged and self.holds(robot)

    def engage(self, robot: str, order: EStop) -> None:
        """Write the file and wait for the disk: pulling the battery is what comes next after an e-stop."""
        text = {"id": order.id, "source": order.source, "reason": order.reason}
        try:
            self._disk.write(self._file(robot), msgspec.json.encode(text) + b"\n")
            self._engaged.add(robot)
        except OSError as error:
            log.error("a restart of this agent would not know of the e-stop", robot=robot, error=str(error))

    def release(self, robot: str) -> None:
        """Take the file away."""
        self._engaged.discard(robot)
        try:
            self._disk.remove(self._file(robot))
        except OSError as error:
            log.error("a restart of this agent would engage the e-stop again", robot=robot, error=str(error))

    def _file(self, robot: str) -> Path:
        return self._folder / f"{robot}.estop"

    def _halt_file(self, robot: str) -> Path:
        return self._folder / f"{robot}.stop"
