"""A storm of invented names: nothing that other processes can fill grows without bound."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from types import FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
import pytest

from fullswarm.agent.neighbours import reception
from fullswarm.bus import local, versions
from fullswarm.operator.console import log
from fullswarm.perf import tallies
from fullswarm.recent import Names, Recent
from tests.unit.test_bus_wild import WORDS, Swarm
from tests.unit.wild import Wild

SMALL = 50
"""Every bound that is stated by `Recent` or `Names` is lowered to this: a short storm then reaches it."""
STORM = 350
MOST = 300
"""Entries of one container: twice what else is bounded at 64, 128 or 256, and what belongs to the swarm."""
LARGER = ("_union", "cells", "grid", "_marks", "history.entries")
"""Grids of the arena: of the size that the first measurement states; the console's log, of 5,000 lines."""
PLAIN = (str, bytes, int, float, bool, type(None), type, ModuleType, np.random.Generator)


class Inventive(Wild):
    """Gives nearly everything that has a name one that was never used before."""

    made = 0

    def _word(self) -> str:
        if self.chance.random() < 0.1:
            return super()._word()
        return self.new()

    def new(self) -> str:
        self.made += 1
        return f"x{self.made}"


def containers(roots: list[Any]) -> Iterator[tuple[str, Any]]:
    """Yield every container that can be reached from objects of this package, with the way to it."""
    seen: set[int] = set()
    stack = [(type(root).__name__, root) for root in roots]
    while stack:
        path, found = stack.pop()
        if id(found) in seen or isinstance(found, PLAIN):
            continue
        seen.add(id(found))
        inner: list[tuple[str, Any]] = []
        if isinstance(found, Mapping):
            yield path, found
            inner = [(f"{path}[{key!r}]", each) for key, each in list(found.items())[:2000]]
        elif isinstance(found, list | tuple | set | frozenset) or type(found).__name__ == "deque":
            yield path, found
            inner = [(f"{path}[]", each) for each in list(found)[:2000]]
        elif isinstance(found, np.ndarray):
            yield path, found
        elif isinstance(found, FunctionType):
            inner = [(path, cell.cell_contents) for cell in found.__closure__ or () if has_content(cell)]
        elif isinstance(found, MethodType):
            inner = [(path, found.__self__)]
        elif type(found).__module__.startswith(("fullswarm", "tests", "functools")):
            names = {*getattr(found, "__dict__", {}), *slots(type(found))}
            inner = [(f"{path}.{name}", getattr(found, name)) for name in names if hasattr(found, name)]
        stack += inner


def has_content(cell: Any) -> bool:
    try:
        return cell.cell_contents is not None
    except ValueError:
        return False


def slots(kind: type) -> list[str]:
    found = [getattr(each, "__slots__", ()) for each in kind.__mro__]
    return [name for each in found for name in ([each] if isinstance(each, str) else each)]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    recent, names = Recent.__init__, Names.__init__

    def small_recent(self: Recent[Any, Any], most: int) -> None:
        recent(self, min(most, SMALL))

    def small_names(self: Names, most: int, *others: Any) -> None:
        names(self, min(most, SMALL), *others)

    monkeypatch.setattr(Recent, "__init__", small_recent)
    monkeypatch.setattr(Names, "__init__", small_names)
    for module, bound in (
        (versions, "MOST"),
        (tallies, "HOSTS"),
        (log, "REMEMBERED"),
        (reception, "MOST_HOSTS"),
        (local, "CACHED_KEYS"),
    ):
        monkeypatch.setattr(module, bound, SMALL)


@pytest.mark.usefixtures("small")
def test_a_storm_of_invented_names_fills_no_memory() -> None:
    swarm, wild = Swarm(), Inventive(1, WORDS, misfits=0.0)
    for expression, kind in sorted(set(swarm.bus.addresses()), key=str):
        for number in range(STORM):
            parts = [wild.new() if part in ("*", "**") else part for part in expression.split("/")]
            swarm.bus.publish("/".join(parts), wild.message(kind))
            if number % 50 == 0:
                swarm.runtime.mailbox.drain()
        swarm.runtime.run(0.02)
    roots = [*swarm.core, swarm.centralised, *swarm.agents.values(), swarm.view, swarm.gateway, swarm.operator]
    grown = {
        re.sub(r"\[[^]]*\]", "[]", path): len(found) for path, found in containers(roots)
        if len(found) > MOST and not path.endswith(LARGER)
    }  # fmt: skip
    assert not grown, "\n".join(f"{size} {path}" for path, size in grown.items())
