"""Publishes what the own robots are and can do, and keeps what the others say of themselves.

Unlike states, profiles seldom change: they are sent on change, when asked, when a robot appears, and every `PERIOD_S`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from fullswarm.agent.neighbours.estimates import CellSubscriptions, Neighbours
from fullswarm.agent.state import AgentState, Identity
from fullswarm.bus.base import Bus
from fullswarm.drivers.base import Description
from fullswarm.kernels import Array, Index
from fullswarm.keys import WHOLE_SWARM_CELL, Keys, cell_of
from fullswarm.messages import RobotProfile, RobotProfiles
from fullswarm.recent import Recent
from fullswarm.runtime import Scheduler

PERIOD_S = 5.0
LEAST_S = 1.0
"""Between two messages of a host, whatever changes."""
BATTERY_STEP = 0.02
"""By so much the charge must have changed to be a change."""
LARGEST_SPEED, LARGEST_ACCEL = 1e4, 1e5
"""m/s and rad/s, m/s²: what a message can state; a driver may have no limits."""
EARLY = 1000
"""Profiles that are kept until the first state of their robot; the newest count."""
REMEMBERED = 4096
"""Processes of other hosts: they choose their names, so their number must be bounded."""


class ProfileTable:
    """Profiles of the robots received, by their rows in :class:`Neighbours`."""

    def __init__(self) -> None:
        self._of: dict[int, RobotProfile] = {}

    def put(self, row: int, profile: RobotProfile) -> None:
        """Keep the profile of the robot in `row`."""
        self._of[row] = profile

    def drop(self, row: int) -> None:
        """Forget the robot in `row`."""
        self._of.pop(row, None)

    def at(self, rows: Index) -> list[RobotProfile | None]:
        """Return the profiles of robots (e,); None: unknown."""
        return [self._of.get(row) for row in rows.tolist()]


def profiles_of(
    ids: Sequence[str], descriptions: Sequence[Description], limits: Array, more: Mapping[str, Sequence[str]]
) -> tuple[RobotProfile, ...]:
    """Return what robots are, as far as it never changes.

    Parameters
    ----------
    limits : (n, 3) m/s, rad/s, m/s²
    more : by robot, capabilities beside those of its make
    """
    found = []
    for robot, description, (speed, turn, accel) in zip(ids, descriptions, limits.tolist(), strict=True):
        names = dict.fromkeys((*description.capabilities, *more.get(robot, ())))
        profile = RobotProfile(
            robot=robot,
            make=description.make,
            model=description.model,
            capabilities=tuple(sorted(names)),
            radius_m=description.radius_m,
            speed_limit_m_s=min(speed, LARGEST_SPEED),
            turn_limit_rad_s=min(turn, LARGEST_SPEED),
            accel_m_s2=min(accel, LARGEST_ACCEL),
        )
        found.append(profile)
    return tuple(found)


def _charged(profile: RobotProfile, charge: float) -> RobotProfile:
    return msgspec.structs.replace(profile, battery=min(max(charge, -1.0), 100.0))


class Profiles:
    """The profiles of one agent's robots and of their neighbours.

    Parameters
    ----------
    own : (n,) of the own robots; see :func:`profiles_of`
    reach_m : profiles of robots so near are received, with what a robot moves between two calls of `follow`

    Attributes
    ----------
    own : the same, with the charge as it was published
    table : of the robots received
    """

    def __init__(
        self, bus: Bus, keys: Keys, scheduler: Scheduler, identity: Identity, cell_m: float, state: AgentState,
        neighbours: Neighbours, own: tuple[RobotProfile, ...], reach_m: float,
    ) -> None:  # fmt: skip
        self._bus, self._keys, self._scheduler, self._identity = bus, keys, scheduler, identity
        self._cell_m, self._state, self._neighbours, self.own = cell_m, state, neighbours, own
        self._reach_m = reach_m
        self.table = ProfileTable()
        neighbours.on_forget.append(self.table.drop)
        self._waiting: Recent[str, RobotProfile] = Recent(EARLY)  # of robots whose states have not been received yet
        self._processes: Recent[str, str] = Recent(REMEMBERED)  # host → its process
        self._subscriptions = CellSubscriptions(bus, keys.profile, RobotProfiles, cell_m, self._on_profiles)
        self._sent_s = self._looked_s = -math.inf
        self._asked, self._cells, self._robots = True, tuple[str, ...](), 0
        self._charge = np.full(len(own), -1.0)
        self._everywhere = (WHOLE_SWARM_CELL,) * len(own)

    def present(self, row: int) -> RobotProfile:
        """Return the profile of own robot `row` with its charge as it is now."""
        reading = self._state.reading
        return self.own[row] if reading is None else _charged(self.own[row], float(reading.battery[row]))

    def follow(self, position: Array) -> None:
        """Have the subscriptions follow the robots at `position` (n, 2)."""
        self._subscriptions.follow(position, self._reach_m)

    def update(self, now_s: float) -> None:
        """Publish what has changed, or was not published for long; called a few times per second."""
        if self._waiting:
            self._settle()
        reading = self._state.reading
        if reading is None or now_s - self._looked_s < LEAST_S:
            return
        self._looked_s = now_s
        changed = bool((np.abs(reading.battery - self._charge) >= BATTERY_STEP).any())
        cells = self._cells_now()
        due = now_s - self._sent_s >= PERIOD_S
        if not (due or changed or self._asked or cells != self._cells or self._neighbours.count > self._robots):
            return
        self._sent_s, self._asked, self._cells, self._robots = now_s, False, cells, self._neighbours.count
        self._charge = reading.battery.copy()
        self.own = tuple(
            _charged(each, round(charge, 2)) for each, charge in zip(self.own, self._charge.tolist(), strict=True)
        )
        for cell in dict.fromkeys(cells):
            robots = tuple(each for each, place in zip(self.own, cells, strict=True) if place == cell)
            host, process = self._identity.host, self._identity.process
            message = RobotProfiles(host=host, process=process, robots=robots, stamp_s=now_s)
            self._bus.publish(self._keys.profile(cell, host), message)

    def _cells_now(self) -> tuple[str, ...]:
        """Return the grid cell of each own robot; one without a pose is in that of the whole swarm."""
        if self._cell_m <= 0.0:
            return self._everywhere
        return tuple(
            cell_of(x_m, y_m, self._cell_m) if math.isfinite(x_m) and math.isfinite(y_m) else WHOLE_SWARM_CELL
            for x_m, y_m in self._state.pose[:, :2].tolist()
        )

    def _on_profiles(self, message: RobotProfiles) -> None:
        if self._processes.get(message.host) != message.process:
            self._processes[message.host] = message.process
            self._asked |= message.host != self._identity.host  # it was started just now, and knows nothing of us
        for profile in message.robots:
            row = self._neighbours.row_of(profile.robot)
            if row >= 0:
                self.table.put(row, profile)
            else:
                self._waiting[profile.robot] = profile

    def report(self) -> None:
        """Publish the profiles now, on request."""
        self._asked, self._looked_s = True, -math.inf
        self.update(self._scheduler.now_s())

    def _settle(self) -> None:
        """Find rows for profiles that came before the first state of their robots."""
        for robot in [robot for robot in self._waiting if self._neighbours.row_of(robot) >= 0]:
            self.table.put(self._neighbours.row_of(robot), self._waiting.pop(robot))

    def close(self) -> None:
        """Drop the subscriptions."""
        self._subscriptions.close()
