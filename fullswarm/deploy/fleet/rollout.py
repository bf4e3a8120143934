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
class Outcome:
    """What became of one robot, and what to do."""

    stage: Stage
    what: str
    mend: str = ""
    release: str = ""
    shipped_bytes: int = 0
    changed: tuple[str, ...] = ()
    exit_code: int = 1


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


def parse_share(text: str) -> float:
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


# ---------------------------------------------------------------- performing it
AT_A_TIME = 8
TRY_AGAIN_S = 5.0

RobotStep = Callable[[str, Stage], Awaitable[Outcome]]


@dataclass(slots=True)
class UpdateState:
    """What is known of an update, at any moment."""

    rollout: Rollout
    outcomes: dict[str, Outcome] = field(default_factory=dict)

    def begin(self, robot: str) -> Stage:
        """Take a robot in hand."""
        self.rollout = self.rollout.begun(robot)
        return self.rollout.stages[robot]

    def end(self, robot: str, outcome: Outcome) -> None:
        """Write down what became of it."""
        self.rollout = self.rollout.after(robot, outcome.stage)
        self.outcomes[robot] = outcome

    def again(self) -> int:
        """Begin anew with robots that could not be reached or were moving; return how many."""
        late = [robot for robot, each in self.rollout.stages.items() if each in (Stage.UNREACHABLE, Stage.REFUSED)]
        for robot in late:
            self.rollout = self.rollout.again(robot)
        return len(late)

    def held(self) -> None:
        """Report that robots which have the release and may not switch to it keep what they run."""
        for robot, stage in self.rollout.stages.items():
            if stage is Stage.STAGED and robot in self.outcomes:
                outcome = self.outcomes[robot]
                self.outcomes[robot] = replace(outcome, what=f"held back: {outcome.what}", mend="update again")

    def interrupted(self, guard_s: float) -> None:
        """Say of each robot in hand in which state we leave it."""
        for robot, stage in self.rollout.stages.items():
            if stage is Stage.STAGING:
                mend = "update again: it goes on with what is missing"
                self.outcomes[robot] = Outcome(stage, "interrupted while staging: it runs what it ran", mend)
            elif stage is Stage.SWITCHING:
                what = f"interrupted at its switch: it goes back by itself within {guard_s:.0f} s"
                self.outcomes[robot] = Outcome(stage, what, "then update again")
            elif stage is Stage.WAITING and robot not in self.outcomes:
                self.outcomes[robot] = Outcome(stage, "not begun: nothing was changed", "update again")


async def perform_rollout(
    board: UpdateState, hands: RobotStep, at_a_time: int = AT_A_TIME, keep_trying_s: float = 0.0
) -> None:
    """Do all that is due. Cancelled, it lets go of every robot at once and leaves `board` as things stand.

    Parameters
    ----------
    keep_trying_s
        Try again for so long with robots that cannot be reached or are moving.
    """
    now = asyncio.get_running_loop().time
    until_s = now() + keep_trying_s
    while True:
        await _round(board, hands, at_a_time)
        if board.rollout.stopped or now() >= until_s or not board.again():
            return
        await asyncio.sleep(min(TRY_AGAIN_S, keep_trying_s))


async def _round(board: UpdateState, hands: RobotStep, at_a_time: int) -> None:
    running: dict[asyncio.Task[Outcome], str] = {}
    bug: Exception | None = None
    try:
        while True:
            for robot in list(board.rollout.due())[: at_a_time - len(running)] if bug is None else ():
                stage = board.begin(robot)
                running[asyncio.ensure_future(_hand(hands, robot, stage))] = robot
            if not running:
                break
            done, _ = await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
            for each in done:
                robot = running.pop(each)
                try:
                    board.end(robot, each.result())
                except Exception as error:  # others may be in the midst of their switch: no new one begins, they finish
                    bug = bug or error
    finally:
        for each in running:
            each.cancel()
        await asyncio.gather(*running, return_exceptions=True)
    if bug is not None:
        raise bug


async def _hand(hands: RobotStep, robot: str, stage: Stage) -> Outcome:
    try:
        return await hands(robot, stage)
    except OSError as error:  # this computer's: a full disk, a key file, too many open files
        what = ": ".join(filter(None, (error.strerror or str(error) or "OSError", str(error.filename or ""))))
        mend = "if it switched, its guard takes it back; " if stage is Stage.SWITCHING else ""
        return Outcome(Stage.FAILED, f"this computer fails: {what}", f"{mend}update again")
