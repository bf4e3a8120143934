"""Kernels compiled give what they give in plain Python, with named tuples too, which compiled code does not have."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pytest

from fullswarm import kernels
from fullswarm.kernels import Array, Kernel, bound


class Pair(NamedTuple):
    """Two columns."""

    first: Array
    second: Array


def difference(pair: Pair, i: int) -> float:
    return float(pair.first[i] - pair.second[i])


def apart(scale: float, pair: Pair, out: Array) -> float:
    first, second = pair
    total = 0.0
    for i in range(pair.first.shape[0]):
        out[i] = scale * inner(pair, i) + first[i] * second[i]
        total += out[i]
    return total


def nested(pair: Pair, i: int) -> float:
    return inner((pair.first, pair.second), i)  # type: ignore[arg-type]  # a tuple that has no name


inner = Kernel(difference)


@pytest.fixture
def pair() -> Pair:
    rng = np.random.default_rng(7)
    return Pair(rng.normal(size=5), rng.normal(size=5))


def test_named_tuples_are_read_unpacked_and_passed_on_alike(pair: Pair) -> None:
    kernel = Kernel(apart)
    plain, compiled = np.zeros(5), np.zeros(5)
    total = kernel.run(2.0, pair, plain)
    kernel.compile()
    assert kernel.run is not kernel.plain
    assert kernel.run(2.0, pair, compiled) == total
    assert compiled.tolist() == plain.tolist()
    assert kernel.run(scale=2.0, pair=pair, out=compiled) == total
    swapped = Pair(pair.second, pair.first)
    assert kernel.run(2.0, swapped, compiled) != total


def total(pair: Pair, out: Array, scale: float, other: Pair) -> float:
    for i in range(out.shape[0]):
        out[i] = scale * (pair.first[i] - other.second[i])
    return float(out[0])


def test_a_bound_call_gives_what_the_whole_call_gives_and_reads_arrays_anew(pair: Pair) -> None:
    kernel, other = Kernel(total), Pair(pair.second + 1.0, pair.first + 1.0)
    expected, out = np.zeros(5), np.zeros(5)
    in_python = bound(partial(kernel.run, pair, out))
    kernel.compile()
    calls = [in_python, bound(partial(kernel.run, pair, out)), bound(kernel.run), bound(partial(kernel.run, pair))]
    rest: list[tuple[Any, ...]] = [(2.0, other), (2.0, other), (pair, out, 2.0, other), (out, 2.0, other)]
    for _ in range(2):
        kernel.run(pair, expected, 2.0, other)
        for call, arguments in zip(calls, rest, strict=True):
            out.fill(0.0)
            whole: Any = call
            assert whole(*arguments) == expected[0]
            assert out.tolist() == expected.tolist()
        pair.first[:] += 1.0
    too_few: Any = calls[1]
    with pytest.raises(TypeError):
        too_few(2.0)


def summed(count: int) -> float:
    made = np.ones(count)
    return float(made.sum())


def by_another(pair: Pair, out: Array) -> float:
    return making(out.shape[0]) + float(pair.first[0])


making = Kernel(summed)


def test_only_kernels_that_make_arrays_count_references(pair: Pair) -> None:
    fills, makes_by_another = Kernel(total), Kernel(by_another)
    expected = makes_by_another.run(pair, np.zeros(5))
    for kernel in (making, fills, makes_by_another):
        kernel.compile()
    fills.run(pair, np.zeros(5), 1.0, pair)
    assert makes_by_another.run(pair, np.zeros(5)) == expected
    assert not counts_references(fills)
    assert counts_references(makes_by_another)


def counts_references(kernel: Kernel[Any, Any]) -> bool:
    compiled: Any = kernel.compiled
    return bool(compiled.targetoptions.get("_nrt", True))


def test_a_named_tuple_without_a_name_is_refused_when_it_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernels, "_ALL", [])  # other tests compile all that are there
    with pytest.raises(TypeError, match="by its name"):
        Kernel(nested).compile()
