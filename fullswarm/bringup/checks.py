"""Defines one line of a check-up: what was checked, its status, and what fixes it; prints all of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal

from fullswarm import output
from fullswarm.config import SwarmConfig
from fullswarm.errors import ConfigError

Status = Literal["ok", "warning", "failure"]


@dataclass(frozen=True, slots=True)
class Check:
    """One line of the report; `mend` is a command or advice that fixes it, empty when nothing is to be done."""

    name: str
    status: Status
    what: str
    mend: str = ""

    @property
    def line(self) -> str:
        """Return it for people: one line, or two with the fix."""
        text = f"{self.status:8} {self.name}: {self.what}"
        return f"{text}\n{'':8} fix: {self.mend}" if self.mend else text


def show(checks: Iterable[Check], *, as_json: bool, about: dict[str, Any] | None = None) -> int:
    """Print each check as it comes, or all as JSON behind what they are `about`; return how many failed.

    `about` is read at the end: the checks may fill it meanwhile.
    """
    done = []
    for check in checks:
        done.append(check)
        if not as_json:
            output.data(check.line)
    failed = sum(each.status == "failure" for each in done)
    if as_json:
        output.data_json({**(about or {}), "ok": not failed, "checks": [asdict(each) for each in done]})
    else:
        warned = sum(each.status == "warning" for each in done)
        output.progress(f"{len(done)} checks: {failed} failures, {warned} warnings")
    return failed


def took(seconds: float) -> str:
    """Return a duration as people write it: ``3.4 ms``, ``1.25 s``."""
    return f"{seconds:.3g} s" if seconds >= 1.0 else f"{1e3 * seconds:.3g} ms"


def stopping(config: SwarmConfig) -> Iterator[Check]:
    """Check that a fleet's robots sense each other early enough to stop, and filter noisy poses."""
    from fullswarm.launch.stopping import check_fleet

    try:
        needed, warning = check_fleet(config)
    except ConfigError as error:
        yield Check("stopping distance", "failure", error.what, error.hint)
        return
    yield Check("stopping distance", "ok", needed)
    if warning:
        yield Check("estimator", "warning", warning, "agent.estimator = 'auto'")
