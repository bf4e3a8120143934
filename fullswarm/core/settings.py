"""The core's settings in its local database: seeded from the fleet file, changed and checked while it runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from pydantic import BaseModel, ValidationError

from fullswarm.config import PerformanceConfig, SwarmConfig
from fullswarm.config.limits import SPEED_LIMIT_M_S, TURN_LIMIT_RAD_S
from fullswarm.config.parameter import BARRIER_GAIN, SAFETY_MARGIN, Parameter
from fullswarm.core.outside import all_records
from fullswarm.core.roster import SILENCE_S
from fullswarm.errors import ConfigError
from fullswarm.messages import ParamEntry
from fullswarm.store import Store, Stored

Check = Callable[[str, object], Stored]
"""``check(key, value)`` returns the value to store or raises ``ConfigError``."""

INTERVAL = "schedule_interval_s"
SILENCE = "presence_silence_s"
PERFORMANCE = "performance/"
SPEED, TURN = "agent/speed_limit_m_s", "agent/turn_limit_rad_s"
MARGIN, GAIN = "agent/safety_margin_m", "agent/barrier_gain_per_s"
BOUNDS, BOXES = "world/bounds", "world/boxes"
SENSING = "agent/sensing_radius_m"
GROUP = "group/"

_LIMITS = {
    INTERVAL: Parameter(type="number", unit="s", min=0.0, max=10.0),
    SILENCE: Parameter(type="number", unit="s", min=0.6, max=60.0),
    SPEED: Parameter(type="number", unit="m/s", min=SPEED_LIMIT_M_S[0], max=SPEED_LIMIT_M_S[1]),
    TURN: Parameter(type="number", unit="rad/s", min=TURN_LIMIT_RAD_S[0], max=TURN_LIMIT_RAD_S[1]),
    MARGIN: SAFETY_MARGIN,
    GAIN: BARRIER_GAIN,
    BOUNDS: Parameter(type="points", unit="m"),
}


def seeds(config: SwarmConfig) -> dict[str, Stored]:
    """Return what the fleet file and ``behaviours.toml`` say, by key of the database."""
    world, agent = config.world, config.agent
    x_low, y_low, x_high, y_high = config.bounds_m
    values: dict[str, Stored] = {f"behaviour/{name}": record for name, record in all_records().items()}
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
    values |= {GROUP + name: {"robots": list(robots)} for name, robots in config.groups.items()}
    return values | {PERFORMANCE + name: value for name, value in config.performance.model_dump().items()}


class Settings:
    """Settings as they are now. Reading one costs nothing: they are kept until the database changes.

    Attributes
    ----------
    schedule_interval_s : rapid requests are spread over this
    presence_silence_s : a robot not heard for longer is absent
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
        raise ConfigError(str(error), hint=f"wanted: {_LIMITS[key].wanted()}") from None


def _validated(model: type[BaseModel], values: Mapping[str, object], key: str) -> BaseModel:
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ConfigError(f"{key} = {values[key.rpartition('/')[2]]!r}: {error.errors()[0]['msg']}") from None
