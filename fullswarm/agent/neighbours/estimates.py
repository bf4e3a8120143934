"""Keeps the newest state of every other robot, predicts it to now, and finds which robots are near each other."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from functools import partial
from types import MappingProxyType
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from fullswarm.bus.base import Bus, Subscription
from fullswarm.kernels import Array, Flags, Index, bound, kernel, views
from fullswarm.keys import ANY, WHOLE_SWARM_CELL, cells_within
from fullswarm.messages import AWAY, Message, RobotStates
from fullswarm.recent import Names, Recent

M = TypeVar("M", bound=Message)

Peers = Mapping[int, frozenset[str]]
NO_PEERS: Peers = MappingProxyType({})

MANY_CELLS = 64
STRANGERS = 256
"""Robots that are not of the fleet file, at most; see :class:`~fullswarm.recent.Names`."""
MOST_HOSTS = 10_000

SILENT_S = 0.3
"""A robot that was silent for so long may have left the subscribed cells."""
ANEW_S = 1.0
"""A robot that sends nothing newer for so long, and then counts from below, has booted: its clock began anew too."""
STRIDE_S = 0.2
"""So long a robot may go unheard while it leaves them: some state messages."""


class Nearby(NamedTuple):
    """Which robots are near each own robot, and where they may be; rows of the arrays of :class:`Neighbours`.

    `start` (n + 1,), `other`: the neighbours of robot i are ``other[start[i]:start[i + 1]]``. `places`, `spread_m`,
    `blur_m`: see :class:`Predicted`. `states`: (m, 6) as received, at `arrival_s` (m,).
    """

    start: Index
    other: Index
    places: Array
    states: Array
    spread_m: Array
    blur_m: Array
    arrival_s: Array


class Received(NamedTuple):
    """States (m, 6): x, y (m), heading (rad), speed (m/s), turn rate (rad/s), radius (m); when each came (m,).

    `arrival_s` is on this machine's clock; -inf: never received, or forgotten. `limits` (m, 5): m/s, rad/s and m/s²
    that each states; NaN: it states none; and by how many m and s a stop takes longer than these say. `sigma`: (m, 2)
    standard deviations of position (m) and heading (rad).
    `delay_s`: (m,) how old each was on its arrival. `confined` (m, 4): a disc (x, y, radius in m) that holds a silent
    robot's centre, and the arrival of its last state; NaN for x: it is nowhere near. It counts while no newer state
    arrives.
    """

    states: Array
    arrival_s: Array
    limits: Array
    sigma: Array
    delay_s: Array
    confined: Array


class Assumed(NamedTuple):
    """Limits of robots that state none, and after how long one that fell silent is at standstill, at the latest.

    `confidence`: so many standard deviations of a reported pose count. `extra_m`, `extra_s`: by how much a stop from
    full speed takes longer than the acceleration says.
    """

    accel_m_s2: float
    speed_m_s: float
    turn_rad_s: float
    halt_s: float
    confidence: float = 0.0
    extra_m: float = 0.0
    extra_s: float = 0.0


UNMOVED = Assumed(0.0, 0.0, 0.0, 0.0)
"""The other robots keep the motion that they sent."""


class Predicted(NamedTuple):
    """What :func:`predict` fills.

    `predicted`: (m, 2), NaN for silent robots. `places` (m, 2), `spread_m` (m,): centre and radius of the disc that
    holds the robot's centre. `blur_m`: (m,) by how much its direction is unknown: the spread, but 0 for a silent robot,
    which is kept off like a wall, so that a robot inside its disc may leave it.
    """

    predicted: Array
    places: Array
    spread_m: Array
    blur_m: Array


class Neighbours:
    """The newest state of every robot received, as arrays that grow with the swarm.

    Attributes
    ----------
    states : (m, 6) x, y, heading, speed, turn rate, radius as received
    limits : (m, 5) greatest speed, turn rate and acceleration as received, NaN: none; what a stop takes beyond them
    teams : (m,) of which team each is, as received; 0: none
    aims : (m, 2) m, where each says that it is driving to next, its own place: nowhere; NaN: it does not say
    arrival_s : (m,) when, on this machine's clock
    sigma : (m, 2) standard deviations (m, rad) of position and heading, as received; zero: not stated
    delay_s : (m,) how old each state was on its arrival
    delay_of : returns that of states at their arrival, s; see ``CoreClock.delay_s``
    predicted : (m, 2) positions moved on to the time of the last `set_time`, filled by `within`; NaN when too old
    places, spread_m, blur_m : the same for the safety filter, filled by `around`: see :class:`Predicted`. A robot that
        fell silent stays in them until it is received again or its cell is not subscribed
    silent : how many of those there are
    names : (m,) ids of the robots; one that is not of the fleet file is forgotten when it has been silent for long,
        and its row is given to another one
    on_forget : called with the row of a robot that is forgotten
    now_s : time of the last `set_time`
    ids : (n,) ids of the own robots
    own_away : (n,) which of them are away: see ``orders.charging``, which writes it
    listed : robots of the fleet file; None: all count as such
    own_frame_host, own_frame_s : the host that last sent poses in a frame of its own, and when they were received
    """

    def __init__(
        self, ids: tuple[str, ...], timeout_s: float, assumed: Assumed = UNMOVED, listed: Collection[str] | None = None
    ) -> None:
        self.ids, self._assumed = ids, assumed
        self._alone = ids if len(ids) == 1 else None
        self._timeout_s = timeout_s
        self._row_of: dict[str, int] = {}
        self._batch: tuple[tuple[str, ...], Index] | None = None
        self._place: Index | slice = slice(0, 0)  # the rows of the batch, as a slice where they are one
        self._aimed = False  # some of the batch's rows hold an aim
        self._kept: object = None  # what seldom changes, while the batch's rows hold it
        self._newest: Recent[str, tuple[int, float, float]] = Recent(MOST_HOSTS)  # by host: sequence, its clock, ours
        self._strangers = None if listed is None else Names(STRANGERS, self._forget_stranger, (*listed, *ids))
        self._all_listed: tuple[str, ...] = ()  # robots of one message that all are of the fleet file
        self._free: list[int] = []  # rows of robots that are forgotten
        self.on_forget: list[Callable[[int], None]] = []
        self.now_s, self._stale = 0.0, True
        self.count = 0
        self.names: list[str] = []
        self._others = 0  # of them, robots of other agents
        self.own_row = np.full(len(ids), -1, np.int64)
        self.own_away: Flags = np.zeros(len(ids), np.bool_)
        self._lists: dict[tuple[float, bool], tuple[Index, Index]] = {}
        self.states = np.zeros((0, 6))
        self.limits = np.zeros((0, 5))
        self._confined = np.zeros((0, 4))
        self.teams = np.zeros(0, np.int64)
        self.aims = np.zeros((0, 2))
        self.arrival_s = np.zeros(0)
        self.sigma = np.zeros((0, 2))
        self.delay_s = np.zeros(0)
        self.delay_of: Callable[[RobotStates, float], float] = no_delay
        self.predicted = np.zeros((0, 2))
        self.places = np.zeros((0, 2))
        self.spread_m, self.blur_m = np.zeros(0), np.zeros(0)
        self.silent = 0
        self.own_frame_host, self.own_frame_s = "", -math.inf
        self._near: Nearby | None = None
        self._rank = np.zeros(0, np.int64)  # of each robot's name among all
        self._grow(max(16, len(ids)))

    def receive(self, states: RobotStates, now_s: float) -> None:
        """Take in the states of one host.

        Ignored: a message older than the last from that host, one whose columns do not fit together, and on board
        the own state, and a robot with a number that is not finite: it keeps its last state.
        """
        if states.robots == self._alone:
            return
        newest = self._newest.get(states.host)
        # A sequence that falls while the sender's clock goes on means that the agent was restarted; its computer
        # too, when the clock falls as well. The same sequence comes once per grid cell.
        older = newest and states.sequence < newest[0] and states.stamp_s <= newest[1]
        if newest and older and now_s - newest[2] < ANEW_S:
            return
        if not states.robots or not _fits(states) or not self._admit(states.robots, now_s):
            return
        self._newest[states.host] = (states.sequence, states.stamp_s, now_s)
        self._stale = True
        if states.own_frame:
            self.own_frame_host, self.own_frame_s = states.host, now_s
        if len(states.robots) == 1:
            self._receive_one(states, now_s)
            return
        rows = self._rows(states.robots)
        columns = (states.x_m, states.y_m, states.heading_rad, states.speed_m_s, states.turn_rad_s, states.radius_m)
        kept = (
            states.teams, states.speed_limit_m_s, states.turn_limit_rad_s, states.accel_m_s2, states.sigma_m,
            states.sigma_rad, states.stop_extra_m, states.stop_extra_s,
        )  # fmt: skip
        table = np.array(columns)
        if kept == self._kept and math.isfinite(sum(map(sum, columns))):
            self.states[self._place] = table.T
            self.arrival_s[self._place] = now_s
            self.delay_s[self._place] = self.delay_of(states, now_s)
            if states.aim_x_m or self._aimed:
                self.aims[self._place] = _aims(states).T
                self._aimed = bool(states.aim_x_m)
            return
        self._kept = None
        teams = np.array(states.teams or (0,) * len(rows), np.int64)
        limits = np.full((5, len(rows)), math.nan)
        if states.accel_m_s2:
            limits[:3] = states.speed_limit_m_s, states.turn_limit_rad_s, states.accel_m_s2
            limits[3:] = (states.stop_extra_m, states.stop_extra_s) if states.stop_extra_m else 0.0
        sigma = np.zeros((2, len(rows)))
        if states.sigma_m:
            sigma[0] = states.sigma_m
        if states.sigma_rad:
            sigma[1] = states.sigma_rad
        finite = np.isfinite(table.sum(axis=0))
        aims, self._aimed = _aims(states), bool(states.aim_x_m)
        if finite.all():
            self._kept = kept
        else:
            rows, table, teams, aims = rows[finite], table[:, finite], teams[finite], aims[:, finite]
            limits, sigma = limits[:, finite], sigma[:, finite]
        self.states[rows] = table.T
        self.limits[rows] = limits.T
        self.teams[rows] = teams
        self.aims[rows] = aims.T
        self.arrival_s[rows] = now_s
        self.sigma[rows] = sigma.T
        self.delay_s[rows] = self.delay_of(states, now_s)

    def _admit(self, robots: tuple[str, ...], now_s: float) -> bool:
        """Tell whether there is room for all these robots; those of the fleet file always have some."""
        strangers = self._strangers
        if strangers is None:
            return True
        if len(robots) == 1:
            return strangers.admit(robots[0], now_s)
        if robots is self._all_listed or robots == self._all_listed:
            return True
        if strangers.listed.issuperset(robots):
            self._all_listed = robots
            return True
        admitted = [strangers.admit(robot, now_s) for robot in robots]
        return all(admitted)

    def _forget_stranger(self, robot: str) -> None:
        """Give up the row of a robot that is not of the fleet file and has been silent for long."""
        row = self._row_of.pop(robot, None)
        if row is not None:
            self.arrival_s[row], self._stale = -math.inf, True
            self._free.append(row)
            self._batch, self._kept = None, None
            for callback in self.on_forget:
                callback(row)

    def receive_relayed(self, states: RobotStates, age_s: float, now_s: float) -> None:
        """Take in states that came through the core, measured at least `age_s` ago, unless newer ones are known."""
        newest = self._newest.get(states.host)
        if newest and now_s - newest[2] < ANEW_S and (states.sequence <= newest[0] or states.stamp_s <= newest[1]):
            return
        self.receive(states, now_s - age_s)

    def _receive_one(self, states: RobotStates, now_s: float) -> None:
        """Do the same for a host with one robot, number by number.

        An agent does it some hundred times a second, and arrays would cost 10 µs more each time.
        """
        x_m, y_m, heading_rad = states.x_m[0], states.y_m[0], states.heading_rad[0]
        speed_m_s, turn_rad_s, radius_m = states.speed_m_s[0], states.turn_rad_s[0], states.radius_m[0]
        if not math.isfinite(x_m + y_m + heading_rad + speed_m_s + turn_rad_s + radius_m):
            return
        row = self._row_of.get(states.robots[0])
        if row is None:
            row = int(self._rows(states.robots)[0])
        self._kept = None
        received = self.states
        received[row, 0] = x_m
        received[row, 1] = y_m
        received[row, 2] = heading_rad
        received[row, 3] = speed_m_s
        received[row, 4] = turn_rad_s
        received[row, 5] = radius_m
        limits = self.limits
        if not states.accel_m_s2:
            limits[row, 2] = math.nan
        else:
            limits[row, 0] = states.speed_limit_m_s[0]
            limits[row, 1] = states.turn_limit_rad_s[0]
            limits[row, 2] = states.accel_m_s2[0]
            limits[row, 3] = states.stop_extra_m[0] if states.stop_extra_m else 0.0
            limits[row, 4] = states.stop_extra_s[0] if states.stop_extra_s else 0.0
        self.teams[row] = states.teams[0] if states.teams else 0
        aims = self.aims
        aims[row, 0] = states.aim_x_m[0] if states.aim_x_m else math.nan
        aims[row, 1] = states.aim_y_m[0] if states.aim_y_m else math.nan
        self.arrival_s[row] = now_s
        self.delay_s[row] = self.delay_of(states, now_s)
        self.sigma[row, 0] = states.sigma_m[0] if states.sigma_m else 0.0
        self.sigma[row, 1] = states.sigma_rad[0] if states.sigma_rad else 0.0

    def set_time(self, now_s: float) -> None:
        """Have `within` and `around` answer for `now_s` from here on."""
        if now_s != self.now_s:
            self.now_s, self._stale = now_s, True

    def refresh(self, now_s: float) -> None:
        """Predict to `now_s` now, unless that has been done."""
        if self._stale or self.now_s != now_s:
            self.now_s = now_s
            self._predict()

    def _predict(self) -> None:
        """Predict all positions to the time of the last `set_time`, on use."""
        self._stale, now_s = False, self.now_s
        self.silent = self._run_predict(self.count, now_s, self._timeout_s)

    def around(self, position: Array, reach_m: float) -> Nearby:
        """Find what the safety filter must respect: as `within`, but silent robots too, at uncertain places."""
        if self._stale:
            self._predict()
        start, other = self._search(position, self.places, reach_m)
        near = self._near
        if near is None or near.start is not start or near.other is not other or near.places is not self.places:
            self._near = near = self.nearby(start, other)
        return near

    def nearby(self, start: Index, other: Index) -> Nearby:
        """Return lists of robots as :class:`Nearby`."""
        return Nearby(start, other, self.places, self.states, self.spread_m, self.blur_m, self.arrival_s)

    def ages_s(self, now_s: float) -> Array:
        """Return how long ago each neighbour was received, (k,) s."""
        return now_s - self.arrival_s[: self.count]

    def forget(self, now_s: float, listened: Callable[[float, float, float], bool]) -> None:
        """Forget silent robots outside the subscribed cells: there silence says nothing.

        Parameters
        ----------
        listened : whether all of a disc (x, y, radius in m) is listened to: ``CellSubscriptions.covers``
        """
        if self._strangers is not None:
            self._strangers.sweep(now_s)
        ages_s = now_s - self.arrival_s[: self.count]
        for row in np.flatnonzero((ages_s > SILENT_S) & np.isfinite(ages_s)).tolist():
            x_m, y_m, _, speed_m_s, _, _ = self.states[row].tolist()
            stated_m_s = float(self.limits[row, 0])
            fastest_m_s = self._assumed.speed_m_s if math.isnan(stated_m_s) else stated_m_s
            if not listened(x_m, y_m, STRIDE_S * max(abs(speed_m_s), fastest_m_s)):
                self.arrival_s[row], self._stale = -math.inf, True

    def at_rest(self, now_s: float) -> Flags:
        """Tell which robots are silent and at standstill by now, (m,): their discs grow no more."""
        count = self.count
        speed, accel = self.limits[:count, 0], self.limits[:count, 2]
        stated = np.isfinite(speed + accel)
        speed = np.maximum(np.where(stated, speed, self._assumed.speed_m_s), np.abs(self.states[:count, 3]))
        stop_s = speed / np.maximum(np.where(stated, accel, self._assumed.accel_m_s2), 1e-9)
        stop_s += np.where(stated, self.limits[:count, 4], self._assumed.extra_s)
        ages_s = self.ages_s(now_s)
        silent: Flags = np.isfinite(ages_s) & (ages_s > max(self._assumed.halt_s, self._timeout_s) + stop_s)
        return silent

    def heard(self, now_s: float) -> Flags:
        """Tell which robots are not silent, own ones left out, (m,)."""
        found: Flags = self.ages_s(now_s) <= self._timeout_s
        found[self.own_row[self.own_row >= 0]] = False
        return found

    def confine(self, row: int, x_m: float, y_m: float, radius_m: float) -> None:
        """Hold the disc of a silent robot to (x, y) and a radius; NaN: it is nowhere near. A new state ends that."""
        self._confined[row] = x_m, y_m, radius_m, self.arrival_s[row]
        self._stale = True

    def within(
        self, position: Array, reach_m: float, team: Index | None = None, peers: Peers = NO_PEERS
    ) -> tuple[Index, Index]:
        """Find the robots within `reach_m` of each own robot at the time of the last `set_time`, and of its team.

        Parameters
        ----------
        team : (n,) of the own robots; 0, or None for all of them: all robots count
        peers : robots of some teams, by number, which count whatever they run

        Returns
        -------
        start : (n + 1,)
        other : (capacity,) rows; neighbours of robot i are ``other[start[i]:start[i + 1]]``. Both are reused.
        """
        if self._stale:
            self._predict()
        start, other = self._search(position, self.predicted, reach_m)
        if team is not None and peers:
            team = self._keep_peers(start, other, team, peers)
        if team is not None and self._mixed(team):
            keep_team.run(start, other, team, self.teams)
        if team is not None and (self.teams[: self.count] == AWAY).any():
            leave_out.run(start, other, self.own_away, self.teams)
        return start, other

    def _keep_peers(self, start: Index, other: Index, team: Index, peers: Peers) -> Index:
        """Drop the neighbours that are no peers of a robot whose team has some; return the teams of the others."""
        numbers = list(peers)
        listed = np.array([[name in peers[number] for name in self.names] for number in numbers], bool)
        place = np.array([numbers.index(each) if each in peers else -1 for each in team.tolist()], np.int64)
        if (place >= 0).any():
            keep_listed.run(start, other, place, listed)
        return np.where(place >= 0, 0, team)

    def within_by_name(
        self, position: Array, reach_m: float, team: Index | None = None, peers: Peers = NO_PEERS
    ) -> tuple[Index, Index]:
        """Do what `within` does, with the neighbours of each robot in the order of their names.

        Else they come in the order in which they were first received, which differs from agent to agent, and so does
        the last bit of a sum over them.
        """
        start, other = self.within(position, reach_m, team, peers)
        if len(self._rank) != self.count:
            self._rank = np.argsort(np.argsort(np.array(self.names, np.str_)))
        found = other[: start[-1]]
        of = np.repeat(np.arange(len(position)), start[1:] - start[:-1])
        return start, found[np.lexsort((self._rank[found], of))]

    def _mixed(self, team: Index) -> bool:
        """Tell whether an own robot, of `team` (n,), may have received one that is not of its team."""
        if self._alone is not None:  # to look through its few neighbours costs less than to reduce an array
            return bool(team[0])
        known = self.own_row >= 0  # what the own robots run is known at once, without their messages
        self.teams[self.own_row[known]] = np.where(self.own_away, AWAY, team)[known]
        return bool((self.teams[: self.count] != team[0]).any() or (team != team[0]).any())

    def _search(self, position: Array, places: Array, reach_m: float) -> tuple[Index, Index]:
        count, key = self.count, (reach_m, places is self.places)
        start, other = self._lists.get(key) or (np.zeros(len(position) + 1, np.int64), np.zeros(64, np.int64))
        search = all_pairs if len(position) * count <= BRUTE_FORCE_BELOW else cell_pairs
        found = search.run(position, self.own_row, places, count, reach_m, start, other)
        if found > len(other):
            other = np.zeros(2 * found, np.int64)
            search(position, self.own_row, places, count, reach_m, start, other)
        self._lists[key] = (start, other)
        return start, other

    def longest_delay_s(self, now_s: float) -> float:
        """Return the greatest delay of the states that still count, s; NaN when there are none of other robots."""
        if not self._others:
            return math.nan
        fresh = now_s - self.arrival_s[: self.count] <= self._timeout_s
        fresh[self.own_row[self.own_row >= 0]] = False
        return float(self.delay_s[: self.count][fresh].max()) if fresh.any() else math.nan

    def oldest_age_s(self, now_s: float) -> float:
        """Return the age of the stalest state that still counts; 0 when none is received."""
        ages = now_s - self.arrival_s[: self.count]
        fresh = ages[ages <= self._timeout_s]
        return float(fresh.max()) if len(fresh) else 0.0

    def row_of(self, robot: str) -> int:
        """Return the row of a robot that was received, -1 if it never was."""
        return self._row_of.get(robot, -1)

    def _rows(self, robots: tuple[str, ...]) -> Index:
        if self._batch is not None and self._batch[0] == robots:
            return self._batch[1]
        for robot in robots:
            if robot not in self._row_of:
                if self._free:
                    self._reuse(self._free.pop(), robot)
                    continue
                self._row_of[robot] = self.count
                self.names.append(robot)
                self.count += 1
                if robot in self.ids:
                    self.own_row[self.ids.index(robot)] = self._row_of[robot]
                else:
                    self._others += 1
        self._grow(self.count)
        rows = np.array([self._row_of[robot] for robot in robots], np.int64)
        if len(robots) > 1:
            self._batch, self._kept = (robots, rows), None
            self._place = slice(int(rows[0]), int(rows[-1]) + 1) if (np.diff(rows) == 1).all() else rows
        return rows

    def _reuse(self, row: int, robot: str) -> None:
        """Give the row of a forgotten robot to another one; nothing of the first may be left in it."""
        self._row_of[robot] = row
        self.names[row] = robot
        self.limits[row], self._confined[row], self.aims[row] = math.nan, math.nan, math.nan
        self.teams[row], self.sigma[row], self.delay_s[row] = 0, 0.0, 0.0
        self._rank = np.zeros(0, np.int64)

    def _grow(self, count: int) -> None:
        if count > len(self.states):
            more = max(count, 2 * len(self.states)) - len(self.states)
            self.states = np.vstack([self.states, np.zeros((more, 6))])
            self.limits = np.vstack([self.limits, np.full((more, 5), math.nan)])
            self._confined = np.vstack([self._confined, np.full((more, 4), math.nan)])
            self.teams = np.concatenate([self.teams, np.zeros(more, np.int64)])
            self.aims = np.vstack([self.aims, np.full((more, 2), math.nan)])
            self.arrival_s = np.concatenate([self.arrival_s, np.full(more, -math.inf)])
            self.sigma = np.vstack([self.sigma, np.zeros((more, 2))])
            self.delay_s = np.concatenate([self.delay_s, np.zeros(more)])
            self.spread_m = np.concatenate([self.spread_m, np.zeros(more)])
            self.blur_m = np.concatenate([self.blur_m, np.zeros(more)])
            self.places = np.vstack([self.places, np.full((more, 2), math.nan)])
            self.predicted = np.vstack([self.predicted, np.full((more, 2), math.nan)])
            received = Received(
                self.states, self.arrival_s, self.limits, self.sigma, self.delay_s, self._confined
            )  # fmt: skip
            out = Predicted(self.predicted, self.places, self.spread_m, self.blur_m)
            if predict.run is predict.plain:
                received, out = views(received), views(out)
            self._run_predict = bound(partial(predict.run, received, out, self._assumed))


def _aims(states: RobotStates) -> Array:
    """Return where the robots say that they are driving to, (2, n) m; NaN: they do not say."""
    if states.aim_x_m:
        return np.array((states.aim_x_m, states.aim_y_m))
    return np.full((2, len(states.robots)), math.nan)


def no_delay(_states: RobotStates, _now_s: float) -> float:
    """Return 0: states count from their arrival."""
    return 0.0


def _fits(states: RobotStates) -> bool:
    """Tell whether the columns have one length: a stranger's message must not end an agent."""
    x_m, y_m, heading_rad = states.x_m, states.y_m, states.heading_rad
    speed_m_s, turn_rad_s, radius_m = states.speed_m_s, states.turn_rad_s, states.radius_m
    count = len(states.robots)
    for optional in (states.teams, states.sigma_m, states.sigma_rad, states.stop_extra_m, states.stop_extra_s):
        if optional and len(optional) != count:
            return False
    accel_m_s2 = states.accel_m_s2
    if accel_m_s2 and not count == len(accel_m_s2) == len(states.speed_limit_m_s) == len(states.turn_limit_rad_s):
        return False
    if len(states.stop_extra_m) != len(states.stop_extra_s):
        return False
    if len(states.aim_x_m) != len(states.aim_y_m) or (states.aim_x_m and len(states.aim_x_m) != count):
        return False
    fits = count == len(x_m) == len(y_m) == len(heading_rad)
    return fits and count == len(speed_m_s) == len(turn_rad_s) == len(radius_m)


class CellSubscriptions(Generic[M]):
    """Subscriptions to the messages of the grid cells around the own robots; they follow as the robots move.

    Parameters
    ----------
    key_of : returns the key expression of a cell
    """

    def __init__(
        self, bus: Bus, key_of: Callable[[str], str], kind: type[M], cell_m: float, receive: Callable[[M], None]
    ) -> None:
        self._bus, self._key_of, self._kind, self._cell_m, self._receive = bus, key_of, kind, cell_m, receive
        self._cells: dict[str, Subscription] = {}

    def follow(self, position: Array, reach_m: float) -> None:
        """Subscribe to the cells within `reach_m` of `position` (n, 2), drop those left behind.

        Where that would be more than `MANY_CELLS`, one subscription to all cells is cheaper.
        """
        wanted = {WHOLE_SWARM_CELL} if self._cell_m <= 0.0 else self._around(position, reach_m)
        for cell in wanted - self._cells.keys():
            self._cells[cell] = self._bus.subscribe(self._key_of(cell), self._kind, self._receive, latest=True)
        for cell in self._cells.keys() - wanted:
            self._cells.pop(cell).close()

    def _around(self, position: Array, reach_m: float) -> set[str]:
        if (2.0 * reach_m / self._cell_m + 1.0) ** 2 > MANY_CELLS:
            return {ANY}
        wanted: set[str] = set()
        for x_m, y_m in position.tolist():
            if math.isfinite(x_m) and math.isfinite(y_m):
                wanted |= cells_within(x_m, y_m, reach_m, self._cell_m)
            if len(wanted) > MANY_CELLS:
                return {ANY}
        return wanted

    def covers(self, x_m: float, y_m: float, radius_m: float) -> bool:
        """Tell whether all cells that a disc touches are listened to."""
        cells = self._cells.keys()
        everywhere = ANY in cells or WHOLE_SWARM_CELL in cells
        return everywhere or cells_within(x_m, y_m, radius_m, self._cell_m) <= cells

    def close(self) -> None:
        """Drop all subscriptions."""
        for subscription in self._cells.values():
            subscription.close()
        self._cells.clear()


BRUTE_FORCE_BELOW = 3000
"""Products n x m below which trying all pairs beats sorting into cells."""


@kernel
def distance_m(speed: float, accel: float, fastest: float, time_s: float) -> float:
    """Return how far a body goes in a time that gains `accel` from `speed` >= 0 until it is at `fastest`."""
    if accel <= 0.0:
        return fastest * time_s
    gaining_s = min((fastest - speed) / accel, time_s)
    return (speed + 0.5 * accel * gaining_s) * gaining_s + fastest * (time_s - gaining_s)


@kernel
def reachable(speed: float, accel: float, fastest: float, turn: float, time_s: float) -> tuple[float, float]:
    """Return a disc that holds all places a unicycle can reach: its centre's distance ahead, and its radius, m.

    While its heading has changed by less than a quarter turn, it is in a rectangle: ahead as far as it can go forwards,
    behind as far as it can reverse after it has braked, and to the side as far as at full speed in a full turn. After
    that every direction is possible at the greatest speed.
    """
    if accel <= 0.0:
        return 0.0, fastest * time_s
    straight_s = min(time_s, 0.5 * math.pi / turn) if turn > 0.0 else time_s
    aside_m = fastest * (1.0 - math.cos(turn * straight_s)) / turn if turn > 0.0 else 0.0
    braking_s = min(math.fabs(speed) / accel, straight_s)
    on_m = distance_m(math.fabs(speed), accel, fastest, straight_s)
    back_m = distance_m(0.0, accel, fastest, straight_s - braking_s)
    ahead_m = 0.5 * (on_m - back_m) if speed >= 0.0 else 0.5 * (back_m - on_m)
    return ahead_m, math.hypot(0.5 * (on_m + back_m), aside_m) + fastest * (time_s - straight_s)


@kernel
def predict(received: Received, out: Predicted, assumed: Assumed, count: int, now_s: float, timeout_s: float) -> int:
    """Predict the first `count` received states to `now_s`; return how many robots are silent: older than `timeout_s`.

    How far off the prediction may be grows with the square of the age (another acceleration than predicted), but a
    robot is never farther from its last position than its acceleration and speed allow, nor outside of what a unicycle
    can reach from its last motion (`reachable`): the smallest disc counts. A silent robot is at standstill or about to
    be: its disc grows until the assumed `halt_s` and then stays, for ever, unless the robot is confined by sight. The
    error of the reported position widens the disc, but not the direction in which it lies: the distance of two points
    is a convex function of their motion, so a constant error of it stays one. An error of the heading turns the
    predicted path.
    """
    states, arrival_s, limits, sigma, delay_s, confined = received
    assumed_accel, assumed_speed, assumed_turn, halt_s, confidence, assumed_extra_m, _ = assumed
    halt_s = max(halt_s, timeout_s)
    predicted, places, spread_m, blur_m = out
    silent = 0
    for row in range(count):
        age_s = max(now_s - arrival_s[row], 0.0) + delay_s[row]
        if math.isinf(age_s):
            predicted[row, 0] = math.nan
            predicted[row, 1] = math.nan
            places[row, 0] = math.nan
            places[row, 1] = math.nan
            spread_m[row] = 0.0
            blur_m[row] = 0.0
            continue
        speed = states[row, 3]
        rate = states[row, 4]
        speed_m_s = limits[row, 0]
        turn_rad_s = limits[row, 1]
        accel_m_s2 = limits[row, 2]
        extra_m = limits[row, 3]
        if math.isnan(speed_m_s + turn_rad_s + accel_m_s2):
            extra_m = assumed_extra_m
            speed_m_s = assumed_speed
            turn_rad_s = assumed_turn
            accel_m_s2 = assumed_accel
        moved_s = min(age_s, halt_s)
        fastest = max(speed_m_s, math.fabs(speed))
        gained = min(math.fabs(speed) + accel_m_s2 * moved_s, fastest)
        sideways = gained * turn_rad_s
        strongest = math.sqrt(accel_m_s2 * accel_m_s2 + sideways * sideways) + math.fabs(speed * rate)
        swing = min(confidence * sigma[row, 1], 2.0)
        near_prediction_m = 0.5 * moved_s * moved_s * strongest + swing * math.fabs(speed) * moved_s
        near_state_m = distance_m(math.fabs(speed), accel_m_s2, fastest, moved_s)
        middle = states[row, 2] + 0.5 * age_s * rate
        x = states[row, 0] + speed * age_s * math.cos(middle)
        y = states[row, 1] + speed * age_s * math.sin(middle)
        if age_s <= timeout_s:
            predicted[row, 0] = x
            predicted[row, 1] = y
        else:
            predicted[row, 0] = math.nan
            predicted[row, 1] = math.nan
            silent += 1
        ahead_m = 0.0
        near_ahead_m = near_state_m
        if age_s > timeout_s or near_prediction_m > 0.5 * near_state_m:  # what is reachable is no smaller than that
            ahead_m, near_ahead_m = reachable(speed, accel_m_s2, fastest, max(turn_rad_s, math.fabs(rate)), moved_s)
            near_ahead_m += swing * near_state_m
            if near_ahead_m >= near_state_m:
                ahead_m = 0.0
                near_ahead_m = near_state_m
        if age_s <= timeout_s and near_prediction_m < near_ahead_m:
            places[row, 0] = x
            places[row, 1] = y
            spread_m[row] = near_prediction_m
        else:
            if age_s > halt_s and accel_m_s2 > 0.0:
                near_ahead_m += 0.5 * fastest * fastest / accel_m_s2 + extra_m
            places[row, 0] = states[row, 0] + ahead_m * math.cos(states[row, 2])
            places[row, 1] = states[row, 1] + ahead_m * math.sin(states[row, 2])
            spread_m[row] = near_ahead_m
        blur_m[row] = spread_m[row] if age_s <= timeout_s else 0.0
        spread_m[row] += confidence * sigma[row, 0]
        if age_s > halt_s and confined[row, 3] == arrival_s[row]:
            places[row, 0] = confined[row, 0]
            places[row, 1] = confined[row, 1]
            spread_m[row] = confined[row, 2]
    return silent


@kernel
def all_pairs(
    position: Array, own_row: Index, predicted: Array, count: int, reach_m: float, start: Index, other: Index
) -> int:
    """Find the robots within `reach_m` of each own robot by trying all.

    Parameters
    ----------
    position : (n, 2) own positions
    own_row : (n,) row of each own robot among the received ones, -1 if it is not there
    start : (n + 1,) out: neighbours of robot i are ``other[start[i]:start[i + 1]]``
    other : (capacity,) out: rows among the received ones

    Returns
    -------
    int
        How many pairs there are; more than the capacity means that `other` is too short.
    """
    found = 0
    capacity = other.shape[0]
    reach_squared = reach_m * reach_m
    for i in range(position.shape[0]):
        start[i] = min(found, capacity)
        x = position[i, 0]
        y = position[i, 1]
        mine = own_row[i]
        for row in range(count):
            dx = predicted[row, 0] - x
            dy = predicted[row, 1] - y
            if dx * dx + dy * dy <= reach_squared and row != mine:
                if found < capacity:
                    other[found] = row
                found += 1
    start[position.shape[0]] = min(found, capacity)
    return found


@kernel
def cell_pairs(
    position: Array, own_row: Index, predicted: Array, count: int, reach_m: float, start: Index, other: Index
) -> int:
    """Do what :func:`all_pairs` does in time linear in the swarm, by sorting into cells of `reach_m`."""
    low_x = math.inf
    low_y = math.inf
    high_x = -math.inf
    high_y = -math.inf
    for row in range(count):
        if not math.isnan(predicted[row, 0]):
            low_x = min(low_x, predicted[row, 0])
            high_x = max(high_x, predicted[row, 0])
            low_y = min(low_y, predicted[row, 1])
            high_y = max(high_y, predicted[row, 1])
    if low_x > high_x:
        start[:] = 0
        return 0
    # Cells no smaller than the reach, and no more of them than a few per robot.
    side = max(reach_m, max(high_x - low_x, high_y - low_y) / (2.0 * math.sqrt(count) + 1.0))
    columns = int((high_x - low_x) / side) + 1
    rows = int((high_y - low_y) / side) + 1
    begin = np.zeros(columns * rows + 1, np.int64)
    for row in range(count):
        if not math.isnan(predicted[row, 0]):
            cell = int((predicted[row, 1] - low_y) / side) * columns + int((predicted[row, 0] - low_x) / side)
            begin[cell + 1] += 1
    for cell in range(columns * rows):
        begin[cell + 1] += begin[cell]
    member = np.empty(count, np.int64)
    fill = begin[:-1].copy()
    for row in range(count):
        if not math.isnan(predicted[row, 0]):
            cell = int((predicted[row, 1] - low_y) / side) * columns + int((predicted[row, 0] - low_x) / side)
            member[fill[cell]] = row
            fill[cell] += 1
    found = 0
    capacity = other.shape[0]
    reach_squared = reach_m * reach_m
    for i in range(position.shape[0]):
        start[i] = min(found, capacity)
        x = position[i, 0]
        y = position[i, 1]
        first_column = max(0, int(math.floor((x - reach_m - low_x) / side)))
        last_column = min(columns - 1, int(math.floor((x + reach_m - low_x) / side)))
        first_row = max(0, int(math.floor((y - reach_m - low_y) / side)))
        last_row = min(rows - 1, int(math.floor((y + reach_m - low_y) / side)))
        for cell_row in range(first_row, last_row + 1):
            for column in range(first_column, last_column + 1):
                cell = cell_row * columns + column
                for k in range(begin[cell], begin[cell + 1]):
                    row = member[k]
                    dx = predicted[row, 0] - x
                    dy = predicted[row, 1] - y
                    if dx * dx + dy * dy <= reach_squared and row != own_row[i]:
                        if found < capacity:
                            other[found] = row
                        found += 1
    start[position.shape[0]] = min(found, capacity)
    return found


@kernel
def leave_out(start: Index, other: Index, own_away: Flags, teams: Index) -> None:
    """Drop robots that are away from the pair list, but for own robots that are away themselves: they drive past them.

    Parameters
    ----------
    start, other : as `all_pairs` fills them; both are rewritten in place
    own_away : (n,) own robots that are away
    teams : (m,) team of each robot received
    """
    kept = 0
    for i in range(own_away.shape[0]):
        first = start[i]
        start[i] = kept
        for pair in range(first, start[i + 1]):
            row = other[pair]
            if own_away[i] or teams[row] != AWAY:
                other[kept] = row
                kept += 1
    start[own_away.shape[0]] = kept


@kernel
def keep_team(start: Index, other: Index, own_team: Index, teams: Index) -> None:
    """Drop from the pair list robots that are not of a robot's own team.

    Parameters
    ----------
    start, other : as `all_pairs` fills them; both are rewritten in place
    own_team : (n,) team of each own robot; 0: it keeps all its neighbours
    teams : (m,) team of each robot received
    """
    kept = 0
    for i in range(own_team.shape[0]):
        first = start[i]
        start[i] = kept
        mine = own_team[i]
        for pair in range(first, start[i + 1]):
            row = other[pair]
            if mine == 0 or teams[row] == mine:
                other[kept] = row
                kept += 1
    start[own_team.shape[0]] = kept


@kernel
def keep_listed(start: Index, other: Index, place: Index, listed: Flags) -> None:
    """Drop from the pair list robots that are not in the list of a robot's team.

    Parameters
    ----------
    start, other : as `all_pairs` fills them; both are rewritten in place
    place : (n,) of the list of each own robot among `listed`; -1: it keeps all its neighbours
    listed : (k, m) whether each list holds each robot received
    """
    kept = 0
    for i in range(place.shape[0]):
        first = start[i]
        start[i] = kept
        mine = place[i]
        for pair in range(first, start[i + 1]):
            row = other[pair]
            if mine < 0 or listed[mine, row]:
                other[kept] = row
                kept += 1
    start[place.shape[0]] = kept
