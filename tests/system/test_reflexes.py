"""The fault matrix as a test: whatever happens, wheels come to zero in time. See docs/safety.md for the table."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator

import pytest

from tests.system.fault_matrix import BACKENDS, FAULTS, Result, Round, full_rounds, quick_rounds
from tests.system.fault_rounds import Matrix

LOOK_S = 0.05
"""The world is looked at each 5 ms, by a machine that has other work; docs/safety.md has the bare figures."""
TRIES = 3
"""What a busy machine delays comes in time in another round; a stop that is really late is late in each."""
BRAKE_S = 1.2


@pytest.fixture(scope="module")
def matrix() -> Iterator[Matrix]:
    made = Matrix()
    yield made
    made.close()


def late(result: Result) -> bool:
    if not result.zero_s <= result.bound_s + LOOK_S:
        return True
    return math.isfinite(result.bound_s) and not result.rest_s <= result.bound_s + BRAKE_S


def judge(matrix: Matrix, happens: Round, capsys: pytest.CaptureFixture[str]) -> None:
    missed = dict.fromkeys(BACKENDS.values(), 0)
    for _ in range(TRIES):
        results = matrix.run(happens)
        with capsys.disabled():
            sys.stdout.write("\n" + "\n".join(map(str, results)) + "\n")
        assert sorted(each.fault for each in results) == sorted(happens.values())
        for each in results:
            missed[each.backend] += late(each)
        if not any(map(late, results)):
            return
    always = [f"{each}: late in {TRIES} of {TRIES} rounds" for each in results if missed[each.backend] == TRIES]
    assert not always, "\n".join(always)


def test_quick_rounds_have_each_fault_once_and_each_backend_twice() -> None:
    cells = [(name, robot) for happens in quick_rounds() for robot, name in happens.items()]
    assert {name for name, _ in cells} == set(FAULTS)
    assert all(sum(robot == each for _, robot in cells) >= 2 for each in BACKENDS)
    assert all(robot in FAULTS[name].robots for name, robot in cells)


@pytest.mark.parametrize("happens", quick_rounds(), ids=lambda each: "+".join(sorted(set(each.values()))))
def test_each_fault_once(matrix: Matrix, happens: dict[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    judge(matrix, happens, capsys)


@pytest.mark.slow
@pytest.mark.parametrize("happens", full_rounds(), ids=lambda each: next(iter(each.values())))
def test_each_fault_on_each_backend(
    matrix: Matrix, happens: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    judge(matrix, happens, capsys)
