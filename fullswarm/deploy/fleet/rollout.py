"""Decides which robots may switch: stage to all, a canary, a wave, the rest; stop at k failures. No network, no clock.

::

    WAITING ─ STAGING ─┬─ STAGED ─ SWITCHING ─┬─ HEALTHY
                       │                      ├─ ROLLED_BACK   unhealthy: the base or the robot took it back
                       │                      ├─ LOST          silent since the switch: its guard takes it back
                       │                      ├─ REFUSED       moving, or something else the robot minds
                       ├─ CURRENT             └─ UNREACHABLE   before the switch
                       ├─ FAILED       cannot take this release: signature, disk, arch
                       └─ UNREACHABLE  ─ again ─▶ WAITING

Only what tells against the release counts as a failure: ROLLED_BACK and LOST. A robot that is moving or switched
off says nothing about it, and the next one takes its place as canary.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

from fullswarm.errors import ConfigError


class Stage(StrEnum):
    """Where one robot stands."""

    WAITING = "waiting"
    STAGING = "staging"
    STAGED = "staged"
    SWITCHING = "switching"
    HEALTHY = "updated"
    CURRENT = "unchanged"
    ROLLED_BACK = "rolled back"
    LOST = "lost"
    REFUSED = "refused"
    FAILED = "failed"
    UNREACHABLE = "unreachable"


GOOD = frozenset({Stage.HEALTHY, Stage.CURRENT})
BAD = frozenset({Stage.ROLLED_BACK, Stage.LOST})
IN_HAND = frozenset({Stage.STAGING, Stage.SWITCHING})
_AFTER = {
    Stage.STAGING: frozenset({Stage.STAGED, Stage.CURRENT, Stage.FAILED, Stage.UNREACHABLE, Stage.REFUSED}),
    Stage.SWITCHING: frozenset({Stage.HEALTHY, Stage.REFUSED, Stage.FAILED, Stage.UNREACHABLE}) | BAD,
}


@dataclass(frozen=True, slots=True)
class Plan:
    """How careful to be.

    Parameters
    ----------
    canary
        So many robots run the release first; all of them must be healthy.
    wave
        Share of the robots that do not run it yet, 0 to 1, that may do so before the rest.
    stop_at
        With so many failures no further robot switches.
    """

    canary: int = 1
    wave: float = 0.25
    stop_at: int = 2

    def __post_init__(self) -> None:
        if self.canary < 0 or not 0 < self.wave <= 1 or self.stop_at < 1:
            hint = "a canary of 0 or more robots, a wave above 0 % and up to 100 %, to stop at 1 failure or more"
            raise ConfigError("no plan for an update", hint=hint)


@dataclass(frozen=True, slots=True)
class Rollout:
    """All robots of an update; a new one after each event."""

    plan: Plan
    stages: Mapping[str, Stage]

    @classmethod
    def of(cls, robots: tuple[str, ...], plan: Plan) -> Rollout:
        """Begin with robots in the order in which they shall be tried."""
        return cls(plan, dict.fromkeys(robots, Stage.WAITING))

    @property
    def stopped(self) -> bool:
        """Too many failures: a robot that has not switched keeps what it runs."""
        return self._count(BAD) >= self.plan.stop_at

    @property
    def over(self) -> bool:
        """Nothing is in hand and nothing is due."""
        return not self._count(IN_HAND) and not self.due()

    def due(self) -> dict[str, Stage]:
        """Robots that may be taken in hand now, with the stage they enter: STAGING or SWITCHING."""
        waiting = self._in(Stage.WAITING)
        if waiting:
            return dict.fromkeys(waiting, Stage.STAGING)
        if self.stopped or self._in(Stage.STAGING):
            return {}
        return dict.fromkeys(self._in(Stage.STAGED)[: self._room()], Stage.SWITCHING)

    def begun(self, robot: str) -> Rollout:
        """Take a robot in hand that is due."""
        return self._with(robot, self.due()[robot])

    def after(self, robot: str, stage: Stage) -> Rollout:
        """Say what became of a robot in hand."""
        now = self.stages[robot]
        if stage not in _AFTER.get(now, ()):
            raise ValueError(f"{robot} cannot be '{stage}' after '{now}'")
        return self._with(robot, stage)

    def again(self, robot: str) -> Rollout:
        """Begin anew with a robot that could not be reached, or was moving."""
        if self.stages[robot] not in (Stage.UNREACHABLE, Stage.REFUSED):
            raise ValueError(f"{robot} is '{self.stages[robot]}'")
        return self._with(robot, Stage.WAITING)

    def _room(self) -> int:
        """How many more robots may switch, by what has become of those before."""
        # A robot that ran the release before is no evidence for how the others take the switch.
        everybody = len(self.stages) - self._count({Stage.CURRENT})
        switching, good, bad = self._count({Stage.SWITCHING}), self._count({Stage.HEALTHY}), self._count(BAD)
        if good < min(self.plan.canary, everybody):
            return max(0, self.plan.canary - good - switching)
        # Good and bad: the wave is over when all of it has been heard of, not when it has been sent.
        wave = max(math.ceil(self.plan.wave * everybody), self.plan.canary)
        return everybody if good + bad >= wave else max(0, wave - good - bad - switching)

    def _in(self, stage: Stage) -> list[str]:
        return [robot for robot, each in self.stages.items() if each is stage]

    def _count(self, which: frozenset[Stage] | set[Stage]) -> int:
        return sum(each in which for each in self.stages.values())

    def _with(self, robot: str, stage: Stage) -> Rollout:
        return replace(self, stages={**self.stages, robot: stage})


def share(text: str) -> float:
    """``25%`` → 0.25.

    Raises
    ------
    ConfigError
        It is no percentage.
    """
    try:
        return float(text.removesuffix("%")) / 100.0
    except ValueError:
        raise ConfigError(f"'{text}' is no share of the robots", where="--wave", hint="--wave 25%") from None
