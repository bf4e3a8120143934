"""One fleet for all tests of a run; what they measured is printed at the end."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from tests.fleet.fleet import Figures, Fleet
from tests.fleet.lab import Lab
from tests.fleet.tools import Missing, missing

FIGURES = Figures()


@pytest.fixture(scope="session")
def whole_fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    """Yield 16 robots (``FULLSWARM_TEST_ROBOTS``) with our newest release on them."""
    if lacking := missing():
        pytest.skip(f"no fleet of containers: {lacking}")
    try:
        lab = Lab(int(os.environ.get("FULLSWARM_TEST_ROBOTS", "16")), tmp_path_factory.mktemp("fleet"))
        with lab:
            yield Fleet(lab, FIGURES)
    except Missing as error:
        pytest.skip(f"no fleet of containers: {error}")


@pytest.fixture
def fleet(whole_fleet: Fleet) -> Fleet:
    """Return the fleet with nothing wrong and all robots on the first release."""
    whole_fleet.settle()
    return whole_fleet


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the figures."""
    if FIGURES.rows:
        terminalreporter.section("fleet: what was measured")
        for line in FIGURES.lines():
            terminalreporter.write_line(line)
