"""No module of the package imports itself, by whatever detour, not even for its type annotations."""

from __future__ import annotations

import grimp
import pytest


def circles(imports: dict[str, set[str]]) -> list[list[str]]:
    """Return what is left when modules that import nothing of what is left are taken away again and again."""
    left = {module: set(found) for module, found in imports.items()}
    while done := {module for module, found in left.items() if not found & left.keys()}:
        left = {module: found for module, found in left.items() if module not in done}
    while done := {module for module in left if not any(module in found for found in left.values())}:
        left = {module: found for module, found in left.items() if module not in done}
    return [sorted(left)] if left else []


def test_circles_are_found() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": set()}) == []
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b", "d"}, "d": set()}) == [["b", "c"]]


@pytest.mark.parametrize("annotations", [False, True])
def test_nothing_imports_itself(annotations: bool) -> None:
    graph = grimp.build_graph("fullswarm", exclude_type_checking_imports=not annotations, cache_dir=None)
    assert circles({module: graph.find_modules_directly_imported_by(module) for module in graph.modules}) == []
