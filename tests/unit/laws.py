"""Control laws that exist for a test only, as if their packages were installed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from fullswarm import registry


def install(monkeypatch: pytest.MonkeyPatch, **laws: Any) -> None:
    """Have `registry.law_module` find these laws: a function, which is a ``velocity``, or a namespace of a module's."""
    modules = {name: SimpleNamespace(velocity=law) if callable(law) else law for name, law in laws.items()}
    found = registry.law_module
    monkeypatch.setattr(registry, "law_module", lambda name: modules.get(name) or found(name))
