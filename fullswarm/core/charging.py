"""Plans which robot charges when, and where (decisions 64 and 65); nothing runs in a fleet without docks.

The robots' health reports are authoritative: each says whether its task is interrupted, for which dock, and how far it
has got. What this node wants of a robot is sent until the report shows it. So a core that is started again takes over
what it finds, and an interruption that a robot has ended (a stop, a stick, a failed driver) has ended here, too.

No two robots get one slot. A slot in which a robot stands that was not sent there is not used, nor one in which or
before which a robot has fallen silent, also after a restart of the core; one that does not charge, or that a robot does
not reach, is said to have failed and tried again later.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Literal

import structlog

from fullswarm.bus import Bus
from fullswarm.bus.report_query import ReportsOnQuery
from fullswarm.config import SwarmConfig
from fullswarm.config.docks import Slot, Thresholds, slots_of, thresholds_of
from fullswarm.core.charge_plan import Candidate, latest_begins, nearest_free
from fullswarm.core.energy import Energy
from fullswarm.core.roster import Roster
from fullswarm.keys import Keys
from fullswarm.messages import ChargeOrder, ChargePhase, ChargingStatus, DockState, RobotHealth, RobotStates
from fullswarm.reasons import NONE, Code, Reason, reason
from fullswarm.runtime import Scheduler, Timer
from fullswarm.store import Store, Stored

TICK_S = 1.0
PUBLISH_S = 2.0
START_S = 3.0
"""After a start of the core it waits so long for reports before it plans: a robot may stand in any dock."""
UNCONFIRMED_S = 5.0
"""An order that its robot does not follow within this is dropped, and"""
REFUSED_S = 15.0
"""the robot gets another one after this: a person drives it, or it was stopped in that moment."""
LOST_S = 10.0
"""A robot silent for so long has lost its slot, unless it stands there."""
BLOCKED_S = 10.0
"""A robot that knows no way to its dock for so long gets another one."""
WAY_S_PER_M, WAY_S = 20.0, 180.0
"""A way to a dock may take so long: per metre of the straight line, and beyond that."""
NO_RISE_S = 300.0
"""A charge that has not risen for so long in a dock does not rise any more, or never did."""
RISE = 0.001
ENOUGH = 0.1
"""A robot that has charged so much more than `go_at` makes room for one that must charge now."""
LEAD_S = 5.0
KEEP_S = 600.0
ENERGY = "charging/energy/"
OWNERS = "charging/owners"

Op = Literal["wait", "go", "leave", "cancel"]

log = structlog.get_logger()


@dataclass(slots=True)
class Trip:
    """One robot's interruption, as this core wants it."""

    id: str
    robot: str
    op: Op
    slot: str = ""
    sent_s: float = 0.0  # when `op` was first wanted
    phase: ChargePhase | None = None  # as the robot reports it; None: not yet
    phase_s: float = 0.0  # since when
    blocked_s: float = math.inf  # since when it knows no way
    began_charge: float = 0.0
    straight_m: float = 0.0
    risen: float = -1.0  # the highest charge in the dock, and when it was reached
    risen_s: float = 0.0
    current_s: float = 0.0  # when current was last seen to flow


@dataclass(slots=True)
class Place:
    """One slot."""

    slot: Slot
    failed_until_s: float = -math.inf
    failed: Reason = NONE
    stands: tuple[str, ...] = ()  # robots that are in the way and were not sent there; a silent one first
    reason: Reason = NONE  # why it is not used now


@dataclass(slots=True)
class Known:
    """What is known of one robot."""

    energy: Energy
    limits: Thresholds
    x_m: float = math.nan
    y_m: float = math.nan
    radius_m: float = 0.2
    not_before_s: float = -math.inf  # it gets no order earlier
    shunned: dict[str, float] = field(default_factory=dict)  # slots that it did not reach → until when


class ChargingNode:
    """Sends robots to docks and back.

    Parameters
    ----------
    halts_of : the stops of a robot that the core knows
    process : name of this start of the core
    """

    def __init__(
        self, bus: Bus, keys: Keys, scheduler: Scheduler, config: SwarmConfig, store: Store, roster: Roster,
        halts_of: Callable[[str], tuple[str, ...]], process: str,
    ) -> None:  # fmt: skip
        self._bus, self._keys, self._scheduler, self._config = bus, keys, scheduler, config
        self._store, self._roster, self._halts_of, self._process = store, roster, halts_of, process
        self._settings = config.charging
        self._places = {slot.name: Place(slot) for slot in slots_of(config)}
        self._robots: dict[str, Known] = {}
        self._trips: dict[str, Trip] = {}  # by robot
        self._waiting: tuple[str, ...] = ()
        self._owners: dict[str, str] = {}  # robot → slot, as in the database
        self._numbers, self._sequence = itertools.count(1), 0
        self._began_s, self._published_s, self._kept_s = scheduler.now_s(), -math.inf, scheduler.now_s()
        self._said: object = None
        self._timer: Timer | None = None
        self._subscription = None
        self._on_query: ReportsOnQuery | None = None
        if self._places:
            self._remember_owners()
            self._timer = scheduler.every(TICK_S, self._tick)
            self._subscription = bus.subscribe(keys.state(), RobotStates, self._on_states, latest=True)
            self._on_query = ReportsOnQuery(bus, keys, scheduler, self._report)

    def close(self) -> None:
        """Stop planning: robots in docks stay there, robots on their way stand once the core is silent."""
        if self._timer is not None:
            self._timer.cancel()
        if self._subscription is not None:
            self._subscription.close()
        if self._on_query is not None:
            self._on_query.close()

    # ---------------------------------------------------------------- what is known
    def _on_states(self, states: RobotStates) -> None:
        if states.own_frame:
            return
        for robot, x_m, y_m, radius_m in zip(states.robots, states.x_m, states.y_m, states.radius_m, strict=True):
            if (known := self._known(robot)) is not None:
                known.x_m, known.y_m, known.radius_m = x_m, y_m, radius_m

    def _known(self, robot: str) -> Known | None:
        found = self._robots.get(robot)
        if found is None and robot in self._roster.known():
            found = self._robots[robot] = Known(self._energy_of(robot), thresholds_of(self._config, robot))
        return found

    def _energy_of(self, robot: str) -> Energy:
        """Return what an earlier core has learnt of a robot, or the first guesses of the fleet file."""
        guess = self._settings
        found = Energy(
            guess.draw_per_h / 3600.0, guess.draw_per_m * guess.way_factor, guess.charge_per_h / 3600.0
        )  # fmt: skip
        kept = self._store.get(ENERGY + robot)
        values = kept.get("rates") if isinstance(kept, dict) else None
        rates = [each for each in values if isinstance(each, float) and each > 0.0] if isinstance(values, list) else []
        if len(rates) == 3:
            found.draw_per_s, found.way_per_m, found.charge_per_s = rates
        return found

    def _remember_owners(self) -> None:
        """Take robots that an earlier core sent to a slot to stand there until they say where they are."""
        kept = self._store.get(OWNERS)
        for robot, name in (kept if isinstance(kept, dict) else {}).items():
            place, known = self._places.get(str(name)), self._known(robot)
            if place is not None and known is not None:
                self._owners[robot] = place.slot.name
                known.x_m, known.y_m = place.slot.x_m, place.slot.y_m

    def _keep_owners(self, healths: dict[str, RobotHealth]) -> None:
        """Write into the database which robot has which slot, once that changes: a silent one keeps what it had."""
        owners = {robot: slot for robot, slot in self._owners.items() if robot in self._robots and robot not in healths}
        owners |= {trip.robot: trip.slot for trip in self._trips.values() if trip.slot}
        if owners != self._owners:
            self._owners = owners
            self._store.keep({OWNERS: dict(owners)}, f"core {self._process}")

    def _keep(self) -> None:
        """Write what was learnt into the database."""
        self._kept_s = self._scheduler.now_s()
        values: dict[str, Stored] = {
            ENERGY + robot: {"rates": [each.energy.draw_per_s, each.energy.way_per_m, each.energy.charge_per_s]}
            for robot, each in self._robots.items()
        }
        if values:
            self._store.keep(values, f"core {self._process}")

    # ---------------------------------------------------------------- each second
    def _tick(self) -> None:
        now_s = self._scheduler.now_s()
        healths = {
            robot: health
            for robot in self._roster.present()
            if (health := self._roster.health(robot)) is not None and self._known(robot) is not None
        }
        for robot in [robot for robot in self._robots if robot not in self._roster.known()]:
            del self._robots[robot]
        for robot, health in healths.items():
            self._follow(robot, health, now_s)
        self._lose(healths, now_s)
        self._look_at_places(healths, now_s)
        if now_s - self._began_s >= START_S:
            for trip in tuple(self._trips.values()):
                if trip.robot in healths:
                    self._judge(trip, healths[trip.robot], now_s)
            self._plan(healths, now_s)
            self._keep_owners(healths)
            for trip in self._trips.values():
                self._send(trip)
        if now_s - self._kept_s >= KEEP_S:
            self._keep()
        self._publish(now_s)

    def _follow(self, robot: str, health: RobotHealth, now_s: float) -> None:
        """Take a robot's report in: how far its interruption is, and what its battery says."""
        known, trip, charge = self._robots[robot], self._trips.get(robot), health.charge
        if charge is not None and (trip is None or (trip.phase and trip.id != charge.id)):
            trip = self._adopt(robot, charge.id, charge.dock, now_s, health)
        if trip is not None and charge is not None and trip.id == charge.id:
            if trip.phase != charge.phase:
                self._enter(trip, charge.phase, health, now_s)
        elif trip is not None and charge is None:
            if trip.phase:
                self._end(trip, now_s)
            elif now_s - trip.sent_s > UNCONFIRMED_S:
                self._end(trip, now_s)
                known.not_before_s = now_s + REFUSED_S
        if health.battery >= 0.0:
            docked = charge is not None and charge.phase == "docked"
            works = charge is None and bool(health.behaviour) and not health.charging
            known.energy.note("work" if works else "charges" if docked else "", health.battery, now_s)

    def _adopt(self, robot: str, trip_id: str, slot: str, now_s: float, health: RobotHealth) -> Trip:
        """Take over an interruption that this core has not begun, or that a robot has taken up again by itself."""
        taken = any(each.slot == slot and each.robot != robot for each in self._trips.values())
        usable = slot in self._places and not taken
        op: Op = "go" if usable else "wait" if not slot else "cancel"
        trip = self._trips[robot] = Trip(trip_id, robot, op, slot if usable else "", now_s)
        trip.began_charge = health.battery
        return trip

    def _enter(self, trip: Trip, phase: ChargePhase, health: RobotHealth, now_s: float) -> None:
        known = self._robots[trip.robot]
        if phase == "docked":
            if trip.phase == "docking":
                known.energy.note_way(trip.began_charge - health.battery, trip.straight_m)
            trip.risen, trip.risen_s, trip.current_s = health.battery, now_s, now_s
        trip.phase, trip.phase_s, trip.blocked_s = phase, now_s, math.inf

    def _end(self, trip: Trip, now_s: float) -> None:
        del self._trips[trip.robot]
        log.info("a robot has charged", robot=trip.robot, dock=trip.slot, phase=trip.phase, at_s=round(now_s, 1))

    def _lose(self, healths: dict[str, RobotHealth], now_s: float) -> None:
        """Give up the trips of robots that are silent; one that stands in its slot blocks it, see below."""
        for robot, trip in tuple(self._trips.items()):
            if robot in healths:
                continue
            trip.blocked_s = min(trip.blocked_s, now_s)
            if now_s - trip.blocked_s >= LOST_S:
                del self._trips[robot]

    def _look_at_places(self, healths: dict[str, RobotHealth], now_s: float) -> None:
        """Find out which slots robots stand in, or before, that were not sent there."""
        owners = {trip.slot: trip.robot for trip in self._trips.values() if trip.slot}
        for name, place in self._places.items():
            slot, place.reason = place.slot, NONE
            others = [robot for robot in self._robots if robot != owners.get(name, "")]
            # One that is silent stays where it is, perhaps on the line into the slot: it must be passed there.
            lost = [robot for robot in others if robot not in healths and self._is_in(robot, slot, slot.approach)]
            here = [robot for robot in others if robot in healths and self._is_in(robot, slot, (slot.x_m, slot.y_m))]
            idle = [robot for robot in here if not healths[robot].behaviour and robot not in self._trips]
            if lost:
                place.reason = reason(Code.DOCK_LOST, robot=lost[0])
            elif idle:  # others only pass by
                place.reason = reason(Code.DOCK_TAKEN, robot=idle[0])
            elif now_s < place.failed_until_s:
                place.reason = place.failed
            place.stands = (*lost, *idle, *(robot for robot in here if robot not in idle))

    def _is_in(self, robot: str, slot: Slot, begin: tuple[float, float]) -> bool:
        """Tell whether a robot is within two radii of the line from `begin` into a slot."""
        known = self._robots[robot]
        dx, dy = slot.x_m - begin[0], slot.y_m - begin[1]
        squared = dx * dx + dy * dy
        along = 0.0 if squared == 0.0 else ((known.x_m - begin[0]) * dx + (known.y_m - begin[1]) * dy) / squared
        share = min(max(along, 0.0), 1.0)
        apart_m = math.hypot(known.x_m - begin[0] - share * dx, known.y_m - begin[1] - share * dy)
        return apart_m < 2.0 * known.radius_m

    # ---------------------------------------------------------------- trips that are under way
    def _judge(self, trip: Trip, health: RobotHealth, now_s: float) -> None:
        """Decide what becomes of a trip: it goes on, it has been charged, or its dock has failed."""
        known, settings = self._robots[trip.robot], self._settings
        if trip.phase == "going":
            blocked = health.stop_code in (Code.NO_WAY, Code.GOAL_CLOSED)
            trip.blocked_s = min(trip.blocked_s, now_s) if blocked else math.inf
            longest_s = WAY_S + WAY_S_PER_M * trip.straight_m
            if now_s - trip.blocked_s >= BLOCKED_S or now_s - trip.phase_s >= longest_s:
                self._shun(trip, known, now_s)
        elif trip.phase == "docking" and now_s - trip.phase_s >= settings.dock_s:
            self._fail(trip, reason(Code.DOCK_NOT_REACHED, robot=trip.robot), now_s)
        elif trip.phase == "docked" and trip.op in ("go", "wait"):
            if health.charging or trip.op == "wait":
                trip.current_s = now_s
            if health.battery > trip.risen + RISE:
                trip.risen, trip.risen_s = health.battery, now_s
            full = health.battery >= known.limits.leave_at
            if full:
                # A robot without a task stays until another one needs its place: see `_plan`.
                if health.behaviour:
                    self._want(trip, "leave", now_s)
            elif health.charging is False and now_s - trip.current_s >= settings.no_current_s:
                self._fail(trip, reason(Code.DOCK_NO_CURRENT, robot=trip.robot), now_s)
            elif health.charging is not False and now_s - trip.risen_s >= NO_RISE_S:
                if health.battery >= known.limits.go_at + ENOUGH:  # as full as this battery gets
                    if health.behaviour:
                        self._want(trip, "leave", now_s)
                else:
                    self._fail(trip, reason(Code.DOCK_NO_CURRENT, robot=trip.robot), now_s)

    def _want(self, trip: Trip, op: Op, now_s: float) -> None:
        if trip.op != op:
            trip.op, trip.sent_s = op, now_s

    def _shun(self, trip: Trip, known: Known, now_s: float) -> None:
        """Have a robot try another dock than one to which it finds no way."""
        known.shunned[trip.slot] = now_s + self._settings.retry_s
        log.warning("a robot does not get to a dock", robot=trip.robot, dock=trip.slot)
        self._redirect(trip, known, now_s)

    def _fail(self, trip: Trip, why: Reason, now_s: float) -> None:
        """Note that a dock has failed, and have its robot try another one."""
        place = self._places.get(trip.slot)
        if place is not None and trip.op != "cancel":
            place.failed, place.failed_until_s = why, now_s + self._settings.retry_s
            place.reason = place.reason or why
            log.warning("a dock is not used for a while", dock=trip.slot, reason=why.text)
        self._redirect(trip, self._robots[trip.robot], now_s)

    def _redirect(self, trip: Trip, known: Known, now_s: float) -> None:
        """Send a robot to another free dock; without one it goes back to work as long as it can, then it waits."""
        old = trip.slot
        trip.slot = ""
        health = self._roster.health(trip.robot)
        slot = "" if health is None else self._free_for(trip.robot, health, now_s)
        if slot and slot != old:
            self._begin(trip.robot, slot, now_s)
        elif known.energy.lasts_s(self._charge_of(trip.robot), known.limits.reserve, self._far_m(trip.robot)) > 0.0:
            trip.slot = old  # until it is out of it
            self._want(trip, "cancel", now_s)
        else:
            self._begin(trip.robot, "", now_s)

    # ---------------------------------------------------------------- who goes
    def _plan(self, healths: dict[str, RobotHealth], now_s: float) -> None:
        """Send the robots that are due, and make room for those that cannot work on."""
        usable = [name for name, place in self._places.items() if not place.reason]
        candidates, may_go = [], set[str]()
        for robot, health in healths.items():
            if self._wants_to_charge(robot, health, now_s):
                known = self._robots[robot]
                slots = self._slots_of(robot, health, now_s)
                lasts_s = known.energy.lasts_s(health.battery, known.limits.reserve, self._far_m(robot))
                stays_s = known.energy.charges_s(known.limits.reserve, known.limits.leave_at) + 2.0 * 60.0
                candidates.append(Candidate(robot, lasts_s, stays_s, slots))
                if health.battery < max(self._settings.early_at, known.limits.go_at):
                    may_go.add(robot)
        begins_s = latest_begins(candidates, usable)
        lasts_s_of = {each.robot: each.lasts_s for each in candidates}
        waiting: list[str] = []
        for robot, begin_s in begins_s.items():
            health, known = healths[robot], self._robots[robot]
            due = begin_s <= LEAD_S or health.battery < known.limits.go_at
            if robot not in may_go or not due:
                continue
            slot = self._free_for(robot, health, now_s)
            if slot:
                self._begin(robot, slot, now_s)
                continue
            waiting.append(robot)
            if lasts_s_of[robot] <= 0.0 and known.not_before_s <= now_s:
                self._make_room(healths, self._slots_of(robot, health, now_s), now_s)
                if robot not in self._trips and health.behaviour:
                    self._begin(robot, "", now_s)
        self._waiting = tuple(waiting)
        if waiting:
            self._make_idle_leave(healths, now_s)

    def _wants_to_charge(self, robot: str, health: RobotHealth, now_s: float) -> bool:
        """Tell whether a robot is one that may be sent to a dock."""
        trip, known = self._trips.get(robot), self._robots[robot]
        if health.battery < 0.0 or not math.isfinite(known.x_m) or known.not_before_s > now_s:
            return False
        if health.estop or health.lifecycle == "FAULT":
            return False
        if trip is not None:
            return trip.phase == "waiting" and trip.op == "wait"
        return bool(health.behaviour) or self._settings.idle_robots

    def _slots_of(self, robot: str, health: RobotHealth, now_s: float) -> tuple[str, ...]:
        """Return the slots that a robot may use and reaches, as far as is known."""
        shunned = self._robots[robot].shunned
        return tuple(
            name
            for name, place in self._places.items()
            if place.slot.takes(robot, health.make, health.model) and shunned.get(name, -math.inf) <= now_s
        )

    def _free_for(self, robot: str, health: RobotHealth, now_s: float) -> str:
        """Return the nearest slot that is free for a robot; "": none is."""
        taken = {trip.slot for trip in self._trips.values()}
        free = {
            name: self._apart_m(robot, place.slot)
            for name, place in self._places.items()
            if name not in taken and not place.reason and set(place.stands) <= {robot}
        }
        return nearest_free(self._slots_of(robot, health, now_s), free)

    def _begin(self, robot: str, slot: str, now_s: float) -> None:
        """Begin a trip to a slot; "": the robot waits for one."""
        trip = Trip(f"{self._process}.c{next(self._numbers)}", robot, "go" if slot else "wait", slot, now_s)
        trip.began_charge = self._charge_of(robot)
        if slot:
            trip.straight_m = self._apart_m(robot, self._places[slot].slot)
        self._trips[robot] = trip
        log.info("a robot is sent to charge", robot=robot, dock=slot, battery=round(trip.began_charge, 3))

    def _make_room(self, healths: dict[str, RobotHealth], slots: Iterable[str], now_s: float) -> None:
        """Let the robot that is charged most leave one of these slots, if it has charged enough to be of use."""
        if any(trip.slot in slots and trip.op == "leave" for trip in self._trips.values()):
            return
        docked = [
            (healths[trip.robot].battery, trip.robot)
            for trip in self._trips.values()
            if trip.slot in slots and trip.phase == "docked" and trip.op == "go" and trip.robot in healths
        ]
        enough = [(battery, robot) for battery, robot in docked if battery >= self._robots[robot].limits.go_at + ENOUGH]
        if enough:
            self._want(self._trips[max(enough)[1]], "leave", now_s)

    def _make_idle_leave(self, healths: dict[str, RobotHealth], now_s: float) -> None:
        """Let a robot without a task that is charged leave its slot: others wait for one."""
        for trip in self._trips.values():
            health = healths.get(trip.robot)
            if health is None or health.behaviour or trip.phase != "docked":
                continue
            if health.battery >= self._robots[trip.robot].limits.leave_at:
                self._want(trip, "leave", now_s)

    def _charge_of(self, robot: str) -> float:
        health = self._roster.health(robot)
        return -1.0 if health is None else health.battery

    def _apart_m(self, robot: str, slot: Slot) -> float:
        known = self._robots[robot]
        return math.hypot(known.x_m - slot.x_m, known.y_m - slot.y_m)

    def _far_m(self, robot: str) -> float:
        """Return the distance to the farthest usable dock of a robot: the nearest may be taken when it must go."""
        health = self._roster.health(robot)
        slots = () if health is None else self._slots_of(robot, health, self._scheduler.now_s())
        usable = [self._places[name].slot for name in slots if not self._places[name].reason]
        return max((self._apart_m(robot, slot) for slot in usable), default=0.0)

    # ---------------------------------------------------------------- what goes out
    def _send(self, trip: Trip) -> None:
        """Send what is wanted of a robot, unless its report shows it."""
        done = {
            "wait": ("waiting",),
            "go": ("going", "docking", "docked"),
            "leave": ("leaving", "returning"),
            "cancel": ("leaving", "returning"),
        }
        if trip.phase in done[trip.op]:
            return
        place = self._places.get(trip.slot)
        slot = None if place is None else place.slot
        order = ChargeOrder(
            id=trip.id,
            robot=trip.robot,
            op=trip.op,
            dock=trip.slot,
            x_m=0.0 if slot is None else slot.x_m,
            y_m=0.0 if slot is None else slot.y_m,
            heading_rad=0.0 if slot is None else slot.heading_rad,
            approach_m=0.0 if slot is None else slot.approach_m,
            means="pose" if slot is None else slot.means,
            speed_m_s=self._settings.speed_m_s,
            idle=self._settings.idle_robots,
            halts=self._halts_of(trip.robot),
            core=self._process,
            stamp_s=self._scheduler.now_s(),
        )
        self._bus.publish(self._keys.charge(trip.robot), order)

    def _report(self) -> None:
        self._said = None
        self._publish(self._scheduler.now_s())

    def _publish(self, now_s: float) -> None:
        """Publish the docks where they have changed, and now and then."""
        docks = tuple(self._state(place) for place in self._places.values())
        said = docks, self._waiting
        if said == self._said and now_s - self._published_s < PUBLISH_S - 1e-6:
            return
        self._said, self._published_s = said, now_s
        self._sequence += 1
        status = ChargingStatus(
            docks=docks, waiting=self._waiting, core=self._process, sequence=self._sequence, stamp_s=now_s
        )
        self._bus.publish(self._keys.charging_status, status)

    def _state(self, place: Place) -> DockState:
        slot = place.slot
        trip = next((each for each in self._trips.values() if each.slot == slot.name), None)
        failed = bool(place.reason) and place.reason.code in (Code.DOCK_NO_CURRENT, Code.DOCK_NOT_REACHED)
        return DockState(
            dock=slot.name, x_m=slot.x_m, y_m=slot.y_m, heading_rad=slot.heading_rad, approach_m=slot.approach_m,
            robot=trip.robot if trip is not None else place.stands[0] if place.stands else "",
            phase=("failed" if failed else "blocked") if place.reason else _phase(trip),
            reason=place.reason.text, code=place.reason.code,
        )  # fmt: skip


def _phase(trip: Trip | None) -> ChargePhase | Literal["free"]:
    return "free" if trip is None else trip.phase or "going"
