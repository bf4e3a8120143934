"""The rollout as a machine: canary, waves, stop at k failures, whatever robots do."""

from __future__ import annotations

import asyncio
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.deploy.fleet import rollout
from fullswarm.deploy.fleet.rollout import (
    BAD,
    IN_PROGRESS,
    Outcome,
    Plan,
    Rollout,
    Stage,
    UpdateState,
    parse_share,
    perform_rollout,
)
from fullswarm.errors import ConfigError

STAGED_AS = (Stage.STAGED, Stage.STAGED, Stage.STAGED, Stage.CURRENT, Stage.FAILED, Stage.UNREACHABLE)
SWITCHED_AS = (Stage.HEALTHY, Stage.HEALTHY, *sorted(BAD), Stage.REFUSED, Stage.UNREACHABLE, Stage.FAILED)


def staged(rollout: Rollout) -> Rollout:
    for robot in rollout.due():
        rollout = rollout.begun(robot).after(robot, Stage.STAGED)
    return rollout


def robots(count: int) -> tuple[str, ...]:
    return tuple(f"r{number}" for number in range(1, count + 1))


def finish(rollout: Rollout, stage: Stage = Stage.HEALTHY) -> tuple[Rollout, list[str]]:
    """Let all switch that may now."""
    due = list(rollout.due())
    for robot in due:
        rollout = rollout.begun(robot)
    for robot in due:
        rollout = rollout.after(robot, stage)
    return rollout, due


def test_one_then_a_quarter_then_the_rest() -> None:
    rollout = staged(Rollout.of(robots(8), Plan()))
    waves = []
    while not rollout.over:
        rollout, due = finish(rollout)
        waves.append(due)
    assert waves == [["r1"], ["r2"], ["r3", "r4", "r5", "r6", "r7", "r8"]]
    assert set(rollout.stages.values()) == {Stage.HEALTHY}


def test_nobody_switches_before_all_are_staged() -> None:
    rollout = Rollout.of(robots(3), Plan())
    rollout = rollout.begun("r1").after("r1", Stage.STAGED).begun("r2")
    assert rollout.due() == {"r3": Stage.STAGING}
    rollout = rollout.begun("r3").after("r3", Stage.STAGED)
    assert rollout.due() == {}
    assert rollout.after("r2", Stage.UNREACHABLE).due() == {"r1": Stage.SWITCHING}


def test_a_canary_that_is_moving_or_away_is_replaced_and_does_not_count() -> None:
    rollout = staged(Rollout.of(robots(4), Plan(stop_at=1)))
    rollout, _ = finish(rollout, Stage.REFUSED)
    rollout, due = finish(rollout, Stage.UNREACHABLE)
    assert due == ["r2"]
    rollout, due = finish(rollout)
    assert due == ["r3"]
    assert not rollout.stopped
    assert finish(rollout)[1] == ["r4"]


@pytest.mark.parametrize("failure", sorted(BAD))
def test_failures_stop_it_and_the_rest_keep_what_they_run(failure: Stage) -> None:
    rollout = staged(Rollout.of(robots(8), Plan(stop_at=2)))
    rollout, _ = finish(rollout, failure)
    assert not rollout.stopped
    rollout, _ = finish(rollout, failure)
    assert rollout.stopped
    assert rollout.over
    assert list(rollout.stages.values()).count(Stage.STAGED) == 6


def test_who_runs_it_already_is_no_canary_and_no_wave() -> None:
    rollout = Rollout.of(robots(16), Plan())
    for robot in robots(16):
        rollout = rollout.begun(robot).after(robot, Stage.CURRENT if robot in robots(4) else Stage.STAGED)
    waves = []
    while not rollout.over:
        rollout, due = finish(rollout)
        waves.append(len(due))
    assert waves == [1, 2, 9]  # a quarter of the twelve that do not


def test_events_out_of_turn_are_mistakes() -> None:
    rollout = Rollout.of(robots(1), Plan())
    with pytest.raises(ValueError, match="cannot be 'updated' after 'waiting'"):
        rollout.after("r1", Stage.HEALTHY)
    with pytest.raises(ValueError, match="is 'waiting'"):
        rollout.again("r1")
    with pytest.raises(KeyError):
        rollout.begun("r1").begun("r1")


@pytest.mark.parametrize("plan", [(-1, 0.25, 1), (1, 0.0, 1), (1, 1.1, 1), (1, 0.25, 0)])
def test_plans_that_are_none(plan: tuple[int, float, int]) -> None:
    with pytest.raises(ConfigError, match="no plan"):
        Plan(*plan)


def test_a_share_of_the_robots() -> None:
    assert (parse_share("25%"), parse_share("100")) == (0.25, 1.0)
    with pytest.raises(ConfigError, match="--wave: invalid share 'a few'"):
        parse_share("a few")


@given(st.data())
def test_whatever_robots_do_in_whatever_order(data: st.DataObject) -> None:
    count = data.draw(st.integers(1, 12))
    plan = Plan(
        data.draw(st.integers(0, 3)), data.draw(st.sampled_from([0.1, 0.25, 0.5, 1.0])), data.draw(st.integers(1, 4))
    )
    rollout = Rollout.of(robots(count), plan)
    switched: set[str] = set()
    while not rollout.over:
        hands = [robot for robot, stage in rollout.stages.items() if stage in IN_PROGRESS]
        due = rollout.due()
        robot = data.draw(st.sampled_from(sorted({*hands, *due})))
        if robot in due:
            if due[robot] is Stage.SWITCHING:
                stages = list(rollout.stages.values())
                assert Stage.WAITING not in stages
                assert Stage.STAGING not in stages
                assert sum(each in BAD for each in stages) < plan.stop_at
                good, others = stages.count(Stage.HEALTHY), count - stages.count(Stage.CURRENT)
                tried = good + sum(each in BAD for each in stages)
                switching = stages.count(Stage.SWITCHING)
                if good < min(plan.canary, others):
                    assert good + switching < plan.canary
                elif tried < math.ceil(plan.wave * others):
                    assert tried + switching < max(math.ceil(plan.wave * others), plan.canary)
                assert robot not in switched
                switched.add(robot)
            rollout = rollout.begun(robot)
        else:
            ends = STAGED_AS if rollout.stages[robot] is Stage.STAGING else SWITCHED_AS
            rollout = rollout.after(robot, data.draw(st.sampled_from(ends)))
    left = set(rollout.stages.values())
    assert not left & (IN_PROGRESS | {Stage.WAITING})
    assert Stage.STAGED not in left or rollout.stopped


# ---------------------------------------------------------------- performing it
def test_never_more_at_a_time_than_asked_for() -> None:
    busy, most = 0, 0

    async def hands(robot: str, stage: Stage) -> Outcome:
        nonlocal busy, most
        busy += 1
        most = max(most, busy)
        await asyncio.sleep(0)
        busy -= 1
        return Outcome(Stage.STAGED if stage is Stage.STAGING else Stage.HEALTHY, "")

    board = UpdateState(Rollout.of(robots(10), Plan(canary=0, wave=1.0)))
    asyncio.run(perform_rollout(board, hands, at_a_time=3))
    assert most == 3
    assert set(board.rollout.stages.values()) == {Stage.HEALTHY}


def test_an_interrupted_one_says_where_each_robot_stands() -> None:
    async def main() -> UpdateState:
        board = UpdateState(Rollout.of(robots(3), Plan()))
        reached = asyncio.Event()

        async def hands(robot: str, stage: Stage) -> Outcome:
            if stage is Stage.STAGING:
                return Outcome(Stage.STAGED, "has it")
            reached.set()
            await asyncio.Event().wait()
            raise AssertionError

        task = asyncio.create_task(perform_rollout(board, hands))
        await reached.wait()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        board.interrupted(60.0)
        return board

    board = asyncio.run(main())
    assert "rolls back on its own within 60 s" in board.outcomes["r1"].what
    assert board.outcomes["r2"].what == "has it"


@pytest.mark.parametrize("error", [OSError(28, "No space left on device", "/tmp/x"), TimeoutError()])
def test_a_fault_of_this_computer_is_one_robots_and_ends_no_others_work(error: OSError) -> None:
    async def hands(robot: str, stage: Stage) -> Outcome:
        if stage is Stage.STAGING:
            return Outcome(Stage.STAGED, "")
        if robot == "r1":
            raise error
        for _ in range(5):
            await asyncio.sleep(0)
        return Outcome(Stage.HEALTHY, "")

    board = UpdateState(Rollout.of(robots(3), Plan(canary=0, wave=1.0)))
    asyncio.run(perform_rollout(board, hands))
    assert list(board.rollout.stages.values()) == [Stage.FAILED, Stage.HEALTHY, Stage.HEALTHY]
    why = "No space left on device: /tmp/x" if error.errno else "OSError"
    assert board.outcomes["r1"].what == f"error on this computer: {why}"
    assert "its guard rolls it back" in board.outcomes["r1"].mend


def test_a_bug_lets_those_finish_that_are_in_hand_and_begins_with_nobody() -> None:
    begun = []

    async def hands(robot: str, stage: Stage) -> Outcome:
        if stage is Stage.STAGING:
            return Outcome(Stage.STAGED, "")
        begun.append(robot)
        if robot == "r1":
            raise KeyError("a bug")
        for _ in range(5):
            await asyncio.sleep(0)
        return Outcome(Stage.HEALTHY, "")

    board = UpdateState(Rollout.of(robots(4), Plan(canary=0, wave=1.0)))
    with pytest.raises(KeyError, match="a bug"):
        asyncio.run(perform_rollout(board, hands, at_a_time=2))
    assert begun == ["r1", "r2"]
    assert board.rollout.stages["r2"] is Stage.HEALTHY


def test_who_was_away_is_tried_again_for_so_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rollout, "TRY_AGAIN_S", 0.0)
    calls = []

    async def hands(robot: str, stage: Stage) -> Outcome:
        calls.append(stage)
        if stage is Stage.STAGING:
            return Outcome(Stage.UNREACHABLE if len(calls) < 3 else Stage.STAGED, "")
        return Outcome(Stage.HEALTHY, "")

    board = UpdateState(Rollout.of(("r1",), Plan()))
    asyncio.run(perform_rollout(board, hands, keep_trying_s=60.0))
    assert board.rollout.stages["r1"] is Stage.HEALTHY
    assert calls == [Stage.STAGING, Stage.STAGING, Stage.STAGING, Stage.SWITCHING]
