"""The fault matrix as a test: whatever happens, wheels come to zero in time. See docs/safety.md for the table."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator

import pytest

from tests.system.fault_matrix import BACKENDS, FAULTS, Result, Round, full_rounds, quick_rounds
from tests.system.fault_rounds import Matrix

pytestmark = pytest.mark.system

LOOK_S = 0.2
"""The world is stepped and looked at each 5 ms, on a machine that may be busy; docs/safety.md has the bare figures."""
BRAKE_S = 1.2


@pytest.fixture(scope="module")
def matrix() -> Iterator[Matrix]:
    made = Matrix()
    yield made
    made.close()


def judge(happens: Round, results: list[Result], capsys: pytest.CaptureFixture[str]) -> None:
    with capsys.disabled():
        sys.stdout.write("\n" + "\n".join(map(str, results)) + "\n")
    assert sorted(each.fault for each in results) == sorted(happens.values())
    late = [each for each in results if not each.zero_s <= each.bound_s + LOOK_S]
    assert not late, "\n".join(map(str, late))
    rolls = [each for each in results if math.isfinite(each.bound_s) and not each.rest_s <= each.bound_s + BRAKE_S]
    assert not rolls, "\n".join(map(str, rolls))


def test_quick_rounds_have_each_fault_once_and_each_backend_twice() -> None:
    cells = [(name, robot) for happens in quick_rounds() for robot, name in happens.items()]
    assert {name for name, _ in cells} == set(FAULTS)
    assert all(sum(robot == each for _, robot in cells) >= 2 for each in BACKENDS)
    assert all(robot in FAULTS[name].robots for name, robot in cells)


@pytest.mark.parametrize("happens", quick_rounds(), ids=lambda each: "+".join(sorted(set(each.values()))))
def test_each_fault_once(matrix: Matrix, happens: dict[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    judge(happens, matrix.run(happens), capsys)


@pytest.mark.slow
@pytest.mark.parametrize("happens", full_rounds(), ids=lambda each: next(iter(each.values())))
def test_each_fault_on_each_backend(
    matrix: Matrix, happens: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    judge(happens, matrix.run(happens), capsys)
