"""Operations that read: each makes a record of what the console has received."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from fullswarm import __version__
from fullswarm.errors import did_you_mean
from fullswarm.messages import RequestStatus
from fullswarm.operator.console.api import records
from fullswarm.operator.console.api.problems import ProblemError
from fullswarm.operator.console.api.programs import Program
from fullswarm.operator.console.fleet import UNKNOWN, core_age_s
from fullswarm.operator.console.gateway import Gateway
from fullswarm.operator.console.world import World
from fullswarm.operator.robot_state import advise, row_state
from fullswarm.operator.view import RobotRow, Snapshot

MOST_ENTRIES = 2000


@dataclass(frozen=True, slots=True)
class Reader:
    """What one program may read."""

    gateway: Gateway
    program: Program

    @property
    def world(self) -> World:
        """The console's copy of the core's database.

        Raises
        ------
        ProblemError
            503: the core has not answered yet.
        """
        world = self.gateway.context.world
        if not world.known:
            hint = "is it running? start it with `fullswarm up FLEET.toml`"
            raise ProblemError(503, "the core has not answered yet", where="core", hint=hint, retry_s=1.0)
        return world

    # ---------------------------------------------------------------- robots
    def swarm(self) -> records.SwarmState:
        """Return the swarm as a whole."""
        seen, world = self.gateway.view.snapshot(), self.gateway.context.world
        admitted = self.program.admitted
        return records.SwarmState(
            swarm=seen.swarm,
            version=__version__,
            you=records.You(operator=self.program.name, role=admitted.role),
            hub_connected=seen.connected,
            core_age_s=core_age_s(seen),
            robots=tuple(row.robot for row in seen.robots),
            silent=seen.silent,
            missing=seen.missing,
            groups={name: tuple(robots) for name, robots in world.shown()["groups"].items()},
        )

    def robots(self) -> records.Robots:
        """Return all robots."""
        seen = self.gateway.view.snapshot()
        return records.Robots(robots=tuple(self._robot(row, seen) for row in seen.robots), missing=seen.missing)

    def robot(self, robot: str) -> records.Robot:
        """Return one robot.

        Raises
        ------
        ProblemError
            404: there is none of that name.
        """
        seen = self.gateway.view.snapshot()
        for row in seen.robots:
            if row.robot == robot:
                return self._robot(row, seen)
        raise self._unknown(robot)

    def some_robots(self, robots: frozenset[str]) -> tuple[records.Robot, ...]:
        """Return the robots of these names that are there; none: all."""
        seen = self.gateway.view.snapshot()
        return tuple(self._robot(row, seen) for row in seen.robots if not robots or row.robot in robots)

    def expanded(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return robots with groups expanded, each once.

        Raises
        ------
        ProblemError
            404: there is no such robot or group.
        """
        present = frozenset(self.gateway.view.present())
        found: dict[str, None] = {}
        for name in names:
            if name.startswith("@"):
                members = self.world.group(name[1:])
                if not members:
                    hint = did_you_mean(name[1:], self.world.shown()["groups"])
                    raise ProblemError(404, f"no group '{name[1:]}'", where="robots", hint=hint)
                found |= dict.fromkeys(members)
            elif name not in present:
                raise self._unknown(name)
            else:
                found[name] = None
        return tuple(found)

    def _unknown(self, robot: str) -> ProblemError:
        hint = did_you_mean(robot, self.gateway.view.present())
        return ProblemError(404, f"no robot '{robot[:64]}' is there", where="robots", hint=hint)

    def _robot(self, row: RobotRow, seen: Snapshot) -> records.Robot:
        health, state = row.health or UNKNOWN, row_state(row)
        until_s = self.program.twists.until_s(row.robot)
        driven_s = None if until_s is None else max(0.0, until_s - self.gateway.context.scheduler.now_s())
        return records.Robot(
            robot=row.robot,
            age_s=row.age_s,
            silent=row.silent,
            pose=records.Pose(x_m=_known(row.x_m), y_m=_known(row.y_m), heading_rad=_known(row.heading_rad)),
            twist=records.Motion(linear_m_s=_known(row.speed_m_s), angular_rad_s=_known(row.turn_rad_s)),
            radius_m=_known(row.radius_m),
            state=state.word,
            attention=state.attention,
            why=state.why,
            advice=advise(row),
            held_by=seen.holders.get(row.robot, ""),
            driven_until_s=driven_s,
            battery=None if health.battery < 0.0 else health.battery,
            charging=health.charging,
            make=health.make,
            model=health.model,
            lifecycle=health.lifecycle,
            moving=health.moving,
            estop=health.estop,
            touching=health.contacts,
            behaviour=health.behaviour,
            request_id=health.request_id,
            stop=records.Reason(code=health.stop_code, text=health.stop_reason, parameters=health.stop_parameters),
            fault=records.Reason(code=health.fault_code, text=health.fault),
        )

    # ---------------------------------------------------------------- what the core has
    def behaviours(self) -> records.Behaviours:
        """Return all behaviours."""
        found = self.world.shown()["behaviours"]
        return records.Behaviours(behaviours=tuple(_behaviour(name, each) for name, each in found.items() if each))

    def behaviour(self, name: str) -> records.Behaviour:
        """Return one behaviour.

        Raises
        ------
        ProblemError
            404: there is none of that name.
        """
        record = self.world.record(name)
        if record is None:
            hint = did_you_mean(name[:64], self.world.shown()["behaviours"])
            raise ProblemError(404, f"no behaviour '{name[:64]}'", where="behaviour", hint=hint)
        return _behaviour(name, record)

    def map(self) -> records.WorldMap:
        """Return what is known of the ground."""
        shown = self.world.shown()
        bounds, sensing = shown["arena"], shown["sensing_radius_m"]
        boxes = (box for box in shown["boxes"] if isinstance(box, list | tuple) and len(box) >= 4)
        return records.WorldMap(
            bounds_m=(bounds[0], bounds[1], bounds[2], bounds[3]) if bounds is not None and len(bounds) == 4 else None,
            boxes=tuple(
                records.Box(
                    x_m=box[0], y_m=box[1], size_x_m=box[2], size_y_m=box[3],
                    heading_rad=box[4] if len(box) > 4 else 0.0,
                )
                for box in boxes
            ),
            sensing_radius_m=float(sensing) if isinstance(sensing, int | float) else None,
        )  # fmt: skip

    def docks(self) -> records.Docks:
        """Return the docks."""
        seen = self.gateway.view.snapshot()
        return records.Docks(docks=seen.docks, waiting=seen.waiting)

    def missions(self) -> records.Missions:
        """Return the missions."""
        return records.Missions(missions=self.gateway.missions())

    def parameters(self, query: records.ParameterQuery) -> records.Entries:
        """Return entries of the core's database.

        Raises
        ------
        ProblemError
            422: they are too many.
        """
        found = self.world.entries(query.key)
        if len(found) > MOST_ENTRIES:
            hint = "name the beginning of a key, for example agent/*"
            raise ProblemError(422, f"more than {MOST_ENTRIES} entries", where="key", hint=hint)
        return records.Entries(parameters=found)

    # ---------------------------------------------------------------- what has happened
    def log(self, query: records.LogQuery) -> records.Log:
        """Return the newest lines of the log."""
        entries = self.gateway.log_entries()[-query.limit :]
        return records.Log(
            lines=tuple(
                records.LogLine(
                    clock=each.clock, kind=each.kind, text=each.text, robots=each.robots, request_id=each.request_id,
                    by=each.by,
                )
                for each in entries
            )
        )  # fmt: skip

    def leases(self) -> records.Leases:
        """Return which operator holds which robots."""
        name = self.program.name
        return records.Leases(
            leases=tuple(
                records.Lease(
                    robot=each.robot, operator=each.operator, age_s=each.age_s, mine=each.operator == name,
                    ends_in_s=self.program.ends_in_s(each.robot) if each.operator == name else None,
                )
                for each in self.gateway.view.snapshot().leases
            )
        )  # fmt: skip

    def request(self, request_id: str) -> RequestStatus:
        """Return the newest status of a request of this program.

        Raises
        ------
        ProblemError
            404: there is none, or it is too old.
        """
        status = self.program.status(request_id)
        if status is None:
            raise ProblemError(404, f"no request '{request_id[:64]}' of yours is known", where="request")
        return status


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _behaviour(name: str, record: dict[str, Any]) -> records.Behaviour:
    return records.Behaviour(
        behaviour=name,
        summary=str(record.get("summary", "")),
        safety_filter=bool(record.get("filtered")),
        available=available(record),
        parameters=parameter_schema(record),
    )


def available(record: dict[str, Any]) -> bool:
    """Return whether programs may request a behaviour: behind the filter, or without a motion; no stick's intent."""
    moves = bool(record.get("law") or record.get("centralised"))
    return (bool(record.get("filtered")) or not moves) and not record.get("expires_s")


_POINT = {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}
_TYPES: dict[str, dict[str, Any]] = {
    "number": {"type": "number"},
    "integer": {"type": "integer"},
    "flag": {"type": "boolean"},
    "word": {"type": "string"},
    "point": _POINT,
    "points": {"type": "array", "items": _POINT},
}
_KEYS = {"min": "minimum", "max": "maximum", "choices": "enum", "doc": "description", "default": "default"}


def parameter_schema(record: dict[str, Any]) -> dict[str, Any]:
    """Return a JSON Schema (draft 2020-12) of what a request of a behaviour may contain."""
    properties, required = {}, []
    for name, spec in record["parameters"].items():
        schema = dict(_TYPES.get(str(spec.get("type")), {}))
        schema |= {ours: spec[theirs] for theirs, ours in _KEYS.items() if spec.get(theirs) is not None}
        if unit := spec.get("unit"):
            schema["description"] = f"{schema.get('description', '')} ({unit})".strip()
        properties[name] = schema
        if spec.get("required"):
            required.append(name)
    return {"type": "object", "properties": properties, "required": required, "additionalProperties": False}
