"""The core's settings in its local database: seeded from the fleet file, changed over the bus (paper II.A)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from pydantic import BaseModel, ValidationError

from fullswarm.bus import Bus
from fullswarm.config import PerformanceConfig, SwarmConfig
from fullswarm.config.models import SPEED_LIMIT_M_S, TURN_LIMIT_RAD_S
from fullswarm.config.parameter import BARRIER_GAIN, SAFETY_MARGIN, Parameter
from fullswarm.core.behaviours import PREFIX, all_records
from fullswarm.core.roster import SILENCE_S
from fullswarm.errors import ConfigError, FullswarmError, did_you_mean
from fullswarm.keys import Keys
from fullswarm.messages import ParamChanged, ParamEntry, ParamReply, ParamRequest
from fullswarm.recent import Recent
from fullswarm.store import Store, Stored

Check = Callable[[str, object], Stored]
"""``check(key, value)`` returns the value to store or raises ``ConfigError``."""

INTERVAL = "schedule_interval_s"
SILENCE = "presence_silence_s"
PERFORMANCE = "performance/"
SPEED, TURN = "agent/speed_limit_m_s", "agent/turn_limit_rad_s"
MARGIN, GAIN = "agent/safety_margin_m", "agent/barrier_gain_per_s"
BOUNDS, BOXES, ORIGIN = "world/bounds", "world/boxes", "world/origin"
SENSING = "agent/sensing_radius_m"
GROUP = "group/"
COPIES_S = 0.1
"""A question is repeated after twice that at the earliest."""

_LIMITS = {
    INTERVAL: Parameter(type="number", unit="s", min=0.0, max=10.0),
    SILENCE: Parameter(type="number", unit="s", min=0.6, max=60.0),
    SPEED: Parameter(type="number", unit="m/s", min=SPEED_LIMIT_M_S[0], max=SPEED_LIMIT_M_S[1]),
    TURN: Parameter(type="number", unit="rad/s", min=TURN_LIMIT_RAD_S[0], max=TURN_LIMIT_RAD_S[1]),
    MARGIN: SAFETY_MARGIN,
    GAIN: BARRIER_GAIN,
    BOUNDS: Parameter(type="points", unit="m"),
}


def record_seeds() -> dict[str, Stored]:
    """Return the records of all installed behaviours, by key of the database; `ConfigError` if one is broken."""
    return {PREFIX + name: record for name, record in all_records().items()}


def seeds(config: SwarmConfig) -> dict[str, Stored]:
    """Return the values of the fleet file and of ``behaviours.toml``, by key of the database."""
    world, agent = config.world, config.agent
    x_low, y_low, x_high, y_high = config.bounds_m
    values = record_seeds()
    values |= {
        INTERVAL: config.core.schedule_interval_s,
        SILENCE: SILENCE_S,
        SPEED: agent.speed_limit_m_s or (world.speed_limit_m_s if world else None),
        TURN: agent.turn_limit_rad_s or (world.turn_limit_rad_s if world else None),
        MARGIN: agent.safety_margin_m,
        GAIN: agent.barrier_gain_per_s,
        BOUNDS: [[x_low, y_low], [x_high, y_high]],
        BOXES: {"boxes": [list(box) for box in world.boxes] if world else []},
        SENSING: agent.sensing_radius_m,
    }
    if config.origin_deg is not None:
        values[ORIGIN] = {"latitude_deg": config.origin_deg[0], "longitude_deg": config.origin_deg[1]}
    values |= {GROUP + name: {"robots": list(robots)} for name, robots in config.groups.items()}
    return values | {PERFORMANCE + name: value for name, value in config.performance.model_dump().items()}


class Settings:
    """The current settings. Reading one costs nothing: they are cached until the database changes.

    Attributes
    ----------
    schedule_interval_s : rapid requests are spread over this
    presence_silence_s : a robot silent for longer is absent
    performance : conditions under which a trial is over
    """

    def __init__(self, store: Store, config: SwarmConfig) -> None:
        store.seed(seeds(config))
        self._store, self._config = store, config
        self._read()
        store.watch(self._changed)

    def _changed(self, entry: ParamEntry) -> None:
        if entry.key in _LIMITS or entry.key.startswith(PERFORMANCE):
            self._read()

    def _read(self) -> None:
        interval, silence = self._store.get(INTERVAL), self._store.get(SILENCE)
        usual_s = self._config.core.schedule_interval_s
        self.schedule_interval_s = float(interval) if isinstance(interval, int | float) else usual_s
        self.presence_silence_s = float(silence) if isinstance(silence, int | float) else SILENCE_S
        self.performance = PerformanceConfig.model_validate(self._performance())

    def _performance(self) -> dict[str, Any]:
        names = PerformanceConfig.model_fields
        found = {name: self._store.entry(PERFORMANCE + name) for name in names}
        return {name: entry.value for name, entry in found.items() if entry is not None}

    def checks(self) -> dict[str, Check]:
        """Return what may be set, with how it is checked."""
        checks: dict[str, Check] = dict.fromkeys(_LIMITS, _within)
        return checks | dict.fromkeys((PERFORMANCE + name for name in PerformanceConfig.model_fields), self._condition)

    def _condition(self, key: str, value: object) -> Stored:
        name = key.removeprefix(PERFORMANCE)
        checked = _validated(PerformanceConfig, {**self._performance(), name: value}, key)
        stored: Stored = getattr(checked, name)
        return stored


def _within(key: str, value: object) -> Stored:
    try:
        return _LIMITS[key].check(key, value)
    except ValueError as error:
        raise ConfigError(str(error), hint=f"expected: {_LIMITS[key].expected()}") from None


def _validated(model: type[BaseModel], values: Mapping[str, object], key: str) -> BaseModel:
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ConfigError(f"{key} = {values[key.rpartition('/')[2]]!r}: {error.errors()[0]['msg']}") from None


class ParamServer:
    """Answers ParamRequest for one layer: get, set with a check, history; announces every change.

    Parameters
    ----------
    checks
        Key → ``check(key, value)``, which returns the value to store or raises ``ConfigError``. A key that ends in
        ``*`` means all with its prefix. A key without a check cannot be set from outside.
    show
        Turns an entry into the one that is sent to a reader.
    now_s
        Returns the time, by which copies of a question that come together are known; by default all are answered.
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        layer: str,
        store: Store,
        checks: Mapping[str, Check] | None = None,
        show: Callable[[ParamEntry], ParamEntry] = lambda entry: entry,
        *,
        now_s: Callable[[], float] = lambda: math.inf,
    ) -> None:
        self._now_s = now_s
        self._bus, self._keys, self._layer, self._store = bus, keys, layer, store
        self._checks, self._show = dict(checks or {}), show
        self._done: Recent[str, ParamReply] = Recent(1024)  # a repeated set is answered, not carried out again
        self._answered_s: Recent[str, float] = Recent(1024)
        self._unwatch = store.watch(self._announce)
        self._subscription = bus.subscribe(keys.param_request(layer), ParamRequest, self._answer)

    def close(self) -> None:
        """Stop answering."""
        self._subscription.close()
        self._unwatch()

    def _announce(self, entry: ParamEntry) -> None:
        self._bus.publish(self._keys.param_changed(self._layer), ParamChanged(layer=self._layer, entry=entry))

    def _answer(self, request: ParamRequest) -> None:
        now_s = self._now_s()
        if now_s - self._answered_s.get(request.id, -math.inf) < COPIES_S:
            return  # copies that have waited here together need one answer
        self._answered_s[request.id] = now_s
        reply = self._done.get(request.id)
        if reply is None:
            try:
                reply = ParamReply(id=request.id, ok=True, entries=self._serve(request))
            except FullswarmError as error:
                reply = ParamReply(id=request.id, ok=False, reason=str(error))
            if request.op == "set":
                self._done[request.id] = reply
        self._bus.publish(self._keys.param_reply(self._layer, request.id), reply)

    def _serve(self, request: ParamRequest) -> tuple[ParamEntry, ...]:
        key = request.key
        if request.op == "history":
            return self._store.history(key)
        if request.op == "set":
            return (self._set(key, request.value, request.author),)
        if key.endswith("*"):
            return tuple(map(self._show, self._store.list(key[:-1])))
        entry = self._store.entry(key)
        return () if entry is None or entry.value is None else (self._show(entry),)

    def _set(self, key: str, value: Stored, author: str) -> ParamEntry:
        check = self._checks.get(key)
        if check is None:
            wide = (found for name, found in self._checks.items() if name.endswith("*") and key.startswith(name[:-1]))
            check = next(wide, None)
        if check is None:
            raise ConfigError(f"'{key}' cannot be set", hint=did_you_mean(key, self._checks))
        return self._store.set(key, check(key, value), author or "unknown")
