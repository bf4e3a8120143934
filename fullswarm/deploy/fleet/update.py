"""Performs a rollout: so many robots at a time, until nothing is due. Interrupted, it says where each stands."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace

from fullswarm.deploy.fleet.rollout import Rollout, Stage
from fullswarm.deploy.fleet.work import Outcome

AT_A_TIME = 8
TRY_AGAIN_S = 5.0

Hands = Callable[[str, Stage], Awaitable[Outcome]]


@dataclass(slots=True)
class Board:
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


async def perform(board: Board, hands: Hands, at_a_time: int = AT_A_TIME, keep_trying_s: float = 0.0) -> None:
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


async def _round(board: Board, hands: Hands, at_a_time: int) -> None:
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


async def _hand(hands: Hands, robot: str, stage: Stage) -> Outcome:
    try:
        return await hands(robot, stage)
    except OSError as error:  # this computer's: a full disk, a key file, too many open files
        what = ": ".join(filter(None, (error.strerror or str(error) or "OSError", str(error.filename or ""))))
        mend = "if it switched, its guard takes it back; " if stage is Stage.SWITCHING else ""
        return Outcome(Stage.FAILED, f"this computer fails: {what}", f"{mend}update again")
