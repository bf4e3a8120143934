"""Decides which robots may switch: stage to all, a canary, a wave, the rest; stop at k failures. Performs it.

::

    WAITING ─ STAGING ─┬─ STAGED ─ SWITCHING ─┬─ HEALTHY
                       │                      ├─ ROLLED_BACK   unhealthy: the base or the robot rolled back
                       │                      ├─ LOST          silent since the switch: its guard rolls back
                       │                      ├─ REFUSED       moving, or something else that the robot refuses
                       ├─ CURRENT             └─ UNREACHABLE   before the switch
                       ├─ FAILED       cannot take this release: signature, disk, arch
                       └─ UNREACHABLE  ─ again ─▶ WAITING

Only what speaks against the release counts as a failure: ROLLED_BACK and LOST. A robot that is moving or switched
off is no evidence about it, and the next one takes its place as canary. :class:`Rollout` uses no network and no clock;
:func:`perform_rollout` takes so many robots at a time until nothing is due.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

from fullswarm.errors import ConfigError


class Stage(StrEnum):
    """The state of one robot in a rollout."""

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
IN_PROGRESS = frozenset({Stage.STAGING, Stage.SWITCHING})
_AFTER = {
    Stage.STAGING: frozenset({Stage.STAGED, Stage.CURRENT, Stage.FAILED, Stage.UNREACHABLE, Stage.REFUSED}),
    Stage.SWITCHING: frozenset({Stage.HEALTHY, Stage.REFUSED, Stage.FAILED, Stage.UNREACHABLE}) | BAD,
}


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of one robot, and what to do."""

    stage: Stage
    what: str
    mend: str = ""
    release: str = ""
    shipped_bytes: int = 0
    changed: tuple[str, ...] = ()
    exit_code: int = 1


@dataclass(frozen=True, slots=True)
class Plan:
    """How many robots switch at a time, and when to stop.

    Parameters
    ----------
    canary
        Number of robots that run the release first; all of them must be healthy.
    wave
        Share of the robots that do not run it yet, 0 to 1, that may do so before the rest.
    stop_at
        Number of failures after which no further robot switches.
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
        """Start with robots in the order in which they are tried."""
        return cls(plan, dict.fromkeys(robots, Stage.WAITING))

    @property
    def stopped(self) -> bool:
        """Too many failures: a robot that has not switched keeps what it runs."""
        return self._count(BAD) >= self.plan.stop_at

    @property
    def over(self) -> bool:
        """No robot is in progress and none is due."""
        return not self._count(IN_PROGRESS) and not self.due()

    def due(self) -> dict[str, Stage]:
        """Return the robots that may start a step now, with the stage they enter: STAGING or SWITCHING."""
        waiting = self._in(Stage.WAITING)
        if waiting:
            return dict.fromkeys(waiting, Stage.STAGING)
        if self.stopped or self._in(Stage.STAGING):
            return {}
        return dict.fromkeys(self._in(Stage.STAGED)[: self._room()], Stage.SWITCHING)

    def begun(self, robot: str) -> Rollout:
        """Return it after a robot that is due has started its step."""
        return self._with(robot, self.due()[robot])

    def after(self, robot: str, stage: Stage) -> Rollout:
        """Return it after a robot has finished its step."""
        now = self.stages[robot]
        if stage not in _AFTER.get(now, ()):
            raise ValueError(f"{robot} cannot be '{stage}' after '{now}'")
        return self._with(robot, stage)

    def again(self, robot: str) -> Rollout:
        """Return it with a robot waiting again that could not be reached, or was moving."""
        if self.stages[robot] not in (Stage.UNREACHABLE, Stage.REFUSED):
            raise ValueError(f"{robot} is '{self.stages[robot]}'")
        return self._with(robot, Stage.WAITING)

    def _room(self) -> int:
        """Return how many more robots may switch, by the results so far."""
        # A robot that ran the release already is no evidence about the switch of the others.
        total = len(self.stages) - self._count({Stage.CURRENT})
        switching, good, bad = self._count({Stage.SWITCHING}), self._count({Stage.HEALTHY}), self._count(BAD)
        if good < min(self.plan.canary, total):
            return max(0, self.plan.canary - good - switching)
        # Good and bad: a wave is over when all its results are in, not when all of it has switched.
        wave = max(math.ceil(self.plan.wave * total), self.plan.canary)
        return total if good + bad >= wave else max(0, wave - good - bad - switching)

    def _in(self, stage: Stage) -> list[str]:
        return [robot for robot, each in self.stages.items() if each is stage]

    def _count(self, which: frozenset[Stage] | set[Stage]) -> int:
        return sum(each in which for each in self.stages.values())

    def _with(self, robot: str, stage: Stage) -> Rollout:
        return replace(self, stages={**self.stages, robot: stage})


def parse_share(text: str) -> float:
    """``25%`` → 0.25.

    Raises
    ------
    ConfigError
        It is not a percentage.
    """
    try:
        return float(text.removesuffix("%")) / 100.0
    except ValueError:
        raise ConfigError(
            f"invalid share '{text}'; expected a percentage", where="--wave", hint="for example 25%"
        ) from None


# ---------------------------------------------------------------- performing it
AT_A_TIME = 8
TRY_AGAIN_S = 5.0

RobotStep = Callable[[str, Stage], Awaitable[Outcome]]


@dataclass(slots=True)
class UpdateState:
    """The rollout and its results so far."""

    rollout: Rollout
    outcomes: dict[str, Outcome] = field(default_factory=dict)

    def begin(self, robot: str) -> Stage:
        """Start the step of a robot that is due."""
        self.rollout = self.rollout.begun(robot)
        return self.rollout.stages[robot]

    def end(self, robot: str, outcome: Outcome) -> None:
        """Store the result of its step."""
        self.rollout = self.rollout.after(robot, outcome.stage)
        self.outcomes[robot] = outcome

    def again(self) -> int:
        """Let robots wait again that could not be reached or were moving; return how many."""
        late = [robot for robot, each in self.rollout.stages.items() if each in (Stage.UNREACHABLE, Stage.REFUSED)]
        for robot in late:
            self.rollout = self.rollout.again(robot)
        return len(late)

    def held(self) -> None:
        """Mark the robots that have the release but may not switch to it."""
        for robot, stage in self.rollout.stages.items():
            if stage is Stage.STAGED and robot in self.outcomes:
                outcome = self.outcomes[robot]
                self.outcomes[robot] = replace(outcome, what=f"held back: {outcome.what}", mend="update again")

    def interrupted(self, guard_s: float) -> None:
        """Store for each robot in progress in which state it is left."""
        for robot, stage in self.rollout.stages.items():
            if stage is Stage.STAGING:
                mend = "update again: it continues with what is missing"
                self.outcomes[robot] = Outcome(stage, "interrupted while staging: its release is unchanged", mend)
            elif stage is Stage.SWITCHING:
                what = f"interrupted at its switch: it rolls back on its own within {guard_s:.0f} s"
                self.outcomes[robot] = Outcome(stage, what, "then update again")
            elif stage is Stage.WAITING and robot not in self.outcomes:
                self.outcomes[robot] = Outcome(stage, "not started: nothing was changed", "update again")


async def perform_rollout(
    state: UpdateState, step: RobotStep, at_a_time: int = AT_A_TIME, keep_trying_s: float = 0.0
) -> None:
    """Perform all steps that are due. Cancelled, it ends every connection at once and keeps `state` as it is.

    Parameters
    ----------
    keep_trying_s
        Retry for so long with robots that cannot be reached or are moving.
    """
    now = asyncio.get_running_loop().time
    until_s = now() + keep_trying_s
    while True:
        await _round(state, step, at_a_time)
        if state.rollout.stopped or now() >= until_s or not state.again():
            return
        await asyncio.sleep(min(TRY_AGAIN_S, keep_trying_s))


async def _round(state: UpdateState, step: RobotStep, at_a_time: int) -> None:
    running: dict[asyncio.Task[Outcome], str] = {}
    failure: Exception | None = None
    try:
        while True:
            for robot in list(state.rollout.due())[: at_a_time - len(running)] if failure is None else ():
                stage = state.begin(robot)
                running[asyncio.ensure_future(_step(step, robot, stage))] = robot
            if not running:
                break
            done, _ = await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
            for each in done:
                robot = running.pop(each)
                try:
                    state.end(robot, each.result())
                except Exception as error:  # others may be switching: they finish, no new one starts
                    failure = failure or error
    finally:
        for each in running:
            each.cancel()
        await asyncio.gather(*running, return_exceptions=True)
    if failure is not None:
        raise failure


async def _step(step: RobotStep, robot: str, stage: Stage) -> Outcome:
    try:
        return await step(robot, stage)
    except OSError as error:  # of this computer: a full disk, a key file, too many open files
        what = ": ".join(filter(None, (error.strerror or str(error) or "OSError", str(error.filename or ""))))
        mend = "if it switched, its guard rolls it back; " if stage is Stage.SWITCHING else ""
        return Outcome(Stage.FAILED, f"error on this computer: {what}", f"{mend}update again")
