"""The Robotarium's own simulator beside ours in one process: each import of ``rps`` begins from nothing."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

ALIAS = "fullswarm.robotarium.as_rps"


@contextmanager
def fresh_rps() -> Iterator[None]:
    """Forget all modules of ``rps``, and bring them back at the end; warnings of that package are not ours."""
    before = {name: module for name, module in sys.modules.items() if _is_rps(name)}
    _forget()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        _forget()
        sys.modules.update(before)


def _is_rps(name: str) -> bool:
    return name == "rps" or name.startswith("rps.") or name == ALIAS


def _forget() -> None:
    for name in [each for each in sys.modules if _is_rps(each)]:
        del sys.modules[name]
